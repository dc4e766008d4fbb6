"""The example that renders and computes by docs/wire.md alone gives what our processes give."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from mrcdrl.common.arena import ArenaBatch, Scene, make_codec
from mrcdrl.common.arena.world.starts import test_starts as starts
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.model.q_network import Kind, QNetwork
from mrcdrl.common.model.weights_io import weights_to_bytes

EXAMPLE = Path(__file__).parents[2] / "examples" / "foreign_images.py"


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


foreign = load(EXAMPLE)
WALLS = {"inner_walls_px": ((250, 300, 350, 300), (420, 330, 500, 460))}
DISCS = {"obstacles_px": ((300, 120, 35),), "num_obstacles": 2}
ARENAS: list[dict[str, object]] = [
    {},
    {"num_robots": 4, "num_targets": 5, "target_layout": "random", **DISCS, **WALLS},
    {"num_robots": 3, "target_layout": "random", "orientation": "heading_up", **DISCS, **WALLS},
    {"crop_px": 201, "view_px": 41},
    {"pixel_noise": 9.5},
    {"orientation": "heading_up", "crop_px": 330, "view_px": 50},
]


@pytest.mark.parametrize("settings", ARENAS, ids=range(len(ARENAS)))
def test_an_image_is_what_the_page_says_to_the_pixel(settings: dict[str, object]) -> None:
    config = ArenaConfig.model_validate(settings)
    arena, codec = config.model_dump(), make_codec(config)
    for start in starts(config, 4, 0):
        scene = Scene(start.robots, start.targets, start.obstacles)
        records = codec.encode(scene, np.arange(2**32 - config.num_robots, 2**32, dtype=np.uint32))
        assert records.shape[1] == foreign.record_bytes(arena)
        for record, ours in zip(records, codec.decode(records), strict=True):
            error = np.abs(foreign.render(record.tobytes(), arena).astype(int) - ours)
            assert ours.max() == 255
            assert error.max() <= 1, "more than a rounding"
            assert (error > 0).mean() < 0.002


@pytest.mark.parametrize("num_targets", [0, 4])
def test_absent_robots_and_targets_are_not_in_an_image(num_targets: int) -> None:
    config = ArenaConfig(robots=(1, 2, 4), num_targets=num_targets)
    arenas, decode = ArenaBatch(config, [np.random.default_rng(0)]), make_codec(config).decode
    numbers = set()
    for _ in range(10):
        records = arenas.reset(0).records[: arenas.present[0]]
        numbers.add(len(records))
        for record, ours in zip(records, decode(records), strict=True):
            error = np.abs(foreign.render(record.tobytes(), config.model_dump()).astype(int) - ours)
            assert error.max() <= 1
    assert numbers == {1, 2, 4}


@pytest.mark.parametrize("kind", ["duel", "ddqn", "dqn"])
def test_values_are_those_of_the_network(kind: Kind) -> None:
    torch.manual_seed(0)
    network = QNetwork(kind)
    state = np.random.default_rng(0).integers(0, 256, (4, 60, 60), np.uint8)
    metadata, arrays = foreign.weights_of(weights_to_bytes(network))
    assert metadata["kind"] == kind
    with torch.no_grad():
        expected = network(torch.from_numpy(state)[None])[0].numpy()
    np.testing.assert_allclose(foreign.q_values(state, arrays), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_is_cast_up(dtype: torch.dtype) -> None:
    network = QNetwork("ddqn")
    _, arrays = foreign.weights_of(weights_to_bytes(network, dtype))
    for name, parameter in network.state_dict().items():
        np.testing.assert_array_equal(arrays[name], parameter.to(dtype).float().numpy())
        assert arrays[name].dtype == np.float32


def test_records_of_pixels_and_of_noise_have_the_lengths_of_the_page() -> None:
    for settings in ({"codec": "frames"}, {"pixel_noise": 2.0, "num_targets": 7}):
        config = ArenaConfig.model_validate(settings)
        assert foreign.record_bytes(json.loads(config.model_dump_json())) == config.record_bytes
