"""The processes of a simulation: started, let work together, listened to, summed up.

Invariants: the clock runs from when all have joined; a process that fails ends the simulation,
with its reason; all have ended when the block is left.
"""

import math
import multiprocessing
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from statistics import fmean
from time import monotonic
from typing import Any

import numpy as np

from mrcdrl.common.errors import MrcdrlError, WireError
from mrcdrl.common.messages.trajectory import Float64Array, Stats
from mrcdrl.common.messages.wire import decode, encode_parts
from mrcdrl.common.runtime.process import StopSignal, available_cores
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.tools.simulate.actors import BEGIN, STOP, Plan, Tally, act, episode_chunks
from mrcdrl.services.tools.simulate.load import Load, Share, Usage, busy_cores, first_limit, latency
from mrcdrl.services.tools.simulate.target import Target

_JOIN_S = 120.0
_END_S = 60.0
_TICK_S = 0.2
_LINE_S = 1.0  # between lines on a terminal
_PLAIN_S = 10.0  # and elsewhere
Work = Callable[[Plan, Connection], None]


@dataclass(frozen=True, slots=True)
class Demand:
    """What is to be simulated."""

    actors: int
    rate: float  # robot steps per second of each; infinite: as many as are acknowledged
    processes: int  # that they share
    publications: float | None  # of weights, per second; None: no learner


class Worker:
    """A process that simulates, and what it told."""

    def __init__(self, name: str, work: Work, plan: Plan) -> None:
        spawn = multiprocessing.get_context("spawn")
        self.name = name
        self._connection, theirs = spawn.Pipe()
        self._process: SpawnProcess = spawn.Process(
            target=work, args=(plan, theirs), name=name, daemon=True
        )
        self._process.start()
        theirs.close()
        self.seconds = math.inf
        self.counts: Counter[str] = Counter()
        self.insert_s: list[Float64Array] = []

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    def say(self, word: str) -> None:
        self._connection.send(word)

    def hear(self) -> Tally:
        """Its next tally, waited for; raises MrcdrlError with what went wrong there."""
        if not self._connection.poll(_JOIN_S):
            raise MrcdrlError(f"{self.name} said nothing for {_JOIN_S:g} s")
        try:
            said = self._connection.recv()
        except (EOFError, ConnectionError) as error:
            raise MrcdrlError(f"{self.name} ended; its error is above") from error
        if not isinstance(said, Tally):
            raise MrcdrlError(f"{self.name}: {said}")
        self.seconds, self.counts = said.seconds or math.inf, said.counts
        self.insert_s.append(said.insert_s)
        return said

    def drain(self) -> None:
        """Hear what it has said by now."""
        while self._connection.poll():
            self.hear()

    def close(self) -> None:
        """Without a parent to listen to, it ends."""
        self._connection.close()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


@contextmanager
def simulation(demand: Demand, target: Target, name: str) -> Iterator["Simulation"]:
    """All processes started and joined to the run, waiting to begin; `name` begins the actors'."""
    actors = [f"{name}-{index}" for index in range(demand.actors)]
    shares = [tuple(actors[i :: demand.processes]) for i in range(demand.processes)]
    with ExitStack() as owned:

        def start(title: str, work: Work, who: tuple[str, ...], rate: float) -> Worker:
            plan = Plan(target.config, target.run, target.transport, who, rate)
            worker = Worker(title, work, plan)
            owned.callback(worker.close)
            return worker

        workers = [start(f"actors-{i}", act, who, demand.rate) for i, who in enumerate(shares)]
        if demand.publications is not None:
            workers.append(start("learner", learn, (name,), demand.publications))
        for worker in workers:
            worker.hear()
        session = owned.enter_context(Session(target.transport))
        yield Simulation(demand, target, workers, session)


def learn(plan: Plan, connection: Connection) -> None:
    """A simulated learner's process; none but it brings in torch."""
    from mrcdrl.services.tools.simulate.learner import learn

    learn(plan, connection)


class Simulation:
    """Lets the processes work, watches them and replay, and sums up."""

    def __init__(
        self, demand: Demand, target: Target, workers: Sequence[Worker], session: Session
    ) -> None:
        self._demand, self._target, self._workers = demand, target, workers
        self._stats = session.queue_subscriber(Keys(target.run).stats("replay", "*"))
        self._pids = target.pids | {worker.name: worker.pid for worker in workers}
        self._replays: dict[str, dict[str, float]] = {}  # last words of each shard
        self._held: list[float] = []
        self._insert_s = latency(np.empty(0))

    def run(self, seconds: float, stop: StopSignal) -> dict[str, Any]:
        """The figures of so many seconds, or of those until stopped."""
        for worker in self._workers:
            worker.say(BEGIN)
        first, busy_s, began_s = self._usage(), busy_cores(), monotonic()
        shown_s = began_s
        while not stop.is_set() and monotonic() - began_s < seconds:
            self._listen()
            if monotonic() - shown_s >= (_LINE_S if sys.stderr.isatty() else _PLAIN_S):
                shown_s = monotonic()
                self._show(shown_s - began_s)
        lasted_s = monotonic() - began_s
        last, busy_end_s = self._usage(), busy_cores()
        for worker in self._workers:
            worker.say(STOP)
        for worker in self._workers:
            while not worker.hear().last:
                pass
        if sys.stderr.isatty():
            sys.stderr.write("\n")
        busy = None if busy_s is None or busy_end_s is None else (busy_end_s - busy_s) / lasted_s
        shares = {
            name: Share.between(first[name], last[name], lasted_s) for name in first if name in last
        }
        return self._figures(lasted_s, shares, busy)

    def _count(self, name: str) -> int:
        return sum(worker.counts[name] for worker in self._workers)

    def _rate(self, name: str) -> float:
        """Per second; a process that is late counts by its own clock."""
        return sum(worker.counts[name] / worker.seconds for worker in self._workers)

    def _usage(self) -> dict[str, Usage]:
        found = {name: Usage.of(pid) for name, pid in self._pids.items()}
        return {name: usage for name, usage in found.items() if usage is not None}

    def _listen(self) -> None:
        """What replay says of itself, and the processes of themselves."""
        item = self._stats.take(_TICK_S)
        if item is not None:
            try:
                stats = decode(Stats, item[1])
            except WireError:
                return
            self._replays[stats.id] = stats.metrics
            self._held.append(stats.metrics.get("insert_held", 0.0))
        for worker in self._workers:
            worker.drain()

    def _show(self, now_s: float) -> None:
        due = self._demand.actors * self._demand.rate
        of_due = f" of {due:,.0f} due" if math.isfinite(due) else ""
        recent = [worker.insert_s[-1] for worker in self._workers]
        p99 = latency(np.concatenate(recent))["p99"]
        line = (
            f"{now_s:.0f} s: {self._rate('transitions'):,.0f} transitions/s{of_due}, "
            f"insert p99 {'–' if p99 is None else f'{p99:.0f}'} ms, "
            f"held {self._count('held')}, unanswered {self._count('unanswered')}, "
            f"weights {self._rate('weights_bytes') / 1e6:.0f} MB/s"
        )
        sys.stderr.write(f"\r\033[K{line}" if sys.stderr.isatty() else f"{line}\n")
        sys.stderr.flush()

    def _figures(
        self, seconds: float, shares: dict[str, Share], busy: float | None
    ) -> dict[str, Any]:
        actors, due = self._demand.actors, self._demand.actors * self._demand.rate
        inserts = latency(np.concatenate([a for w in self._workers for a in w.insert_s]))
        held = fmean(self._held) if self._held else 0.0
        cores, taken = available_cores(), self._rate("transitions")
        load = Load(due, taken, held, inserts["p50"], cores, busy, shares)
        chunks = episode_chunks(self._target.config)
        expected = self._count("published") * actors
        replays = self._replays.values()
        return {
            "seconds": round(seconds, 2),
            "due_transitions_per_s": round(due) if math.isfinite(due) else None,
            "transitions_per_s": round(taken, 1),
            "chunks_per_s": round(self._rate("chunks"), 1),
            "inserts_per_s": round(self._rate("requests"), 1),
            "chunk_bytes": round(fmean(sum(map(len, encode_parts(c))) for c in chunks), 1),
            "insert_ms": inserts,
            "held": self._count("held"),
            "held_share": round(held, 3),
            "unanswered": self._count("unanswered"),
            "refused": sum(replay["refused"] for replay in replays),
            "wait_share": round(self._rate("waited_ms") / 1000 / actors, 3),
            "samples_per_s": round(self._rate("samples"), 1),
            "weights_published": self._count("published"),
            "weights_received_share": (
                round(self._count("weights") / expected, 3) if expected else None
            ),
            "weights_bytes_per_s": round(self._rate("weights_bytes")),
            "table": {
                "size": sum(replay["size"] for replay in replays),
                "bytes": sum(replay["bytes"] for replay in replays),
            },
            "processes": {name: asdict(share) for name, share in shares.items()},
            "cores": cores,
            "busy_cores": None if busy is None else round(busy, 2),
            "first_limit": first_limit(load),
        }
