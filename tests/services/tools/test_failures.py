"""Failures in hand-made scenes: who hit what, why perhaps, and until when it could be saved."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from mrcdrl.common.arena import STRAIGHT, Scene, Start, layout_for
from mrcdrl.common.config import ArenaConfig, load_config, to_toml
from mrcdrl.common.messages.trajectory import Outcome, UInt8Array
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_files import write_weights
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.services.evaluator.navigation import journey
from mrcdrl.services.evaluator.trial import ControllerPlayer, EpisodeResult, play
from mrcdrl.services.tools import evaluate
from mrcdrl.services.tools.failure_summary import as_json, failure_table, summarize
from mrcdrl.services.tools.failures import (
    Failure,
    contacts,
    failure,
    last_savable_frames,
    outside_images,
    wanted_targets,
)
from mrcdrl.services.tools.replays import failures_of, num_replays
from mrcdrl.services.tools.subject import controlled

CONFIG = ArenaConfig(num_robots=2, max_frames=300)
UP = -np.pi / 2
Pose = tuple[float, float, float]


def straight_on(config: ArenaConfig, *robots: Pose) -> EpisodeResult:
    """The episode of robots that drive straight on."""
    rng = np.random.default_rng(0)
    layout = layout_for(config, rng)

    def straight(scene: Scene) -> UInt8Array:
        return np.full(len(scene.robots), STRAIGHT, np.uint8)

    start = Start(np.array(robots), layout.targets, layout.obstacles)
    player = ControllerPlayer(lambda: straight, 0.0, rng)
    (result,) = play(config, [start], player, keep_failed_paths=True) or []
    return result


def timed_out(path: ArrayLike, targets: ArrayLike) -> EpisodeResult:
    """An episode that timed out after this path [T, K, 3]."""
    robots, places = np.array(path, np.float64), np.array(targets, np.float64)
    frames, num = len(robots) - 1, robots.shape[1]
    none = np.zeros(num, np.bool_)
    return EpisodeResult(
        outcome=Outcome.TIMEOUT,
        frames=frames,
        score=0.0,
        targets=places,
        obstacles=np.empty((0, 3)),
        robots=robots,
        explored=np.zeros((frames, num), np.bool_),
        journey=journey(robots, places, none, none, CONFIG.robot_radius_px),
    )


def described(result: EpisodeResult, config: ArenaConfig = CONFIG) -> Failure:
    return failure(
        config,
        0,
        result,
        succeeds_without_exploration=False,
        savable=None,
        savable_until_frame=None,
    )


FACING = straight_on(CONFIG, (270, 300, 0), (331, 300, np.pi))  # 11 px between their rims
DISC = ArenaConfig(num_robots=2, obstacles_px=((300, 300, 30),))


@pytest.mark.parametrize(
    ("config", "robots", "met"),
    [
        (CONFIG, [(270, 300, 0), (331, 300, np.pi)], [("robot", (0, 1), (300.5, 300))]),
        (CONFIG, [(40, 300, np.pi), (300, 100, 0)], [("wall", (0,), (12, 300))]),
        (CONFIG, [(100, 500, 0), (300, 561, -UP)], [("wall", (1,), (300, 588))]),
        (DISC, [(100, 500, 0), (300, 358, UP)], [("obstacle", (1,), (300, 330))]),
        (
            CONFIG.model_copy(update={"inner_walls_px": ((250, 400, 350, 400),)}),
            [(100, 500, 0), (300, 430, UP)],
            [("wall", (1,), (300, 401))],
        ),
        (
            CONFIG.model_copy(update={"num_robots": 3}),
            [(39, 300, np.pi), (91, 300, np.pi), (300, 100, 0)],  # the second follows the first
            [("wall", (0,), (12, 300)), ("robot", (0, 1), (63.75, 300))],
        ),
    ],
    ids=["robot", "left wall", "lower wall", "obstacle", "inner wall", "wall and follower"],
)
def test_who_hit_what(
    config: ArenaConfig,
    robots: Sequence[Pose],
    met: list[tuple[str, tuple[int, ...], tuple[float, float]]],
) -> None:
    found = contacts(config, straight_on(config, *robots))
    assert [(contact.what, contact.robots) for contact in found] == [m[:2] for m in met]
    for contact, (_, _, place) in zip(found, met, strict=True):
        assert contact.place_px == pytest.approx(place, abs=1e-9)


@pytest.mark.parametrize(
    ("frames_before", "robot", "found"),
    [(1, 0, True), (10, 0, True), (11, 0, False), (1, 1, False)],
)
def test_exploring_counts_soon_before_and_of_robots_that_collided(
    frames_before: int, robot: int, found: bool
) -> None:
    result = straight_on(CONFIG, (80, 300, np.pi), (300, 100, 0))
    explored = np.zeros((result.frames, 2), np.bool_)
    explored[-frames_before, robot] = True
    assert described(dataclasses.replace(result, explored=explored)).explored_before is found


def driving(start: Pose, num: int = 21) -> np.ndarray:
    """A straight path [num, 3]."""
    x, y, heading = start
    way = np.arange(num)[:, None] * 2.5 * np.array([np.cos(heading), np.sin(heading)])
    return np.column_stack([np.array((x, y)) + way, np.full(num, heading)])


def circling(x: float, y: float, num: int = 21) -> np.ndarray:
    """A circle [num, 3] as robots drive it that turn left always."""
    headings = -np.arange(num) * np.radians(23)
    steps = 2.5 * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    return np.column_stack([np.array((x, y)) + np.cumsum(steps, axis=0), headings])


TARGETS = np.array([(150.0, 300.0), (450.0, 300.0)])


@pytest.mark.parametrize(
    ("paths", "wanted"),
    [
        ([driving((300, 300, 0)), driving((250, 300, np.pi))], [1, 0]),
        ([driving((300, 300, 0)), driving((360, 340, 0))], [1, 1]),
        ([circling(450, 300), driving((300, 300, 0))], [1, 1]),
        ([circling(450, 300), driving((420, 350, np.pi))], [1, 0]),  # near 1, on its way to 0
        ([circling(280, 300), circling(320, 300)], [0, 1]),
    ],
    ids=["apart", "side by side", "on target and coming", "passing", "waiting"],
)
def test_a_robot_wants_what_it_heads_for_and_where_it_stays_what_is_nearest(
    paths: list[np.ndarray], wanted: list[int]
) -> None:
    path = np.stack(paths, axis=1)
    assert wanted_targets(CONFIG, path, TARGETS).tolist() == wanted
    assert described(timed_out(path, TARGETS)).same_target is (wanted[0] == wanted[1])


def test_two_that_face_each_other_want_different_targets() -> None:
    assert not described(FACING).same_target
    assert not described(FACING).unseen


@pytest.mark.parametrize(
    ("orientation", "crop_px", "other", "outside"),
    [
        ("unrotated", 600, (340, 300), False),
        ("unrotated", 100, (374, 300), False),  # its rim begins 1 px inside
        ("unrotated", 100, (376, 300), True),
        ("unrotated", 100, (366, 366), False),
        ("unrotated", 100, (368, 368), True),  # 25.5 px off the corner
        ("heading_up", 100, (376, 300), False),  # beside the window, if that were not turned
        ("heading_up", 100, (354, 354), True),
        ("heading_up", 100, (352, 352), False),
    ],
)
def test_what_a_robot_sees(
    orientation: str, crop_px: float, other: tuple[float, float], outside: bool
) -> None:
    config = load_config(
        "smoke", {"arena.orientation": orientation, "arena.crop_px": str(crop_px)}, {}
    ).arena
    scene = [(300, 300, np.pi / 4), (*other, 0)]
    seen = outside_images(config, np.array([scene] * 9, np.float64), 0, 1)
    assert seen.tolist() == [outside] * (config.stack + 1)


def test_a_collision_is_unseen_if_one_image_before_lacked_the_other() -> None:
    config = CONFIG.model_copy(update={"crop_px": 60.0})
    met = straight_on(config, (250, 300, 0), (350, 300, np.pi))
    assert described(met, config).unseen  # 75 px ahead is 20 px outside, four frames before
    assert described(straight_on(config, (40, 300, np.pi), (300, 100, 0)), config).unseen is None


def test_who_was_late_and_circled() -> None:
    on_target, lost = circling(150, 300, 301), circling(300, 100, 301)
    told = described(timed_out(np.stack([on_target, lost], axis=1), TARGETS))
    (late,) = told.late_robots
    assert (late.robot, late.target, late.circled) == (1, 1, True)
    assert late.path_px == pytest.approx(500)
    assert late.displacement_px < 13
    assert (told.contacts, told.explored_before, told.unseen) == ((), None, None)
    driven = driving((40, 100, 0), 201)
    (late,) = described(timed_out(np.stack([on_target[:201], driven], 1), TARGETS)).late_robots
    assert not late.circled


@pytest.mark.parametrize("last", [None, 0, 1, 7, 41])
def test_bisection_finds_the_last_savable_frame(last: int | None) -> None:
    rounds = []

    def saves(asked: Sequence[tuple[int, int]]) -> list[bool]:
        rounds.append(len(asked))
        return [last is not None and frame <= last for _, frame in asked]

    assert last_savable_frames([42, 43, 100], saves) == [last] * 3
    assert len(rounds) <= 7
    assert last_savable_frames([], saves) == []


def test_a_head_on_collision_could_be_saved_until_shortly_before() -> None:
    subject = controlled("greedy", load_config("quick", {}, {}))
    replays = []
    result = straight_on(subject.config.arena, (200, 300, 0), (420, 300, np.pi))
    (told,) = failures_of(subject, [result], 0, lambda: replays.append(1))
    assert told.contacts[0].robots == (0, 1)
    assert told.savable
    assert told.savable_until_frame is not None
    assert 0 < told.frames - told.savable_until_frame < 10
    assert len(replays) <= num_replays([result])


def test_what_is_too_late_is_not_saved() -> None:
    config = load_config("quick", {"arena.max_frames": "80"}, {})
    late = straight_on(config.arena, (175, 550, UP), (425, 550, UP))
    assert late.outcome is Outcome.TIMEOUT
    (told,) = failures_of(controlled("greedy", config), [late], 0, lambda: None)
    assert told.savable is False  # nothing was wrong on the way, but 230 px take 92 frames


def test_a_world_that_the_safe_controller_does_not_know_is_said() -> None:
    config = load_config("quick", {"arena.obstacles_px": "[[300, 300, 30]]"}, {})
    result = straight_on(config.arena, (100, 500, 0), (300, 380, UP))
    (told,) = failures_of(controlled("greedy", config), [result], 0, lambda: None)
    assert told.savable is None
    summary = summarize([told], 1)
    assert (summary.shares["savable"].of, summary.shares["savable"].share) == (0, None)


def test_shares_count_what_a_question_applies_to() -> None:
    on_target, lost = circling(150, 300, 301), circling(300, 100, 301)
    timeout = described(timed_out(np.stack([on_target, lost], axis=1), TARGETS))
    failures = [described(FACING), described(FACING), timeout]
    summary = summarize(failures, 10)
    counted = {key: (s.count, s.of) for key, s in summary.shares.items()}
    assert counted["hit_robot"] == (2, 3)
    assert counted["timeout"] == (1, 3)
    assert counted["unseen"] == (0, 2)
    assert counted["explored_before"] == (0, 2)
    assert counted["late_robot"] == counted["circled"] == (1, 1)
    text = failure_table(failures, summary, 2)
    assert "start 0, frame 3: robots 0 and 1 at (300, 300)" in text
    assert "3 failures of 10 episodes" in text
    assert text.count("start ") == len(as_json(failures, summary, 2)["listed"]) == 2
    assert "robot 1" in failure_table(failures, summary, 3)


def test_exploration_is_to_blame_only_where_there_was_some() -> None:
    def played(name: str, epsilon: float) -> tuple[list[EpisodeResult], list[Failure]]:
        config = load_config("quick", {"evaluator.epsilon": str(epsilon)}, {})
        subject = controlled(name, config)
        *_, results = evaluate.evaluate(subject, 20, 1, lambda _done: None, keep_failed_paths=True)
        return results, failures_of(subject, results, 1, lambda: None)

    results, failures = played("greedy", 0.05)
    assert failures
    for told in failures:
        if not results[told.start].explored.any():
            assert not told.succeeds_without_exploration
    _, failures = played("safe_circle", 0.5)
    assert failures
    assert all(told.succeeds_without_exploration for told in failures)


def test_the_command_tells_failures_of_random_weights_and_the_same_numbers_as_without(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], one_thread: None
) -> None:
    config = load_config("smoke", {"arena.max_frames": "40"}, {})
    (tmp_path / "config.toml").write_text(to_toml(config))
    payload = weights_to_bytes(QNetwork(config.agent.kind))
    write_weights(tmp_path / "checkpoints" / "best.safetensors", payload, {})
    argv = [str(tmp_path), "--episodes", "6"]

    def told(*more: str) -> dict[str, object]:
        assert evaluate.main([*argv, "--json", *more]) == 0
        said: dict[str, object] = json.loads(capsys.readouterr().out)
        assert said.pop("wall_s")
        return said

    plain, one, every = told(), told("--failures", "1"), told("--failures")
    failures = every.pop("failures")
    assert isinstance(failures, dict)
    assert every == plain
    assert failures["failures"] == len(failures["listed"]) == 6  # random weights
    few = one["failures"]
    assert isinstance(few, dict)
    assert few == failures | {"listed": failures["listed"][:1]}
    assert evaluate.main([*argv, "--failures", "2"]) == 0
    assert "6 failures of 6 episodes" in capsys.readouterr().out
