"""Noise and dropped frames, which a record determines completely."""

from typing import Any

import numpy as np
import pytest

from mrcdrl.common.arena import Arena, Scene, make_codec
from mrcdrl.common.arena.images.noise import add_noise
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import UInt8Array

SCENE = Scene(np.array([[200.0, 300, 1], [400, 200, 2]]), np.array([[175.0, 300], [425, 300]]))


def records_of(config: ArenaConfig, frames: int = 40) -> UInt8Array:
    """Plays with a seed and returns records [frames, K, R]."""
    rng = np.random.default_rng(5)
    game = Arena(config, rng)
    records = [game.reset().records]
    for _ in range(frames - 1):
        records.append(game.step(np.full(config.num_robots, 1)).records)
    return np.stack(records)


def test_noise_has_its_mean_and_deviation_and_follows_the_seed() -> None:
    views = np.full((4, 255, 255), 128, np.uint8)
    add_noise(views, np.array([1, 2, 2, 2**32 - 1], np.uint32), 10.0)
    noise = views.astype(float) - 128
    np.testing.assert_allclose(noise.mean(axis=(1, 2)), 0, atol=0.2)
    np.testing.assert_allclose(noise.std(axis=(1, 2)), 10, rtol=0.02)
    np.testing.assert_array_equal(views[1], views[2])
    for one, other in [(0, 1), (0, 3), (1, 3)]:
        assert abs(np.corrcoef(noise[one].ravel(), noise[other].ravel())[0, 1]) < 0.02
    assert abs(np.corrcoef(noise[0, :, 1:].ravel(), noise[0, :, :-1].ravel())[0, 1]) < 0.02


def test_noise_is_clipped_at_black_and_white() -> None:
    views = np.stack([np.zeros((60, 60), np.uint8), np.full((60, 60), 255, np.uint8)])
    add_noise(views, np.zeros(2, np.uint32), 20.0)
    assert (views[0] == 0).mean() == pytest.approx(0.5, abs=0.05)
    assert (views[1] == 255).mean() == pytest.approx(0.5, abs=0.05)


def splitmix(state: int) -> int:
    """The generator again, in Python's integers."""
    state = (state ^ (state >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    state = (state ^ (state >> 27)) * 0x94D049BB133111EB % 2**64
    return state ^ (state >> 31)


def test_noise_is_four_lanes_of_splitmix_summed() -> None:
    views = np.full((1, 2, 3), 100, np.uint8)
    add_noise(views, np.array([7], np.uint32), 30.0)
    gamma = 0x9E3779B97F4A7C15
    state = splitmix(7 * gamma % 2**64)
    for pixel in views.ravel().tolist():
        state = (state + gamma) % 2**64
        total = sum(splitmix(state) >> shift & 0xFFFF for shift in (0, 16, 32, 48))
        deviations = (total - 2 * 65535) / np.sqrt((65536.0**2 - 1) / 3)
        assert pixel == int(100 + 30 * deviations + 0.5)


def test_only_noisy_records_carry_a_seed() -> None:
    plain, noisy = ArenaConfig(), ArenaConfig(pixel_noise=8)
    assert (plain.record_bytes, noisy.record_bytes) == (40, 44)
    records = make_codec(noisy).encode(SCENE, np.array([3, 2**32 - 1], np.uint32))
    np.testing.assert_array_equal(records[:, :40], make_codec(plain).encode(SCENE))
    assert records[:, 40:].view("<u4").ravel().tolist() == [3, 2**32 - 1]


@pytest.mark.parametrize("renderer", ["analytic", "literal"])
def test_both_codecs_show_the_same_noise_and_the_same_drops(renderer: str) -> None:
    base = {"pixel_noise": 8, "dropped_frame_probability": 0.3, "renderer": renderer}
    by_codec = []
    for codec in ("scene", "frames"):
        config = ArenaConfig.model_validate({**base, "codec": codec})
        records = records_of(config, 20)
        assert records.shape[-1] == config.record_bytes
        by_codec.append(make_codec(config).decode(records))
    np.testing.assert_array_equal(*by_codec)
    fresh = (by_codec[0][1:] != by_codec[0][:-1]).any(axis=(2, 3))
    assert 0.4 < fresh.mean() < 0.95


def test_a_dropped_frame_repeats_the_previous_record_of_that_robot() -> None:
    plain = records_of(ArenaConfig(max_collisions=1000))
    settings: dict[str, Any] = {"max_collisions": 1000, "dropped_frame_probability": 0.25}
    seen = records_of(ArenaConfig.model_validate(settings))
    np.testing.assert_array_equal(seen[0], plain[0])
    dropped = (seen != plain).any(axis=2)
    assert 0.1 < dropped.mean() < 0.4
    assert (dropped.sum(axis=1) == 1).any()  # robots drop frames independently
    for frame, robot in zip(*np.nonzero(dropped), strict=True):
        np.testing.assert_array_equal(seen[frame, robot], seen[frame - 1, robot])


def test_a_seed_gives_the_same_noise_and_failures_again() -> None:
    config = ArenaConfig(
        pixel_noise=5, dropped_frame_probability=0.1, failure_probability=0.01, max_collisions=1000
    )
    np.testing.assert_array_equal(records_of(config), records_of(config))
