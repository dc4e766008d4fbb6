"""Pixel noise of images, a function of the seed that a record carries.

Invariants: the same seed gives the same noise on every machine; each pixel takes one draw.
"""

import math

import numpy as np
from numpy.typing import NDArray

from mrcdrl.common.messages.trajectory import UInt8Array
from mrcdrl.common.runtime.compiled import compiled

NoiseSeeds = NDArray[np.uint32]

# Splitmix64 (Steele, Lea, Flood 2014).
_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)
_LANE, _LANE_MASK = np.uint64(16), np.uint64(0xFFFF)
# The sum of four uniform 16-bit numbers is nearly Gaussian, within 3.46 standard deviations.
_MEAN = 2 * 65535.0
_DEVIATION = math.sqrt(4 * (65536.0**2 - 1) / 12)


def add_noise(views: UInt8Array, seeds: NoiseSeeds, deviation: float) -> None:
    """Adds noise to images [N, V, V] in place, clipped to 0 ... 255; seeds: [N]."""
    _add_noise(views, np.ascontiguousarray(seeds), deviation / _DEVIATION)


@compiled
def _add_noise(views, seeds, scale):  # type: ignore[no-untyped-def]
    for n in range(len(views)):
        state = _mixed(np.uint64(seeds[n]) * _GAMMA)
        for i in range(views.shape[1]):
            for j in range(views.shape[2]):
                state += _GAMMA
                bits = _mixed(state)
                total = 0.0
                for _ in range(4):
                    total += np.float64(bits & _LANE_MASK)
                    bits >>= _LANE
                intensity = np.float64(views[n, i, j]) + (total - _MEAN) * scale
                views[n, i, j] = np.uint8(min(max(intensity + 0.5, 0.0), 255.0))


@compiled
def _mixed(z):  # type: ignore[no-untyped-def]
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)
