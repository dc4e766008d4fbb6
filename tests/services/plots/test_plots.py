"""Figures and films from synthetic runs: they are written, readable, and of the right size."""

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree import ElementTree

import av
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from mrcdrl.common.config import ArenaConfig, load_config
from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome, UInt8Array
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.plots.figures import Path2D, by_robots, training_curve, trajectories
from mrcdrl.services.plots.film import compose_frame, write_film
from mrcdrl.services.plots.paper import Contender, arenas, comparison, curves

CONFIG = load_config("quick", environ={})


def record(run_dir: Path, num_episodes: int, num_evaluations: int) -> None:
    state = RunState(CONFIG)
    with Recorder(run_dir, CONFIG) as recorder:
        for number in range(num_episodes):
            outcome = Outcome.SUCCESS if number % 7 < number / 60 else Outcome.COLLISION
            episode = EpisodeSummary("a", 0, number, outcome, 99, 1.0 * number, 1, 0.1, 5, 2.0, 2)
            state.observe_episode(episode)
            recorder.record_episode(episode, state, 0.5 * number)
        for k in range(num_evaluations):
            rate = k / num_evaluations
            judged = Evaluation("0", 1, k, 500 * k, 2, 100, rate, 1 - rate, 0.0,
                                (0.9 * rate, 1.0), 9.0, 9.0, 4.0, 9.0, 9.0, 1, 20.0)  # fmt: skip
            recorder.record_evaluation(state.observe_evaluation(judged, 30.0 * k))


@pytest.mark.parametrize(
    ("num_episodes", "num_evaluations"), [(0, 0), (1, 1), (30, 2), (450, 12), (4_100, 3)]
)
def test_training_curve_of_any_length(
    tmp_path: Path, num_episodes: int, num_evaluations: int
) -> None:
    record(tmp_path, num_episodes, num_evaluations)
    training_curve(tmp_path, tmp_path / "curve.png", tmp_path / "curve.svg")
    assert ElementTree.parse(tmp_path / "curve.svg").getroot().tag.endswith("svg")
    with Image.open(tmp_path / "curve.png") as image:
        assert image.size == (1_800, 2_200)
        assert image.info["dpi"] == pytest.approx((200, 200), abs=1)
        assert len(np.unique(np.asarray(image.convert("L")))) > 50


def test_training_curve_of_a_directory_without_records(tmp_path: Path) -> None:
    training_curve(tmp_path, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 10_000


@pytest.mark.parametrize("num_episodes", [0, 1, 6])
def test_trajectories_show_starts_and_targets(tmp_path: Path, num_episodes: int) -> None:
    robots = np.stack([np.linspace((100, 200, 0), (400, 200 + 50 * k, 1), 40) for k in range(3)], 1)
    targets = np.array([[400.0, 200.0], [400.0, 250.0], [100.0, 500.0]])
    episodes = [
        Path2D(robots, targets, np.array([[300.0, 200, 30]]), Outcome.SUCCESS)
    ] * num_episodes
    trajectories(episodes, ArenaConfig(num_robots=3), tmp_path / "paths.png")
    with Image.open(tmp_path / "paths.png") as image:
        colours = {tuple(pixel) for pixel in np.asarray(image.convert("RGB")).reshape(-1, 3)}
    assert ((255, 0, 0) in colours) == (num_episodes > 0)
    assert ((32, 80, 208) in colours) == (num_episodes > 0)


def test_an_episode_of_one_frame_can_be_drawn(tmp_path: Path) -> None:
    robots, targets = np.full((1, 2, 3), 100.0), np.full((2, 2), 300.0)
    still = Path2D(robots, targets, np.empty((0, 3)), Outcome.COLLISION)
    trajectories([still], ArenaConfig(), tmp_path / "paths.png")
    assert (tmp_path / "paths.png").exists()


LONG = "n" * 64  # no name of a run is longer


def still(*, obstacles: int = 0) -> Path2D:
    robots, targets = np.full((3, 2, 3), 100.0), np.full((2, 2), 300.0)
    return Path2D(robots, targets, np.full((obstacles, 3), 200.0), Outcome.COLLISION)


def draw_curve(folder: Path, out: Path) -> None:
    record(folder / LONG, 450, 12)
    training_curve(folder / LONG, out)


def draw_curves(folder: Path, out: Path) -> None:
    runs = [folder / f"{number}{LONG[1:]}" for number in range(9)]
    for run in runs:
        record(run, 200, 3)
    curves(runs, out)


def draw_paths(_: Path, out: Path) -> None:
    trajectories([still(obstacles=1)], ArenaConfig(), out)


def draw_comparison(_: Path, out: Path) -> None:
    rows = [Contender(f"{LONG}: 12 of 12", [still()] * 2)] * 3
    comparison(rows, ArenaConfig(), out)


def draw_arenas(_: Path, out: Path) -> None:
    arenas([np.zeros((60, 60, 3), np.uint8)], ["4 robots"], out, obstacles=True)


@pytest.mark.parametrize(
    ("draw", "legends", "words"),
    [
        (draw_curve, 3, "95 % interval"),
        (draw_curves, 2, f"8{LONG[1:]}"),
        (draw_paths, 1, "obstacle"),
        (draw_comparison, 1, "target"),
        (draw_arenas, 1, "obstacle"),
    ],
)
def test_nothing_is_cut_off_and_every_panel_is_explained(
    draw: Callable[[Path, Path], None],
    legends: int,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, _out: drawn.append(figure))
    draw(tmp_path, tmp_path / "figure.png")
    (figure,) = drawn
    figure.draw_without_rendering()
    box, (width, height) = figure.get_tightbbox(), figure.get_size_inches()
    assert min(box.x0, box.y0, width - box.x1, height - box.y1) > 0
    found = [*figure.legends, *(legend for a in figure.axes if (legend := a.get_legend()))]
    assert len(found) == legends
    assert words in [text.get_text() for legend in found for text in legend.get_texts()]


def test_long_names_of_rows_do_not_overlap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, _out: drawn.append(figure))
    draw_comparison(tmp_path, tmp_path / "figure.png")
    drawn[0].draw_without_rendering()
    names = [axes.yaxis.label for axes in drawn[0].axes[::2]]
    assert [name.get_text().replace("\n", "") for name in names] == [f"{LONG}: 12 of 12"] * 3
    boxes = [name.get_window_extent() for name in names]
    assert all(upper.y0 > lower.y1 for upper, lower in itertools.pairwise(boxes))


@pytest.mark.parametrize("num_robots", [1, 2, 3, 4, 10])
def test_composed_frames_hold_arena_views_and_caption(num_robots: int) -> None:
    arena = np.full((600, 600, 3), (10, 120, 200), np.uint8)
    views = np.full((num_robots, 60, 60), 199, np.uint8)
    frame = compose_frame(arena, views, "episode 1 · ε 0.01", "the first 4 of 12 episodes")
    assert frame.dtype == np.uint8
    assert [side % 2 for side in frame.shape[:2]] == [0, 0]
    assert (frame[:600, :600] == arena).all()
    enlarged = (frame[:600, 600:] == 225).all(axis=2).sum()
    assert enlarged >= num_robots * 60 * 60 * (16 if num_robots <= 4 else 4) * 0.99
    assert (frame[600:, :300] > 200).any()
    assert (frame[600:, -200:] > 200).any()


def test_targets_and_walls_can_be_seen_in_the_robots_images() -> None:
    """Intensities 29 and 76, on a ground of 0, as robots and obstacles are."""
    views = np.zeros((1, 60, 60), np.uint8)
    for column, intensity in enumerate((29, 76, 150, 255)):
        views[:, :, 10 * (column + 1)] = intensity
    frame = compose_frame(np.zeros((600, 600, 3), np.uint8), views, "")
    shown = np.unique(frame[300, 650:])
    assert set(shown) >= {0, 86, 139, 196, 255}


def texts_of_a_frame(monkeypatch: pytest.MonkeyPatch, num_robots: int, note: str) -> list[str]:
    written: list[str] = []
    text = ImageDraw.ImageDraw.text

    def write(self: ImageDraw.ImageDraw, at: object, words: str, **options: object) -> None:
        written.append(words)
        text(self, at, words, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", write)
    views = np.zeros((num_robots, 60, 60), np.uint8)
    compose_frame(np.zeros((600, 600, 3), np.uint8), views, "episode 1 of 4   frame 300", note)
    return written


def test_a_frame_says_that_images_are_brightened_and_which_episodes_are_shown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    written = texts_of_a_frame(monkeypatch, 2, "the first 4 of 12 episodes")
    assert written[:2] == ["robot 1 sees", "robot 2 sees"]
    assert written[-1] == "the first 4 of 12 episodes · robots' images brightened"
    assert texts_of_a_frame(monkeypatch, 2, "")[-1] == "robots' images brightened"


def test_labels_that_do_not_fit_are_shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    written = texts_of_a_frame(monkeypatch, 20, "")
    assert "robot 1" in written
    assert "20" in written


def counting_frames(num: int, height: int, width: int) -> Iterator[UInt8Array]:
    for k in range(num):
        yield np.full((height, width, 3), 10 * k, np.uint8)


@pytest.mark.parametrize(("height", "width"), [(64, 96), (65, 97)])
def test_a_film_reads_back(tmp_path: Path, height: int, width: int) -> None:
    path = tmp_path / "film.mp4"
    assert write_film(path, counting_frames(20, height, width), 30) == 20
    with av.open(str(path)) as film:
        stream = film.streams.video[0]
        assert (stream.codec_context.name, stream.average_rate) == ("h264", 30)
        assert (stream.width, stream.height) == (96, 64)
        intensities = [frame.to_ndarray(format="gray").mean() for frame in film.decode(video=0)]
    assert len(intensities) == 20
    assert intensities == sorted(intensities)


def test_a_gif_is_half_as_large_and_shows_every_third_frame(tmp_path: Path) -> None:
    path = tmp_path / "film.gif"
    assert write_film(path, counting_frames(20, 65, 97), 30) == 7
    intensities = []
    with Image.open(path) as film:
        assert (film.size, film.n_frames) == ((48, 32), 7)
        for number in range(film.n_frames):
            film.seek(number)
            assert film.info["duration"] == 100
            intensities.append(np.asarray(film.convert("L")).mean())
    np.testing.assert_allclose(intensities, [30 * number for number in range(7)], atol=4)


def test_a_gif_keeps_the_arenas_colours(tmp_path: Path) -> None:
    """BGR in, RGB out: red walls, blue targets, white robots, grey views."""
    colours = [(0, 0, 255), (255, 0, 0), (255, 255, 255), (76, 76, 76), (0, 0, 0)]
    frame = np.repeat(np.array(colours, np.uint8)[None], 8, axis=0).repeat(8, axis=1)
    write_film(tmp_path / "film.gif", [frame], 30)
    with Image.open(tmp_path / "film.gif") as film:
        shown = np.asarray(film.convert("RGB"))[2, 2::4]
    np.testing.assert_allclose(shown, np.array(colours)[:, ::-1], atol=4)


def test_films_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MrcdrlError, match=r"unsupported extension '.avi'; use .mp4 or .gif"):
        write_film(tmp_path / "film.avi", counting_frames(2, 64, 64), 30)
    with pytest.raises(MrcdrlError, match="no frames"):
        write_film(tmp_path / "empty.mp4", [], 30)
    assert not (tmp_path / "empty.mp4").exists()
    with pytest.raises(MrcdrlError, match="cannot be written"):
        write_film(tmp_path / "missing" / "film.mp4", counting_frames(2, 64, 64), 30)
    sizes = [np.zeros((64, 64, 3), np.uint8), np.zeros((32, 64, 3), np.uint8)]
    with pytest.raises(MrcdrlError, match="the first"):
        write_film(tmp_path / "sizes.mp4", sizes, 30)


def test_each_number_of_robots_has_a_curve_of_its_own(tmp_path: Path) -> None:
    with Recorder(tmp_path, CONFIG) as recorder:
        state = RunState(CONFIG)
        for step in range(6):
            for number in (1, 2, 4):
                judged = Evaluation("0", 1, step, 500 * step, number, 100, step / 9, 1 - step / 9,
                                    0.0, (0.0, 1.0), 9.0, 9.0, 4.0, 9.0, 9.0, 1, 20.0)  # fmt: skip
                recorder.record_evaluation(state.observe_evaluation(judged, 30.0 * step))
    assert {n: len(own) for n, own in by_robots(state.evaluations).items()} == {1: 6, 2: 6, 4: 6}
    training_curve(tmp_path, tmp_path / "curve.svg")
    curves([tmp_path], tmp_path / "curves.svg")
    for name in ("curve.svg", "curves.svg"):
        drawn = (tmp_path / name).read_text("utf-8")
        assert all(f"{number} robot" in drawn for number in (1, 2, 4))
