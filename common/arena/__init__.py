"""The paper's 2-D arena: physics, rewards, starts and the robots' images.

Invariant: the arena knows neither networks nor services. Each name here is imported on first use:
who wants a layout's symmetries needs no physics and no pictures. Everything else is imported from
its module.
"""

from typing import TYPE_CHECKING

from mrcdrl.common.runtime.lazy import imported

if TYPE_CHECKING:
    from mrcdrl.common.arena.arena import Arena
    from mrcdrl.common.arena.batch import ArenaBatch, Arenas, make_arenas
    from mrcdrl.common.arena.counting import (
        CountingArena,
        CountingBatch,
        counting_frames,
        counting_outcome,
        counting_reward,
        decode_counters,
    )
    from mrcdrl.common.arena.envs.custom import looked_up
    from mrcdrl.common.arena.envs.custom_batch import CustomBatch
    from mrcdrl.common.arena.images.codec import ObservationCodec, SceneCodec, make_codec
    from mrcdrl.common.arena.images.rendering import literal_views, render_arena
    from mrcdrl.common.arena.world.layout import layout_for, layout_symmetries
    from mrcdrl.common.arena.world.scene import LEFT, RIGHT, STRAIGHT, Layout, Scene, Start
    from mrcdrl.common.arena.world.starts import test_starts, training_start
    from mrcdrl.common.arena.world.symmetry import IDENTITY, SYMMETRIES, Symmetry

__all__ = [
    "IDENTITY",
    "LEFT",
    "RIGHT",
    "STRAIGHT",
    "SYMMETRIES",
    "Arena",
    "ArenaBatch",
    "Arenas",
    "CountingArena",
    "CountingBatch",
    "CustomBatch",
    "Layout",
    "ObservationCodec",
    "Scene",
    "SceneCodec",
    "Start",
    "Symmetry",
    "counting_frames",
    "counting_outcome",
    "counting_reward",
    "decode_counters",
    "layout_for",
    "layout_symmetries",
    "literal_views",
    "looked_up",
    "make_arenas",
    "make_codec",
    "render_arena",
    "test_starts",
    "training_start",
]

_MODULES = {
    "IDENTITY": "world.symmetry",
    "LEFT": "world.scene",
    "RIGHT": "world.scene",
    "STRAIGHT": "world.scene",
    "SYMMETRIES": "world.symmetry",
    "Arena": "arena",
    "ArenaBatch": "batch",
    "Arenas": "batch",
    "CustomBatch": "envs.custom_batch",
    "CountingArena": "counting",
    "CountingBatch": "counting",
    "Layout": "world.scene",
    "ObservationCodec": "images.codec",
    "Scene": "world.scene",
    "SceneCodec": "images.codec",
    "Start": "world.scene",
    "Symmetry": "world.symmetry",
    "counting_frames": "counting",
    "counting_outcome": "counting",
    "counting_reward": "counting",
    "decode_counters": "counting",
    "layout_for": "world.layout",
    "layout_symmetries": "world.layout",
    "literal_views": "images.rendering",
    "looked_up": "envs.custom",
    "make_arenas": "batch",
    "make_codec": "images.codec",
    "render_arena": "images.rendering",
    "test_starts": "world.starts",
    "training_start": "world.starts",
}


def __getattr__(name: str) -> object:
    """Import a name on first use, and keep it."""
    return imported(__name__, _MODULES, name)
