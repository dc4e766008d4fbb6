"""The collision rule as a table, and properties of any play."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrcdrl.common.arena import (
    LEFT,
    RIGHT,
    STRAIGHT,
    Layout,
    Scene,
    Start,
    Symmetry,
    training_start,
)
from mrcdrl.common.arena.world.obstacles import clearance_px, obstacles_for, reachable_px
from mrcdrl.common.arena.world.physics import ArrayPhysics, Physics
from mrcdrl.common.arena.world.pymunk_physics import PymunkPhysics
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import BoolArray, Float64Array, UInt8Array
from tests.common.arena.shared import NO_OBSTACLES

TURN = math.radians(23)
EAST, SOUTH, WEST, NORTH = 0.0, math.pi / 2, math.pi, -math.pi / 2
GO = STRAIGHT

PHYSICS = {"array": ArrayPhysics, "pymunk": PymunkPhysics}


class World:
    """The robots of one arena, moved by the configured physics."""

    def __init__(
        self, config: ArenaConfig, robots: Float64Array, obstacles: Float64Array = NO_OBSTACLES
    ) -> None:
        self._physics: Physics = PHYSICS[config.physics](config, 1)
        self._physics.place(0, robots, obstacles)
        self.hit_wall = np.zeros(len(robots), np.bool_)
        self.failed = np.zeros(len(robots), np.bool_)

    @property
    def robots(self) -> Float64Array:
        return self._physics.robots[0].copy()

    def move(self, moves: UInt8Array) -> BoolArray:
        collided, hit_wall = self._physics.move(np.array([0]), moves[None], self.failed[None])
        self.hit_wall = hit_wall[0]
        return collided[0]


def world(*robots: tuple[float, float, float], **settings: object) -> World:
    config = ArenaConfig.model_validate({"num_robots": len(robots), **settings})
    obstacles = np.array(config.obstacles_px, np.float64).reshape(-1, 3)
    return World(config, np.array(robots, np.float64), obstacles)


@pytest.fixture(params=PHYSICS)
def physics(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def actions(*values: int) -> UInt8Array:
    return np.array(values, np.uint8)


@pytest.mark.parametrize(("action", "heading"), [(LEFT, -TURN), (STRAIGHT, 0.0), (RIGHT, TURN)])
def test_a_robot_turns_and_then_moves(physics: str, action: int, heading: float) -> None:
    arena = world((300, 300, EAST), physics=physics)
    assert not arena.move(actions(action)).any()
    expected = (300 + 2.5 * math.cos(heading), 300 + 2.5 * math.sin(heading), heading)
    np.testing.assert_allclose(arena.robots[0], expected)


@pytest.mark.parametrize(
    ("robots", "collided"),
    [
        # walls: the inner face is at 12 px, so a centre may be at 37 px
        ([(39.5, 300, WEST)], [False]),
        ([(39.4, 300, WEST)], [True]),
        ([(560.5, 300, EAST)], [False]),
        ([(560.6, 300, EAST)], [True]),
        ([(300, 39.5, NORTH)], [False]),
        ([(300, 39.4, NORTH)], [True]),
        ([(300, 560.6, SOUTH)], [True]),
        # two robots: centres may be 50 px apart
        ([(200, 300, EAST), (255, 300, WEST)], [False, False]),
        ([(200, 300, EAST), (254.9, 300, WEST)], [True, True]),
        ([(200, 300, EAST), (250, 300, EAST)], [False, False]),
        ([(200, 300, EAST), (250, 300, SOUTH)], [True, True]),
        # a robot that drives away is not hit, though its old place would be
        ([(200, 300, WEST), (250, 300, WEST)], [False, False]),
        # a chain: the wall stops the first, whose old place stops the second, and so on
        ([(37, 300, WEST), (87, 300, WEST), (137, 300, WEST)], [True, True, True]),
        ([(37, 300, WEST), (89.6, 300, WEST), (140, 300, EAST)], [True, False, False]),
        ([(37, 300, WEST), (89.4, 300, WEST), (139.5, 300, WEST)], [True, True, True]),
    ],
)
def test_collisions(
    physics: str, robots: list[tuple[float, float, float]], collided: list[bool]
) -> None:
    arena = world(*robots, physics=physics)
    assert arena.move(actions(*[GO] * len(robots))).tolist() == collided
    for robot, before, blocked in zip(arena.robots, robots, collided, strict=True):
        assert (robot[:2].tolist() == list(before[:2])) is blocked


def test_a_blocked_robot_keeps_its_turn(physics: str) -> None:
    arena = world((37, 300, WEST), physics=physics)
    assert arena.move(actions(RIGHT)).all()
    np.testing.assert_allclose(arena.robots[0], (37, 300, TURN - math.pi))


def test_back_off_drives_backwards_and_is_neither_steered_nor_punished(physics: str) -> None:
    arena = world((38, 300, WEST), back_off_frames=2, physics=physics)
    assert arena.move(actions(STRAIGHT)).all()
    assert not arena.move(actions(LEFT)).any()
    assert not arena.move(actions(LEFT)).any()
    np.testing.assert_allclose(arena.robots[0], (43, 300, math.pi))
    assert not arena.move(actions(STRAIGHT)).any()
    np.testing.assert_allclose(arena.robots[0, 0], 40.5)


def test_a_robot_blocked_while_backing_off_does_not_collide(physics: str) -> None:
    robots = (562, 300, EAST), (512, 300, EAST), (462, 300, NORTH)
    arena = world(*robots, back_off_frames=3, physics=physics)
    assert arena.move(actions(GO, GO, GO)).tolist() == [True, True, False]
    before = arena.robots
    # the second drives back into the third, the first into the second
    assert arena.move(actions(GO, GO, GO)).tolist() == [False, False, True]
    np.testing.assert_array_equal(arena.robots, before)


@pytest.mark.parametrize(
    ("robot", "blocked"),
    [
        # a disc of radius 20 at (300, 300): centres stay 45 px away
        ((252.5, 300, EAST), False),
        ((252.6, 300, EAST), True),
        # a wall 2 px thick from (100, 200) to (100, 400): centres stay 26 px away, also at its end
        ((128.5, 300, WEST), False),
        ((128.4, 300, WEST), True),
        ((71.6, 300, EAST), True),
        ((100, 171.5, SOUTH), False),
        ((100, 171.6, SOUTH), True),
        ((74.5, 170.0, SOUTH), False),
    ],
)
def test_obstacles_stop_robots(
    physics: str, robot: tuple[float, float, float], blocked: bool
) -> None:
    arena = world(
        robot,
        obstacles_px=((300, 300, 20),),
        inner_walls_px=((100, 200, 100, 400),),
        physics=physics,
    )
    assert arena.move(actions(GO)).tolist() == [blocked]
    assert arena.hit_wall.tolist() == [blocked]


def test_a_failed_robot_stands_still_and_stops_others(physics: str) -> None:
    arena = world((200, 300, EAST), (252, 300, WEST), (300, 500, EAST), physics=physics)
    arena.failed = np.array([False, True, False])
    assert arena.move(actions(GO, LEFT, GO)).tolist() == [True, False, False]
    assert not arena.hit_wall.any()
    assert arena.robots[1].tolist() == [252, 300, WEST]
    assert arena.robots[:, 0].tolist() == [200, 252, 302.5]


@pytest.mark.parametrize(
    "robots",
    [
        [(36.9, 300, 0)],
        [(300, 563.1, 0)],
        [(-1000, 300, 0)],
        [(300, math.nan, 0)],
        [(300, 300, math.inf)],
        [(300, 300, 0), (349, 300, 0)],
        [(456, 400, 0)],
        [(100, 226, 0)],
    ],
)
def test_impossible_places_are_refused(
    physics: str, robots: list[tuple[float, float, float]]
) -> None:
    fixed = {"obstacles_px": ((500, 400, 20),), "inner_walls_px": ((100, 100, 100, 201),)}
    with pytest.raises(ValueError, match="robot"):
        world(*robots, **fixed, physics=physics)


OBSTRUCTED = {
    "size_px": 400,
    "obstacles_px": ((320, 300, 15),),
    "num_obstacles": 1,
    "obstacle_radius_px": 20,
    "inner_walls_px": ((120, 60, 120, 160), (40, 250, 150, 330)),
}


def crowd(seed: int, **settings: object) -> tuple[ArenaConfig, Start, np.random.Generator]:
    """Makes a crowded arena, in which robots collide often."""
    config = ArenaConfig.model_validate({"num_robots": 5, "size_px": 270, **settings})
    rng = np.random.default_rng(seed)
    layout = Layout(np.zeros((5, 2)), obstacles_for(config, np.empty((0, 2)), rng))
    return config, training_start(config, layout, rng), rng


def clear(config: ArenaConfig, robots: Float64Array, obstacles: Float64Array) -> bool:
    low, high = reachable_px(config)
    first, second = np.triu_indices(len(robots), 1)
    gaps = np.hypot(*(robots[first, :2] - robots[second, :2]).T)
    places = robots[:, :2]
    return bool(
        (gaps >= 2 * config.robot_radius_px - 1e-9).all()
        and (places >= low - 1e-9).all()
        and (places <= high + 1e-9).all()
        and (clearance_px(config, places, obstacles) >= -1e-9).all()
    )


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    back_off=st.sampled_from([0, 3]),
    world_and_step=st.sampled_from([({}, 2.5), ({}, 80.0), (OBSTRUCTED, 2.5), (OBSTRUCTED, 30.0)]),
)
def test_robots_never_overlap_nor_leave(
    seed: int, back_off: int, world_and_step: tuple[dict[str, object], float]
) -> None:
    fixed, step = world_and_step
    config, start, rng = crowd(seed, back_off_frames=back_off, step_px=step, **fixed)
    arena = World(config, start.robots, start.obstacles)
    for _ in range(60):
        arena.move(rng.integers(0, 3, 5, dtype=np.uint8))
        assert clear(config, arena.robots, start.obstacles)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), order=st.permutations(range(5)))
def test_the_order_of_robots_does_not_matter(seed: int, order: list[int]) -> None:
    config, start, rng = crowd(seed)
    one, other = World(config, start.robots), World(config, start.robots[order])
    for _ in range(60):
        moves = rng.integers(0, 3, 5, dtype=np.uint8)
        collided = one.move(moves)
        np.testing.assert_array_equal(other.move(moves[order]), collided[order])
        np.testing.assert_array_equal(other.robots, one.robots[order])


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), flags=st.tuples(*[st.booleans()] * 3), bare=st.booleans())
def test_a_mapped_world_gives_the_mapped_outcome(
    seed: int, flags: tuple[bool, bool, bool], bare: bool
) -> None:
    config, start, rng = crowd(seed, **({} if bare else OBSTRUCTED))
    symmetry = Symmetry(*flags)

    def mapped(poses: Float64Array) -> Scene:
        scene = Scene(poses, np.zeros((5, 2)), start.obstacles)
        return symmetry.apply_to_scene(scene, config.size_px)

    ends = np.array(config.inner_walls_px).reshape(-1, 2)
    walls = symmetry.apply_to_points(ends, config.size_px).reshape(-1, 4).tolist()
    turned_config = config.model_copy(update={"inner_walls_px": tuple(map(tuple, walls))})
    turned_start = mapped(start.robots)
    one = World(config, start.robots, start.obstacles)
    other = World(turned_config, turned_start.robots, turned_start.obstacles)
    for _ in range(60):
        moves = rng.integers(0, 3, 5, dtype=np.uint8)
        collided = one.move(moves)
        np.testing.assert_array_equal(other.move(symmetry.apply_to_actions(moves)), collided)
        expected = mapped(one.robots).robots
        np.testing.assert_allclose(other.robots[:, :2], expected[:, :2], atol=1e-7)
        turned = np.exp(1j * (other.robots[:, 2] - expected[:, 2]))
        np.testing.assert_allclose(turned, 1, atol=1e-9)


def by_the_rule(
    config: ArenaConfig, robots: Float64Array, moves: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Applies the rule in an independent implementation, without pymunk."""
    turned = robots.copy()
    turned[:, 2] += (moves - 1) * math.radians(config.turn_deg)
    ways = np.stack([np.cos(turned[:, 2]), np.sin(turned[:, 2])], axis=1)
    after = turned.copy()
    after[:, :2] += config.step_px * ways
    low, high = reachable_px(config)
    blocked = np.zeros(len(robots), np.bool_)
    while True:
        places = np.where(blocked[:, None], turned, after)[:, :2]
        gaps = np.linalg.norm(places[:, None] - places[None], axis=2)
        np.fill_diagonal(gaps, np.inf)
        hit = (gaps < 2 * config.robot_radius_px).any(axis=1)
        hit |= ((places < low) | (places > high)).any(axis=1)
        if not (hit & ~blocked).any():
            return np.where(blocked[:, None], turned, after), blocked
        blocked |= hit & ~blocked


def test_collisions_are_what_the_rule_says(physics: str) -> None:
    config, start, rng = crowd(1, physics=physics)
    arena = World(config, start.robots)
    low, high = reachable_px(config)
    seen = 0
    for _ in range(1000):
        moves = rng.integers(0, 3, 5, dtype=np.uint8)
        expected, blocked = by_the_rule(config, arena.robots, moves.astype(np.float64))
        turned = arena.robots[:, 2] + (moves - 1.0) * TURN
        ways = config.step_px * np.stack([np.cos(turned), np.sin(turned)], axis=1)
        proposals = arena.robots[:, :2] + ways
        np.testing.assert_array_equal(arena.move(moves), blocked)
        beyond = ((proposals < low) | (proposals > high)).any(axis=1)
        np.testing.assert_array_equal(arena.hit_wall, beyond)
        np.testing.assert_allclose(arena.robots[:, :2], expected[:, :2], atol=1e-9)
        seen += int(blocked.sum())
    assert seen > 100


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    num_robots=st.integers(1, 10),
    back_off=st.sampled_from([0, 1, 10]),
    step=st.sampled_from([2.5, 7.3, 60.0]),
    turn=st.sampled_from([23.0, 90.0, 171.3]),
    offset=st.sampled_from([10.0, 0.0, 3.7]),
    bare=st.booleans(),
)
def test_array_physics_equals_pymunk_to_the_bit(
    seed: int, num_robots: int, back_off: int, step: float, turn: float, offset: float, bare: bool
) -> None:
    fixed = {} if bare else OBSTRUCTED
    config = ArenaConfig.model_validate(
        {
            "num_robots": num_robots,
            "size_px": round(60 + 100 * num_robots**0.5),
            "back_off_frames": back_off,
            "step_px": step if bare else min(step, 30),
            "turn_deg": turn,
            "wall_offset_px": offset,
            **fixed,
        }
    )
    rng = np.random.default_rng(seed)
    one, other = ArrayPhysics(config, 2), PymunkPhysics(config, 2)
    for arena in (0, 1):
        obstacles = obstacles_for(config, np.empty((0, 2)), rng)
        robots = training_start(config, Layout(np.empty((0, 2)), obstacles), rng).robots
        robots[:, 2] *= rng.choice([1, 5])  # headings need not be wrapped
        one.place(arena, robots, obstacles)
        other.place(arena, robots, obstacles)
    failed = np.zeros((2, num_robots), np.bool_)
    for _ in range(60):
        failed |= rng.random(failed.shape) < 0.01
        arenas = np.flatnonzero(rng.random(2) < 0.9)
        if len(arenas):
            moves = rng.integers(0, 3, (len(arenas), num_robots), dtype=np.uint8)
            ours = one.move(arenas, moves, failed[arenas])
            theirs = other.move(arenas, moves, failed[arenas])
            np.testing.assert_array_equal(ours, theirs)
        assert one.robots.tobytes() == other.robots.tobytes()
