"""Controllers that see the true state: the properties of each, and that they mostly succeed."""

import math
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrcdrl.common.arena import Arena, ArenaBatch, Scene
from mrcdrl.common.arena.controllers import CONTROLLERS, SafeCircle, greedy_actions, make_controller
from mrcdrl.common.arena.controllers.heading import (
    actions_towards,
    assigned_distances_px,
    shortest_assignment,
)
from mrcdrl.common.arena.world import starts
from mrcdrl.common.arena.world.obstacles import reachable_px
from mrcdrl.common.arena.world.physics import ArrayPhysics
from mrcdrl.common.arena.world.rewards import target_distances_px
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Float64Array, Outcome
from tests.common.arena.shared import NO_OBSTACLES, TARGETS


def outcomes(name: str, config: ArenaConfig, episodes: int, epsilon: float = 0) -> list[Outcome]:
    """Plays the paper's test and returns how its episodes end."""
    rng = np.random.default_rng(0)
    game = Arena(config, rng, max_collisions=1)
    ended = []
    for start in starts.test_starts(config, episodes, seed=0):
        play = make_controller(name, config, rng)
        step = game.reset(start)
        while not step.last:
            actions = play(game.scene)
            explores = rng.random(len(actions)) < epsilon
            step = game.step(np.where(explores, rng.integers(0, 3, len(actions)), actions))
        assert step.outcome is not None
        ended.append(step.outcome)
    return ended


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_controller_gives_an_action_to_every_robot(name: str) -> None:
    for num_robots in (1, 3):
        config = ArenaConfig(num_robots=num_robots)
        game = Arena(config, np.random.default_rng(0))
        play = make_controller(name, config, np.random.default_rng(0))
        game.reset()
        for _ in range(5):
            game.step(play(game.scene))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("clever", "choose from random, greedy, potential_field, orca, safe_circle"),
        ("safe-circle", "did you mean safe_circle"),
        ("potential", "did you mean potential_field"),
        ("", "choose from random"),
    ],
)
def test_an_unknown_controller_is_refused_with_the_closest_match(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_controller(name, ArenaConfig(), np.random.default_rng(0))


def test_greedy_heads_for_free_targets() -> None:
    robots = np.array([[170.0, 100, 0], [180.0, 500, 0]])
    nearer = greedy_actions(Scene(robots, TARGETS), ArenaConfig())
    assert nearer.tolist() == [2, 0]  # one to (175, 300), below it; one to (425, 300), above


@pytest.mark.parametrize(
    ("name", "robots", "least"),
    [("greedy", 2, 0.75), ("potential_field", 4, 0.9), ("orca", 4, 0.9), ("safe_circle", 4, 1.0)],
)
def test_a_controller_mostly_succeeds(name: str, robots: int, least: float) -> None:
    ended = outcomes(name, ArenaConfig(num_robots=robots), 20)
    assert ended.count(Outcome.SUCCESS) >= 20 * least


@pytest.mark.parametrize("layout", ["fixed", "random"])
def test_safe_circle_never_collides_and_survives_exploration(layout: str) -> None:
    config = ArenaConfig.model_validate({"num_robots": 6, "target_layout": layout})
    assert Outcome.COLLISION not in outcomes("safe_circle", config, 5)
    assert outcomes("safe_circle", config, 5, epsilon=0.01).count(Outcome.COLLISION) <= 1


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), num_robots=st.integers(1, 5), power=st.sampled_from([1, 2]))
def test_the_assignment_is_the_shortest_of_all(seed: int, num_robots: int, power: int) -> None:
    rng = np.random.default_rng(seed)
    scene = Scene(rng.uniform(0, 600, (num_robots, 3)), rng.uniform(0, 600, (num_robots, 2)))
    costs = target_distances_px(scene) ** power
    every = [costs[np.arange(num_robots), list(p)].sum() for p in permutations(range(num_robots))]
    chosen = shortest_assignment(scene, power)
    assert sorted(chosen.tolist()) == list(range(num_robots))
    assert costs[np.arange(num_robots), chosen].sum() == pytest.approx(min(every))


@given(st.integers(0, 2**32 - 1), st.lists(st.booleans(), min_size=1, max_size=4))
def test_assigned_distances_are_the_least_in_sum_of_those_who_take_part(
    seed: int, taking_part: list[bool]
) -> None:
    """In each of two arenas, with up to two targets more than robots; some targets are absent."""
    rng, num_robots = np.random.default_rng(seed), len(taking_part)
    num_targets = num_robots + int(rng.integers(3))
    absent = int(rng.integers(num_targets - sum(taking_part) + 1))
    robots = rng.uniform(0, 600, (2, num_robots, 3))
    robots[:, ~np.array(taking_part)] = np.nan  # nobody looks where the others are
    targets = rng.uniform(0, 600, (2, num_targets, 2))
    targets[:, num_targets - absent :] = np.nan
    scenes = Scene(robots, targets)
    found = assigned_distances_px(scenes, np.array([taking_part] * 2))
    each = np.flatnonzero(taking_part)
    for i in range(2):
        distances = target_distances_px(Scene(robots[i], scenes.targets[i]))
        choices = permutations(range(num_targets - absent), len(each))
        least = min(distances[each, list(chosen)].sum() for chosen in choices)
        assert found[i].sum() == pytest.approx(least)
        assert (found[i][~np.array(taking_part)] == 0).all()
        for robot in each:
            assert np.isclose(distances[robot], found[i, robot]).any()


def test_a_robot_that_has_failed_needs_no_target() -> None:
    batch = ArenaBatch(ArenaConfig(num_robots=3), [np.random.default_rng(0)])
    batch.reset(0)
    whole = batch.assigned_distances_px(np.array([0]))
    assert (whole > 0).all()
    batch.failed[0, 1] = True
    left = batch.assigned_distances_px(np.array([0]))
    assert left[0, 1] == 0
    assert left.sum() <= whole[0, [0, 2]].sum()


def test_with_squares_the_robot_in_the_way_takes_the_farther_target() -> None:
    scene = Scene(
        np.array([[100.0, 300, 0], [200.0, 300, 0]]), np.array([[210.0, 300], [400, 300]])
    )
    assert shortest_assignment(scene, power=2).tolist() == [0, 1]


@pytest.mark.parametrize(
    ("heading", "wanted", "action"),
    [(0, 0, 1), (0, 0.1, 1), (0, 0.3, 2), (0, -0.3, 0), (3, -3, 2), (-3, 3, 0), (0, 3, 2)],
)
def test_the_action_that_turns_nearest(heading: float, wanted: float, action: int) -> None:
    got = actions_towards(np.array([heading], float), np.array([wanted], float), ArenaConfig())
    assert got.tolist() == [action]


@settings(max_examples=200)
@given(
    seed=st.integers(0, 2**32 - 1),
    sides=st.tuples(st.sampled_from([-1, 1]), st.sampled_from([-1, 1])),
)
def test_gaps_are_the_least_while_circling_forever(seed: int, sides: tuple[int, int]) -> None:
    config = ArenaConfig()
    rng = np.random.default_rng(seed)
    poses = np.concatenate([rng.uniform(240, 360, (2, 2)), rng.uniform(-4, 4, (2, 1))], axis=1)
    poses[0, 0] = rng.uniform(0, 240)  # the wall may be nearer than the other
    gaps = SafeCircle(config).gaps(poses[:1], np.array(sides[:1]), poses[1:], np.array(sides[1:]))
    least = least_gap(config, poses, np.array(sides))
    assert gaps[0] <= least + 1e-9
    if math.dist(poses[0, :2], poses[1, :2]) > 30:  # else one circles within the other
        assert gaps[0] == pytest.approx(least, abs=0.2)


def least_gap(config: ArenaConfig, poses: Float64Array, sides: Float64Array) -> float:
    """Least gap of the first robot in 720 frames of circling."""
    turns = np.arange(1, 721)[:, None] * sides * math.radians(config.turn_deg)
    headings = poses[:, 2] + turns
    ways = config.step_px * np.stack([np.cos(headings), np.sin(headings)], axis=2).cumsum(axis=0)
    places = np.concatenate([poses[None, :, :2], poses[:, :2] + ways])
    low, high = reachable_px(config)
    walls = np.minimum(places[:, 0] - low, high - places[:, 0]).min()
    apart = np.linalg.norm(places[:, 0] - places[:, 1], axis=1).min()
    return float(min(walls, apart - 2 * config.robot_radius_px))


@pytest.mark.parametrize(
    "settings", [{"num_obstacles": 3}, {"inner_walls_px": ((300, 200, 300, 400),)}]
)
def test_controllers_play_among_obstacles_or_refuse(
    settings: dict[str, object],
) -> None:
    config = ArenaConfig.model_validate({"max_frames": 400, **settings})
    rng = np.random.default_rng(0)
    for name in CONTROLLERS:
        if name in ("orca", "safe_circle"):
            with pytest.raises(ConfigError, match=f"{name}.* not support obstacles"):
                make_controller(name, config, rng)
        else:
            make_controller(name, config, rng)
    with pytest.raises(ConfigError, match=r"safe_circle.* robots that fail"):
        make_controller("safe_circle", ArenaConfig(failure_probability=0.1), rng)
    game = Arena(config, rng, max_collisions=1)
    wins = 0
    for start in starts.test_starts(config, 20, seed=0):
        play = make_controller("potential_field", config, rng)
        step = game.reset(start)
        while not step.last:
            step = game.step(play(game.scene))
        wins += step.outcome is Outcome.SUCCESS
    assert wins >= 15


def test_circling_stays_on_its_circle() -> None:
    config = ArenaConfig(num_robots=1)
    physics = ArrayPhysics(config, 1)
    physics.place(0, np.array([[300.0, 300.0, 0.3]]), NO_OBSTACLES)
    places = []
    for _ in range(360):
        physics.move(np.array([0]), np.zeros((1, 1), np.uint8), np.zeros((1, 1), np.bool_))
        places.append(physics.robots[0, 0, :2].copy())
    across = np.ptp(np.array(places), axis=0)
    assert across == pytest.approx(2 * 6.27, abs=0.05)
