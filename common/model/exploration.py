"""Epsilon of each arena: paper section 5.2; the "ladder" is the schedule of Ape-X, section 4.1.

Invariants: pure; epsilon stays in 0 ... 1; with the ladder, the exponents of all arenas of all
actors are spread evenly over 1 ... ladder_power, and so are those of each actor.
"""

import numpy as np

from mrcdrl.common.config import ExplorationConfig
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Float32Array, Float64Array


def epsilon_exponents(num_actors: int, rank: int, num_arenas: int, power: float) -> Float64Array:
    """Exponents [num_arenas] of the arenas of actor `rank`, 1 ... power.

    They spread the logarithm of epsilon ** exponent evenly. The actors' arenas are interleaved, so
    that each actor has arenas that explore little and much. A single arena has exponent 1.

    Raises ConfigError for a rank that is not below num_actors.
    """
    if not 0 <= rank < num_actors:
        raise ConfigError(f"actor rank {rank} is not one of {num_actors} actors (0 is the first)")
    total = num_actors * num_arenas
    ranks = np.arange(num_arenas, dtype=np.float64) * num_actors + rank
    return 1.0 + (power - 1.0) * ranks / max(total - 1, 1)


def epsilons(
    config: ExplorationConfig, learner_step: int, rank: int, num_actors: int, num_arenas: int
) -> Float32Array:
    """Epsilon of each arena of actor `rank`, float32 [num_arenas]."""
    epsilon = value_at(config.schedule, learner_step)
    if config.kind == "schedule":
        return np.full(num_arenas, epsilon, dtype=np.float32)
    exponents = epsilon_exponents(num_actors, rank, num_arenas, config.ladder_power)
    return (epsilon**exponents).astype(np.float32)
