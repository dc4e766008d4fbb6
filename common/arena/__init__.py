"""The paper's 2-D arena: physics, rewards, starts and the robots' images.

Invariant: the arena knows neither networks nor services. Everything else is imported from
its module.
"""

from mrcdrl.common.arena.arena import Arena
from mrcdrl.common.arena.batch import ArenaBatch, make_arenas
from mrcdrl.common.arena.counting import (
    CountingArena,
    CountingBatch,
    counting_frames,
    counting_outcome,
    counting_reward,
    decode_counters,
)
from mrcdrl.common.arena.images.codec import ObservationCodec, make_codec
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
    "CountingArena",
    "CountingBatch",
    "Layout",
    "ObservationCodec",
    "Scene",
    "Start",
    "Symmetry",
    "counting_frames",
    "counting_outcome",
    "counting_reward",
    "decode_counters",
    "layout_for",
    "layout_symmetries",
    "literal_views",
    "make_arenas",
    "make_codec",
    "render_arena",
    "test_starts",
    "training_start",
]
