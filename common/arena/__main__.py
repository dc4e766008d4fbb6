"""`python -m common.arena`: compile what moves and draws robots, so that no first start has to.

The machine code goes where numba keeps it (NUMBA_CACHE_DIR); another processor compiles anew.
"""

import numpy as np

from common.arena import make_arenas, make_codec
from common.config import Config


def main() -> None:
    """A new episode and one step of it, drawn as actors do."""
    config = Config().arena
    arenas = make_arenas(config, [np.random.default_rng(0)], [0])
    codec = make_codec(config)
    codec.decode(arenas.reset(0).records)
    steps = arenas.step(np.zeros((1, config.num_robots), np.uint8))
    codec.decode(steps.records.reshape(config.num_robots, -1))


if __name__ == "__main__":
    main()
