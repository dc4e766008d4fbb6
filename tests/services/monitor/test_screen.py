"""The screen at various sizes, and the plain line."""

import io

import pytest
from rich.console import Console

from mrcdrl.common.config import load_config
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
        summary = EpisodeSummary("actor-0", 0, number, outcome, 99, 150.0, 1, 0.1, 5, 2.0)
        state.observe_episode(summary)
    for k in range(14):
        rate = k / 14
        judged = Evaluation("0", 1, 80 * k, 4_000 * k, 4, 100, rate, 1 - rate, 0.0, (0.1, 0.9),
                            98.0, 90.0, 8.0, 110.0, 170.0, 1, 22.0)  # fmt: skip
        state.observe_evaluation(judged, 60.0 * k)
    state.observe_log("actor-2: no acknowledgement for 60 s")
    return state


def rendered(state: RunState, width: int, height: int, now: float) -> list[str]:
    console = Console(width=width, height=height, record=True, file=io.StringIO())
    console.print(Screen(state, now, "quick-1"))
    text = console.export_text().replace("\N{NO-BREAK SPACE}", " ")
    return text.removesuffix("\n").split("\n")


@pytest.mark.parametrize(("width", "height"), [(100, 32), (80, 24), (200, 60)])
@pytest.mark.parametrize("num_actors", [1, 3, 30])
def test_screen_fits_and_shows_everything(width: int, height: int, num_actors: int) -> None:
    lines = rendered(busy_state(num_actors), width, height, 11.2)
    assert len(lines) <= height
    assert max(map(len, lines)) <= width
    text = "\n".join(lines)
    for words in (
        "quick-1", "4 robots", "0:19:48 left", f"{num_actors} actors ─", "replay ─7", "225/s",
        "weights v1207", "123 456 of 400 000", "3.98 samples per insert", "0.02 … 0.31",
        "92.9% success", "7.1% collision", "lost", "up", "processes", "bottleneck",
        "collection: actor inference", "no acknowledgement for 60 s", "1 000 episodes",
    ):  # fmt: skip
        assert words in text, words


@pytest.mark.parametrize(("width", "height"), [(100, 32), (80, 24), (40, 10)])
def test_screen_before_anything_is_known(width: int, height: int) -> None:
    lines = rendered(RunState(CONFIG), width, height, 0.0)
    assert max(map(len, lines)) <= width
    text = "\n".join(lines)
    assert text.count("none yet") == 2
    assert "waiting for replay" in text


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


def test_plain_line_is_one_line_with_the_same_figures() -> None:
    line = plain_line(busy_state(3), 11.2)
    assert "\n" not in line
    for words in ("0:00:11", "0:19:48 left", "3 actors", "weights v1207", "evaluation 92.9%",
                  "bottleneck: collection: actor inference"):  # fmt: skip
        assert words in line


def test_plain_line_before_anything_is_known() -> None:
    assert "evaluation –" in plain_line(RunState(CONFIG), 0.0)


@pytest.mark.parametrize(
    ("values", "points", "expected"),
    [([], 3, []), ([5], 3, [5, 5, 5]), ([0, 2], 3, [0, 1, 2]), ([0, 2, 4, 6], 2, [1, 5])],
)
def test_resample(values: list[float], points: int, expected: list[float]) -> None:
    assert resample(values, points) == pytest.approx(expected)


def test_braille_curve_runs_from_the_bottom_to_the_top() -> None:
    assert braille_curve([0, 100], 1, 1, 0, 100) == ["⡸"]
    lines = braille_curve([0] * 10 + [100] * 10, 10, 3, 0, 100)
    assert [len(line) for line in lines] == [10] * 3
    assert lines[0].startswith("⠀⠀")
    assert lines[2].startswith("⣀⣀")
