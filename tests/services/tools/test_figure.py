"""`mrcdrl figure`: each image is drawn, shows what it says, and bad requests are refused."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from mrcdrl.common.config import load_config, to_toml
from mrcdrl.common.errors import CheckpointError, ConfigError, MrcdrlError, RunDirectoryError
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_files import write_weights
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.tools.figure import main

VIEW_PX = 32
FIRST_RUN = (0x12, 0x3C, 0x73)  # its colour among curves
SHORT = {"arena.view_px": str(VIEW_PX), "arena.max_frames": "40"}
FLAGS = [f"--{name}={value}" for name, value in SHORT.items()]


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with weights, configuration and records."""
    folder = tmp_path_factory.mktemp("runs") / "three"
    config = load_config("quick", {**SHORT, "arena.num_robots": "3"}, {})
    folder.mkdir()
    payload = weights_to_bytes(QNetwork("duel", view_px=VIEW_PX))
    write_weights(folder / "checkpoints" / "best.safetensors", payload, {})
    (folder / "config.toml").write_text(to_toml(config))
    state = RunState(config)
    with Recorder(folder, config) as recorder:
        for number in range(200):
            episode = EpisodeSummary("a", 0, number, Outcome.SUCCESS, 99, 1.0, 1, 0.1, 5, 2.0, 2)
            recorder.record_episode(episode, state, 0.5 * number)
        for k in range(3):
            judged = Evaluation("0", 1, k, 500 * k, 3, 100, 0.9, 0.1, 0.0,
                                (0.8, 1.0), 9.0, 9.0, 4.0, 9.0, 9.0, 1, 20.0)  # fmt: skip
            recorder.record_evaluation(state.observe_evaluation(judged, 30.0 * k))
    return folder


def drawn(out: Path, *argv: object) -> np.ndarray:
    """RGB of the figure."""
    assert main([*map(str, argv), "--out", str(out)]) == 0
    with Image.open(out) as image:
        return np.asarray(image.convert("RGB"))


def share(image: np.ndarray, colour: tuple[int, int, int]) -> float:
    return float((image == colour).all(axis=2).mean())


def above_legend(image: np.ndarray) -> np.ndarray:
    """The panel of an arena, whose targets and obstacles end above this row."""
    return image[: image.shape[0] * 6 // 7]


def test_an_arena_has_as_many_targets_as_robots(tmp_path: Path) -> None:
    one, four = (above_legend(drawn(tmp_path / "a.png", "arena", "--robots", n)) for n in (1, 4))
    blue = (0, 0, 255)
    assert share(four, blue) / share(one, blue) == pytest.approx(4, rel=0.2)


def test_an_arena_has_its_obstacles(tmp_path: Path) -> None:
    green, out = (0, 255, 0), tmp_path / "arena.png"
    assert share(drawn(out, "arena"), green) == 0
    given = ["--arena.obstacles_px", "[[300, 150, 40], [300, 450, 40]]"]
    discs = above_legend(drawn(out, "arena", *given))
    drawn_at_random = ["--arena.num_obstacles", 2, "--arena.obstacle_radius_px", 40]
    random = above_legend(drawn(out, "arena", *drawn_at_random))
    assert 0.015 < share(discs, green) < 2 * np.pi * 40**2 / 600**2
    assert share(random, green) == pytest.approx(share(discs, green), rel=0.05)


def test_views_show_obstacles(tmp_path: Path) -> None:
    argv = ["views", "--controller", "random", *FLAGS, "--frame", 2]
    plain = drawn(tmp_path / "plain.png", *argv)
    discs = drawn(tmp_path / "discs.png", *argv, "--arena.obstacles_px", "[[300, 300, 40]]")
    green_intensity = (150, 150, 150)  # 0.587 of 255
    assert share(discs, green_intensity) > share(plain, green_intensity) + 0.001


def test_arenas_of_runs_and_controllers_stand_side_by_side(tmp_path: Path, run_dir: Path) -> None:
    one = drawn(tmp_path / "one.png", "arena", run_dir)
    two = drawn(tmp_path / "two.png", "arena", run_dir, "--controller", "greedy")
    assert two.shape[0] == pytest.approx(one.shape[0], abs=2)
    assert two.shape[1] == pytest.approx(2 * one.shape[1], rel=0.1)


@pytest.mark.parametrize("orientation", ["unrotated", "heading_up"])
def test_views_are_intensities_with_one_rectangle(tmp_path: Path, orientation: str) -> None:
    image = drawn(
        tmp_path / "views.png", "views", "--controller", "random", *FLAGS,
        f"--arena.orientation={orientation}", "--frame", 2,
    )  # fmt: skip
    assert share(image, (0, 0, 0)) > 0.3
    assert 0 < share(image, (255, 144, 32)) < 0.02


def test_views_of_a_run_at_a_frame_after_its_end(tmp_path: Path, run_dir: Path) -> None:
    drawn(tmp_path / "views.png", "views", run_dir, "--frame", 10_000)


def test_a_comparison_has_a_row_a_policy_and_a_column_a_start(
    tmp_path: Path, run_dir: Path
) -> None:
    out = tmp_path / "comparison.svg"
    argv = ["comparison", run_dir, "--controller", "random", "--controller", "safe_circle"]
    assert main([*map(str, argv), "--episodes", "2", "--out", str(out)]) == 0
    text = out.read_text("utf-8")
    assert ElementTree.fromstring(text).tag.endswith("svg")
    for name in ("three: 0 of 2", "random: 0 of 2", "safe_circle: "):
        assert f"<!-- {name}" in text
    assert text.count(" frames -->") == 6


def test_trajectories_of_a_run(tmp_path: Path, run_dir: Path) -> None:
    image = drawn(tmp_path / "paths.png", "trajectories", run_dir, "--episodes", 2)
    assert share(image, (255, 0, 0)) > 0
    assert share(image, (32, 80, 208)) > 0


def test_curves_name_their_runs(tmp_path: Path, run_dir: Path) -> None:
    other = tmp_path / "empty"
    other.mkdir()
    (other / "config.toml").touch()
    out = tmp_path / "curves.svg"
    assert main(["curves", str(run_dir), str(other), "--out", str(out)]) == 0
    text = out.read_text("utf-8")
    assert "<!-- three -->" in text
    assert "<!-- empty -->" in text
    assert main(["curves", str(other), "--out", str(out)]) == 0
    assert "<!-- no records -->" in out.read_text("utf-8")


def test_a_curve_of_one_point_is_seen(tmp_path: Path, run_dir: Path) -> None:
    short = tmp_path / "short"
    short.mkdir()
    (short / "config.toml").write_text((run_dir / "config.toml").read_text("utf-8"), "utf-8")
    first = (run_dir / "evaluations.jsonl").read_text("utf-8").splitlines(keepends=True)[0]
    (short / "evaluations.jsonl").write_text(first, "utf-8")
    curves = drawn(tmp_path / "one.png", "curves", short)
    (short / "evaluations.jsonl").unlink()
    assert share(curves, FIRST_RUN) > share(
        drawn(tmp_path / "none.png", "curves", short), FIRST_RUN
    )


@pytest.mark.parametrize(
    ("argv", "error", "message"),
    [
        (["arena", "--out", "a.pdf"], MrcdrlError, "extension '.pdf'; use .png or .svg"),
        (["arena", "--out", "/proc/a.png"], ConfigError, "/proc/a.png cannot be written: No such"),
        (["views"], ConfigError, "views takes one: either weights or --controller"),
        (["trajectories", "a", "b"], ConfigError, "trajectories takes one"),
        (["trajectories", "--controller", "greed"], ConfigError, "did you mean greedy"),
        (["trajectories", "none.safetensors"], CheckpointError, "No such file"),
        (["comparison", "--controller", "greedy"], ConfigError, "at least two"),
        (["curves"], ConfigError, "takes run directories only"),
        (["curves", "a", "--controller", "greedy"], ConfigError, "takes run directories only"),
        (["curves", "missing"], RunDirectoryError, "no run 'missing'"),
    ],
)
def test_what_cannot_be_drawn_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    argv: list[str],
    error: type[Exception],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message):
        main(["--out", "a.png", *argv] if "--out" not in argv else argv)


def test_policies_of_different_arenas_are_not_compared(tmp_path: Path, run_dir: Path) -> None:
    other = tmp_path / "two"
    payload = weights_to_bytes(QNetwork("duel", view_px=VIEW_PX))
    write_weights(other / "checkpoints" / "best.safetensors", payload, {})
    (other / "config.toml").write_text(to_toml(load_config("quick", SHORT, {})))
    with pytest.raises(ConfigError, match=r"arena\.num_robots differs"):
        main(["comparison", str(run_dir), str(other), "--out", str(tmp_path / "a.png")])


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["arena"], "--out"),
        (["map", "--out", "a.png"], "invalid choice: 'map'"),
        (["arena", "--out", "a.png", "--episodes", "0"], "--episodes: 0 must be at least 1"),
        (["arena", "--out", "a.png", "--frame", "-1"], "--frame: -1 must be at least 0"),
    ],
)
def test_wrong_flags_are_refused(
    argv: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(argv)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
