"""The paper's rewards with numbers worked out by hand, and the definition of success."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrcdrl.common.arena import Scene
from mrcdrl.common.arena.world.rewards import drawn_to_occupied, frame_rewards, on_target_px
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import BoolArray, Float32Array

TARGETS = [(175.0, 300.0), (425.0, 300.0)]
HIT = [True, False]
FREE = [False, False]


def scene(*places: tuple[float, float], targets: list[tuple[float, float]] = TARGETS) -> Scene:
    robots = np.array([(x, y, 0.0) for x, y in places])
    return Scene(robots, np.array(targets))


def rewarded(
    scene: Scene,
    collided: BoolArray,
    frame: int,
    config: ArenaConfig,
    failed: BoolArray | None = None,
) -> tuple[Float32Array, bool]:
    """Applies frame_rewards to one arena."""
    failed = np.zeros(len(collided), np.bool_) if failed is None else failed
    stacked = Scene(scene.robots[None], scene.targets[None])
    frames = np.array([frame])
    rewards, success = frame_rewards(stacked, collided[None], failed[None], frames, config)
    return rewards[0], bool(success[0])


def test_on_target_is_nearer_than_the_printed_root() -> None:
    assert on_target_px(ArenaConfig()) == pytest.approx(42.72, abs=0.002)


@pytest.mark.parametrize(
    ("places", "collided", "frame", "expected", "success"),
    [
        pytest.param([(300, 100), (300, 500)], FREE, 1, [0.03, 0.03], False, id="off"),
        pytest.param([(300, 100), (300, 500)], HIT, 1, [-5, 0.03], False, id="collision"),
        pytest.param([(175, 300), (300, 500)], FREE, 250, [0.85, 0.03], False, id="half-time"),
        # chi = 21.36 px: r_chi = 0.5; f = 100: r_f = 0.8; 0.7 * 0.5 + 0.3 * 0.8
        pytest.param([(175, 321.36), (300, 500)], FREE, 100, [0.59, 0.03], False, id="on-target"),
        pytest.param([(175, 321.36), (300, 500)], FREE, 500, [0.35, 0.03], False, id="at-f_max"),
        pytest.param([(175, 321.36), (300, 500)], FREE, 900, [0.35, 0.03], False, id="past-f_max"),
        pytest.param([(175, 342.7), (175, 342.8)], FREE, 500, [0.0003, 0.03], False, id="edge"),
        pytest.param([(175, 319), (425, 281)], FREE, 9, [200, 200], True, id="success"),
        pytest.param([(425, 319), (175, 281)], FREE, 9, [200, 200], True, id="either-target"),
        # chi = 20 is not below delta: r_chi = 0.53182, r_f = 0.8
        pytest.param(
            [(175, 320), (425, 300)], FREE, 100, [0.61229, 0.94], False, id="delta-is-open"
        ),
        pytest.param([(175, 300), (425, 300)], HIT, 100, [-5, 0.94], False, id="collided-there"),
        # the same target for both: 1 - 10 / 42.72 = 0.76592
        pytest.param(
            [(165, 300), (185, 300)], FREE, 500, [0.53614, 0.53614], False, id="one-target"
        ),
    ],
)
def test_rewards(
    places: list[tuple[float, float]],
    collided: list[bool],
    frame: int,
    expected: list[float],
    success: bool,
) -> None:
    rewards, done = rewarded(scene(*places), np.array(collided), frame, ArenaConfig())
    assert rewards.dtype == np.float32
    np.testing.assert_allclose(rewards, expected, atol=1e-4)
    assert done is success


@pytest.mark.parametrize(
    ("places", "success"),
    [
        # within 20 px: robot 0 has A and B, robot 1 A, robot 2 C: 0 must leave A to 1
        ([(110, 100), (90, 100), (150, 100)], True),
        # robots 0 and 1 have only A, though each of the three targets has a robot near
        ([(95, 100), (90, 100), (135, 100)], False),
    ],
)
def test_success_finds_a_target_for_each(places: list[tuple[float, float]], success: bool) -> None:
    targets = [(100.0, 100.0), (125.0, 100.0), (150.0, 100.0)]
    config = ArenaConfig(num_robots=3)
    _, done = rewarded(scene(*places, targets=targets), np.zeros(3, np.bool_), 1, config)
    assert done is success


@settings(max_examples=300)
@given(seed=st.integers(0, 2**32 - 1), num_robots=st.integers(1, 4), spare=st.integers(0, 3))
def test_success_is_all_within_delta_of_distinct_targets(
    seed: int, num_robots: int, spare: int
) -> None:
    rng = np.random.default_rng(seed)
    num_targets = num_robots + spare
    config = ArenaConfig(num_robots=num_robots, num_targets=num_targets)
    targets = rng.uniform(280, 280 + 10 * num_targets, (num_targets, 2))
    places = rng.permutation(targets)[:num_robots] + rng.uniform(-16, 16, (num_robots, 2))
    robots = np.concatenate([rng.permutation(places), np.zeros((num_robots, 1))], axis=1)
    collided = rng.random(num_robots) < 0.05
    failed = rng.random(num_robots) < 0.2
    rewards, success = rewarded(Scene(robots, targets), collided, 1, config, failed)
    near = np.linalg.norm(robots[:, None, :2] - targets, axis=2) < config.success_radius_px
    each = np.flatnonzero(~failed)
    seated = any(near[each, list(o)].all() for o in permutations(range(num_targets), len(each)))
    assert success is (seated and not collided.any())
    assert (rewards == config.success_reward).all() == success
    assert (rewards[collided] == config.collision_reward).all()


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        pytest.param([(175, 300), (425, 300)], [False, False], id="each-its-own"),
        pytest.param([(175, 310), (175, 340)], [False, True], id="both-at-one"),
        pytest.param([(100, 300), (425, 300)], [False, False], id="off-but-free"),
        pytest.param([(175, 310), (290, 300)], [False, True], id="far-but-drawn"),
        pytest.param([(175, 310), (310, 300)], [False, False], id="nearer-to-the-free-one"),
        pytest.param([(175, 310), (175, 290)], [False, False], id="equally-near"),
        pytest.param([(np.nan, np.nan), (175, 310)], [False, False], id="absent"),
    ],
)
def test_a_target_is_occupied_by_the_robot_nearest_to_it(
    places: list[tuple[float, float]], expected: list[bool]
) -> None:
    one = scene(*places)
    assert drawn_to_occupied(one).tolist() == expected
    many = Scene(np.stack([one.robots, one.robots[::-1]]), np.stack([one.targets] * 2))
    assert drawn_to_occupied(many).tolist() == [expected, expected[::-1]]


def test_an_absent_target_draws_nobody() -> None:
    alone = scene((175, 310), (425, 330), targets=[(175.0, 300.0), (np.nan, np.nan)])
    assert drawn_to_occupied(alone).tolist() == [False, True]
