"""The paper's 2-D arena: physics, rewards, starts and the robots' pictures.

Invariants: the only package that imports pymunk or OpenCV; it knows of no network and no service.
"""

from common.arena.arena import Arena
from common.arena.batch import ArenaBatch, make_arenas
from common.arena.codec import FrameCodec, ObservationCodec, SceneCodec, make_codec
from common.arena.counting import (
    Counters,
    CountingArena,
    CountingBatch,
    counting_frames,
    counting_outcome,
    counting_reward,
    decode_counters,
)
from common.arena.layout import fixed_layout, layout_for, layout_symmetries
from common.arena.physics import ArrayPhysics, Physics
from common.arena.pymunk_physics import PymunkPhysics
from common.arena.rendering import draw_arena, literal_views
from common.arena.rewards import frame_rewards, target_distances_px
from common.arena.scene import LEFT, RIGHT, STRAIGHT, Layout, Scene, Start
from common.arena.starts import test_starts, training_start
from common.arena.symmetry import IDENTITY, SYMMETRIES, Symmetry
from common.arena.views import AnalyticViews

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
    "draw_arena",
    "fixed_layout",
    "frame_rewards",
    "layout_for",
    "layout_symmetries",
    "literal_views",
    "make_arenas",
    "make_codec",
    "target_distances_px",
    "test_starts",
    "training_start",
]
