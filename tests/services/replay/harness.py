"""Replay services without transport, driven step by step in the test's own thread."""

import dataclasses
import queue
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.messages.framing import Part
from mrcdrl.common.messages.trajectory import Chunk
from mrcdrl.common.messages.wire import encode
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.log import open_log
from mrcdrl.services.replay.service import ReplayService
from mrcdrl.services.replay.table import Table
from tests.patience import PATIENCE_S

LENGTH = 16  # transitions of a chunk

Answer = tuple[str, bytes | str]  # "reply", "refuse" or "throttle", and its payload or reason


def settings(**replay: object) -> Config:
    """A small prioritized table."""
    small = {"capacity": 500, "min_size": 64, "segment_bytes": 4000, "sampler": "prioritized"}
    given = {f"replay.{name}": str(value) for name, value in {**small, **replay}.items()}
    return load_config("smoke", {"agent.n_step": "3", **given}, environ={})


CONFIG = settings()
TAIL = CONFIG.arena.stack - 1 + CONFIG.agent.n_step


def make_chunk(
    sequence: int,
    length: int = LENGTH,
    *,
    tail: int = TAIL,
    record_bytes: int = CONFIG.arena.record_bytes,
    priority: float | None = None,
    **fields: Any,
) -> Chunk:
    """A chunk of actor "a" whose rewards are its sequence number.

    Records are 0 everywhere, so that chunks share their tails and a table fills its capacity.
    """
    columns: dict[str, Any] = {
        "actor": "a",
        "incarnation": 1,
        "weights_version": 0,
        "records": np.zeros((length + tail, record_bytes), np.uint8),
        "actions": (np.arange(length) % 3).astype(np.uint8),
        "rewards": np.full(length, sequence, np.float32),
        "discounts": np.full(length, 0.9, np.float32),
        "bootstrap_offsets": np.ones(length, np.uint8),
        "priorities": np.full(0 if priority is None else length, priority or 0.0, np.float32),
    }
    return Chunk(sequence=sequence, **columns | fields)


class NoServer:
    """A server that nobody asks."""

    refused = 0

    def take(self, timeout_s: float) -> None:
        return None


@dataclasses.dataclass
class FakeRequest:
    """A request that keeps its answers."""

    payload: bytes
    arrived_s: float = dataclasses.field(default_factory=time.monotonic)
    answers: queue.Queue[Answer] = dataclasses.field(default_factory=queue.Queue)

    def room(self, size: int) -> None:
        return None

    def reply(self, payload: Part | Sequence[Part]) -> None:
        whole = payload if isinstance(payload, Part) else b"".join(payload)
        self.answers.put(("reply", bytes(whole)))

    def refuse(self, reason: str) -> None:
        self.answers.put(("refuse", reason))

    def throttle(self, reason: str) -> None:
        self.answers.put(("throttle", reason))

    def answer(self) -> Answer:
        """The next answer, which must come soon."""
        return self.answers.get(timeout=PATIENCE_S)


def start(
    directory: Path, config: Config = CONFIG, meanwhile: Callable[[], None] = lambda: None
) -> ReplayService:
    """A service that has read back its log and snapshot, and whose threads do not run."""
    table, limiter = Table.from_config(config), RateLimiter.from_config(config)
    log = open_log(config, directory)
    service = ReplayService(config, table, limiter, *[NoServer()] * 3, log)
    service.recover(meanwhile)
    return service


def offer(service: ReplayService, *chunks: Chunk, together: bool = False) -> list[Answer]:
    """Insert chunks, one by one or in one commit; each request's answer."""
    requests = [FakeRequest(encode(chunk), arrived_s=0.0) for chunk in chunks]
    for request in requests:
        service._join(request)
        if not together:
            service._store_in_turn()
    service._store_in_turn()
    assert [request.answers.qsize() for request in requests] == [1] * len(requests)
    return [request.answer() for request in requests]


def insert(service: ReplayService, *chunks: Chunk) -> None:
    """Insert chunks that must be accepted."""
    assert {kind for kind, _ in offer(service, *chunks)} <= {"reply"}


def update(service: ReplayService, priorities: dict[int, float]) -> None:
    """Set priorities by key."""
    keys, values = np.array(list(priorities)), np.array(list(priorities.values()), np.float32)
    service._table.update_priorities(keys, values)


def save(service: ReplayService, directory: Path) -> None:
    """Write a snapshot."""
    (directory / "snapshot").write_bytes(service.snapshot().to_bytes())
