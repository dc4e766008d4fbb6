"""What a controller that sees the true state would do in sampled states.

Records hold the scenes that images are rendered from, so the learner can ask for any state of its
own, with no message and no flag for it. The controller is `potential_field` without memory: targets
are assigned anew in each scene, by the least sum of squared distances.

Invariants: pure; only the learner asks, never what plays or tests. Records of any bytes give some
action: a peer may have sent them.
"""

from collections.abc import Callable

import numpy as np

from mrcdrl.common.arena import SceneCodec, make_codec
from mrcdrl.common.arena.controllers.heading import first_assigned
from mrcdrl.common.arena.controllers.potential_field import field_actions
from mrcdrl.common.arena.world.rewards import target_distances_px
from mrcdrl.common.arena.world.scene import Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Int64Array, UInt8Array


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
    return np.array([first_assigned(each) for each in target_distances_px(scenes) ** 2], np.int64)
