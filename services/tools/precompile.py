"""Compiles the numba functions of a run ahead of its first start.

These move and render robots, and compute the network's first layer as actors (contiguous states)
and the learner (views of longer windows) call it. numba caches the machine code (NUMBA_CACHE_DIR);
another processor compiles again.
"""

import numpy as np
import torch

from mrcdrl.common.arena import make_arenas, make_codec
from mrcdrl.common.config import Config, validate_config
from mrcdrl.common.model.fast_forward import fast_forward, operands, prepare
from mrcdrl.common.model.q_network import QNetwork


def main() -> None:
    """Step and render a new episode as actors do; compute values of states and their gradient."""
    config = validate_config(Config().model_dump())  # as received: floats, not a default's ints
    arena = config.arena
    arenas = make_arenas(arena, [np.random.default_rng(0)], [0])
    codec = make_codec(arena)
    codec.decode(arenas.reset(0).records)
    steps = arenas.step(np.zeros((1, arena.num_robots), np.uint8))
    codec.decode(steps.records.reshape(arena.num_robots, -1))

    network = QNetwork(config.agent.kind, stack=arena.stack, view_px=arena.view_px)
    windows = torch.zeros(2, arena.stack + 1, arena.view_px, arena.view_px, dtype=torch.uint8)
    for states in (windows[:, : arena.stack].contiguous(), windows[:, : arena.stack]):
        values = fast_forward(network, prepare(network, states), operands(network))
        values.sum().backward()  # type: ignore[no-untyped-call]


if __name__ == "__main__":
    main()
