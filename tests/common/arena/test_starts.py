"""Layouts, training starts and the paper's test starts."""

import math
from itertools import product

import numpy as np
import pytest

from mrcdrl.common.arena import (
    LEFT,
    Layout,
    Scene,
    Symmetry,
    layout_for,
    layout_symmetries,
    training_start,
)
from mrcdrl.common.arena.world import starts
from mrcdrl.common.arena.world.layout import fixed_layout
from mrcdrl.common.arena.world.obstacles import clearance_px
from mrcdrl.common.arena.world.physics import ArrayPhysics
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError
from tests.common.arena.shared import NO_OBSTACLES

NONE_FAILED = np.zeros((1, 10), np.bool_)


def nearest_pair(points: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]") -> float:
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    return float(gaps.min())


@pytest.mark.parametrize("num_robots", range(1, 11))
def test_fixed_layouts_leave_room(num_robots: int) -> None:
    targets = fixed_layout(num_robots)
    assert targets.shape == (num_robots, 2)
    assert nearest_pair(targets) >= 150
    assert (np.abs(targets - 300) <= 300 - 37).all()


def test_fixed_layouts_of_the_trial() -> None:
    assert fixed_layout(2).tolist() == [[175, 300], [425, 300]]
    assert {tuple(t) for t in fixed_layout(4).tolist()} == set(product((175, 425), repeat=2))
    with pytest.raises(ConfigError, match="11 targets"):
        fixed_layout(11)


def test_layout_follows_size_and_targets_px() -> None:
    rng = np.random.default_rng(0)
    assert layout_for(ArenaConfig(size_px=300), rng).targets.tolist() == [[87.5, 150], [212.5, 150]]
    given = ArenaConfig(targets_px=((100, 100), (200, 300)))
    assert layout_for(given, rng).targets.tolist() == [[100, 100], [200, 300]]


def test_random_layouts_leave_room() -> None:
    config = ArenaConfig(num_robots=4, target_layout="random")
    rng = np.random.default_rng(0)
    for _ in range(50):
        targets = layout_for(config, rng).targets
        assert nearest_pair(targets) >= 90
        assert targets.min() >= 42
        assert targets.max() <= 558


@pytest.mark.parametrize("num_targets", [6, 10, 20])
def test_more_targets_than_robots(num_targets: int) -> None:
    config = ArenaConfig(num_robots=4, num_targets=num_targets, target_layout="random")
    rng = np.random.default_rng(0)
    for _ in range(20):
        targets = layout_for(config, rng).targets
        assert targets.shape == (num_targets, 2)
        assert nearest_pair(targets) >= 90
    assert starts.test_starts(config, 2, seed=0)[0].targets.shape == (num_targets, 2)
    with pytest.raises(ConfigError, match="30 random targets"):
        layout_for(config.model_copy(update={"num_targets": 30}), rng)


@pytest.mark.parametrize("layout", ["fixed", "random"])
def test_random_obstacles_leave_room_to_pass_and_to_stand(layout: str) -> None:
    config = ArenaConfig.model_validate(
        {
            "num_robots": 4,
            "target_layout": layout,
            "obstacles_px": ((300, 300, 20),),
            "num_obstacles": 3,
            "inner_walls_px": ((60, 60, 120, 60),),
        }
    )
    rng = np.random.default_rng(0)
    for _ in range(30):
        drawn = layout_for(config, rng)
        assert drawn.obstacles.shape == (4, 3)
        assert drawn.obstacles[:, 2].tolist() == [20, 30, 30, 30]
        for i, (*place, radius) in enumerate(drawn.obstacles):
            rest = np.delete(drawn.obstacles, i, axis=0)
            others = np.linalg.norm(rest[:, :2] - place, axis=1) - rest[:, 2] - radius
            assert others.min() >= 60
            if i:
                assert min(place) - 12 - radius >= 60
                assert 588 - max(place) - radius >= 60
        assert (clearance_px(config, drawn.targets, drawn.obstacles) >= 5).all()
        robots = training_start(config, drawn, rng).robots
        assert (clearance_px(config, robots[:, :2], drawn.obstacles) >= 0).all()


def test_test_starts_keep_off_obstacles_for_a_rotation() -> None:
    config = ArenaConfig(num_robots=3, num_obstacles=3, inner_walls_px=((300, 250, 300, 350),))
    physics = ArrayPhysics(config, 1)
    for start in starts.test_starts(config, 30, seed=3):
        physics.place(0, start.robots, start.obstacles)
        for _ in range(math.ceil(360 / 23)):
            collided, _ = physics.move(
                np.array([0]), np.full((1, 3), LEFT, np.uint8), NONE_FAILED[:, :3]
            )
            assert not collided.any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_obstacles": 12, "size_px": 300}, "12 random obstacles of radius 30"),
        ({"obstacles_px": ((200, 300, 20),)}, r"\(175, 300\) .* overlap an obstacle"),
        ({"inner_walls_px": ((425, 200, 425, 280),)}, r"\(425, 300\) .* overlap an obstacle"),
        ({"num_robots": 10, "size_px": 200, "target_layout": "random"}, "10 random targets"),
        ({"num_robots": 1, "targets_px": ((5, 300),)}, r"\(5, 300\) cannot be reached"),
        ({"targets_px": ((300, 300), (309, 300))}, "9 px apart"),
    ],
)
def test_impossible_layouts_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        layout_for(ArenaConfig.model_validate(settings), np.random.default_rng(0))


@pytest.mark.parametrize(
    ("settings", "count"),
    [
        ({"num_robots": 1}, 8),
        ({"num_robots": 2}, 4),
        ({"num_robots": 3}, 2),
        ({"num_robots": 4}, 8),
        ({"num_robots": 4, "target_layout": "random"}, 8),
        ({"num_robots": 1, "targets_px": ((100, 200),)}, 1),
        ({"num_robots": 1, "targets_px": ((200, 200),)}, 2),
        ({"num_robots": 3, "orientation": "heading_up"}, 2),
        ({"num_robots": 1, "targets_px": ((100, 200),), "orientation": "heading_up"}, 1),
        ({"num_robots": 4, "target_layout": "random", "orientation": "heading_up"}, 2),
        ({"num_robots": 4, "num_obstacles": 2}, 8),
        ({"num_robots": 4, "obstacles_px": ((300, 300, 20),)}, 8),
        ({"num_robots": 4, "obstacles_px": ((300, 100, 20),)}, 2),
        ({"num_robots": 4, "obstacles_px": ((300, 100, 20), (300, 500, 20))}, 4),
        ({"num_robots": 4, "obstacles_px": ((300, 100, 20), (300, 500, 21))}, 2),
        ({"num_robots": 4, "inner_walls_px": ((250, 300, 350, 300),)}, 4),
        ({"num_robots": 4, "inner_walls_px": ((250, 250, 350, 350),)}, 4),
        ({"target_layout": "random", "inner_walls_px": ((250, 299, 350, 301),)}, 2),
    ],
)
def test_symmetries_of_layouts(settings: dict[str, object], count: int) -> None:
    symmetries = layout_symmetries(ArenaConfig.model_validate(settings))
    assert len(set(symmetries)) == count
    assert Symmetry(transpose=False, flip_x=False, flip_y=False) in symmetries


def test_two_targets_side_by_side_may_be_flipped_but_not_transposed() -> None:
    assert set(layout_symmetries(ArenaConfig())) == {
        Symmetry(False, x, y) for x, y in product((False, True), repeat=2)
    }


@pytest.mark.parametrize("num_robots", [2, 4, 10])
def test_training_starts_are_legal(num_robots: int) -> None:
    config = ArenaConfig(num_robots=num_robots)
    rng = np.random.default_rng(0)
    targets = fixed_layout(num_robots)
    for _ in range(20):
        ArrayPhysics(config, 1).place(
            0, training_start(config, Layout(targets), rng).robots, NO_OBSTACLES
        )


@pytest.mark.parametrize("layout", ["fixed", "random"])
def test_test_starts_stay_clear_for_a_rotation(layout: str) -> None:
    config = ArenaConfig.model_validate({"num_robots": 4, "target_layout": layout})
    for start in starts.test_starts(config, 100, seed=3):
        physics = ArrayPhysics(config, 1)
        physics.place(0, start.robots, NO_OBSTACLES)
        for _ in range(math.ceil(360 / 23)):
            collided, _ = physics.move(
                np.array([0]), np.full((1, 4), LEFT, np.uint8), NONE_FAILED[:, :4]
            )
            assert not collided.any()
        assert Scene(start.robots, start.targets).targets.shape == (4, 2)


def test_a_seed_names_the_test_starts() -> None:
    config = ArenaConfig(num_robots=3, target_layout="random")
    one, again = (starts.test_starts(config, 30, seed=5) for _ in range(2))
    other = starts.test_starts(config, 30, seed=6)
    for a, b, c in zip(one, again, other, strict=True):
        np.testing.assert_array_equal(a.robots, b.robots)
        np.testing.assert_array_equal(a.targets, b.targets)
        assert not np.array_equal(a.robots, c.robots)
    for a, b in zip(one, starts.test_starts(config, 10, seed=5), strict=False):
        np.testing.assert_array_equal(a.robots, b.robots)


def test_too_many_robots_are_refused_by_name() -> None:
    config = ArenaConfig(num_robots=10, size_px=200)
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigError, match=r"10 robots .* 200 px"):
        training_start(config, Layout(np.zeros((10, 2))), rng)
    crowded = ArenaConfig(num_robots=4, size_px=130, target_layout="fixed", success_radius_px=30)
    with pytest.raises(ConfigError, match=r"4 robots .* 130 px"):
        starts.test_starts(crowded, 1, seed=0)
