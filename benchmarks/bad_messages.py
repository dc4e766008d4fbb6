"""Send bad messages to a real replay service on all its keys, with one good one in fifty.

`python -m benchmarks.bad_messages --count 100000` starts a replay process and sends it malformed,
truncated, flipped, spliced, foreign, ill-fitting and oversized messages over Zenoh, also with
their arrays after the map, and in sets. It prints one line of JSON: how many of each kind were
refused, how many replay counted, the reasons, messages/s, and the memory of the process (VmRSS)
over time. tests/system/test_bad_messages.py sends a few thousand.
"""

import argparse
import collections
import dataclasses
import random
import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import msgpack
import numpy as np

from benchmarks.machine import emit
from mrcdrl.common.config import Config, TransportConfig, load_config, to_toml
from mrcdrl.common.errors import DeadlineError, RefusedError, ThrottledError, WireError
from mrcdrl.common.messages import wire
from mrcdrl.common.messages.framing import join_set, split_set
from mrcdrl.common.messages.trajectory import Chunk, Priorities, SampleRequest, Stats
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.transport import PendingReply, Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from tests.patience import eventually
from tests.system.system_processes import Command, end_all, run_name

IN_FLIGHT = 32
GOOD_EVERY = 50
WARM_UP = 1000  # messages before the first look at the memory
LARGEST = 200_000  # bytes of a message
CONFIG = load_config(
    "smoke",
    {
        "replay.sampler": "prioritized",
        "replay.samples_per_insert": "0",
        "replay.capacity": "2000",
        "replay.min_size": "32",
        "transport.max_message_bytes": str(LARGEST),
    },
    environ={},
)
KINDS = (
    *("random", "empty", "truncated", "flipped", "spliced", "longer", "foreign", "newer"),
    *("misfit", "odd", "nested", "oversized", "apart", "set"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        emit({"bench": "bad_messages", **flood(arguments.count, arguments.seed, Path(folder))})


def flood(count: int, seed: int, folder: Path) -> dict[str, Any]:
    """Start a replay process, send it that many messages, and return the figures.

    Raises AssertionError if a bad message is not refused, or a good one is.
    """
    name, endpoint = run_name("bad-messages"), free_endpoint()
    path = folder / "bad.toml"
    path.write_text(to_toml(CONFIG), "utf-8")
    serving = ["replay", "--run", name, "--config", path, "--listen", endpoint]
    try:
        with (
            Command([*serving, "--run-dir", folder], folder) as replay,
            Session(TransportConfig(connect=(endpoint,))) as session,
        ):
            eventually(lambda: _answers(session, Keys(name)), "replay answers")
            return Peer(session, Keys(name), seed, replay.process.pid).send(count)
    finally:
        end_all(name)


class Peer:
    """Sends bad and good messages, a few at a time, and counts the answers."""

    def __init__(self, session: Session, keys: Keys, seed: int, pid: int) -> None:
        self._stats = session.queue_subscriber(keys.every_stats)
        self._clients = {
            Chunk: session.client(keys.insert(), "replay"),
            SampleRequest: session.client(keys.sample(), "replay"),
            Priorities: session.client(keys.priorities(), "replay"),
        }
        self._status = Path(f"/proc/{pid}/status")
        self._rng = random.Random(seed)
        self._inserted = 0
        self._pending: collections.deque[tuple[str, bytes, PendingReply]] = collections.deque()
        self._refused: collections.Counter[str] = collections.Counter()
        self._reasons: collections.Counter[str] = collections.Counter()
        self._good = 0

    def send(self, count: int) -> dict[str, Any]:
        for _ in range(3):
            self._ask_well(Chunk)
        self._settle(0)
        began, memory = time.monotonic(), [self._memory_kib()]
        for number in range(1, count + 1):
            if number % GOOD_EVERY == 0:
                self._ask_well(self._rng.choice(list(self._clients)))
            cls, kind = self._rng.choice(list(self._clients)), self._rng.choice(KINDS)
            self._ask(cls, kind, bad(cls, kind, self._rng))
            if number == WARM_UP or number % (max(count // 10, WARM_UP)) == 0:
                self._settle(0)
                memory.append(self._memory_kib())
        self._settle(0)
        seconds = time.monotonic() - began
        for cls in self._clients:
            self._ask_well(cls)
        self._settle(0)
        refused = self._heard("refused", count)
        return {
            "count": count,
            "refused": dict(sorted(self._refused.items())),
            "counted_by_replay": refused,
            "good_answered": self._good,
            "transitions": self._heard("inserts", self._inserted * CONFIG.actor.chunk_length),
            "inserted": self._inserted * CONFIG.actor.chunk_length,
            "seconds": round(seconds, 1),
            "messages_per_s": round(count / seconds),
            "rss_kib": memory,
            "grown_kib": memory[-1] - memory[min(1, len(memory) - 1)],
            "reasons": dict(self._reasons.most_common(40)),
        }

    def _ask(self, cls: type, kind: str, payload: bytes) -> None:
        self._settle(IN_FLIGHT - 1)
        self._pending.append((kind, payload, self._clients[cls].ask(payload)))

    def _ask_well(self, cls: type) -> None:
        message = example(cls, self._inserted)
        self._inserted += cls is Chunk
        self._ask(cls, "good", encode(message))

    def _settle(self, most: int) -> None:
        """Wait for answers until at most `most` requests are in flight."""
        while len(self._pending) > most:
            kind, payload, reply = self._pending.popleft()
            try:
                reply.result()
            except ThrottledError as error:
                raise AssertionError(f"{kind} message throttled: {error}") from error
            except RefusedError as error:
                if kind == "good":
                    raise AssertionError(f"a good message was refused: {error}") from error
                self._refused[kind] += 1
                self._reasons[_form(str(error))] += 1
            else:
                assert kind == "good", f"{kind} message taken: {payload.hex()[:4000]}"
                self._good += 1

    def _heard(self, metric: str, at_least: int) -> int:
        """Replay's own figure, once it is that large."""

        def look() -> float | None:
            item = self._stats.take(1.0)
            figure = decode(Stats, item[1]).metrics[metric] if item else -1.0
            return figure if figure >= at_least else None

        return int(eventually(look, f"{metric} of {at_least}", 60.0))

    def _memory_kib(self) -> int:
        lines = self._status.read_text("utf-8").splitlines()
        return int(next(line for line in lines if line.startswith("VmRSS")).split()[1])


def _answers(session: Session, keys: Keys) -> bool:
    """Whether replay is up: it answers once it has read its log back."""
    try:
        return bool(session.client(keys.config, "replay", timeout_s=1.0).ask(b"").result())
    except DeadlineError:
        return False


def _form(reason: str) -> str:
    """A reason with its digits replaced, so that similar ones are counted together."""
    return "".join("9" if c.isdigit() else c for c in reason.removeprefix("replay refused: "))[:60]


def example(cls: type, sequence: int = 0, config: Config = CONFIG) -> Any:
    """A good message."""
    length = config.actor.chunk_length
    if cls is SampleRequest:
        return SampleRequest(config.learner.batch_size)
    if cls is Priorities:
        return Priorities(np.arange(32), np.ones(32, np.float32))
    rows = config.arena.stack - 1 + length + config.agent.n_step
    return Chunk(
        actor="actor-0",
        incarnation=1,
        sequence=sequence,
        weights_version=0,
        records=np.full((rows, config.arena.record_bytes), sequence % 256, np.uint8),
        actions=np.zeros(length, np.uint8),
        rewards=np.ones(length, np.float32),
        discounts=np.ones(length, np.float32),
        bootstrap_offsets=np.ones(length, np.uint8),
        priorities=np.ones(length, np.float32),
    )


def bad(cls: type, kind: str, rng: random.Random) -> bytes:
    """A bad message of that kind for a receiver of `cls`; never one that could be taken."""
    if kind == "oversized":
        return rng.randbytes(rng.randint(LARGEST + 1, 2 * LARGEST))
    while True:
        payload = _MAKE[kind](cls, rng)
        if not could_be_taken(cls, payload):
            return payload


def could_be_taken(cls: type, payload: bytes) -> bool:
    """Whether the change did no harm, or none that shows."""
    try:
        parts = split_set(payload) if cls is Chunk else [payload]
        return all(_fits(decode(cls, part)) for part in parts)
    except WireError:
        return False


def _fits(message: Any) -> bool:
    """Whether a valid message fits the run's arena, agent and batch size."""
    if isinstance(message, SampleRequest):
        return 1 <= message.batch_size <= CONFIG.learner.sample_size
    if isinstance(message, Chunk):
        due = example(Chunk).records.shape[1], CONFIG.arena.stack - 1 + CONFIG.agent.n_step
        given = message.records.shape[1], len(message.records) - len(message)
        offsets = int(message.bootstrap_offsets.max()) <= CONFIG.agent.n_step
        return due == given and offsets and len(message) <= CONFIG.actor.chunk_length
    return True


def _flipped(cls: type, rng: random.Random) -> bytes:
    return _flip(encode(example(cls)), rng)


def _flip(message: bytes, rng: random.Random) -> bytes:
    data = bytearray(message)
    for _ in range(rng.randint(1, 8)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def _apart(cls: type, rng: random.Random) -> bytes:
    """Arrays after the map, with bits flipped or the end cut off."""
    with mock.patch.object(wire, "_LARGE_BYTES", 1):
        data = encode(example(cls))
    return _flip(data, rng) if rng.random() < 0.5 else data[: rng.randrange(len(data))]


def _set(cls: type, rng: random.Random) -> bytes:
    """A set with one bad message, or with a wrong head."""
    good, other = [encode(example(cls, 2**40))], [_flip(encode(example(cls)), rng)]
    message = b"".join(join_set([good, other] if rng.random() < 0.5 else [good, good]))
    return message if rng.random() < 0.5 else _flip(message[:16], rng) + message[16:]


def _spliced(cls: type, rng: random.Random) -> bytes:
    into = encode(example(cls))
    of = encode(example(rng.choice((Chunk, SampleRequest, Priorities))))
    start, stop = sorted(rng.randint(0, len(into)) for _ in range(2))
    begin, end = sorted(rng.randint(0, len(of)) for _ in range(2))
    return into[:start] + of[begin:end] + into[stop:]


def _foreign(cls: type, rng: random.Random) -> bytes:
    others = [o for o in (Chunk, SampleRequest, Priorities, Stats) if o is not cls]
    other = rng.choice(others)
    return encode(Stats("actor", "a", {"x": 1.0}) if other is Stats else example(other))


def _misfit(cls: type, rng: random.Random) -> bytes:
    """A well-formed message of another arena, agent or batch size."""
    message = example(cls)
    if cls is SampleRequest:
        return encode(SampleRequest(rng.choice((0, -1, CONFIG.learner.sample_size + 1, 2**62))))
    if cls is Priorities:
        bad_one = np.float32(rng.choice((-1.0, np.nan, np.inf)))
        return encode(dataclasses.replace(message, priorities=np.full(32, bad_one)))
    records = message.records
    changes: list[dict[str, Any]] = [
        {"records": records[:, 1:]},
        {"records": records[1:]},
        {"records": np.repeat(records, 2, axis=0)},
        {"bootstrap_offsets": np.full(len(message), 33, np.uint8)},
        {"actions": np.full(len(message), 3, np.uint8)},
        {"rewards": np.full(len(message), np.nan, np.float32)},
        {"priorities": np.full(len(message), -1, np.float32)},
        {"sequence": -1},
        {"actor": "a" * 100},
    ]
    return encode(dataclasses.replace(message, **rng.choice(changes)))


def _odd(cls: type, rng: random.Random) -> bytes:
    """A message with a field of another kind, a missing field or an extra one."""
    table = msgpack.unpackb(encode(example(cls)))
    name = rng.choice(list(table))
    odd = (None, True, -1, 2**64 - 1, 1.5, "a", b"a", [], {}, [[], b"\1"], [[2**40, 2**40], b""])
    table[name if rng.random() < 0.9 else "more"] = rng.choice(odd)
    if rng.random() < 0.2:
        table.pop(name)
    packed: bytes = msgpack.packb(table)
    return packed


_MAKE: dict[str, Callable[[type, random.Random], bytes]] = {
    "random": lambda cls, rng: rng.randbytes(rng.randint(1, 300)),
    "empty": lambda cls, rng: b"",
    "truncated": lambda cls, rng: (data := encode(example(cls)))[: rng.randrange(len(data))],
    "flipped": _flipped,
    "spliced": _spliced,
    "longer": lambda cls, rng: encode(example(cls)) + rng.randbytes(rng.randint(1, 50_000)),
    "foreign": _foreign,
    "newer": lambda cls, rng: re.sub(rb"/\d", b"/9", encode(example(cls)), count=1),
    "misfit": _misfit,
    "odd": _odd,
    "apart": _apart,
    "set": _set,
    "nested": lambda cls, rng: b"\x91" * rng.randint(1, 100_000) + b"\xc0",
}

if __name__ == "__main__":
    main()
