"""The paper's 2-D arena: physics, rewards, starts and the robots' images.

Invariants: the only package that imports pymunk or OpenCV; it knows of no network and no service.
"""

from mrcdrl.common.arena.arena import Arena
from mrcdrl.common.arena.batch import ArenaBatch, make_arenas
from mrcdrl.common.arena.counting import (
    Counters,
    CountingArena,
    CountingBatch,
    counting_frames,
    counting_outcome,
    counting_reward,
    decode_counters,
)
from mrcdrl.common.arena.images.codec import FrameCodec, ObservationCodec, SceneCodec, make_codec
from mrcdrl.common.arena.images.rendering import literal_views, render_arena
from mrcdrl.common.arena.images.views import AnalyticViews
from mrcdrl.common.arena.world.layout import fixed_layout, layout_for, layout_symmetries
from mrcdrl.common.arena.world.physics import ArrayPhysics, Physics
from mrcdrl.common.arena.world.pymunk_physics import PymunkPhysics
from mrcdrl.common.arena.world.rewards import frame_rewards, target_distances_px
from mrcdrl.common.arena.world.scene import LEFT, RIGHT, STRAIGHT, Layout, Scene, Start
from mrcdrl.common.arena.world.starts import test_starts, training_start
from mrcdrl.common.arena.world.symmetry import IDENTITY, SYMMETRIES, Symmetry

__all__ = [
    "IDENTITY",
    "LEFT",
    "RIGHT",
    "STRAIGHT",
    "SYMMETRIES",
    "AnalyticViews",
    "Arena",
    "ArenaBatch",
    "ArrayPhysics",
    "Counters",
    "CountingArena",
    "CountingBatch",
    "FrameCodec",
    "Layout",
    "ObservationCodec",
    "Physics",
    "PymunkPhysics",
    "Scene",
    "SceneCodec",
    "Start",
    "Symmetry",
    "counting_frames",
    "counting_outcome",
    "counting_reward",
    "decode_counters",
    "fixed_layout",
    "frame_rewards",
    "layout_for",
    "layout_symmetries",
    "literal_views",
    "make_arenas",
    "make_codec",
    "render_arena",
    "target_distances_px",
    "test_starts",
    "training_start",
]
