"""The counting arena: every number can be recomputed, and torn images are detected."""

import numpy as np
import pytest

from mrcdrl.common.arena import (
    CountingArena,
    counting_frames,
    counting_outcome,
    counting_reward,
    decode_counters,
    make_codec,
)
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Outcome

CONFIG = ArenaConfig(kind="counting", codec="frames", num_robots=3)


def test_everything_is_a_function_of_identity_episode_and_step() -> None:
    codec = make_codec(CONFIG)
    game = CountingArena(CONFIG, identity=300)
    outcomes = set()
    for episode in range(12):
        time_step = game.reset()
        frames = counting_frames(300, episode)
        for step in range(frames + 1):
            counters = decode_counters(codec.decode(time_step.records))
            assert counters.identity.tolist() == [300] * 3
            assert counters.robot.tolist() == [0, 1, 2]
            assert counters.episode.tolist() == [episode] * 3
            assert counters.step.tolist() == [step] * 3
            expected = counting_reward(episode, step) if step else 0
            assert time_step.rewards.tolist() == [expected] * 3
            assert time_step.last is (step == frames)
            if step < frames:
                assert time_step.discount == 1.0
                time_step = game.step(np.zeros(3, int))
        assert time_step.outcome is counting_outcome(300, episode)
        assert time_step.discount == (0.0 if time_step.outcome is Outcome.SUCCESS else 1.0)
        outcomes.add((frames, time_step.outcome))
    assert len(outcomes) == 12


def test_a_torn_image_is_detected() -> None:
    codec = make_codec(CONFIG)
    game = CountingArena(CONFIG)
    before = codec.decode(game.reset().records)
    after = codec.decode(game.reset().records)
    for row in (1, 30, 59):
        torn = after.copy()
        torn[1, row:] = before[1, row:]
        with pytest.raises(ValueError, match="1 of 3 images"):
            decode_counters(torn)
    with pytest.raises(ValueError, match="3 of 3"):
        decode_counters(np.zeros_like(after))
    stacked = decode_counters(np.stack([before, after], axis=1))
    assert stacked.episode.tolist() == [[0, 1]] * 3


def test_an_identity_must_fit() -> None:
    with pytest.raises(ValueError, match="identity 65536"):
        CountingArena(CONFIG, identity=65536)
