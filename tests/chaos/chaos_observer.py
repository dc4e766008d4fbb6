"""An observer that watches a run through faults and checks the promises of docs/architecture.md.

Invariants: it only listens; a service works again when, after a fault's end, it was heard of over
the network twice and has done more by its own figures, and its heartbeat says so too.
"""

import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mrcdrl.common.config import Config, TransportConfig
from mrcdrl.common.messages.trajectory import Stats, Weights
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay.inspect.contents import Contents, log_directory, read_contents
from tests.chaos.chaos_stack import Stack

WORK = {  # role: the figure that rises while it does its work
    "replay": "inserts",
    "learner": "learner_steps",
    "actor": "inserts_acknowledged",
    "evaluator": "evaluations",
}
_LISTEN_S = 0.1


@dataclass(frozen=True, slots=True)
class Life:
    """One process of a service."""

    service: str
    incarnation: int


@dataclass
class Observer:
    """Follows weights and metrics, and restarts ended services while it listens."""

    stack: Stack
    session: Session
    orders: list[tuple[int, int]] = field(default_factory=list)  # of weights as they came
    told: dict[Life, dict[str, float]] = field(default_factory=dict)  # last figures
    backwards: list[str] = field(default_factory=list)  # versions that went back

    def __post_init__(self) -> None:
        keys = Keys(self.stack.run)
        self._stats = self.session.queue_subscriber(keys.every_stats)
        self._weights = self.session.queue_subscriber(keys.weights)

    def listen(self, seconds: float) -> None:
        """Process what arrives within this time."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            self.hear()

    def recovery(self, moment_s: float, limit_s: float) -> dict[str, float]:
        """Seconds from a moment until each service worked again; the limit if it did not."""
        first: dict[Life, float] = {}
        recovered: dict[str, float] = {}
        names = set(self.stack.services)
        while set(recovered) != names and time.monotonic() < moment_s + limit_s:
            stats = self.hear()
            moved = {name for name in names if self.stack.services[name].role not in WORK}
            if stats is not None:
                life, work = _life(stats), stats.metrics[WORK[stats.role]]
                if work > first.setdefault(life, work):
                    moved.add(stats.id)
            for name in moved - set(recovered):
                if self.stack.services[name].worked_since(moment_s):
                    recovered[name] = round(time.monotonic() - moment_s, 2)
        return {name: recovered.get(name, limit_s) for name in self.stack.services}

    def hear(self) -> Stats | None:
        """The next metrics of a service; None if none arrive soon."""
        self.stack.tend()
        item = self._stats.take(_LISTEN_S)
        for _, payload in self._weights.drain():
            order = decode(Weights, payload).order
            if self.orders and order <= self.orders[-1]:
                self.backwards.append(f"published {order} after {self.orders[-1]}")
            self.orders.append(order)
        if item is None:
            return None
        stats = decode(Stats, item[1])
        before = self.told.get(_life(stats), {}).get("weights_version", -1)
        if stats.role != "learner" and stats.metrics.get("weights_version", before) < before:
            self.backwards.append(f"{stats.id} acts by {stats.metrics} after {before}")
        self.told[_life(stats)] = stats.metrics
        return stats

    def figure(self, service: str, name: str) -> float:
        """The last value that any process of that service reported."""
        told = [metrics for life, metrics in self.told.items() if life.service == service]
        return told[-1][name] if told else -1.0


def _life(stats: Stats) -> Life:
    return Life(stats.id, int(stats.text["incarnation"]))


def judge(observer: Observer, config: Config, run: Path) -> dict[str, Any]:
    """Compare an ended run's log with what was acknowledged; empty lists mean that all is well.

    lost: transitions that an actor was told were kept and the log has not, and numbers that are
    missing between two chunks of one actor's process: each is sent when the one before it was
    acknowledged. doubled: chunks that are there twice.
    """
    contents = read_contents(log_directory(run, 0), config)
    assert contents.rebuilt is not None
    assert contents.rebuilt.table.first_key == 0, "a larger replay.capacity: some were replaced"
    return {
        **compare(contents, {life: m for life, m in observer.told.items() if WORK["actor"] in m}),
        "corrupt_records": contents.files.corrupt_records,
        "left_out_chunks": contents.files.left_out_chunks,
        "kept": contents.num_transitions,
        "weights_published": len(observer.orders),
        "weights_backwards": observer.backwards,
    }


def compare(contents: Contents, told: dict[Life, dict[str, float]]) -> dict[str, Any]:
    """`lost` and `doubled` of `judge`."""
    stored: dict[Life, list[int]] = defaultdict(list)
    sequences: dict[Life, list[int]] = defaultdict(list)
    for chunk in contents.chunks:
        life = Life(chunk.actor, chunk.incarnation)
        stored[life].append(len(chunk))
        sequences[life].append(chunk.sequence)
    lost = [
        f"{life.service}: chunks {missing[:5]} of 0 … {numbers[-1]}"
        for life, numbers in sequences.items()
        if (missing := sorted(set(range(numbers[-1])) - set(numbers)))
    ]
    for life, metrics in told.items():
        acknowledged, kept = metrics[WORK["actor"]], sum(stored[_stream(life, stored)])
        if kept < acknowledged:
            lost.append(f"{life.service}: {acknowledged:g} acknowledged, {kept} kept")
    return {
        "lost": lost,
        "doubled": contents.files.duplicate_chunks,
        "acknowledged": int(sum(metrics[WORK["actor"]] for metrics in told.values())),
    }


def _stream(life: Life, stored: dict[Life, list[int]]) -> Life:
    """Identity of a process's chunks, taken from its clock just after that of its metrics."""
    after = [
        s.incarnation
        for s in stored
        if s.service == life.service and s.incarnation >= life.incarnation
    ]
    return Life(life.service, min(after, default=life.incarnation))


def watch(stack: Stack) -> Session:
    """A session for an observer."""
    return Session(TransportConfig(connect=(stack.endpoint,)), open_timeout_s=120)
