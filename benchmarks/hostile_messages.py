"""Hostile messages for every key of a run: random bytes, and valid schemas with extreme values.

Invariants: the same seed gives the same messages. What they claim can be told from the truth: no
stranger holds a liveliness token, and whoever takes the name of a real process says something that
no process says. No message is a chunk, weights or an evaluation that a run could take.
"""

import dataclasses
import enum
import math
import random
import types
from collections.abc import Callable, Iterator
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgpack
import numpy as np

from benchmarks.bad_messages import example
from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import (
    Chunk,
    EpisodeSummary,
    Evaluation,
    InsertReply,
    LeaseReply,
    LeaseRequest,
    Outcome,
    Priorities,
    PrioritiesReply,
    SampleRequest,
    Samples,
    Stats,
    Weights,
)
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.transport.keys import Keys

FLOATS = (
    *(0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e19, -1e19, 2.0**53, 2.0**63, 1e38, 1e308),
    *(math.nan, math.inf, -math.inf),
)
INTS = (0, 1, -1, 2, 99, 2**31, 2**53, 2**53 + 1, 2**63 - 1, 2**63, 2**64 - 1, -(2**63))
NAMES = ("learner-0", "actor-0", "evaluator-0", "replay-0", "x1", "x2", "a" * 64)
ODD_NAMES = (
    "",
    "*",
    "..",
    "a b",
    "a/b",
    "x" * 65,
    "\x1b[31mred",
    "new\nline",
    "\u202eabc",
    "\0",
    "é",
    "x" * 100_000,
)
ROLES = ("learner", "actor", "evaluator", "replay", "status", "router", "x")
MANY = 100_000  # entries of a map
_DEEP = 50_000


@dataclasses.dataclass(frozen=True, slots=True)
class Hostile:
    """One act on a key: a publication, or a query."""

    verb: str  # "put" or "get"
    key: str
    kind: str  # of message that is due there
    payload: bytes


class HostileMessages:
    """An endless, seeded stream of them for one run."""

    def __init__(self, keys: Keys, config: Config, seed: int) -> None:
        self._keys = keys
        self._config = config
        self._rng = random.Random(seed)

    def __iter__(self) -> Iterator[Hostile]:
        while True:
            yield self._next()

    def reply(self, cls: type) -> bytes:
        """What an impostor answers where a message of this class is due."""
        return self._payload(cls, "x1", "actor")

    def _next(self) -> Hostile:
        rng, keys = self._rng, self._keys
        role, name = rng.choice(ROLES), rng.choice(NAMES)
        verb, key, cls = rng.choice(
            (
                ("put", keys.stats(role, name), Stats),
                ("put", keys.stats("learner", name), Stats),
                ("put", keys.episodes(name), EpisodeSummary),
                ("put", keys.evaluation(name), Evaluation),
                ("put", keys.weights, Weights),
                ("get", keys.weights, Weights),
                ("get", keys.config, Stats),
                ("get", keys.leases, LeaseRequest),
                ("get", keys.insert(), Chunk),
                ("get", keys.sample(), SampleRequest),
                ("get", keys.priorities(), Priorities),
                ("get", f"mrcdrl/{keys.run}/**", Chunk),
            )
        )
        if "/stats/" in key:
            role = key.split("/")[-2]
        return Hostile(verb, key, cls.__name__, self._payload(cls, name, role))

    def _payload(self, cls: type, name: str, role: str) -> bytes:
        rng = self._rng
        kind = rng.random()
        if kind < 0.15:
            return rng.randbytes(rng.choice((0, 1, 7, 300, 100_000)))
        if kind < 0.2:
            return rng.choice((b"\x91", b"\x81\xa1a")) * _DEEP + b"\xc0"
        message = self._claim(cls, name, role)
        if kind < 0.3:
            data = bytearray(encode(message))
            for _ in range(rng.randint(1, 4)):
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            return bytes(data)
        table = {"schema": msgpack.unpackb(encode(message))["schema"]}
        table |= {f.name: _packed(getattr(message, f.name)) for f in dataclasses.fields(message)}
        hints = get_type_hints(cls)
        odd = rng.sample(list(hints), min(len(hints), rng.choice((1, 1, 2, 50))))
        if kind < 0.9:
            for field in odd:
                table[field] = _extreme(hints[field], rng)
        else:
            table[rng.choice(odd)] = rng.choice((None, [], {}, "x", b"x", True, [[2**40], b""]))
        packed: bytes = msgpack.packb(table)
        return packed

    def _claim(self, cls: type, name: str, role: str) -> Any:
        """A plausible message, but for who sends it or one thing that no process says."""
        rng, version = self._rng, self._rng.choice((0, 1, 2**53))
        if cls is Stats:
            metrics = {
                "learner_steps": rng.choice((1.0, 1e15, 2.0**53)),
                "weights_version": 2.0**53,
                "weights_epoch": 2.0**63,
                "size": -1e8,
                "capacity": 1.0,
                "env_steps": 1e-320,
                "robot_steps": 2.0**53,
                "loss": 1e308,
            }
            named = rng.sample(list(metrics), 3)
            many = {f"m{i}": 1.0 for i in range(rng.choice((0, 0, 200, 300)))}
            text = {"incarnation": str(rng.getrandbits(63)), "x": "\x1b[2J"}
            texts = {key: text[key] for key in text if rng.random() < 0.7}
            return Stats(role, name, {key: metrics[key] for key in named} | many, texts)
        if cls is EpisodeSummary:
            real = name == "actor-0"
            outcome, epsilon = rng.choice(list(Outcome)), 2.0 if real else 0.1
            return EpisodeSummary(name, 0, 1, outcome, 9, 1.5, 0, epsilon, 1, 1e38, 2)
        if cls is Evaluation:
            epoch = rng.choice((0, 1, 2**63 - 1))
            worker = "x1" if name == "evaluator-0" else name
            counts = (100.0, 100.0, 0.0, 30.0, 200.0, 1, 1.0)
            return Evaluation(
                worker, epoch, version, 100, 2, 100, 1.0, 0.0, 0.0, (0.9, 1.0), *counts
            )
        if cls is Weights:
            payload = rng.choice((b"", b"12345", rng.randbytes(1000)))
            return Weights.of(2**63 - 1, version, 2**53, payload)
        if cls is LeaseRequest:
            slot = rng.choice((-1, 0, 2**63 - 1))
            return LeaseRequest(name, rng.getrandbits(62), slot, slot >= 0, rng.random() < 0.5)
        if cls is SampleRequest:
            return SampleRequest(rng.choice((0, -1, 2**62)), rng.choice((-1, 0, 2**53)))
        if cls is Priorities:
            keys = np.array(rng.choices((0, 1, -1, 2**62), k=32), np.int64)
            return Priorities(keys, np.full(32, rng.choice((0, 1e38)), np.float32))
        if cls is Chunk:
            chunk = example(Chunk, rng.choice((0, 1, 2**62)), self._config)
            beyond = {"rewards": np.full(len(chunk), rng.choice((1e38, -1e38)), np.float32)}
            incarnation = rng.choice((0, -(2**63), 2**63 - 1, rng.getrandbits(62)))
            return dataclasses.replace(chunk, actor=name, incarnation=incarnation, **beyond)
        return _REPLIES[cls](rng)


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [list(value.shape), value.tobytes()]
    return value


def _extreme(hint: Any, rng: random.Random) -> Any:
    """An extreme value of a field's type, as msgpack takes it."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is np.ndarray:
        dtype = np.dtype(get_args(args[1])[0])
        shape = rng.choice(([0], [1], [32], [2, 3], [1] * 40, [2**40, 2**40]))
        size = math.prod(shape) if math.prod(shape) < 2**16 else 1
        if dtype.kind == "f":
            array = np.array(rng.choices(FLOATS, k=size), np.float64)
            with np.errstate(over="ignore"):
                return [shape, array.astype(dtype).tobytes()]
        return [shape, rng.randbytes(size * dtype.itemsize)]
    if origin in (Union, types.UnionType):
        return None
    if origin is tuple:
        return [_extreme(inner, rng) for inner in args]
    if origin is dict:
        few = {name: _extreme(args[1], rng) for name in rng.choices(ODD_NAMES, k=3)}
        return few if rng.random() < 0.95 else {f"n{i}": args[1](1) for i in range(MANY)} | few
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return rng.choice((*map(str, hint), "", "x" * 1000))
    if hint is float:
        return rng.choice(FLOATS)
    if hint is int:
        return rng.choice(INTS)
    if hint is bool:
        return rng.random() < 0.5
    if hint is bytes:
        return rng.randbytes(rng.choice((0, 5, 100_000)))
    return rng.choice((*NAMES, *ODD_NAMES))


def _samples(rng: random.Random) -> Samples:
    size, floats = 32, np.float32(rng.choice((1e38, math.nan)))
    return Samples(
        keys=np.zeros(size, np.int64),
        probabilities=np.full(size, 0.5),
        table_size=2**53,
        total_priority=1e308,
        actions=np.zeros(size, np.uint8),
        rewards=np.full(size, floats, np.float32),
        discounts=np.ones(size, np.float32),
        bootstrap_offsets=np.full(size, 255, np.uint8),
        weights_versions=np.zeros(size, np.int64),
        records=np.zeros((size, 3, 5), np.uint8),
    )


_REPLIES: dict[type, Callable[[random.Random], Any]] = {
    InsertReply: lambda rng: InsertReply(rng.choice((0, 2**63 - 1)), False, 0),
    LeaseReply: lambda rng: LeaseReply(2**62, 2**62, 2**63 - 1, rng.choice((1e-300, 1e300))),
    PrioritiesReply: lambda rng: PrioritiesReply(2**53, 0),
    Samples: _samples,
}
