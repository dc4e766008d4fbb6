"""A worker shows whole episodes at the pace of people, while they watch, and nothing otherwise."""

import threading
import time
import zlib
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from mrcdrl.common.arena import Scene
from mrcdrl.common.config import TransportConfig
from mrcdrl.common.messages.trajectory import ArenaFrame, Outcome
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.sync import broadcast as module
from mrcdrl.common.sync.broadcast import Broadcast, Moment, packed
from mrcdrl.common.transport import Session, WatchedPublisher, free_endpoint
from tests.patience import PATIENCE_S

SCENE = Scene(np.array([[1.0, 2.0, 0.5], [3.0, 4.0, 1.5]]), np.array([[5.0, 6.0], [7.0, 8.0]]))
VALUES = np.array([[0.1, 0.2, 0.3], [0.3, 0.2, 0.1]], np.float32)
ACTIONS = np.array([2, 0], np.uint8)


class Recorded(WatchedPublisher):
    """Keeps what is published."""

    def __init__(self) -> None:
        super().__init__()
        self.watched = True
        self.frames: list[ArenaFrame] = []
        self.times: list[float] = []
        self.come = threading.Condition()

    def put(self, payload: bytes) -> None:
        with self.come:
            self.frames.append(decode(ArenaFrame, payload))
            self.times.append(time.monotonic())
            self.come.notify_all()

    def wait_for(self, count: int) -> list[ArenaFrame]:
        with self.come:
            assert self.come.wait_for(lambda: len(self.frames) >= count, PATIENCE_S)
            return list(self.frames)


def moment(frame: int) -> Moment:
    images = np.full((2, 4, 4), frame % 256, np.uint8)
    return Moment(frame, SCENE, images, 7, 0.25)


def play(shown: Broadcast, frames: int, first: int = 0, outcome: Outcome = Outcome.SUCCESS) -> None:
    """Play an episode of so many steps; the robots collide in turn."""
    for frame in range(first, frames):
        shown.acts(moment(frame), VALUES, ACTIONS)
        last = frame == frames - 1
        collided = np.array([frame % 2 == 0, False])
        shown.stepped(collided, moment(frame + 1) if last else None, outcome if last else None)


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """People who watch a thousand frames a second."""
    monkeypatch.setattr(module, "FRAMES_PER_S", 1000)


@pytest.fixture
def publisher() -> Recorded:
    return Recorded()


@pytest.fixture
def shown(publisher: Recorded) -> Iterator[Broadcast]:
    with Broadcast(publisher, "actor", "actor-0", ahead=2) as made:
        yield made


@pytest.mark.usefixtures("fast")
def test_an_episode_is_shown_frame_by_frame_and_marked_at_its_end(
    publisher: Recorded, shown: Broadcast
) -> None:
    play(shown, 5, outcome=Outcome.COLLISION)
    frames = publisher.wait_for(6)
    assert [frame.frame for frame in frames] == [0, 1, 2, 3, 4, 5]
    assert {frame.episode for frame in frames} == {1}
    assert [frame.outcome for frame in frames] == ["", "", "", "", "", "collision"]
    assert [frame.collided.tolist() for frame in frames[:3]] == [[0, 0], [1, 0], [0, 0]]
    first, last = frames[0], frames[-1]
    np.testing.assert_array_equal(first.robots, SCENE.robots.astype(np.float32))
    np.testing.assert_array_equal(first.q_values, VALUES)
    np.testing.assert_array_equal(first.actions, ACTIONS)
    assert (len(last.q_values), len(last.actions)) == (0, 0)
    assert zlib.decompress(frames[3].images) == bytes([3]) * 32
    assert (first.weights_version, first.epsilon, first.view_px) == (7, 0.25, 4)


def test_while_frames_wait_other_episodes_are_skipped(
    publisher: Recorded, shown: Broadcast
) -> None:
    play(shown, 30)
    for _ in range(5):
        play(shown, 3)
    frames = publisher.wait_for(4)
    assert {frame.episode for frame in frames} == {1}
    assert [frame.frame for frame in frames] == [0, 1, 2, 3][: len(frames)]


@pytest.mark.usefixtures("fast")
def test_episodes_follow_each_other_once_few_frames_wait(
    publisher: Recorded, shown: Broadcast
) -> None:
    play(shown, 3)
    publisher.wait_for(4)
    play(shown, 2)
    frames = publisher.wait_for(7)
    assert [(f.episode, f.frame) for f in frames[4:]] == [(2, 0), (2, 1), (2, 2)]


@pytest.mark.usefixtures("fast")
def test_who_comes_in_the_middle_of_an_episode_sees_it_at_once(publisher: Recorded) -> None:
    with Broadcast(publisher, "actor", "actor-0") as shown:
        publisher.watched = False
        assert not shown.watched
        publisher.watched = True
        play(shown, 9, first=7)
        assert [frame.frame for frame in publisher.wait_for(3)] == [7, 8, 9]


def test_nothing_waits_for_people_who_have_left(publisher: Recorded, shown: Broadcast) -> None:
    play(shown, 100)
    publisher.watched = False
    assert shown.watched, "it has to be told"
    shown.acts(moment(0), VALUES, ACTIONS)
    assert not shown.watched
    assert "0 frames wait" in repr(shown)


def test_frames_come_at_the_pace_of_people(publisher: Recorded, shown: Broadcast) -> None:
    play(shown, 30)
    publisher.wait_for(16)
    span_s = publisher.times[15] - publisher.times[0]
    assert span_s > 0.8, "15 frames a second at most"


@pytest.mark.parametrize("limit", ["MAX_FRAMES", "MAX_BYTES"])
def test_what_waits_is_bounded(
    limit: str, publisher: Recorded, shown: Broadcast, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, limit, {"MAX_FRAMES": 10, "MAX_BYTES": 10 * 32}[limit])
    play(shown, 5000)
    assert len(shown._queue) <= 10
    assert shown._bytes <= 320


def test_images_that_no_batch_of_the_link_holds_are_left_out() -> None:
    noise = np.random.default_rng(0).integers(256, size=(2, 200, 200), dtype=np.uint8)
    small, large = (
        ArenaFrame(
            role="actor",
            worker="a",
            arena=0,
            episode=1,
            frame=0,
            weights_version=0,
            epsilon=0.0,
            robots=np.zeros((2, 3), np.float32),
            targets=np.zeros((2, 2), np.float32),
            obstacles=np.zeros((0, 3), np.float32),
            q_values=VALUES,
            actions=ACTIONS,
            collided=np.zeros(2, np.uint8),
            outcome="",
            view_px=200,
            images=images.tobytes(),
        )
        for images in (np.zeros_like(noise), noise)
    )
    assert len(zlib.decompress(decode(ArenaFrame, packed(small)).images)) == noise.nbytes
    assert decode(ArenaFrame, packed(large)).images == b""


def test_a_publisher_knows_whether_anybody_listens() -> None:
    where = free_endpoint()
    with (
        Session(TransportConfig(listen=(where,))),
        Session(TransportConfig(connect=(where,))) as worker,
        Session(TransportConfig(connect=(where,))) as page,
    ):
        publisher = worker.watched_publisher("mrcdrl/x/arena/actor/a")
        assert not publisher.watched
        waiting, withdraw = page.passing_subscriber("mrcdrl/x/arena/actor/a", 8, 1000)
        wait_until(lambda: publisher.watched)
        publisher.put(b"frame")
        assert waiting.take(PATIENCE_S) == ("mrcdrl/x/arena/actor/a", b"frame")
        withdraw()
        wait_until(lambda: not publisher.watched)


def wait_until(look: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    pause = threading.Event()
    while not look():
        assert time.monotonic() < deadline
        pause.wait(0.01)
