"""Episodes with fewer robots than the arena has room for: the others are as if they were not."""

from typing import Any

import numpy as np
import pytest

from mrcdrl.common.arena import ArenaBatch, Scene, literal_views, make_codec, render_arena
from mrcdrl.common.arena.world import starts
from mrcdrl.common.arena.world.layout import layout_symmetries
from mrcdrl.common.config import ArenaConfig

HARD = {
    "target_layout": "random",
    "num_obstacles": 1,
    "failure_probability": 0.01,
    "dropped_frame_probability": 0.1,
    "pixel_noise": 3.0,
    "back_off_frames": 3,
}


def arena(**settings: Any) -> ArenaConfig:
    return ArenaConfig.model_validate({"robots": (1, 2, 4), "max_frames": 60, **settings})


def batch(config: ArenaConfig, num_arenas: int = 6) -> ArenaBatch:
    """Arenas whose first episodes have begun."""
    arenas = ArenaBatch(config, [np.random.default_rng(seed) for seed in range(num_arenas)])
    for index in range(num_arenas):
        arenas.reset(index)
    return arenas


@pytest.mark.parametrize("settings", [{}, {"num_targets": 4}, HARD])
def test_both_engines_agree_and_the_absent_do_nothing(settings: dict[str, Any]) -> None:
    compiled, plain = batch(arena(**settings)), batch(arena(physics="pymunk", **settings))
    rng, seen = np.random.default_rng(0), set()
    for _ in range(150):
        present = compiled.present.copy()
        np.testing.assert_array_equal(present, plain.present)
        seen |= set(present.tolist())
        absent = np.arange(4) >= present[:, None]
        moves = rng.integers(0, 3, (6, 4))
        steps, others = compiled.step(moves), plain.step(moves)
        for name in ("records", "rewards", "collided", "hit_wall"):
            np.testing.assert_array_equal(getattr(steps, name), getattr(others, name))
        assert steps.outcomes == others.outcomes
        assert not steps.rewards[absent].any()
        assert not steps.collided[absent].any()
        assert compiled.failed[absent].all()
        assert not compiled.failed.all(axis=1).any(), "the last one that is there never fails"
        for index in np.flatnonzero([outcome is not None for outcome in steps.outcomes]).tolist():
            compiled.reset(index)
            plain.reset(index)
    assert seen == {1, 2, 4}


@pytest.mark.parametrize("num_targets", [0, 4])
@pytest.mark.parametrize("number", [1, 2])
def test_an_episode_is_that_of_an_arena_with_so_many_robots(number: int, num_targets: int) -> None:
    config = arena(num_targets=num_targets)
    alone = config.with_robots(number)
    assert (alone.num_robots, alone.target_count) == (number, num_targets or number)
    mixed, fixed = (ArenaBatch(c, [np.random.default_rng(0)]) for c in (config, alone))
    decode, decode_alone = make_codec(config).decode, make_codec(alone).decode
    rng = np.random.default_rng(1)
    for begin in starts.test_starts(alone, 3, seed=0):
        step, own = mixed.reset(0, begin), fixed.reset(0, begin)
        while True:
            images = decode(step.records)
            np.testing.assert_array_equal(images[:number], decode_alone(own.records))
            assert not images[number:].any(), "who is absent sees nothing"
            np.testing.assert_array_equal(step.rewards[:number], own.rewards)
            np.testing.assert_array_equal(mixed.scene(0).robots, fixed.scene(0).robots)
            np.testing.assert_array_equal(mixed.scene(0).targets, fixed.scene(0).targets)
            assert (step.outcome, step.discount) == (own.outcome, own.discount)
            if own.last:
                break
            moves = rng.integers(0, 3, (1, 4))
            step, own = mixed.step(moves)[0], fixed.step(moves[:, :number])[0]


def test_those_who_are_there_succeed_without_the_others() -> None:
    game = batch(arena(num_targets=4), 1)
    config = arena(num_targets=4).with_robots(2)
    (begin,) = starts.test_starts(config, 1, seed=0)
    robots = np.column_stack([begin.targets[:2] - [2.5, 0], np.zeros(2)])
    game.reset(0, type(begin)(robots, begin.targets))
    step = game.step([[1, 1, 1, 1]])[0]
    assert step.outcome == "success"
    np.testing.assert_array_equal(step.rewards, [200, 200, 0, 0])


def test_a_start_has_one_of_the_numbers_of_robots() -> None:
    game = ArenaBatch(arena(), [np.random.default_rng(0)])
    (begin,) = starts.test_starts(ArenaConfig(num_robots=3), 1, seed=0)
    with pytest.raises(ValueError, match="this arena has"):
        game.reset(0, begin)


def test_chances_say_how_many_robots_there_are() -> None:
    game = batch(arena(), 1)
    game.chances = np.array([0.0, 1.0, 0.0])
    for _ in range(10):
        game.reset(0)
        assert game.present.tolist() == [2]
    game.chances = np.array([0.5, 0.0, 0.5])
    drawn = [(game.reset(0), int(game.present[0]))[1] for _ in range(200)]
    assert set(drawn) == {1, 4}
    assert 60 < drawn.count(1) < 140


@pytest.mark.parametrize("orientation", ["unrotated", "heading_up"])
def test_what_is_absent_is_not_rendered(orientation: str) -> None:
    config = arena(orientation=orientation)
    alone = config.with_robots(2)
    (begin,) = starts.test_starts(alone, 1, seed=0)
    absent = np.full((2, 3), np.nan)
    scene = Scene(
        np.concatenate([begin.robots, absent]), np.concatenate([begin.targets, absent[:, :2]])
    )
    own = Scene(begin.robots, begin.targets)
    np.testing.assert_array_equal(render_arena(scene, config), render_arena(own, alone))
    views = literal_views(scene, config)
    np.testing.assert_array_equal(views[:2], literal_views(own, alone))
    assert not views[2:].any()
    for settings in ({}, {"renderer": "literal"}, {"codec": "frames"}):
        pair = [c.model_copy(update=settings) for c in (config, alone)]
        codec, codec_alone = (make_codec(c) for c in pair)
        images = codec.decode(codec.encode(scene))
        np.testing.assert_array_equal(images[:2], codec_alone.decode(codec_alone.encode(own)))
        assert not images[2:].any()


def test_symmetries_hold_for_every_number_of_robots() -> None:
    each = [set(layout_symmetries(arena().with_robots(number))) for number in (1, 2, 4)]
    assert set(layout_symmetries(arena())) == set.intersection(*each) == each[1]
    assert len(each[1]) == 4
    assert len(layout_symmetries(arena(num_targets=4))) == 8
