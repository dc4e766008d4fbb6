"""Shows people one of a worker's arenas: whole episodes, at their pace, while anybody watches.

A worker plays hundreds of frames a second. It puts every frame of an episode in a queue, and a
thread, `broadcast`, publishes them at FRAMES_PER_S. While frames wait, other episodes are skipped.

Invariants: while nobody watches, a step reads one flag; the worker never waits; what waits is
bounded; what is shown has no effect on what is played.
"""

import logging
import threading
import time
import zlib
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from mrcdrl.common.arena import Scene
from mrcdrl.common.errors import TransportError
from mrcdrl.common.messages.trajectory import (
    NUM_ACTIONS,
    ArenaFrame,
    BoolArray,
    Float32Array,
    Outcome,
    UInt8Array,
)
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.runtime.closing import Closing
from mrcdrl.common.transport import WatchedPublisher

FRAMES_PER_S = 15
ARENA = 0  # the one that is shown
MAX_FRAMES = 1800  # that wait: two minutes
MAX_BYTES = 1 << 25  # of their images
_BATCH_BYTES = 60_000  # of a message; where it would be larger, its images are left out
_NO_VALUES: Float32Array = np.zeros((0, NUM_ACTIONS), np.float32)
_NO_ACTIONS: UInt8Array = np.zeros(0, np.uint8)


@dataclass(frozen=True, slots=True)
class Moment:
    """A frame of the arena that is shown, as its worker has it."""

    frame: int  # 0 at the episode's start
    scene: Scene
    images: UInt8Array  # [K, V, V], the newest of each robot
    weights_version: int
    epsilon: float


class Broadcast(Closing):
    """What one worker shows; `acts` and `stepped` are called by its main loop, in turn."""

    def __init__(
        self, publisher: WatchedPublisher, role: str, worker: str, ahead: int = FRAMES_PER_S
    ) -> None:
        """ahead: an episode that begins is taken if no more frames than these wait."""
        self._publisher = publisher
        self._role, self._worker = role, worker
        self._ahead = ahead
        self._changed = threading.Condition()  # of the queue, and of whether it is closed
        self._queue: deque[ArenaFrame] = deque()
        self._bytes = 0  # of images in the queue
        self._closed = False
        self._taking = False  # this episode
        self._taken = 0  # episodes, since somebody watches
        self._episode = 0
        self._collided: UInt8Array | None = None
        self._thread = threading.Thread(target=self._publish, name="broadcast")
        self._thread.start()

    def __repr__(self) -> str:
        return f"Broadcast({self._role} {self._worker}, {len(self._queue)} frames wait)"

    @property
    def watched(self) -> bool:
        """Whether `acts` and `stepped` have anything to do."""
        return self._publisher.watched or self._taken > 0

    def acts(self, moment: Moment, q_values: Float32Array, actions: UInt8Array) -> None:
        """Take the frame before a step, the values [K, A] and the actions chosen [K]."""
        if not self._publisher.watched:
            self._forget()
            return
        if moment.frame == 0 or not self._taken:
            self._begin(at_once=not self._taken)
        if self._taking:
            self._put(moment, q_values, actions, "")

    def stepped(self, collided: BoolArray, last: Moment | None, outcome: Outcome | None) -> None:
        """Take which robots [K] collided and, if the step was the last, what it left."""
        self._collided = collided.astype(np.uint8)
        if last is not None and outcome is not None:
            if self._taking:
                self._put(last, _NO_VALUES, _NO_ACTIONS, outcome)
            self._taking, self._collided = False, None

    def close(self) -> None:
        """Publish no more."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _begin(self, *, at_once: bool) -> None:
        """Decide whether to take an episode; at_once: somebody has just come, and sees nothing."""
        self._taking = at_once or len(self._queue) <= self._ahead
        if at_once:
            self._collided = None
        if self._taking:
            self._taken += 1
            self._episode += 1

    def _put(
        self, moment: Moment, q_values: Float32Array, actions: UInt8Array, outcome: str
    ) -> None:
        images = np.ascontiguousarray(moment.images)
        full = len(self._queue) >= MAX_FRAMES or self._bytes + images.nbytes > MAX_BYTES
        if full:
            self._taking = False
            return
        scene, none = moment.scene, np.zeros(len(actions) or len(images), np.uint8)
        frame = ArenaFrame(
            role=self._role,
            worker=self._worker,
            arena=ARENA,
            episode=self._episode,
            frame=moment.frame,
            weights_version=moment.weights_version,
            epsilon=moment.epsilon,
            robots=scene.robots.astype(np.float32),
            targets=scene.targets.astype(np.float32),
            obstacles=scene.obstacles.astype(np.float32),
            q_values=q_values.astype(np.float32),
            actions=actions.astype(np.uint8),
            collided=none if self._collided is None else self._collided,
            outcome=outcome,
            view_px=images.shape[-1],
            images=images.tobytes(),
        )
        with self._changed:
            self._queue.append(frame)
            self._bytes += len(frame.images)
            self._changed.notify()

    def _forget(self) -> None:
        """Drop what nobody waits for any more."""
        self._taking, self._taken = False, 0
        with self._changed:
            self._queue.clear()
            self._bytes = 0

    def _publish(self) -> None:
        """Publish what is in the queue, at a steady pace; the thread `broadcast`."""
        due_s, failed = 0.0, False
        while (frame := self._next(due_s)) is not None:
            due_s = max(due_s + 1 / FRAMES_PER_S, time.monotonic() - 1 / FRAMES_PER_S)
            try:
                self._publisher.put(packed(frame))
            except TransportError as error:
                if not failed:
                    logging.getLogger(self._role).warning("its arena is not shown: %s", error)
                failed = True

    def _next(self, due_s: float) -> ArenaFrame | None:
        """Wait until this time and for a frame; None once closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed, max(0.0, due_s - time.monotonic()))
            self._changed.wait_for(lambda: self._closed or self._queue)
            if self._closed:
                return None
            frame = self._queue.popleft()
            self._bytes -= len(frame.images)
            return frame


def packed(frame: ArenaFrame) -> bytes:
    """The message of a frame whose images are not packed yet."""
    message = encode(replace(frame, images=zlib.compress(frame.images, 1)))
    return message if len(message) <= _BATCH_BYTES else encode(replace(frame, images=b""))
