"""Pictures drawn by torch are those of the host, symmetries included; here on the CPU's tensors."""

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arena import Scene, Symmetry, make_codec
from common.config import ArenaConfig, load_config
from common.trajectory import UInt8Array
from services.learner.drawing import DeviceDrawing, HostDrawing, ThreadedDecode, make_drawing

EVERY = [Symmetry(*flags) for flags in product((False, True), repeat=3)]


def records(config: ArenaConfig, num_scenes: int, seed: int = 0) -> UInt8Array:
    """Of all robots of scenes by chance, [num_scenes, K, R]; shapes overlap and reach outside."""
    rng, codec, num = np.random.default_rng(seed), make_codec(config), config.num_robots
    scenes = [
        Scene(
            rng.uniform((-50, -50, -np.pi), (650, 650, np.pi), (num, 3)),
            rng.uniform(-50, 650, (num, 2)),
        )
        for _ in range(num_scenes)
    ]
    return np.stack([codec.encode(scene) for scene in scenes])


def both(config: ArenaConfig, given: UInt8Array, turns: Any = ()) -> tuple[UInt8Array, UInt8Array]:
    """Pictures by the host and by the device."""
    host = HostDrawing(make_codec(config).decode)(given, turns)
    device = DeviceDrawing(config, "cpu")(given, turns)
    assert host.dtype == device.dtype == torch.uint8
    assert host.shape == device.shape
    return host.numpy(), device.numpy()


def largest_gap(one: UInt8Array, other: UInt8Array) -> int:
    return int(np.abs(one.astype(int) - other).max())


@settings(max_examples=60)
@given(
    num_robots=st.integers(1, 10),
    orientation=st.sampled_from(["unrotated", "heading_up"]),
    crop_px=st.floats(150, 1500),
    view_px=st.sampled_from([31, 60]),
    seed=st.integers(0, 2**32),
)
def test_the_device_draws_what_the_host_draws(
    num_robots: int, orientation: str, crop_px: float, view_px: int, seed: int
) -> None:
    config = ArenaConfig.model_validate(
        {
            "num_robots": num_robots,
            "orientation": orientation,
            "crop_px": crop_px,
            "view_px": view_px,
        }
    )
    host, device = both(config, records(config, 3, seed))
    assert host.any()
    assert largest_gap(host, device) <= 1


@pytest.mark.parametrize("orientation", ["unrotated", "heading_up"])
def test_headings_along_the_axes(orientation: str) -> None:
    """Where cosines are 0 or nearly so; with walls, targets and robots on whole pixels."""
    config = ArenaConfig.model_validate({"num_robots": 4, "orientation": orientation})
    headings = np.array([0.0, np.pi / 2, np.pi, -np.pi / 2])
    places = [(300, 300), (100, 200), (37, 563), (450, 150)]
    targets = np.array([[300.0, 300.0], [175, 175], [425, 425], [100, 200]])
    robots = np.column_stack([places, headings])
    given = make_codec(config).encode(Scene(robots, targets))
    assert largest_gap(*both(config, given)) <= 1


@given(
    numbers=st.lists(st.floats(width=32), min_size=10, max_size=10),
    orientation=st.sampled_from(["unrotated", "heading_up"]),
)
def test_any_record_gives_some_picture(numbers: list[float], orientation: str) -> None:
    config = ArenaConfig.model_validate({"orientation": orientation})
    given = np.array(numbers, "<f4").view(np.uint8)
    assert DeviceDrawing(config, "cpu")(given[None], ()).shape == (1, 60, 60)


def test_records_that_are_packed_read_only_bytes_are_drawn() -> None:
    config = ArenaConfig()
    aligned = records(config, 3)
    packed = np.frombuffer(b"x" + aligned.tobytes(), np.uint8)[1:].reshape(aligned.shape)
    np.testing.assert_array_equal(
        DeviceDrawing(config, "cpu")(packed, ()), DeviceDrawing(config, "cpu")(aligned, ())
    )


def test_records_of_another_arena_are_refused() -> None:
    given = records(ArenaConfig(num_robots=3), 1)
    with pytest.raises(ValueError, match=r"not uint8 \[..., 40\]"):
        DeviceDrawing(ArenaConfig(num_robots=2), "cpu")(given, ())


def test_no_records_give_no_pictures() -> None:
    config = ArenaConfig()
    assert DeviceDrawing(config, "cpu")(records(config, 3)[:0], ()).shape == (0, 2, 60, 60)


@pytest.mark.parametrize("orientation", ["unrotated", "heading_up"])
def test_symmetries_act_on_both_alike(orientation: str) -> None:
    config = ArenaConfig.model_validate({"num_robots": 3, "orientation": orientation})
    given = records(config, 16)
    turns = [(symmetry, np.array([i, 15 - i])) for i, symmetry in enumerate(EVERY)]
    host, device = both(config, given, turns)
    assert largest_gap(host, device) <= 1
    plain = DeviceDrawing(config, "cpu")(given, ()).numpy()
    for symmetry, rows in turns:
        np.testing.assert_array_equal(device[rows], symmetry.apply_to_pictures(plain[rows]))


@pytest.mark.parametrize(
    ("device", "overrides", "expected"),
    [
        ("cpu", {}, HostDrawing),
        ("cuda", {}, DeviceDrawing),
        ("cuda:1", {}, DeviceDrawing),
        ("cuda", {"arena.renderer": "literal"}, HostDrawing),
        ("cuda", {"arena.codec": "frames"}, HostDrawing),
        ("cuda", {"arena.num_targets": "3"}, DeviceDrawing),
        ("cuda", {"arena.num_obstacles": "1"}, HostDrawing),
        ("cuda", {"arena.inner_walls_px": "[[100, 100, 200, 100]]"}, HostDrawing),
        ("cuda", {"arena.pixel_noise": "2.0"}, HostDrawing),
    ],
)
def test_a_gpu_draws_scenes_itself(
    monkeypatch: pytest.MonkeyPatch, device: str, overrides: dict[str, str], expected: type
) -> None:
    monkeypatch.setattr("services.learner.drawing.DeviceViews", lambda *_: None)
    arena = load_config("quick", overrides, {}).arena
    assert type(make_drawing(arena, torch.device(device))) is expected


@pytest.fixture
def threads() -> Iterator[Executor]:
    with ThreadPoolExecutor(3) as pool:
        yield pool


@pytest.mark.parametrize("codec", ["scene", "frames"])
@pytest.mark.parametrize("num_scenes", [0, 1, 128, 129, 400])
def test_threads_draw_the_same_pictures(threads: Executor, codec: str, num_scenes: int) -> None:
    config = ArenaConfig.model_validate({"num_robots": 2, "codec": codec})
    given = records(config, max(num_scenes, 1))[:num_scenes]
    given.flags.writeable = False  # as they come off the wire
    alone = make_drawing(config, torch.device("cpu"))(given, ())
    shared = make_drawing(config, torch.device("cpu"), threads)(given, ())
    assert shared.shape == alone.shape == (num_scenes, 2, 60, 60)
    assert torch.equal(shared, alone)


def test_an_error_in_a_thread_is_raised(threads: Executor) -> None:
    codec = make_codec(ArenaConfig(num_robots=2))
    with pytest.raises(ValueError, match="records are"):
        ThreadedDecode(codec, 60, threads)(np.zeros((600, 1), np.uint8))
