"""Whole episodes: outcomes, discounts, refused misuse, and identical play from one seed."""

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrcdrl.common.arena import (
    Arena,
    ArenaBatch,
    CountingArena,
    CountingBatch,
    Start,
    Symmetry,
    make_arenas,
    make_codec,
)
from mrcdrl.common.arena.controllers import make_controller
from mrcdrl.common.arena.world import starts
from mrcdrl.common.arena.world.obstacles import clearance_px
from mrcdrl.common.config import ArenaConfig, load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Outcome, StepType
from tests.common.arena.shared import TARGETS, in_another_process, start

GO = np.ones(2, np.uint8)


def arena(max_collisions: int | None = None, **settings: object) -> Arena:
    config = ArenaConfig.model_validate(settings)
    return Arena(config, np.random.default_rng(0), max_collisions=max_collisions)


def test_an_episode_from_first_to_success() -> None:
    game = arena()
    first = game.reset(start((140, 300, 0), (440, 300, np.pi)))
    assert first.first
    assert (first.rewards.tolist(), first.discount, first.outcome) == ([0, 0], 1.0, None)
    for frame in range(1, 7):  # 140 -> 155 is 20 px away, which is not below delta
        step = game.step(GO)
        assert (step.step_type, step.discount, step.outcome) == (StepType.MID, 1.0, None)
        assert game.frame == frame
    last = game.step(GO)
    assert last.last
    assert (last.outcome, last.discount, last.rewards.tolist()) == (Outcome.SUCCESS, 0, [200, 200])
    with pytest.raises(ValueError, match="reset first"):
        game.step(GO)


@pytest.mark.parametrize(
    ("max_collisions", "frames", "collisions"), [(None, 3, 6), (1, 1, 2), (3, 2, 4)]
)
def test_collisions_of_all_robots_end_an_episode(
    max_collisions: int | None, frames: int, collisions: int
) -> None:
    game = arena(max_collisions)
    game.reset(start((200, 500, 0), (250, 500, np.pi)))
    step = game.step(GO)
    while not step.last:
        assert step.rewards.tolist() == [-5, -5]
        assert step.discount == 1.0
        step = game.step(GO)
    assert (game.frame, game.collisions) == (frames, collisions)
    assert (step.outcome, step.discount) == (Outcome.COLLISION, 0)
    assert step.collided.all()


def test_a_timeout_is_truncated_not_terminated() -> None:
    game = arena(max_frames=4)
    game.reset(start((100, 100, 0), (100, 500, 0)))
    steps = [game.step(GO) for _ in range(4)]
    assert [s.step_type for s in steps] == [StepType.MID] * 3 + [StepType.LAST]
    assert (steps[-1].outcome, steps[-1].discount) == (Outcome.TIMEOUT, 1.0)
    assert game.reset().first
    assert (game.frame, game.collisions) == (0, 0)


def test_failure_in_the_last_frame_is_failure() -> None:
    game = arena(1, max_frames=1)
    game.reset(start((200, 500, 0), (250, 500, np.pi)))
    assert game.step(GO).outcome is Outcome.COLLISION


def test_records_are_the_codecs() -> None:
    game = arena()
    codec = make_codec(ArenaConfig())
    np.testing.assert_array_equal(game.reset().records, codec.encode(game.scene))
    np.testing.assert_array_equal(game.step(GO).records, codec.encode(game.scene))


def test_random_targets_change_from_episode_to_episode() -> None:
    game = arena(target_layout="random")
    game.reset()
    before = game.scene.targets
    game.reset()
    assert not np.array_equal(before, game.scene.targets)


@pytest.mark.parametrize(
    "actions", [[1], [1, 1, 1], [[1, 1]], [0, 3], [-1, 0], [0.0, 1.0], [True, False], []]
)
def test_bad_actions_are_refused(actions: list[object]) -> None:
    for game in (arena(), counting()):
        game.reset()
        with pytest.raises(ValueError, match="actions"):
            game.step(np.array(actions))


def counting() -> CountingArena:
    return CountingArena(ArenaConfig(kind="counting", codec="frames"))


def test_misuse_is_refused() -> None:
    for game in (arena(), counting()):
        with pytest.raises(ValueError, match="reset first"):
            game.step(GO)
    with pytest.raises(ValueError, match=r"this arena has .*2, 3"):
        arena().reset(Start(np.zeros((3, 3)), np.zeros((3, 2))))
    with pytest.raises(ValueError, match="targets"):
        arena().reset(Start(start((100, 100, 0), (200, 200, 0)).robots, TARGETS * np.nan))
    with pytest.raises(ValueError, match="overlaps"):
        arena().reset(start((100, 100, 0), (120, 100, 0)))
    with pytest.raises(ValueError, match="max_collisions 0"):
        arena(0)
    with pytest.raises(ConfigError, match="10 robots"):
        arena(num_robots=10, size_px=200, success_radius_px=24)


def test_make_arenas_goes_by_kind() -> None:
    rngs = [np.random.default_rng(0)]
    assert isinstance(make_arenas(ArenaConfig(), rngs, [3]), ArenaBatch)
    config = ArenaConfig(kind="counting", codec="frames")
    assert isinstance(make_arenas(config, rngs, [3]), CountingBatch)


@pytest.mark.parametrize("physics", ["array", "pymunk"])
def test_a_batch_plays_what_its_arenas_would_play_alone(physics: str) -> None:
    config = ArenaConfig.model_validate(
        {"num_robots": 3, "size_px": 300, "max_frames": 40, "physics": physics}
    )
    batch = ArenaBatch(config, [np.random.default_rng(seed) for seed in range(4)])
    alone = [Arena(config, np.random.default_rng(seed)) for seed in range(4)]
    for index, game in enumerate(alone):
        np.testing.assert_array_equal(batch.reset(index).records, game.reset().records)
    rng = np.random.default_rng(9)
    for _ in range(200):
        arenas = np.flatnonzero(rng.random(4) < 0.7)
        moves = rng.integers(0, 3, (len(arenas), 3))
        steps = batch.step(moves, arenas)
        for index, own, ours in zip(arenas, moves, steps, strict=True):
            theirs = alone[index].step(own)
            assert (ours.step_type, ours.outcome) == (theirs.step_type, theirs.outcome)
            assert ours.discount == theirs.discount
            for name in ("records", "rewards", "collided", "hit_wall"):
                np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
            assert (batch.frames[index], batch.collisions[index]) == (
                alone[index].frame,
                alone[index].collisions,
            )
            if ours.last:
                with pytest.raises(ValueError, match="reset first"):
                    batch.step(moves[:1], np.array([index]))
                np.testing.assert_array_equal(
                    batch.reset(index).records, alone[index].reset().records
                )


@pytest.mark.parametrize("physics", ["array", "pymunk"])
def test_failed_robots_stand_still_and_the_last_one_never_fails(physics: str) -> None:
    batch = ArenaBatch(
        ArenaConfig.model_validate(
            {"num_robots": 4, "failure_probability": 0.05, "physics": physics, "max_frames": 200}
        ),
        [np.random.default_rng(seed) for seed in range(3)],
        max_collisions=10**6,
    )
    for index in range(3):
        batch.reset(index)
    seen = 0
    for _ in range(150):
        before = [batch.scene(index).robots for index in range(3)]
        steps = batch.step(np.ones((3, 4), int))
        for index, robots in enumerate(before):
            still = batch.failed[index]
            np.testing.assert_array_equal(batch.scene(index).robots[still], robots[still])
            assert not steps.collided[index, still].any()
            assert not still.all()
        seen = max(seen, int(batch.failed.sum(axis=1).max()))
    assert seen == 3
    batch.reset(0)
    assert not batch.failed[0].any()


def test_success_does_not_wait_for_a_robot_that_failed() -> None:
    begin = start((160, 300, 0), (300, 500, 0))  # the first is on a target, the second is not
    seen = set()
    for seed in range(10):
        game = Arena(ArenaConfig(failure_probability=1), np.random.default_rng(seed))
        game.reset(begin)
        outcome = game.step(GO).outcome
        first_stands, second_stands = (game.scene.robots == begin.robots).all(axis=1)
        assert first_stands != second_stands
        assert outcome is (Outcome.SUCCESS if second_stands else None)
        seen.add(outcome)
    assert len(seen) == 2


@pytest.mark.parametrize("num_robots", [1, 4, 10])
def test_the_hard_preset_can_be_played(num_robots: int) -> None:
    given = {"arena.num_robots": str(num_robots), "arena.num_targets": str(num_robots + 2)}
    config = load_config("hard", given, environ={}).arena
    batch = ArenaBatch(config, [np.random.default_rng(seed) for seed in range(4)])
    codec = make_codec(config)
    rng = np.random.default_rng(1)
    ended = list(range(4))
    for _ in range(150):
        for index in ended:
            batch.reset(index)
            scene = batch.scene(index)
            assert (clearance_px(config, scene.robots[:, :2], scene.obstacles) >= 0).all()
        steps = batch.step(rng.integers(0, 3, (4, num_robots)))
        assert codec.decode(steps.records).shape == (4, num_robots, 60, 60)
        ended = [index for index, outcome in enumerate(steps.outcomes) if outcome is not None]


def fingerprint(physics: str) -> str:
    """Hashes 1 000 seeded steps."""
    base = {"num_robots": 4, "target_layout": "random", "max_collisions": 20}
    config = ArenaConfig.model_validate({**base, "physics": physics})
    rng = np.random.default_rng(7)
    game = Arena(config, rng)
    codec = make_codec(config)
    play = make_controller("random", config, rng)
    total = hashlib.sha256()
    step = game.reset()
    for _ in range(1000):
        for array in (step.records, step.rewards, step.collided, step.hit_wall, game.scene.robots):
            total.update(array.tobytes())
        total.update(codec.decode(step.records).tobytes())
        step = game.reset() if step.last else game.step(play(game.scene))
    for begin in starts.test_starts(config, 20, seed=1):
        total.update(begin.robots.tobytes() + begin.targets.tobytes())
    return total.hexdigest()


def test_a_seed_gives_the_same_play_in_another_process_and_by_pymunk() -> None:
    there = in_another_process(__file__, "fingerprint('array')")
    assert there == fingerprint("array") == fingerprint("pymunk")


@settings(max_examples=16)
@given(
    seed=st.integers(0, 2**32 - 1),
    flags=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    world=st.sampled_from(
        [
            {"size_px": 270},
            {"size_px": 400, "target_layout": "random", "num_targets": 4, "num_obstacles": 2},
        ]
    ),
)
def test_a_mapped_arena_pays_and_ends_the_same(
    seed: int, flags: tuple[bool, bool, bool], world: dict[str, object]
) -> None:
    symmetry = Symmetry(*flags)
    config = ArenaConfig.model_validate(
        {"num_robots": 3, "max_collisions": 20, "max_frames": 60, **world}
    )
    rng = np.random.default_rng(seed)
    one, other = Arena(config, rng), Arena(config, rng)
    one.reset()
    scene = one.scene
    mapped = symmetry.apply_to_scene(scene, config.size_px)
    one.reset(Start(scene.robots, scene.targets, scene.obstacles))
    other.reset(Start(mapped.robots, mapped.targets, mapped.obstacles))
    running = True
    while running:
        moves = rng.integers(0, 3, 3, dtype=np.uint8)
        step, same = one.step(moves), other.step(symmetry.apply_to_actions(moves))
        np.testing.assert_allclose(same.rewards, step.rewards, atol=1e-5)
        np.testing.assert_array_equal(same.collided, step.collided)
        np.testing.assert_array_equal(same.hit_wall, step.hit_wall)
        assert same.outcome is step.outcome
        running = not step.last
