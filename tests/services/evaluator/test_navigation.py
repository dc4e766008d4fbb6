"""Measures of navigation, by hand and as they add up."""

import dataclasses
import json
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.common.arena import STRAIGHT, Scene, Start, layout_for
from mrcdrl.common.arena.controllers import make_controller
from mrcdrl.common.arena.world import starts
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Float64Array, Outcome, UInt8Array
from mrcdrl.services.evaluator.navigation import Journey, journey, navigation, navigation_table
from mrcdrl.services.evaluator.trial import ControllerPlayer, play

SUCCESS, COLLISION, TIMEOUT = Outcome.SUCCESS, Outcome.COLLISION, Outcome.TIMEOUT
TARGETS = np.array([[100.0, 100.0], [300.0, 100.0]])
NONE = np.zeros(2, np.bool_)


def driven(*frames: Sequence[tuple[float, float]]) -> Float64Array:
    """A path [T, K, 3] of robots with heading 0."""
    return np.array([[(x, y, 0.0) for x, y in frame] for frame in frames])


def test_a_journey_by_hand() -> None:
    path = driven([(300, 220), (100, 130)], [(260, 190), (100, 130)], [(300, 160), (100, 100)])
    made = journey(path, TARGETS, NONE, NONE, radius_px=25)
    assert made.path_px.tolist() == [100, 30]
    assert made.straight_px.tolist() == [120, 30]
    expected = np.hypot(160, 60) - 50
    assert made.separation_px == pytest.approx([expected, expected])


def test_a_robot_alone_has_no_separation() -> None:
    config = ArenaConfig(num_robots=1)
    path = driven([(300, 220)], [(300, 217.5)])
    made = journey(path, TARGETS[:1], NONE[:1], NONE[:1], config.robot_radius_px)
    assert made.separation_px.tolist() == [np.inf]
    measures = navigation([TIMEOUT], [1], [made])
    assert measures.smallest_separation_px is None
    assert measures.robots[0].smallest_separation_px is None
    json.dumps(dataclasses.asdict(measures), allow_nan=False)


def test_measures_by_hand() -> None:
    far, near = np.array([20.0, 20.0]), np.array([4.0, 4.0])
    first, second = np.array([True, False]), np.array([False, True])
    line = np.array([100.0, 50.0])
    measures = navigation(
        [SUCCESS, SUCCESS, COLLISION, COLLISION, TIMEOUT],
        [50, 100, 7, 8, 1000],
        [
            Journey(1.5 * line, line, far, NONE, NONE),
            Journey(np.array([100.0, 80.0]), line, near, NONE, NONE),
            Journey(line, line, np.zeros(2), first | second, NONE),
            Journey(line, line, far, NONE, second),
            Journey(9 * line, line, far, NONE, NONE),
        ],
    )
    assert (measures.success_rate, measures.timeout_rate) == (0.4, 0.2)
    assert (measures.collision_with_robot_rate, measures.collision_with_wall_rate) == (0.2, 0.2)
    assert (measures.frames_to_success_mean, measures.frames_to_success_p90) == (75, 95)
    assert measures.path_over_straight_mean == pytest.approx((1.5 + 1.2) / 2)
    assert (measures.smallest_separation_px, measures.smallest_separation_p50_px) == (0, 20)
    one, two = measures.robots
    assert (one.collision_with_robot_rate, one.collision_with_wall_rate) == (0.2, 0)
    assert (two.collision_with_robot_rate, two.collision_with_wall_rate) == (0.2, 0.2)
    assert one.path_over_straight == pytest.approx(250 / 200)
    text = navigation_table(measures)
    assert "collision with a robot  20.00%, with a wall alone 20.00%" in text
    assert "robot 1" in text
    assert "path length ÷ straight line" in text


@given(
    ended=st.lists(
        st.tuples(st.sampled_from(Outcome), st.booleans(), st.booleans()), min_size=1, max_size=40
    )
)
def test_rates_sum_to_1_and_nothing_is_nan(ended: list[tuple[Outcome, bool, bool]]) -> None:
    outcomes = [outcome for outcome, _, _ in ended]
    journeys = [
        Journey(
            np.ones(2), np.ones(2), np.ones(2), np.array([robot, robot]), np.array([wall, 0]) > 0
        )
        for _, robot, wall in ended
    ]
    measures = navigation(outcomes, [10] * len(ended), journeys)
    rates = [
        measures.success_rate,
        measures.collision_with_robot_rate,
        measures.collision_with_wall_rate,
        measures.timeout_rate,
    ]
    assert sum(rates) == pytest.approx(1)
    assert (measures.frames_to_success_mean is None) is (SUCCESS not in outcomes)
    json.dumps(dataclasses.asdict(measures), allow_nan=False)
    navigation_table(measures)


@pytest.mark.parametrize(
    ("robots", "hit_robot", "hit_wall"),
    [
        ([(300, 300, 0), (351, 300, np.pi)], [True, True], [False, False]),
        ([(40, 300, np.pi), (300, 100, 0)], [False, False], [True, False]),
    ],
)
def test_play_tells_what_a_robot_ran_into(
    robots: list[tuple[float, float, float]], hit_robot: list[bool], hit_wall: list[bool]
) -> None:
    config = ArenaConfig()

    def straight(scene: Scene) -> UInt8Array:
        return np.full(2, STRAIGHT, np.uint8)

    rng = np.random.default_rng(0)
    player = ControllerPlayer(lambda: straight, 0.0, rng)
    start = Start(np.array(robots), layout_for(config, rng).targets)
    (result,) = play(config, [start], player) or []
    assert result.outcome is COLLISION
    assert result.journey.hit_robot.tolist() == hit_robot
    assert result.journey.hit_wall.tolist() == hit_wall
    assert len(result.robots) == 0


def test_journeys_match_the_paths_played() -> None:
    config = ArenaConfig()
    rng = np.random.default_rng(0)
    player = ControllerPlayer(lambda: make_controller("safe_circle", config, rng), 0.0, rng)
    results = play(config, starts.test_starts(config, 4, 0), player, keep_paths=True) or []
    for result in results:
        ways = np.linalg.norm(np.diff(result.robots[..., :2], axis=0), axis=2).sum(axis=0)
        np.testing.assert_allclose(result.journey.path_px, ways)
        np.testing.assert_allclose(ways, result.frames * config.step_px)
        assert (result.journey.path_px > result.journey.straight_px - 20).all()
        assert (result.journey.separation_px >= 0).all()
