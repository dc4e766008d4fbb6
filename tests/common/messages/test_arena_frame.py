"""What a receiver refuses in a frame of an arena, which any peer may have sent."""

import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.checks import MAX_FRAME_BYTES, problem
from mrcdrl.common.messages.trajectory import ArenaFrame
from mrcdrl.common.messages.wire import decode, decode_published, encode


def matrix(rows: int, columns: int, value: float = 1.0) -> np.ndarray[Any, Any]:
    return np.full((rows, columns), value, np.float32)


FRAME = ArenaFrame(
    role="actor",
    worker="actor-0",
    arena=0,
    episode=1,
    frame=9,
    weights_version=-1,
    epsilon=0.5,
    robots=matrix(2, 3),
    targets=matrix(2, 2),
    obstacles=matrix(0, 3),
    q_values=matrix(2, 3),
    actions=np.array([0, 2], np.uint8),
    collided=np.array([0, 1], np.uint8),
    outcome="",
    view_px=4,
    images=zlib.compress(bytes(32)),
)
LAST = replace(FRAME, q_values=matrix(0, 3), actions=FRAME.actions[:0], outcome="timeout")
DIVERGED = replace(FRAME, q_values=matrix(2, 3, np.nan))
WITHOUT_IMAGES = replace(FRAME, images=b"")


@pytest.mark.parametrize("frame", [FRAME, LAST, DIVERGED, WITHOUT_IMAGES])
def test_what_a_worker_sends_is_read(frame: ArenaFrame) -> None:
    read = decode(ArenaFrame, encode(frame))
    np.testing.assert_array_equal(read.robots, frame.robots)
    np.testing.assert_array_equal(read.q_values, frame.q_values)
    assert (read.outcome, read.images) == (frame.outcome, frame.images)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"robots": matrix(2, 2)}, "robots is not a matrix of 3 columns"),
        ({"robots": matrix(2, 3, np.nan)}, "robots .*not finite"),
        ({"robots": matrix(0, 3), "actions": FRAME.actions[:0]}, "0 robots"),
        ({"robots": matrix(11, 3)}, "11 robots"),
        ({"targets": matrix(2, 2, np.inf)}, "targets .*not finite"),
        ({"obstacles": matrix(1, 2)}, "obstacles is not a matrix"),
        ({"actions": FRAME.actions[:1]}, "actions is neither empty nor one for each robot"),
        ({"actions": np.array([0, 3], np.uint8)}, "an action is none"),
        ({"q_values": matrix(2, 1)}, "q_values has not 2 to 64 values"),
        ({"q_values": matrix(2, 65)}, "q_values has not 2 to 64 values"),
        ({"q_values": matrix(1, 3)}, "q_values is not a row for each action"),
        ({"collided": FRAME.collided[:1]}, "collided is not one for each robot"),
        ({"outcome": "<script>"}, "outcome is none"),
        ({"images": b"no zlib"}, "images is not zlib data"),
        ({"images": zlib.compress(bytes(31))}, "images is not zlib data"),
        ({"images": zlib.compress(bytes(1 << 24))}, "images is not zlib data"),
        ({"images": zlib.compress(bytes(32))[:-1]}, "images is not zlib data"),
        ({"view_px": 0}, "view_px 0 is outside"),
        ({"view_px": 2**40}, "view_px"),
        ({"epsilon": 1.5}, "epsilon 1.5 is outside"),
        ({"frame": -1}, "frame -1 is outside"),
        ({"worker": "<script>"}, "worker is not a name"),
        ({"role": "a/b"}, "role is not a name"),
    ],
)
def test_what_breaks_a_rule_is_refused(change: dict[str, Any], reason: str) -> None:
    frame = replace(FRAME, **change)
    with pytest.raises(WireError, match=reason):
        decode(ArenaFrame, encode(frame))


def test_a_frame_on_the_key_of_another_is_refused() -> None:
    assert problem(FRAME) is None
    decode_published(ArenaFrame, "mrcdrl/x/arena/actor/actor-0", encode(FRAME))
    with pytest.raises(WireError, match="actor/actor-0 on key"):
        decode_published(ArenaFrame, "mrcdrl/x/arena/evaluator/actor-0", encode(FRAME))


def test_images_of_usual_frames_are_far_below_the_limit() -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(256, size=(10, 60, 60), dtype=np.uint8)  # noise, which packs worst
    many = replace(
        FRAME,
        robots=matrix(10, 3),
        q_values=matrix(10, 3),
        actions=np.zeros(10, np.uint8),
        collided=np.zeros(10, np.uint8),
        view_px=60,
        images=zlib.compress(images.tobytes()),
    )
    assert len(encode(many)) < MAX_FRAME_BYTES / 4


def test_a_check_makes_no_schema(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames come 15 times a second, and a schema takes milliseconds."""
    monkeypatch.setattr(ArenaConfig, "model_json_schema", None)
    assert problem(FRAME) is None
