"""The symmetry that each transition of a batch undergoes, drawn among those of its own layout.

Invariant: a transition is mapped only by a symmetry under which an agent's experience stays valid
in the arena that it is from.

Shapes: B = transitions, W = records of a transition, R = bytes of a record.
"""

import numpy as np

from mrcdrl.common.arena import SceneCodec, layout_symmetries, make_codec
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Int64Array, UInt8Array
from mrcdrl.services.learner.rendering import SymmetryRows


class LayoutSymmetries:
    """The symmetries of a run's layouts: one for each number of robots, where records tell it."""

    def __init__(self, config: ArenaConfig) -> None:
        codec = make_codec(config)
        self._codec = codec if config.mixes_numbers and isinstance(codec, SceneCodec) else None
        # Pictures do not tell which layout they show: then those that all have in common.
        each = [config] if self._codec is None else map(config.with_robots, config.numbers)
        self._kept = {one.num_robots: layout_symmetries(one) for one in each}

    def draw(self, records: UInt8Array, rng: np.random.Generator) -> SymmetryRows:
        """A symmetry for each transition of records [B, W, R], drawn uniformly.

        Transitions of a number of robots that the run does not have undergo none.
        """
        return [
            (symmetry, rows[drawn == place])
            for number, rows in self._rows(records).items()
            for drawn in [rng.integers(len(self._kept[number]), size=len(rows))]
            for place, symmetry in enumerate(self._kept[number])
        ]

    def _rows(self, records: UInt8Array) -> dict[int, Int64Array]:
        """The rows of each number of robots."""
        if self._codec is None:
            return {number: np.arange(len(records)) for number in self._kept}
        present = self._codec.present(records[:, 0])
        return {number: np.flatnonzero(present == number) for number in self._kept}
