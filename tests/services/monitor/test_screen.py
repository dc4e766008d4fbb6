"""The screen at various sizes, and the plain line."""

import io
import math
import re
from pathlib import Path

import pytest
from rich.cells import cell_len
from rich.console import Console

from mrcdrl.common.config import RunConfig, load_config
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome, Stats
from mrcdrl.services.monitor.screen import Screen, braille_curve, plain_line, resample
from mrcdrl.services.monitor.state import RunState

CONFIG = load_config("quick", {"run.minutes": "20", "arena.num_robots": "4"}, environ={})


def busy_state(num_actors: int) -> RunState:
    state = RunState(CONFIG)
    for second in range(12):
        for k in range(num_actors):
            metrics = {
                "env_steps": 150.0 * second, "robot_steps": 600.0 * second, "epsilon_min": 0.02,
                "epsilon_max": 0.31, "weights_version": 1_200.0, "weights_age_s": 1.0,
                "inference_share": 0.6,
            }  # fmt: skip
            state.observe_stats(Stats("actor", f"actor-{k}", metrics), second)
        table = {"size": 123_456.0, "capacity": 4e5, "samples": 7_200.0 * second,
                 "samples_per_insert": 3.98, "sample_held": 1.0, "bytes": 6e7}  # fmt: skip
        state.observe_stats(Stats("replay", "0", table), second)
        learned = {"learner_steps": 225.0 * second, "weights_version": 1_207.0, "loss": 0.01}
        state.observe_stats(Stats("learner", "0", learned), second)
    state.observe_presence("evaluator", "0", alive=False)
    for number in range(1_000):
        outcome = Outcome.SUCCESS if number % 10 * 100 < number else Outcome.TIMEOUT
        summary = EpisodeSummary("actor-0", 0, number, outcome, 99, 150.0, 1, 0.1, 5, 2.0, 2)
        state.observe_episode(summary)
    for k in range(14):
        rate = k / 14
        judged = Evaluation("0", 1, 80 * k, 4_000 * k, 4, 100, rate, 1 - rate, 0.0, (0.1, 0.9),
                            98.0, 90.0, 8.0, 110.0, 170.0, 1, 22.0)  # fmt: skip
        state.observe_evaluation(judged, 60.0 * k)
    state.observe_log("actor-2: no acknowledgement for 60 s")
    return state


KEYS = "Ctrl-C ends the run"
SIZES = [(80, 24), (100, 32), (120, 40), (200, 60)]


def rendered(
    state: RunState, width: int, height: int, now: float, run_dir: str = "runs/quick-1"
) -> list[str]:
    console = Console(width=width, height=height, record=True, file=io.StringIO())
    console.print(Screen(state, now, Path(run_dir), KEYS))
    text = console.export_text().replace("\N{NO-BREAK SPACE}", " ")
    return text.removesuffix("\n").split("\n")


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("num_actors", [1, 3, 30])
def test_screen_fits_and_shows_everything(width: int, height: int, num_actors: int) -> None:
    lines = rendered(busy_state(num_actors), width, height, 11.2)
    assert len(lines) == height
    assert max(map(cell_len, lines)) <= width
    text = "\n".join(lines)
    for words in (
        "quick-1", "4 robots", "0:19:48 left", f"↻ {num_actors} actor", "replay ─7", "225/s",
        "weights v1207", "123 456 of 400 000", "3.98 samples per insert", "0.02 … 0.31",
        "92.9% success", "7.1% collision", "lost", "up", "processes", "bottleneck",
        "collection: actor inference", "no acknowledgement for 60 s", "1 000 episodes",
        "test success  92.9 %, best 92.9 %",
    ):  # fmt: skip
        assert words in text, words
    assert lines[1] == "learning"
    assert width == 80 or "no evaluator" in lines[2]
    assert lines[-1].startswith("folder runs/quick-1  ")
    assert lines[-1].rstrip().endswith(KEYS)


@pytest.mark.parametrize(("width", "height"), [*SIZES, (40, 10)])
def test_screen_before_anything_is_known(width: int, height: int) -> None:
    lines = rendered(RunState(CONFIG), width, height, 0.0)
    assert max(map(cell_len, lines)) <= width
    text = "\n".join(lines)
    assert text.count("none yet") == 2
    assert lines[1].startswith("starting, waiting for replay")
    assert re.search(r"^bottleneck +– ", text, re.MULTILINE)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_curves_have_axes_and_take_the_height_that_is_left(width: int, height: int) -> None:
    lines = rendered(busy_state(1), width, height, 840.0)
    axis = next(i for i, line in enumerate(lines) if line.startswith("   └0 ─"))
    top = next(i for i, line in enumerate(lines) if line.startswith("100┤"))
    assert re.fullmatch(r" +└0 ─.*─ 1 000 episodes +└0 ─.*─ 14 min *", lines[axis])
    assert lines[axis - 1].startswith("  0┤")
    assert all("│" in line or "┤" in line for line in lines[top:axis])
    assert axis - top >= (height - 12) * 0.4
    assert lines[axis - 1].count("┤") == 2
    if height >= 40:
        assert " 75┤" in "\n".join(lines)
        assert "─ 500 ─ 1 000 episodes" in re.sub("─+", "─", lines[axis])


@pytest.mark.parametrize(
    ("episodes", "axis"),
    [(795, "─ 400 ─ 795 episodes"), (12_345, "─ 6 000 ─ 12 345 episodes"), (0, "─ 50 ─ 100 ep")],
)
def test_the_axis_names_round_numbers(episodes: int, axis: str) -> None:
    state = RunState(CONFIG)
    state.episodes = episodes
    text = "\n".join(rendered(state, 120, 40, 30.0))
    assert axis in re.sub("─+", "─", text)
    assert re.search(r"└0 ─+ 1 min", text)


def test_what_people_and_peers_name_keeps_to_its_place() -> None:
    """Wide characters, long names, control characters, numbers that are none."""
    state = busy_state(30)
    lost = {"loss": math.nan, "mean_q": math.inf, "learner_steps": 2_475.0}
    state.observe_stats(Stats("learner", "0", lost), 12.0)
    state.observe_log("actor-1: \x1b[2J\x1b]0;owned\x07 done\r\n日本語 " + 400 * "x")
    folder = "/home/日本語/" + 100 * "ü" + "/\x1b[31m" + 64 * "n"
    for width, height in SIZES:
        lines = rendered(state, width, height, 12.0, folder)
        assert len(lines) == height
        assert max(map(cell_len, lines)) <= width
        text = "\n".join(lines)
        assert "\x1b" not in text
        assert "\x07" not in text
        assert "loss nan · Q inf" in text
        assert "0:19:48 left" in lines[0]
        assert lines[-1].rstrip().endswith(KEYS)


def test_colours_are_not_needed() -> None:
    shown = []
    for colour in (None, "truecolor"):
        console = Console(
            width=100, height=32, file=io.StringIO(), record=True, force_terminal=True,
            color_system=colour, no_color=colour is None,
        )  # fmt: skip
        console.print(Screen(busy_state(3), 11.2, Path("runs/quick-1"), KEYS))
        shown.append(console.export_text(styles=False))
    assert shown[0] == shown[1]


def test_a_silent_service_is_shown_as_such() -> None:
    assert "silent 39 s" in "\n".join(rendered(busy_state(1), 80, 24, 50.0))


def test_slots_and_lost_processes_are_shown() -> None:
    state = RunState(CONFIG)
    for name, slot in (("actor-0", 0.0), ("actor-1", 7.0), ("actor-2", -1.0)):
        state.observe_stats(Stats("actor", name, {"slot": slot}), 0.0)
    state.observe_presence("status", "status-0", alive=True)
    state.observe_presence("actor", "actor-1", alive=False)
    lines = rendered(state, 100, 32, 1.0)
    shown = {line.split()[0]: line for line in lines if line.startswith(("actor-", "status"))}
    assert "slot 0 ·" in shown["actor-0"]
    assert "no slot ·" in shown["actor-1"]
    assert "no slot ·" in shown["actor-2"]
    ends = {name: line.split()[-1] for name, line in shown.items()}
    assert ends == {"actor-0": "up", "actor-1": "lost", "actor-2": "up", "status-0": "up"}


@pytest.mark.parametrize(
    ("version", "words"),
    [
        (1_207, "weights: current, 1 s old"),
        (1_206, "weights: 1 behind, 1 s old"),
        (9, "1198 behind"),
    ],
)
def test_the_age_of_an_actors_weights_is_shown(version: float, words: str) -> None:
    state = busy_state(0)
    metrics = {"weights_version": version, "weights_age_s": 1.0}
    state.observe_stats(Stats("actor", "actor-0", metrics), 11.0)
    assert words in "\n".join(rendered(state, 100, 32, 11.2))


def test_whatever_a_peer_says_of_replay_and_speed_fits_the_screen() -> None:
    config = CONFIG.model_copy(update={"run": RunConfig(learner_steps=100)})
    state = RunState(config)
    state.observe_stats(Stats("replay", "0", {"size": -1e9, "capacity": 1.0}), 0.0)
    for second in (0.0, 1.0):  # a step in more seconds than a float64 holds
        state.observe_stats(Stats("learner", "0", {"learner_steps": second * 5e-324}), second)
    lines = rendered(state, 80, 24, 1.5)
    assert max(map(len, lines)) <= 80
    assert "– left" in lines[0]
    assert len(plain_line(state, 1.5)) < 300


def test_plain_line_is_one_line_with_the_same_figures() -> None:
    line = plain_line(busy_state(3), 11.2)
    assert "\n" not in line
    for words in ("0:00:11", "0:19:48 left", "3 actors", "weights v1207", "evaluation 92.9%",
                  "bottleneck: collection: actor inference"):  # fmt: skip
        assert words in line


def test_plain_line_before_anything_is_known() -> None:
    assert "evaluation –" in plain_line(RunState(CONFIG), 0.0)


def test_one_actor_is_told_in_the_singular() -> None:
    assert "  1 actor  " in plain_line(busy_state(1), 11.2)


@pytest.mark.parametrize(
    ("points", "num", "expected"),
    [
        ([], 3, [None, None, None]),
        ([(2, 5)], 3, [None, 5, None]),
        ([(0, 0), (4, 2)], 3, [0, 1, 2]),
        ([(0, 0), (1, 2), (3, 4), (4, 6)], 2, [1, 5]),
        ([(0, math.nan), (2, 5), (4, math.inf)], 3, [None, 5, None]),
    ],
)
def test_resample(
    points: list[tuple[float, float]], num: int, expected: list[float | None]
) -> None:
    assert resample(points, 4, num) == expected


def test_braille_curve_runs_from_the_bottom_to_the_top() -> None:
    assert braille_curve([(0, 0), (1, 100)], 1, 1, 1) == ["⡸"]
    steps = [(x, 100.0 * (x >= 10)) for x in range(20)]
    lines = braille_curve(steps, 19, 10, 3)
    assert [len(line) for line in lines] == [10] * 3
    assert lines[0].startswith("  ")
    assert lines[2].startswith("⣀⣀")
