"""The paper's test: given starts, one collision is failure, the same seed the same result."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mrcdrl.common.arena import (
    LEFT,
    STRAIGHT,
    Arena,
    Scene,
    Start,
    layout_for,
    make_codec,
    test_starts,
)
from mrcdrl.common.arena.controllers import make_controller
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import (
    BoolArray,
    Float32Array,
    Outcome,
    TimeStep,
    UInt8Array,
)
from mrcdrl.common.model.policy import Policy
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.sync.broadcast import Broadcast, Moment
from mrcdrl.services.evaluator.trial import (
    ControllerPlayer,
    EpisodeResult,
    Player,
    PolicyPlayer,
    Show,
    play,
)

CONFIG = ArenaConfig(num_robots=2, view_px=32, max_frames=150)
starts_of = test_starts  # else pytest takes it for a test
del test_starts


class SteadyPlayer:
    """Every robot takes the same action always; notes what it is told."""

    def __init__(self, action: int) -> None:
        self._action = action
        self.explored = np.zeros((0, CONFIG.num_robots), np.bool_)
        self.begun: list[int] = []
        self.observed: list[tuple[int, ...]] = []

    def begin(self, arena: int, time_step: TimeStep) -> None:
        assert time_step.first
        self.begun.append(arena)

    def act(self, arenas: NDArray[np.int64], scenes: Sequence[Scene]) -> UInt8Array:
        assert len(arenas) == len(scenes)
        self.explored = np.zeros((len(arenas), CONFIG.num_robots), np.bool_)
        return np.full((len(arenas), CONFIG.num_robots), self._action, np.uint8)

    def observe(self, arenas: NDArray[np.int64], records: UInt8Array) -> None:
        self.observed.append(records.shape)


def controlled(name: str, epsilon: float = 0.0, seed: int = 0) -> ControllerPlayer:
    rng = np.random.default_rng(seed)
    return ControllerPlayer(lambda: make_controller(name, CONFIG, rng), epsilon, rng)


def by_policy(epsilon: float) -> PolicyPlayer:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = QNetwork("dqn", view_px=CONFIG.view_px)
    rng = np.random.default_rng(4)
    return PolicyPlayer(CONFIG, make_codec(CONFIG), Policy(network), epsilon, rng)


def outcomes(results: Sequence[EpisodeResult] | None) -> list[tuple[Outcome, int, float]]:
    assert results is not None
    return [(r.outcome, r.frames, r.score) for r in results]


def start(*robots: tuple[float, float, float]) -> Start:
    return Start(np.array(robots), layout_for(CONFIG, np.random.default_rng(0)).targets)


TOWARDS = start((300, 300, 0), (360, 300, np.pi))  # collide at once, going straight
APART = start((100, 300, -np.pi / 2), (500, 300, -np.pi / 2))


def test_one_collision_ends_the_episode() -> None:
    (result,) = play(CONFIG, [TOWARDS], SteadyPlayer(STRAIGHT)) or []
    assert result.outcome is Outcome.COLLISION
    assert result.frames < 5
    assert CONFIG.max_collisions == 5


def test_results_come_in_the_order_of_the_starts() -> None:
    starts = [TOWARDS, APART] * 40  # more than are played at once
    results = outcomes(play(CONFIG, starts, SteadyPlayer(STRAIGHT)))
    assert results[0][1] < results[1][1]  # frames
    assert results == results[:2] * 40


def test_a_time_out_is_at_the_last_frame() -> None:
    (result,) = play(CONFIG, [APART], SteadyPlayer(LEFT)) or []
    assert (result.outcome, result.frames) == (Outcome.TIMEOUT, CONFIG.max_frames)


def test_the_player_is_told_of_every_start_and_step() -> None:
    player = SteadyPlayer(LEFT)
    play(CONFIG, [APART] * 3, player)
    assert player.begun == [0, 1, 2]
    assert player.observed == [(3, 2, CONFIG.record_bytes)] * CONFIG.max_frames


def test_the_same_seed_gives_the_same_results() -> None:
    starts = starts_of(CONFIG, 6, seed=1)
    first, second = (play(CONFIG, starts, by_policy(0.3)) for _ in range(2))
    assert outcomes(first) == outcomes(second)
    third, fourth = (play(CONFIG, starts, controlled("greedy", 0.3, seed=2)) for _ in range(2))
    assert outcomes(third) == outcomes(fourth)


def test_the_greedy_controller_succeeds_more_often_than_the_random_one() -> None:
    starts = starts_of(CONFIG, 40, seed=3)
    wins = {
        name: sum(o is Outcome.SUCCESS for o, _, _ in outcomes(play(CONFIG, starts, player)))
        for name, player in (("greedy", controlled("greedy")), ("random", controlled("random")))
    }
    assert wins["greedy"] > wins["random"] + 5


@pytest.mark.parametrize("keep_paths", [True, False])
def test_paths_are_kept_where_asked_for(keep_paths: bool) -> None:
    (result,) = play(CONFIG, [TOWARDS], SteadyPlayer(STRAIGHT), keep_paths=keep_paths) or []
    if not keep_paths:
        assert len(result.robots) == 0
        return
    assert result.robots.shape == (result.frames + 1, 2, 3)
    np.testing.assert_allclose(result.robots[0], TOWARDS.robots)
    np.testing.assert_allclose(result.targets, TOWARDS.targets)


def test_failed_paths_alone_are_kept_and_change_no_result() -> None:
    starts = starts_of(CONFIG, 20, seed=3)
    plain = play(CONFIG, starts, controlled("greedy", 0.1))
    kept = play(CONFIG, starts, controlled("greedy", 0.1), keep_failed_paths=True) or []
    assert outcomes(kept) == outcomes(plain)
    assert {r.outcome is Outcome.SUCCESS for r in kept} == {True, False}
    for result in kept:
        played = 0 if result.outcome is Outcome.SUCCESS else result.frames
        assert result.explored.shape == (played, 2)
        assert len(result.robots) == (played + 1 if played else 0)


@pytest.mark.parametrize("epsilon", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("make", [by_policy, lambda epsilon: controlled("greedy", epsilon)])
def test_explored_are_the_actions_that_exploration_changed(
    make: Callable[[float], Player], epsilon: float
) -> None:
    results = play(CONFIG, starts_of(CONFIG, 30, seed=1), make(epsilon), keep_paths=True) or []
    explored = np.concatenate([r.explored for r in results])
    # A uniform action is the best one in a third of all cases.
    assert explored.mean() == pytest.approx(epsilon * 2 / 3, abs=0.05)


def test_an_episode_may_begin_at_any_frame_of_a_path() -> None:
    config = CONFIG.model_copy(update={"num_robots": 4, "num_obstacles": 1})
    rng = np.random.default_rng(0)
    player = ControllerPlayer(lambda: make_controller("random", config, rng), 0.0, rng)
    results = play(config, starts_of(config, 10, seed=2), player, keep_paths=True) or []
    arena = Arena(config, rng)
    for result in results:
        for robots in result.robots:
            arena.reset(Start(robots, result.targets, result.obstacles))
            np.testing.assert_array_equal(arena.scene.robots, robots)


def test_no_starts_no_results() -> None:
    assert play(CONFIG, [], SteadyPlayer(LEFT)) == []


def test_it_ends_when_told_to_and_says_how_far_it_is() -> None:
    told: list[int] = []

    def keep_going(done: int) -> bool:
        told.append(done)
        return done < 2

    starts = [TOWARDS, TOWARDS, APART]
    assert play(CONFIG, starts, SteadyPlayer(STRAIGHT), keep_going=keep_going) is None
    assert told[0] == 0
    assert told[-1] == 2


def test_who_is_watched_plays_the_same() -> None:
    """One arena is shown, frame by frame, with what its policy saw, and its results stay."""
    shown: list[tuple[int, str]] = []
    starts = starts_of(CONFIG, 6, 3)

    class Shown(Broadcast):
        """Keeps what an evaluator would show."""

        watched = True

        def __init__(self) -> None:
            pass

        def acts(self, moment: Moment, q_values: Float32Array, actions: UInt8Array) -> None:
            assert moment.images.shape == (2, CONFIG.view_px, CONFIG.view_px)
            np.testing.assert_array_equal(q_values.argmax(axis=1), actions)
            shown.append((moment.frame, ""))

        def stepped(
            self, collided: BoolArray, last: Moment | None, outcome: Outcome | None
        ) -> None:
            if last is not None and outcome is not None:
                shown.append((last.frame, outcome))

    alone, player = play(CONFIG, starts, by_policy(0.0)), by_policy(0.0)
    watched = play(CONFIG, starts, player, show=Show(Shown(), player, 3))
    assert watched is not None
    assert alone is not None
    assert [(r.outcome, r.frames, r.score) for r in watched] == [
        (r.outcome, r.frames, r.score) for r in alone
    ]
    first = watched[0]
    assert shown[: first.frames] == [(frame, "") for frame in range(first.frames)]
    assert shown[first.frames] == (first.frames, first.outcome)
