"""Runs that are up, followed while somebody looks at them.

Invariants: a run is joined when the first viewer comes, and left soon after the last has gone; each
run has one thread, which no viewer can hold up; nothing is published, and no token is held. What
fails is told to the viewers, and tried again.
"""

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import MrcdrlError, RunDirectoryError, UnreachableError, WireError
from mrcdrl.common.messages.checks import MAX_FRAME_BYTES
from mrcdrl.common.messages.trajectory import ArenaFrame
from mrcdrl.common.messages.wire import decode_published
from mrcdrl.common.sync.joining import recorded_endpoint
from mrcdrl.common.transport import QueueSubscriber, Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.monitor import prometheus
from mrcdrl.services.monitor.follower import Follower
from mrcdrl.services.monitor.recall import recall_recent
from mrcdrl.services.monitor.run_info import config_of
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule
from mrcdrl.services.web.folder import is_up
from mrcdrl.services.web.view import frame_view, live_view
from mrcdrl.services.web.viewers import Channel, Viewer, encoded

MAX_RUNS = 8  # followed at a time
MAX_WORKERS = 16  # of a run that are watched
_FRAMES = 64  # that wait to be read
_FRAMES_S = 0.1  # between two pieces of frames; a page plays them evenly
_FIRST_S = 0.02  # the same in the first second that an arena is watched: somebody waits for it
_TICK_S = 0.25
_PERIOD_S = 1.0  # between two events
_LINGER_S = 10.0  # that a run is followed after its last viewer: a page may be loaded anew
_RETRY_S = 1.0
_SCRAPED_S = 60.0  # that a run is followed after a scrape, at least
_JOIN_S = 5.0  # for the run to answer


class Runs:
    """The runs that are followed now; used by the server's event loop only."""

    def __init__(self, transport: TransportConfig) -> None:
        """transport: how runs are joined; its `connect` is for those that note no endpoint."""
        self._transport = transport
        self._followed: dict[Path, FollowedRun] = {}
        self._closed = False

    @asynccontextmanager
    async def viewing(
        self, run_dir: Path, worker: tuple[str, str] | None = None
    ) -> AsyncIterator[Viewer]:
        """A viewer of this run and, with the role and name of a worker, of its arena.

        Without a name, of the first worker in that role.

        Raises MrcdrlError if too many runs are followed, or too many workers watched, already.
        """
        followed, viewer = self._followed_run(run_dir), Viewer()
        try:
            with ExitStack() as opened:
                opened.enter_context(followed.states.open_to(viewer))
                if worker is not None:
                    opened.enter_context(followed.watching(worker, viewer))
                yield viewer
        finally:
            followed.left_s = max(followed.left_s, time.monotonic())

    def expect(self, run_dir: Path) -> None:
        """Join this run if there is room: a page of it is being opened, and will ask for it."""
        with suppress(MrcdrlError):
            self._followed_run(run_dir)

    def follow(self, run_dirs: Iterable[Path]) -> None:
        """Follow these runs for a while, though nobody views them; as many as there is room for."""
        for run_dir in run_dirs:
            with suppress(MrcdrlError):
                followed = self._followed_run(run_dir)
                followed.left_s = max(followed.left_s, time.monotonic() + _SCRAPED_S)

    def measured(self) -> list[prometheus.FollowedRun]:
        """The runs that are joined, for Prometheus; from any thread."""
        each = (followed.measured for followed in list(self._followed.values()))
        return [run for run in each if run is not None]

    def tend(self) -> None:
        """Leave the runs that nobody watches any more; call it once a second."""
        for run_dir, followed in list(self._followed.items()):
            if followed.has_ended or followed.unwatched_s > _LINGER_S:
                followed.stop()
                del self._followed[run_dir]

    async def close(self) -> None:
        """Leave all runs, for good."""
        self._closed = True
        left, self._followed = self._followed, {}
        for followed in left.values():
            followed.stop()
        for followed in left.values():
            await asyncio.to_thread(followed.join)

    def _followed_run(self, run_dir: Path) -> "FollowedRun":
        followed = self._followed.get(run_dir)
        if followed is not None and not followed.has_ended:
            return followed
        if self._closed:
            raise MrcdrlError("the server is ending")
        if len(self._followed) >= MAX_RUNS:
            raise MrcdrlError(f"{MAX_RUNS} runs are watched already: close one of their pages")
        loop = asyncio.get_running_loop()
        followed = FollowedRun(run_dir, self._transport, loop.call_soon_threadsafe)
        self._followed[run_dir] = followed
        return followed


class FollowedRun:
    """A run that is up, and the thread that follows it: `follow`, until `stop` or its end."""

    def __init__(
        self, run_dir: Path, transport: TransportConfig, in_loop: Callable[..., object]
    ) -> None:
        """in_loop: calls a function in the event loop, where viewers are."""
        self.states = Channel()
        self.left_s = time.monotonic()  # when the last viewer went, or a scrape ceases to count
        self.measured: prometheus.FollowedRun | None = None  # while it is joined
        self._run_dir = run_dir
        self._transport = transport
        self._in_loop = in_loop
        self._arenas: dict[tuple[str, str], Channel] = {}  # that are watched, by role and worker
        self._stop = threading.Event()
        self._changed = threading.Event()  # who is watched, or `_stop`
        self._thread = threading.Thread(target=self._follow, name="follow")
        self._thread.start()

    def __repr__(self) -> str:
        return f"FollowedRun({self._run_dir.name!r}, viewers={len(self.states)})"

    @property
    def has_ended(self) -> bool:
        """Whether it follows nothing any more."""
        return self._stop.is_set() or not self._thread.is_alive()

    @property
    def unwatched_s(self) -> float:
        """Seconds since the last viewer went; 0 while there is one."""
        return 0.0 if len(self.states) else time.monotonic() - self.left_s

    @contextmanager
    def watching(self, worker: tuple[str, str], viewer: Viewer) -> Iterator[None]:
        """Hand the viewer the frames of a worker's arena, in this block.

        worker: its role and name; without a name, the first worker in that role.

        Raises MrcdrlError if too many workers are watched already.
        """
        arena = self._arenas.get(worker)
        if arena is None:
            if len(self._arenas) >= MAX_WORKERS:
                raise MrcdrlError(f"{MAX_WORKERS} workers of the run are watched already")
            arena = Channel()
            self._arenas = {**self._arenas, worker: arena}  # replaced: the thread reads it
            self._changed.set()
        try:
            with arena.open_to(viewer):
                yield
        finally:
            if not len(arena):
                self._arenas = {key: a for key, a in self._arenas.items() if a is not arena}
                self._changed.set()

    def stop(self) -> None:
        """Have the thread end."""
        self._stop.set()
        self._changed.set()

    def join(self) -> None:
        """Wait for the thread's end, which is near after `stop`."""
        self._thread.join()

    def _follow(self) -> None:
        """Join the run, again and again, until it or the interest in it ends."""
        while not self._stop.is_set() and is_up(self._run_dir):
            try:
                self._follow_once()
            except MrcdrlError as error:
                self._tell("waiting", {"why": str(error)})
            self.measured = None
            self._stop.wait(_RETRY_S)
        self._tell("ended", {})
        self._in_loop(self.states.end)

    def _follow_once(self) -> None:
        config = config_of(self._run_dir)
        if config is None:
            raise RunDirectoryError("its configuration cannot be read by this version of mrcdrl")
        state = RunState(config)
        with Session(self._joining(), open_timeout_s=_JOIN_S) as session:
            lasted_s = recall_recent(self._run_dir, state)
            keys, rule = Keys(self._run_dir.name), StoppingRule(config.run, config.arena.numbers)
            follower = Follower(session, keys, state, None, rule, lasted_s)
            self.measured = prometheus.FollowedRun(
                self._run_dir.name, state, lambda: follower.now, follower.lock, self._run_dir
            )
            due_s, known, frames = 0.0, False, Frames(session, keys)
            arenas, began_s = self._arenas, follower.lived_s
            while not self._stop.is_set():
                if arenas is not self._arenas:
                    arenas, began_s = self._arenas, follower.lived_s
                chosen = {arena: _chosen(state, *arena) for arena in arenas}
                frames.follow(worker for worker in chosen.values() if worker is not None)
                follower.listen(0.0)
                # Who is there is known a moment after joining; without it a state would mislead.
                known = (
                    known or any(s.alive for s in state.services) or follower.lived_s >= _PERIOD_S
                )
                if known and follower.lived_s >= due_s:
                    if not is_up(self._run_dir):
                        return
                    due_s = follower.lived_s + _PERIOD_S
                    self._tell("state", live_view(state, follower.now))
                for worker, piece in frames.take(state) if known else ():
                    for arena in (a for a in arenas if chosen[a] == worker):
                        self._in_loop(arenas[arena].publish, "frame", piece)
                if known and not arenas:
                    pause_s = _TICK_S
                else:
                    pause_s = _FIRST_S if follower.lived_s < began_s + _PERIOD_S else _FRAMES_S
                self._changed.wait(pause_s)
                self._changed.clear()

    def _joining(self) -> TransportConfig:
        """How the run is joined: at the endpoint that it notes, or else the configured ones."""
        try:
            endpoints = [recorded_endpoint(self._run_dir, "--connect")]
        except UnreachableError:
            endpoints = list(self._transport.connect)
            if not endpoints:
                raise
        return self._transport.model_copy(update={"connect": tuple(endpoints), "listen": ()})

    def _tell(self, name: str, values: dict[str, Any]) -> None:
        self._in_loop(self.states.publish, name, encoded(name, values))


def _chosen(state: RunState, role: str, worker: str) -> tuple[str, str] | None:
    """The worker that is named, or else the first in its role; None if none is there."""
    if worker:
        return role, worker
    return next(((s.role, s.id) for s in state.alive(role)), None)


class Frames:
    """The frames of the workers that are watched, by one thread."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self._session = session
        self._keys = keys
        self._subscribed: dict[tuple[str, str], tuple[QueueSubscriber, Callable[[], None]]] = {}

    def follow(self, workers: Iterable[tuple[str, str]]) -> None:
        """Subscribe to these workers and to no others; a worker publishes while one does."""
        wanted = set(workers)
        for worker in self._subscribed.keys() - wanted:
            self._subscribed.pop(worker)[1]()
        for worker in wanted - self._subscribed.keys():
            self._subscribed[worker] = self._session.passing_subscriber(
                self._keys.arena(*worker), _FRAMES, MAX_FRAME_BYTES
            )

    def take(self, state: RunState) -> Iterator[tuple[tuple[str, str], bytes]]:
        """Each worker of which frames have come, with these as events; strangers are left out."""
        for worker, (subscriber, _) in self._subscribed.items():
            if state.knows(*worker):
                events = [encoded("frame", frame_view(frame)) for frame in _frames(subscriber)]
                if events:
                    yield worker, b"".join(events)


def _frames(subscriber: QueueSubscriber) -> Iterator[ArenaFrame]:
    """The frames that wait, without what is none."""
    for key, data in subscriber.drain():
        with suppress(WireError):
            yield decode_published(ArenaFrame, key, data)
