"""Real actors that join and leave while a learner learns: 1, then 64, then 8.

    python -m benchmarks.scale_actors --minutes 10

Starts replay, a learner and actors as processes of their own, with tiny arenas, and changes the
number of actors while all else goes on: one for a fifth of the time, --actors for the next three,
--left for the last. Prints a line of JSON for each phase, with the learner's updates a second, and
one at the end: what the actors had acknowledged beside what replay counts, and its gaps.
"""

import argparse
import signal
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.machine import emit
from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.common.messages.wire import decode_published
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from tests.system.system_processes import Command, end_all

_TINY = ["--arena.view_px", "32", "--arena.max_frames", "200", "--actor.num_arenas", "2"]
_SETTINGS = ["--learner.batch_size", "32", "--run.minutes", "0", "--run.learner_steps", "0"]
_END_S = 120.0
_SILENT_S = 10.0  # without statistics: an actor has left


class Watcher:
    """The newest statistics of each process, by role and name, and when they came."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self._waiting = session.queue_subscriber(keys.every_stats)
        self.newest: dict[tuple[str, str], Stats] = {}
        self.came_s: dict[tuple[str, str], float] = {}

    def look(self, seconds: float) -> None:
        """Read statistics for this long."""
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            item = self._waiting.take(left_s)
            if item is None:
                return
            try:
                stats = decode_published(Stats, *item)
            except WireError:
                continue
            self.newest[stats.role, stats.id] = stats
            self.came_s[stats.role, stats.id] = time.monotonic()

    def total(self, role: str, metric: str) -> float:
        """Sum over the processes of a role."""
        return sum(s.metrics.get(metric, 0) for (r, _), s in self.newest.items() if r == role)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--actors", type=int, default=64)
    parser.add_argument("--left", type=int, default=8)
    arguments = parser.parse_args()
    fifth_s = 60 * arguments.minutes / 5
    run, endpoint = f"scale-{time.time_ns()}", free_endpoint()
    with tempfile.TemporaryDirectory() as name, ExitStack() as owned:
        folder = Path(name)
        owned.callback(end_all, run)
        listens = ["--listen", endpoint, "--config", "quick", *_TINY, *_SETTINGS]
        owned.enter_context(
            Command(["replay", "--run", run, "--run-dir", folder, *listens], folder)
        )
        joins = ["--run", run, "--run-dir", folder, "--connect", endpoint]
        session = owned.enter_context(
            Session(TransportConfig(connect=(endpoint,)), open_timeout_s=_END_S)
        )
        watcher = Watcher(session, Keys(run))
        owned.enter_context(Command(["learner", *joins], folder))
        actors: list[Command] = []
        for number, seconds in (
            (1, fifth_s),
            (arguments.actors, 3 * fifth_s),
            (arguments.left, fifth_s),
        ):
            while len(actors) < number:
                actor = Command(["actor", *joins, "--id", f"actor-{len(actors)}"], folder)
                actors.append(owned.enter_context(actor))
            leaving, actors = actors[number:], actors[:number]
            for actor in leaving:
                actor.signal(signal.SIGTERM)
            emit({"bench": "scale_actors", **phase(watcher, number, seconds)})
            codes = [actor.wait(_END_S) for actor in leaving]
            assert codes == [0] * len(leaving), codes
        for actor in actors:
            actor.signal(signal.SIGTERM)
        watcher.look(15.0)
        acknowledged = watcher.total("actor", "inserts_acknowledged")
        emit(
            {
                "bench": "scale_actors",
                "ends": [actor.wait(_END_S) for actor in actors],
                "acknowledged": acknowledged,
                "counted_by_replay": watcher.total("replay", "inserts"),
                "gaps": watcher.total("replay", "gaps"),
                "refused": watcher.total("replay", "refused"),
            }
        )


def phase(watcher: Watcher, actors: int, seconds: float) -> dict[str, Any]:
    """Watch for this long; figures of its second half, when all have joined."""
    watcher.look(seconds / 2)
    began_s, before = time.monotonic(), watcher.total("learner", "learner_steps")
    inserts = watcher.total("replay", "inserts")
    watcher.look(seconds / 2)
    lasted_s = time.monotonic() - began_s
    ages = [
        stats.metrics.get("weights_age_s", 0.0)
        for (role, name), stats in watcher.newest.items()
        if role == "actor" and watcher.came_s[role, name] > time.monotonic() - _SILENT_S
    ]
    return {
        "actors": actors,
        "heard_of": len(ages),
        "learner_steps_per_s": (watcher.total("learner", "learner_steps") - before) / lasted_s,
        "inserts_per_s": (watcher.total("replay", "inserts") - inserts) / lasted_s,
        "oldest_weights_s": max(ages, default=None),
    }


if __name__ == "__main__":
    main()
