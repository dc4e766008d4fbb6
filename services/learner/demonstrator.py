"""What a controller that sees the true state would do in sampled states.

Records hold the scenes that images are rendered from, so the learner can ask for any state of its
own, with no message and no flag for it. The controller is `potential_field` without memory: targets
are assigned anew in each scene, by the least sum of squared distances.

Invariants: pure; only the learner asks, never what plays or tests. Records of any bytes give some
action: a peer may have sent them.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment

from mrcdrl.common.arena import SceneCodec, make_codec
from mrcdrl.common.arena.controllers.potential_field import field_actions
from mrcdrl.common.arena.world.rewards import target_distances_px
from mrcdrl.common.arena.world.scene import Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Float64Array, Int64Array, UInt8Array


def demonstrator(config: ArenaConfig) -> Callable[[UInt8Array], UInt8Array]:
    """A function from records [B, R] to the actions [B] of their own robots.

    Raises TypeError for records that hold no poses.
    """
    codec = make_codec(config)
    if not isinstance(codec, SceneCodec):
        raise TypeError(f"{codec!r} keeps no poses")

    def actions(records: UInt8Array) -> UInt8Array:
        with np.errstate(all="ignore"):
            scenes = codec.scenes(records)
            targets = scenes.targets[np.arange(len(records)), _own_targets(scenes)]
            own, others = scenes.robots[:, 0], scenes.robots[:, 1:, :2]
            return field_actions(own, targets, others, scenes.obstacles, config)

    return actions


def _own_targets(scenes: Scene) -> Int64Array:
    """The targets [B] that are assigned to the first robots of B scenes."""
    return np.array([_first_target(each) for each in target_distances_px(scenes) ** 2], np.int64)


def _first_target(squares: Float64Array) -> int:
    """The target of the first robot, of squared distances [K, M]; 0 if it or all are absent.

    Where there are too few targets, a robot without one heads for the nearest.
    """
    known = np.isfinite(squares)
    if not known[0].any():
        return 0
    robots, targets = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known[0])
    costs = np.nan_to_num(squares[np.ix_(robots, targets)], posinf=np.finfo(np.float64).max)
    rows, columns = linear_sum_assignment(costs)
    own = columns[rows == 0]
    return int(targets[own[0] if own.size else costs[0].argmin()])
