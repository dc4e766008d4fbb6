"""Images that a GPU renders are those of the host, symmetries included.

No GPU needs to be here: its kernel's source is C++ as well, which the machine's compiler takes.
"""

import ctypes
import logging
import subprocess
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mrcdrl.common.arena import SYMMETRIES, Scene, make_codec
from mrcdrl.common.config import ArenaConfig, load_config
from mrcdrl.common.messages.trajectory import UInt8Array
from mrcdrl.common.model.kernels.cuda import KernelError, compile_kernel, machine_code
from mrcdrl.services.learner import rendering
from mrcdrl.services.learner.rendering import (
    DeviceRenderer,
    HostRenderer,
    Paint,
    ThreadedDecoder,
    definitions,
    make_renderer,
    renderer_source,
)

CROWDED = {
    "num_targets": 5,
    "num_obstacles": 2,
    "obstacles_px": [[120, 130, 25]],
    "inner_walls_px": [[200, 0, 200, 250], [350.5, 400, 520, 310]],
}
CONFIGS = [
    {"num_robots": num_robots, "orientation": orientation, **more}
    for orientation in ("unrotated", "heading_up")
    for num_robots, more in [
        (2, {}),
        (1, {"crop_px": 150.5}),
        (10, {"crop_px": 1500, "view_px": 31}),
        (3, {"robot_radius_px": 5, "target_size_px": 3}),
        (4, CROWDED),
    ]
]


@pytest.fixture
def compiled(cpp_compiler: str, tmp_path: Path) -> Any:
    """A configuration's kernel for the CPU."""

    def compile_for(config: ArenaConfig) -> Paint:
        source, library = tmp_path / "rendering.cpp", tmp_path / "rendering.so"
        source.write_text(renderer_source(), "utf-8")
        macros = [f"-D{name}={value}" for name, value in definitions(config).items()]
        options = ["-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
        command = [cpp_compiler, *options, *macros, str(source), "-o", str(library)]
        built = subprocess.run(command, capture_output=True, text=True, check=False)
        assert built.returncode == 0, built.stderr
        render = ctypes.CDLL(str(library)).render

        def paint(scenes: torch.Tensor, symmetries: torch.Tensor, images: torch.Tensor) -> None:
            rows, width = scenes.shape[:2]
            pointers = [ctypes.c_void_p(x.data_ptr()) for x in (scenes, symmetries, images)]
            render(*pointers, width, rows * width)

        return paint

    return compile_for


def arena(**settings: Any) -> ArenaConfig:
    return ArenaConfig.model_validate(settings)


def scenes(config: ArenaConfig, num: int, seed: int = 0) -> list[Scene]:
    """By chance; shapes overlap and reach outside."""
    rng = np.random.default_rng(seed)
    radii = rng.uniform(3, 40, (num, config.obstacle_count, 1))
    return [
        Scene(
            rng.uniform((-50, -50, -np.pi), (650, 650, np.pi), (config.num_robots, 3)),
            rng.uniform(-50, 650, (config.target_count, 2)),
            np.hstack([rng.uniform(-50, 650, (config.obstacle_count, 2)), radius]),
        )
        for radius in radii
    ]


def records(config: ArenaConfig, num_scenes: int, seed: int = 0) -> UInt8Array:
    """Of all robots of scenes by chance, [num_scenes, K, R]."""
    codec = make_codec(config)
    return np.stack([codec.encode(scene) for scene in scenes(config, num_scenes, seed)])


def largest_gap(one: torch.Tensor, other: torch.Tensor) -> int:
    assert one.dtype == other.dtype == torch.uint8
    assert one.shape == other.shape
    return int((one.int() - other.int()).abs().max())


@pytest.mark.parametrize("settings", CONFIGS)
def test_the_device_renders_what_the_host_renders(compiled: Any, settings: dict[str, Any]) -> None:
    config = arena(**settings)
    given = records(config, 200)
    symmetry_rows = [(symmetry, np.arange(i, 200, 9)) for i, symmetry in enumerate(SYMMETRIES)]
    host = HostRenderer(make_codec(config).decode)(given, symmetry_rows)
    device = DeviceRenderer(config, "cpu", compiled(config))(given, symmetry_rows)
    assert host.any()
    assert largest_gap(host, device) <= 1


@pytest.mark.parametrize("orientation", ["unrotated", "heading_up"])
def test_what_is_absent_is_not_rendered(compiled: Any, orientation: str) -> None:
    config = arena(robots=(2, 4), orientation=orientation)
    given = records(config, 50)
    numbers = given.view("<f4")
    numbers[:, :, 6:12] = numbers[:, :, 16:] = np.nan  # the last two robots and targets
    alone = config.with_robots(2)
    own = np.concatenate([numbers[:, :2, :6], numbers[:, :2, 12:16]], axis=2).view(np.uint8)
    host = HostRenderer(make_codec(alone).decode)(own, ())
    device = DeviceRenderer(config, "cpu", compiled(config))(given, ())
    assert torch.equal(HostRenderer(make_codec(config).decode)(given[:, :2], ()), host)
    assert largest_gap(host, device[:, :2]) <= 1


@pytest.mark.parametrize("orientation", ["unrotated", "heading_up"])
def test_headings_along_the_axes(compiled: Any, orientation: str) -> None:
    """Where cosines are 0 or nearly so; with walls, targets and robots on whole pixels."""
    config = arena(num_robots=4, orientation=orientation)
    headings = np.array([0.0, np.pi / 2, np.pi, -np.pi / 2])
    places = [(300, 300), (100, 200), (37, 563), (450, 150)]
    targets = np.array([[300.0, 300.0], [175, 175], [425, 425], [100, 200]])
    given = make_codec(config).encode(Scene(np.column_stack([places, headings]), targets))[None]
    host = HostRenderer(make_codec(config).decode)(given, ())
    assert largest_gap(host, DeviceRenderer(config, "cpu", compiled(config))(given, ())) <= 1


@pytest.mark.parametrize("settings", [{}, {"orientation": "heading_up"}, CROWDED])
def test_any_record_gives_some_image(compiled: Any, settings: dict[str, Any]) -> None:
    config = arena(**settings)
    rng = np.random.default_rng(0)
    given = rng.integers(0, 256, (300, 2, config.record_bytes), dtype=np.uint8)
    numbers = given.view("<f4")
    odd = np.array([0, np.nan, np.inf, -np.inf, 1e38, -1e38, 300], "<f4")
    replaced = rng.random(numbers.shape) < 0.5
    numbers[replaced] = rng.choice(odd, int(replaced.sum()))
    assert DeviceRenderer(config, "cpu", compiled(config))(given, ()).shape == (300, 2, 60, 60)


def test_records_that_are_packed_read_only_bytes_are_rendered(compiled: Any) -> None:
    config = ArenaConfig()
    aligned = records(config, 3)
    packed = np.frombuffer(b"x" + aligned.tobytes(), np.uint8)[1:].reshape(aligned.shape)
    render = DeviceRenderer(config, "cpu", compiled(config))
    assert torch.equal(render(packed, ()), render(aligned, ()))


def never(*_: torch.Tensor) -> None:
    raise AssertionError("nothing is to be painted")


@pytest.mark.parametrize("shape", [(1, 2, 52), (1, 40), (1, 1, 2, 40)])
def test_records_of_another_arena_are_refused(shape: tuple[int, ...]) -> None:
    render = DeviceRenderer(arena(num_robots=2), "cpu", never)
    with pytest.raises(ValueError, match=r"not uint8 \[B, W, 40\]"):
        render(np.zeros(shape, np.uint8), ())


def test_no_records_give_no_images() -> None:
    config = ArenaConfig()
    render = DeviceRenderer(config, "cpu", never)
    assert render(np.zeros((0, 2, config.record_bytes), np.uint8), ()).shape == (0, 2, 60, 60)


@pytest.mark.parametrize(
    ("device", "overrides", "expected"),
    [
        ("cpu", {}, HostRenderer),
        ("cuda", {}, DeviceRenderer),
        ("cuda:1", {}, DeviceRenderer),
        ("cuda", {"arena.renderer": "literal"}, HostRenderer),
        ("cuda", {"arena.codec": "frames"}, HostRenderer),
        ("cuda", {"arena.num_targets": "3"}, DeviceRenderer),
        ("cuda", {"arena.num_obstacles": "1"}, DeviceRenderer),
        ("cuda", {"arena.inner_walls_px": "[[100, 100, 200, 100]]"}, DeviceRenderer),
        ("cuda", {"arena.pixel_noise": "2.0"}, HostRenderer),
    ],
)
def test_a_gpu_renders_scenes_itself(
    monkeypatch: pytest.MonkeyPatch, device: str, overrides: dict[str, str], expected: type
) -> None:
    monkeypatch.setattr(rendering, "_device_paint", lambda *_: never)  # no GPU needs to be here
    config = load_config("quick", overrides, {}).arena
    assert type(make_renderer(config, torch.device(device))) is expected


def test_where_the_kernel_cannot_be_had_the_host_renders_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> Paint:
        raise KernelError("cuda-bindings is missing")

    monkeypatch.setattr(rendering, "_device_paint", refuse)
    with caplog.at_level(logging.WARNING, "learner"):
        assert type(make_renderer(ArenaConfig(), torch.device("cuda"))) is HostRenderer
    assert "images are rendered on the CPU: cuda-bindings is missing" in caplog.text


def test_a_kernel_of_a_device_that_is_no_gpu_is_refused() -> None:
    with pytest.raises(KernelError, match="cpu is not a CUDA device"):
        compile_kernel("", "render", torch.device("cpu"), {}, threads=1)


@pytest.mark.parametrize("settings", CONFIGS)
def test_the_kernel_compiles_for_gpus(settings: dict[str, Any]) -> None:
    """Where PyTorch's build for CUDA is, the compiler is as well, GPU or not."""
    pytest.importorskip("cuda.bindings.nvrtc", reason="only with PyTorch's builds for CUDA")
    assert machine_code(renderer_source(), "render", (9, 0), definitions(arena(**settings)))
    with pytest.raises(KernelError, match=r"render does not compile: .*expected"):
        machine_code("extern !", "render", (9, 0), {})


@pytest.fixture
def threads() -> Iterator[Executor]:
    with ThreadPoolExecutor(3) as pool:
        yield pool


@pytest.mark.parametrize("codec", ["scene", "frames"])
@pytest.mark.parametrize("num_scenes", [0, 1, 128, 129, 400])
def test_threads_render_the_same_images(threads: Executor, codec: str, num_scenes: int) -> None:
    config = arena(num_robots=2, codec=codec)
    given = records(config, max(num_scenes, 1))[:num_scenes]
    given.flags.writeable = False  # as they come off the wire
    alone = make_renderer(config, torch.device("cpu"))(given, ())
    shared = make_renderer(config, torch.device("cpu"), threads)(given, ())
    assert shared.shape == alone.shape == (num_scenes, 2, 60, 60)
    assert torch.equal(shared, alone)


def test_an_error_in_a_thread_is_raised(threads: Executor) -> None:
    codec = make_codec(ArenaConfig(num_robots=2))
    with pytest.raises(ValueError, match="records are"):
        ThreadedDecoder(codec, 60, threads)(np.zeros((600, 1), np.uint8))
