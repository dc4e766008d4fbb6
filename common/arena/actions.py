"""The check every arena makes of the actions it is given.

Invariants: what leaves here is uint8 of LEFT, STRAIGHT, RIGHT.
"""

import numpy as np
from numpy.typing import ArrayLike

from common.trajectory import NUM_ACTIONS, UInt8Array


def checked_actions(actions: ArrayLike, shape: tuple[int, ...]) -> UInt8Array:
    """actions as uint8 of this shape; raises ValueError for another shape, kind or value."""
    array = np.asarray(actions)
    if array.shape != shape or array.dtype.kind not in "iu":
        raise ValueError(f"actions are {array.dtype} {array.shape}, not integers {shape}")
    if ((array < 0) | (array >= NUM_ACTIONS)).any():
        raise ValueError(f"actions {array.tolist()} are not all in 0..{NUM_ACTIONS - 1}")
    return array.astype(np.uint8)
