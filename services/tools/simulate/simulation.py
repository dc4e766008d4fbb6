"""Starts the processes of a simulation, lets them work together, and sums up their figures.

Invariants: the clock starts when all have joined; a process that fails, or of which nothing is
heard, ends the simulation with one line; all have ended when the block is left.
"""

import math
import multiprocessing
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from statistics import fmean
from time import monotonic
from typing import Any

import numpy as np

from mrcdrl.common.errors import MrcdrlError, WireError
from mrcdrl.common.messages.trajectory import Float64Array, Stats
from mrcdrl.common.messages.wire import decode_published, encode_parts
from mrcdrl.common.runtime.cores import available_cores
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.tools.progress import Progress
from mrcdrl.services.tools.simulate.actors import BEGIN, STOP, Plan, Tally, act, episode_chunks
from mrcdrl.services.tools.simulate.load import Load, Totals, Usage, bottleneck, busy_cores, latency
from mrcdrl.services.tools.simulate.target import Target

_SILENCE_S = 60.0  # of a process, until it counts as hung
_END_S = 60.0
_SETTLE_S = 2.5  # until replay has told of the last inserts
_TICK_S = 0.2
_LINE_S = 1.0  # between lines on a terminal
_PLAIN_S = 10.0  # otherwise
_LEARNER = "learner"
Work = Callable[[Plan, Connection], None]


@dataclass(frozen=True, slots=True)
class Demand:
    """The load to simulate."""

    actors: int
    rate: float  # robot steps per second and actor; infinite: as many as are acknowledged
    processes: int  # that hold the actors
    publications: float | None  # of weights, per second; None: no learner


class Worker:
    """A process that simulates, and its tallies so far."""

    def __init__(self, name: str, work: Work, plan: Plan) -> None:
        spawn = multiprocessing.get_context("spawn")
        self.name = name
        self.connection, theirs = spawn.Pipe()
        self._process: SpawnProcess = spawn.Process(
            target=work, args=(plan, theirs), name=name, daemon=True
        )
        self._process.start()
        theirs.close()
        self.seconds = math.inf
        self.counts: Counter[str] = Counter()
        self.final: Counter[str] = Counter()
        """What had become of all that it made, a while after the end."""
        self.insert_s: list[Float64Array] = []
        self.weights_s: list[Float64Array] = []

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    def say(self, word: str) -> None:
        """Tell it to begin or stop; raises MrcdrlError if it has ended."""
        try:
            self.connection.send(word)
        except OSError as error:
            raise MrcdrlError(f"{self.name} has ended") from error

    def hear(self) -> Tally:
        """Wait for its next tally; raises MrcdrlError with the reason if it failed."""
        if not self.connection.poll(_SILENCE_S):
            raise MrcdrlError(f"{self.name} hangs: no message for {_SILENCE_S:g} s")
        try:
            message = self.connection.recv()
        except (EOFError, ConnectionError) as error:
            raise MrcdrlError(f"{self.name} has ended; if it said why, that is above") from error
        if not isinstance(message, Tally):
            raise MrcdrlError(f"{self.name}: {message}")
        if message.last:
            self.final = message.counts
            return message
        self.seconds, self.counts = message.seconds or math.inf, message.counts
        self.insert_s.append(message.insert_s)
        self.weights_s.append(message.weights_s)
        return message

    def drain(self) -> None:
        """Read all tallies that have arrived."""
        while self.connection.poll():
            self.hear()

    def close(self) -> None:
        """Close the connection, which ends the process, at once if it has not joined."""
        self.connection.close()
        if not self.seconds < math.inf:
            self._process.terminate()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


@contextmanager
def simulation(demand: Demand, target: Target, name: str) -> Iterator["Simulation"]:
    """Start all processes and wait until they have joined; `name` prefixes the actors' names."""
    actors = [f"{name}-{index}" for index in range(demand.actors)]
    groups = [tuple(actors[i :: demand.processes]) for i in range(demand.processes)]
    with ExitStack() as owned:

        def start(title: str, work: Work, who: tuple[str, ...], rate: float) -> Worker:
            plan = Plan(target.config, target.run, target.transport, who, rate)
            worker = Worker(title, work, plan)
            owned.callback(worker.close)
            return worker

        workers = [start(f"actors-{i}", act, who, demand.rate) for i, who in enumerate(groups)]
        if demand.publications is not None:
            workers.append(start(_LEARNER, learn, (name,), demand.publications))
        began_s = monotonic()
        _await_joined(workers, demand.actors)
        joined_s = monotonic() - began_s
        session = owned.enter_context(Session(target.transport))
        yield Simulation(demand, target, workers, session, joined_s)


def _await_joined(workers: Sequence[Worker], actors: int) -> None:
    """Show how many have joined until all have; raises MrcdrlError if one cannot."""
    due = actors + sum(worker.name == _LEARNER for worker in workers)
    with Progress() as progress:
        done = progress.stage("actors and learner that have joined", due)
        while (joined := sum(worker.counts["joined"] for worker in workers)) < due:
            if not wait([worker.connection for worker in workers], _SILENCE_S):
                raise MrcdrlError(
                    f"{joined} of {due} have joined, and none in the last {_SILENCE_S:g} s: does "
                    "replay hang, or is the machine too busy?"
                )
            for worker in workers:
                worker.drain()
            done(sum(worker.counts["joined"] for worker in workers))


def learn(plan: Plan, connection: Connection) -> None:
    """Run a simulated learner, the only process that imports torch."""
    from mrcdrl.services.tools.simulate.learner import learn

    learn(plan, connection)


class Simulation:
    """Lets the processes work, watches them and replay, and sums up the figures."""

    def __init__(
        self,
        demand: Demand,
        target: Target,
        workers: Sequence[Worker],
        session: Session,
        joined_s: float,
    ) -> None:
        """joined_s: how long it took until all had joined."""
        self._demand, self._target, self._workers = demand, target, workers
        self._joined_s = joined_s
        self._stats = session.queue_subscriber(Keys(target.run).stats("replay", "*"))
        self._ours = {worker.name: worker.pid for worker in workers} | {"simulate": os.getpid()}
        self._pids = target.pids | self._ours
        self._replays: dict[str, dict[str, float]] = {}  # last metrics of each shard
        self._throttled: list[float] = []
        self._insert_s = latency(np.empty(0))

    def run(self, seconds: float, stop: StopSignal) -> dict[str, Any]:
        """Work for this long, or until stopped; return the figures."""
        for worker in self._workers:
            worker.say(BEGIN)
        first, busy_s, began_s = self._totals(), busy_cores(), monotonic()
        shown_s = began_s
        while not stop.is_set() and monotonic() - began_s < seconds:
            self._hear_replay()
            for worker in self._workers:
                worker.drain()
            if monotonic() - shown_s >= (_LINE_S if sys.stderr.isatty() else _PLAIN_S):
                shown_s = monotonic()
                self._show(shown_s - began_s)
        lasted_s = monotonic() - began_s
        last, busy_end_s = self._totals(), busy_cores()
        for worker in self._workers:
            worker.say(STOP)
        for worker in self._workers:
            while not worker.hear().last:
                pass
        settled_s = monotonic() + _SETTLE_S
        while monotonic() < settled_s:
            self._hear_replay()
        if sys.stderr.isatty():
            sys.stderr.write("\n")
        busy = None if busy_s is None or busy_end_s is None else (busy_end_s - busy_s) / lasted_s
        usage = {
            name: Usage.between(first[name], last[name], lasted_s) for name in first if name in last
        }
        return self._figures(lasted_s, usage, busy)

    def _count(self, name: str) -> int:
        return sum(worker.counts[name] for worker in self._workers)

    def _rate(self, name: str) -> float:
        """Total per second, each process by its own clock."""
        return sum(worker.counts[name] / worker.seconds for worker in self._workers)

    def _totals(self) -> dict[str, Totals]:
        found = {name: Totals.of(pid) for name, pid in self._pids.items()}
        return {name: totals for name, totals in found.items() if totals is not None}

    def _hear_replay(self) -> None:
        """Read one of replay's statistics, if one comes soon."""
        item = self._stats.take(_TICK_S)
        if item is None:
            return
        try:
            stats = decode_published(Stats, *item)
        except WireError:
            return
        self._replays[stats.id] = stats.metrics
        self._throttled.append(stats.metrics.get("insert_held", 0.0))

    def _show(self, now_s: float) -> None:
        due = self._demand.actors * self._demand.rate
        of_due = f" of {due:,.0f} due" if math.isfinite(due) else ""
        recent = [worker.insert_s[-1] for worker in self._workers]
        p99 = latency(np.concatenate(recent))["p99"]
        line = (
            f"{now_s:.0f} s: {self._rate('transitions'):,.0f} transitions/s{of_due}, "
            f"insert p99 {'–' if p99 is None else f'{p99:.0f}'} ms, "
            f"throttled {self._count('throttled')}, unanswered {self._count('unanswered')}, "
            f"weights {self._rate('weights_bytes') / 1e6:.0f} MB/s"
        )
        sys.stderr.write(f"\r\033[K{line}" if sys.stderr.isatty() else f"{line}\n")
        sys.stderr.flush()

    def _figures(
        self, seconds: float, usage: dict[str, Usage], busy: float | None
    ) -> dict[str, Any]:
        actors, due = self._demand.actors, self._demand.actors * self._demand.rate
        inserts = latency(np.concatenate([a for w in self._workers for a in w.insert_s]))
        throttled = fmean(self._throttled) if self._throttled else 0.0
        cores, accepted = available_cores(), self._rate("transitions")
        chunks = episode_chunks(self._target.config)
        expected = self._count("published") * actors
        received = self._count("weights") / expected if expected else None
        weights = latency(np.concatenate([a for w in self._workers for a in w.weights_s]))
        replays = self._replays.values()
        load = Load(
            due,
            accepted,
            throttled,
            inserts["p50"],
            cores,
            busy,
            usage,
            weights["p99"],
            frozenset(self._ours),
        )
        acknowledged = sum(worker.final["transitions"] for worker in self._workers)
        return {
            "joined_s": round(self._joined_s, 2),
            "seconds": round(seconds, 2),
            "due_transitions_per_s": round(due) if math.isfinite(due) else None,
            "transitions_per_s": round(accepted, 1),
            "chunks_per_s": round(self._rate("chunks"), 1),
            "inserts_per_s": round(self._rate("requests"), 1),
            "chunk_bytes": round(fmean(sum(map(len, encode_parts(c))) for c in chunks), 1),
            "insert_ms": inserts,
            "fair_turn_ms": self._fair_turn_ms(),
            "held": self._count("throttled"),
            "held_share": round(throttled, 3),
            "unanswered": self._count("unanswered"),
            "refused": sum(replay["refused"] for replay in replays),
            "made": sum(worker.final["made"] for worker in self._workers),
            "acknowledged": acknowledged,
            "lost": self._lost(acknowledged),
            "wait_share": round(self._rate("waited_ms") / 1000 / actors, 3),
            "samples_per_s": round(self._rate("samples"), 1),
            "weights_published": self._count("published"),
            "weights_received_share": None if received is None else round(received, 3),
            "weights_ms": weights if expected else latency(np.empty(0)),
            "weights_bytes_per_s": round(self._rate("weights_bytes")),
            "table": {
                "size": sum(replay["size"] for replay in replays),
                "bytes": sum(replay["bytes"] for replay in replays),
            },
            "processes": {name: asdict(used) for name, used in usage.items()},
            "cores": cores,
            "busy_cores": None if busy is None else round(busy, 2),
            "first_limit": bottleneck(load),
        }

    def _fair_turn_ms(self) -> float | None:
        """How long each insert takes if actors that all ask all the time are served in turn."""
        requests_per_s = self._rate("requests")
        return round(1000 * self._demand.actors / requests_per_s, 1) if requests_per_s else None

    def _lost(self, acknowledged: int) -> int | None:
        """Transitions that were acknowledged and that replay does not count.

        None if others insert, too, or if a shard has not told of itself.
        """
        if not self._target.pids or len(self._replays) < self._target.config.replay.shards:
            return None
        stored = sum(round(replay["inserts"]) for replay in self._replays.values())
        return max(acknowledged - stored, 0)
