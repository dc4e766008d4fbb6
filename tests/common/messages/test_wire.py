"""Encoded messages decode to the same, and anything else raises WireError."""

import contextlib
import dataclasses
from typing import Any
from unittest import mock

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from mrcdrl.common.errors import WireError
from mrcdrl.common.messages import wire
from mrcdrl.common.messages.framing import join_map, join_set, split_map, split_set
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
    WeightsNotice,
)
from mrcdrl.common.messages.wire import decode, encode, encode_parts

INTS = st.integers(-(2**63), 2**63 - 1)
COUNTS = st.integers(0, 2**53)
TIMES_NS = st.integers(0, 2**63 - 1)
NUMBERS = st.floats(-(2.0**53), 2.0**53)
SHARES = st.floats(0, 1)
NAMES = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,19}", fullmatch=True)
TEXTS = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20)


def arrays(dtype: str, *shape: int, **numbers: Any) -> st.SearchStrategy[Any]:
    kind = np.dtype(dtype).kind
    elements = npst.from_dtype(np.dtype(dtype), **numbers) if kind == "f" else None
    return npst.arrays(dtype, shape, elements=elements)


FINITE = {"allow_nan": False, "allow_infinity": False}


@st.composite
def chunks(draw: st.DrawFn) -> Chunk:
    length, tail, record_bytes = draw(st.tuples(*[st.integers(1, 6)] * 3))
    prioritized = draw(st.booleans())
    return Chunk(
        actor=draw(NAMES),
        incarnation=draw(INTS),
        sequence=draw(COUNTS),
        weights_version=draw(COUNTS),
        records=draw(arrays("u1", length + tail, record_bytes)),
        actions=draw(npst.arrays("u1", (length,), elements=st.integers(0, 2))),
        rewards=draw(arrays("f4", length, **FINITE)),
        discounts=draw(arrays("f4", length, min_value=0, max_value=1)),
        bootstrap_offsets=draw(npst.arrays("u1", (length,), elements=st.integers(1, 255))),
        priorities=draw(arrays("f4", length if prioritized else 0, min_value=0, **FINITE)),
    )


@st.composite
def samples(draw: st.DrawFn) -> Samples:
    size, window, record_bytes = draw(st.tuples(*[st.integers(0, 5)] * 3))
    return Samples(
        keys=draw(arrays("i8", size)),
        probabilities=draw(arrays("f8", size, min_value=1e-300, max_value=1)),
        table_size=draw(st.integers(1, 2**53)),
        total_priority=draw(st.floats(1e-300, 1e300)),
        records=draw(arrays("u1", size, window, record_bytes)),
        actions=draw(npst.arrays("u1", (size,), elements=st.integers(0, 2))),
        rewards=draw(arrays("f4", size, **FINITE)),
        discounts=draw(arrays("f4", size, min_value=0, max_value=1)),
        bootstrap_offsets=draw(npst.arrays("u1", (size,), elements=st.integers(1, 255))),
        weights_versions=draw(arrays("i8", size)),
    )


@st.composite
def priorities(draw: st.DrawFn) -> Priorities:
    size = draw(st.integers(0, 6))
    return Priorities(
        keys=draw(arrays("i8", size)),
        priorities=draw(arrays("f4", size, min_value=0, **FINITE)),
    )


EPISODES = st.builds(
    EpisodeSummary,
    actor=NAMES,
    arena=COUNTS,
    episode=COUNTS,
    outcome=st.sampled_from(Outcome),
    frames=COUNTS,
    score=NUMBERS,
    collisions=COUNTS,
    epsilon=SHARES,
    weights_version=COUNTS,
    mean_q=st.floats(allow_nan=False),
    num_robots=st.integers(1, 10),
)


@st.composite
def evaluations(draw: st.DrawFn) -> Evaluation:
    success = draw(SHARES)
    collision = draw(st.floats(0, 1 - success))
    low, high = sorted(draw(st.tuples(SHARES, SHARES)))
    return Evaluation(
        worker=draw(NAMES),
        weights_epoch=draw(TIMES_NS),
        weights_version=draw(COUNTS),
        learner_step=draw(COUNTS),
        num_robots=draw(st.integers(1, 10)),
        episodes=draw(st.integers(1, 2**53)),
        success_rate=success,
        collision_rate=collision,
        timeout_rate=1 - success - collision,
        success_interval=(low, high),
        max_per_100=draw(st.floats(0, 100)),
        mean_per_100=draw(st.floats(0, 100)),
        variance_per_100=draw(st.floats(0, 2500)),
        mean_frames=draw(st.floats(0, 2.0**53)),
        mean_score=draw(NUMBERS),
        seed=draw(INTS),
        wall_s=draw(st.floats(0, 2.0**53)),
    )


MESSAGES = st.one_of(
    chunks(),
    samples(),
    priorities(),
    EPISODES,
    evaluations(),
    st.builds(InsertReply, sequence=TIMES_NS, duplicate=st.booleans(), inserts=COUNTS),
    st.builds(SampleRequest, batch_size=INTS),
    st.builds(PrioritiesReply, updated=COUNTS, ignored=COUNTS),
    st.builds(
        LeaseRequest,
        actor=NAMES,
        incarnation=INTS,
        slot=COUNTS,
        holds=st.booleans(),
        ends=st.booleans(),
    ),
    st.builds(
        LeaseReply,
        slot=COUNTS,
        rank=st.integers(0, 9),
        num_places=st.integers(10, 99),
        lease_s=st.floats(0.1, 1e6),
    ),
    st.builds(Weights.of, epoch=TIMES_NS, version=COUNTS, learner_step=COUNTS, payload=st.binary()),
    st.builds(
        WeightsNotice,
        epoch=TIMES_NS,
        version=COUNTS,
        learner_step=COUNTS,
        digest=st.text("0123456789abcdef", min_size=64, max_size=64),
        num_bytes=st.integers(1, 2**30),
        address=st.text(max_size=128),
    ),
    st.builds(
        Stats,
        role=NAMES,
        id=NAMES,
        metrics=st.dictionaries(NAMES, NUMBERS, max_size=5),
        text=st.dictionaries(NAMES, TEXTS, max_size=5),
    ),
)
CLASSES = (
    Chunk,
    Samples,
    EpisodeSummary,
    Evaluation,
    InsertReply,
    SampleRequest,
    Priorities,
    PrioritiesReply,
    LeaseRequest,
    LeaseReply,
    Weights,
    WeightsNotice,
    Stats,
)


def assert_same(found: Any, expected: Any) -> None:
    assert type(found) is type(expected)
    for field in dataclasses.fields(expected):
        ours, theirs = getattr(found, field.name), getattr(expected, field.name)
        assert type(ours) is type(theirs), field.name
        if isinstance(theirs, np.ndarray):
            assert ours.dtype == theirs.dtype
            np.testing.assert_array_equal(ours, theirs, strict=True)
        else:
            assert ours == theirs, field.name


LARGE_FROM = st.sampled_from([0, 8192])  # bytes: all arrays follow the map, or none so small


@given(MESSAGES, LARGE_FROM)
def test_every_message_comes_back_as_it_was(message: Any, large_from: int) -> None:
    with mock.patch.object(wire, "_LARGE_BYTES", large_from):
        data = encode(message)
    assert_same(decode(type(message), data), message)


def test_an_array_that_is_not_contiguous_comes_back_as_it_was() -> None:
    rows = np.arange(24, dtype=np.uint8).reshape(4, 6)
    message = dataclasses.replace(CHUNK, records=rows.T[::2])
    np.testing.assert_array_equal(decode(Chunk, encode(message)).records, rows.T[::2])


def test_arrays_are_little_endian_and_read_only_views() -> None:
    message = dataclasses.replace(CHUNK, rewards=np.array([1.0, 2.0], ">f4"))
    found = decode(Chunk, encode(message)).rewards
    assert found.tolist() == [1.0, 2.0]
    assert not found.flags.writeable
    assert b"\x00\x00\x80\x3f\x00\x00\x00\x40" in encode(message)


CHUNK = Chunk(
    actor="actor-0",
    incarnation=1,
    sequence=0,
    weights_version=3,
    records=np.arange(5 * 4, dtype=np.uint8).reshape(5, 4),
    actions=np.array([0, 2], np.uint8),
    rewards=np.array([1.0, -5.0], np.float32),
    discounts=np.array([0.9, 0.0], np.float32),
    bootstrap_offsets=np.array([1, 1], np.uint8),
    priorities=np.empty(0, np.float32),
)
SAMPLES = Samples(
    keys=np.array([7, 9], np.int64),
    probabilities=np.array([0.5, 1.0]),
    table_size=2,
    total_priority=2.5,
    records=np.zeros((2, 5, 4), np.uint8),
    actions=np.array([0, 2], np.uint8),
    rewards=np.array([1.0, -5.0], np.float32),
    discounts=np.array([0.9, 0.0], np.float32),
    bootstrap_offsets=np.array([1, 1], np.uint8),
    weights_versions=np.array([3, 3], np.int64),
)
PRIORITIES = Priorities(np.array([7, 9], np.int64), np.array([0.5, 0.0], np.float32))
WISH = LeaseRequest("a", 1, 3, holds=True, ends=False)
LEASE = LeaseReply(3, 2, 5, 15.0)
STATS = Stats("actor", "actor-0", {"env_steps": 3.0})
EPISODE = EpisodeSummary("a", 0, 1, Outcome.SUCCESS, 9, 1.5, 0, 0.1, 3, 2.5, 2)
_DEEP = b"\x91" * 1000 + b"\x90"  # a list in a list in a list …, as deep as msgpack unpacks


def table_of(message: Any) -> dict[str, Any]:
    table: dict[str, Any] = msgpack.unpackb(encode(message))
    return table


def changed(message: Any, **fields: Any) -> bytes:
    """The message's bytes with these fields changed; ... leaves one out."""
    table = {**table_of(message), **fields}
    packed: bytes = msgpack.packb({k: v for k, v in table.items() if v is not ...})
    return packed


def floats(*values: float) -> list[Any]:
    return [[len(values)], np.array(values, "<f4").tobytes()]


def doubles(*values: float) -> list[Any]:
    return [[len(values)], np.array(values, "<f8").tobytes()]


def octets(*values: int) -> list[Any]:
    return [[len(values)], bytes(values)]


MALFORMED = {
    "empty": (Chunk, b"", "not msgpack"),
    "truncated": (Chunk, encode(CHUNK)[:-1], "not msgpack"),
    "trailing bytes": (Chunk, encode(CHUNK) + b"\x00", "not msgpack"),
    "never used byte": (Chunk, b"\xc1", "not msgpack"),
    "not a map": (Chunk, msgpack.packb([1, 2]), "not a map"),
    "number as key": (Chunk, msgpack.packb({1: 2}), "not msgpack"),
    "no schema": (Chunk, changed(CHUNK, schema=...), "NoneType.*'chunk/1' is due"),
    "another schema": (Chunk, encode(STATS), "'stats/1' where 'chunk/1' is due"),
    "newer schema": (Chunk, changed(CHUNK, schema="chunk/2"), "'chunk/2' where"),
    "long schema": (Chunk, changed(CHUNK, schema="x" * 10_000), f"'{'x' * 40}' where"),
    "nested schema": (Chunk, b"\x81\xa6schema" + _DEEP, "'list' where"),
    "missing field": (Chunk, changed(CHUNK, actor=...), "unknown fields: actor"),
    "unknown field": (Chunk, changed(CHUNK, done=1), "unknown fields: done"),
    "name as bytes": (Chunk, changed(CHUNK, actor=b"a"), "actor: not of type str"),
    "name not UTF-8": (Chunk, encode(CHUNK).replace(b"actor-0", b"actor-\xff"), "not msgpack"),
    "float for an integer": (Chunk, changed(CHUNK, incarnation=1.0), "incarnation: not an integer"),
    "bool for an integer": (Chunk, changed(CHUNK, sequence=True), "sequence: not an integer"),
    "integer of 65 bits": (Chunk, changed(CHUNK, sequence=2**63), "outside 64 bits"),
    "text for a number": (EpisodeSummary, changed(EPISODE, score="1"), "score: not a number"),
    "unknown outcome": (EpisodeSummary, changed(EPISODE, outcome="draw"), "outcome: not one of"),
    "outcome no name": (EpisodeSummary, changed(EPISODE, outcome=[1]), "outcome: not one of"),
    "integer for a bool": (
        InsertReply,
        changed(InsertReply(1, False, 2), duplicate=0),
        "duplicate: not of type bool",
    ),
    "metrics no map": (Stats, changed(STATS, metrics=[]), "metrics: not a map"),
    "metric no number": (Stats, changed(STATS, metrics={"a": "b"}), "metrics: not a number"),
    "metric named by bytes": (Stats, changed(STATS, metrics={b"a": 1.0}), "metrics: not a map"),
    "array no pair": (Chunk, changed(CHUNK, actions=[1, 2, 3]), "actions: not a pair"),
    "shape no list": (Chunk, changed(CHUNK, actions=[2, b"ab"]), "actions: not a pair"),
    "array as text": (Chunk, changed(CHUNK, actions=[[2], "ab"]), "actions: not a pair"),
    "9 dimensions": (Chunk, changed(CHUNK, actions=[[1] * 9, b"a"]), "actions: not a pair"),
    "wrong dtype": (Chunk, changed(CHUNK, rewards=octets(1, 2)), "does not fit 2 bytes"),
    "negative shape": (Chunk, changed(CHUNK, records=[[-5, -4], b"a" * 20]), "natural number"),
    "fractional shape": (Chunk, changed(CHUNK, records=[[5.0, 4.0], b"a" * 20]), "natural number"),
    "huge shape": (Chunk, changed(CHUNK, records=[[2**40, 2**40], b""]), "does not fit 0 bytes"),
    "huge empty shape": (Chunk, changed(CHUNK, records=[[0, 2**64 - 1], b""]), "records: "),
    "too many for an array": (Chunk, changed(CHUNK, records=[[0, *[2**62] * 7], b""]), "records: "),
    "records a vector": (Chunk, changed(CHUNK, records=octets(*range(20))), "not a matrix"),
    "too few records": (Chunk, changed(CHUNK, records=[[2, 4], b"a" * 8]), "not a matrix"),
    "actions a number": (Chunk, changed(CHUNK, actions=[[], b"\1"]), "are vectors"),
    "priorities a number": (Chunk, changed(CHUNK, priorities=[[], b"\0" * 4]), "are vectors"),
    "long name": (Chunk, changed(CHUNK, actor="a" * 65), "actor is not a name of up to 64"),
    "sampled actions a number": (Samples, changed(SAMPLES, actions=[[], b"\1"]), "is not a vector"),
    "sampled records a matrix": (
        Samples,
        changed(SAMPLES, records=[[2, 4], b"a" * 8]),
        "does not have 3 dim",
    ),
    "actions a matrix": (Chunk, changed(CHUNK, actions=[[2, 1], b"ab"]), "are vectors"),
    "lengths differ": (Chunk, changed(CHUNK, actions=octets(1)), "differ in length"),
    "no transition": (
        Chunk,
        changed(
            CHUNK,
            actions=octets(),
            rewards=floats(),
            discounts=floats(),
            bootstrap_offsets=octets(),
        ),
        "or are empty",
    ),
    "NaN reward": (Chunk, changed(CHUNK, rewards=floats(1, np.nan)), "not finite"),
    "infinite discount": (Chunk, changed(CHUNK, discounts=floats(1, np.inf)), "outside 0 ... 1"),
    "negative priority": (Chunk, changed(CHUNK, priorities=floats(1, -1)), "priority is negative"),
    "one priority of two": (Chunk, changed(CHUNK, priorities=floats(1)), "priorities is neither"),
    "offset 0": (Chunk, changed(CHUNK, bootstrap_offsets=octets(1, 0)), "offset is 0"),
    "negative sequence": (Chunk, changed(CHUNK, sequence=-1), "is negative"),
    "probability 0": (Samples, changed(SAMPLES, probabilities=doubles(0.5, 0)), "not above 0"),
    "probability 2": (Samples, changed(SAMPLES, probabilities=doubles(0.5, 2)), "at most 1"),
    "total priority 0": (Samples, changed(SAMPLES, total_priority=0.0), "not above 0"),
    "NaN total priority": (Samples, changed(SAMPLES, total_priority=np.nan), "not above 0"),
    "endless total priority": (Samples, changed(SAMPLES, total_priority=np.inf), "finite"),
    "NaN probability": (Samples, changed(SAMPLES, probabilities=doubles(1, np.nan)), "not above"),
    "a key too many": (Priorities, changed(PRIORITIES, priorities=floats(1)), "of one length"),
    "keys a matrix": (
        Priorities,
        changed(PRIORITIES, keys=[[2, 1], b"a" * 16]),
        "not vectors",
    ),
    "negative new priority": (
        Priorities,
        changed(PRIORITIES, priorities=floats(1, -1)),
        "priority is negative",
    ),
    "infinite priority": (
        Priorities,
        changed(PRIORITIES, priorities=floats(1, np.inf)),
        "not finite",
    ),
    "wish of a long name": (LeaseRequest, changed(WISH, actor="a" * 65), "not a name of up to 64"),
    "wish for slot -2": (LeaseRequest, changed(WISH, slot=-2), "slot is below -1"),
    "wish that holds none": (LeaseRequest, changed(WISH, slot=-1), "slot names none"),
    "lease of slot -2": (LeaseReply, changed(LEASE, slot=-2), "slot is below -1"),
    "rank above the places": (LeaseReply, changed(LEASE, rank=5), "not among 5 places"),
    "negative rank": (LeaseReply, changed(LEASE, rank=-1), "not among 5 places"),
    "lease of no time": (LeaseReply, changed(LEASE, lease_s=0.0), "not above 0"),
    "lease forever": (LeaseReply, changed(LEASE, lease_s=np.inf), "finite"),
    "NaN priority": (Priorities, changed(PRIORITIES, priorities=floats(np.nan, 1)), "not finite"),
}


LARGE = dataclasses.replace(
    CHUNK,
    records=np.arange(5 * 2000, dtype=np.uint16).astype(np.uint8).reshape(5, 2000),
    actions=np.zeros(2, np.uint8),
)
_PLACES = encode(LARGE)


def _other_place(place: int) -> bytes:
    """LARGE, with another place given for its records."""
    packed = changed_map(LARGE, records=[[5, 2000], place])
    return b"".join(join_map(packed, [memoryview(LARGE.records.reshape(-1))]))


def changed_map(message: Any, **fields: Any) -> bytes:
    packed, _ = split_map(memoryview(encode(message)))
    replaced: bytes = msgpack.packb({**msgpack.unpackb(packed), **fields})
    return replaced


MALFORMED |= {
    "head alone": (Chunk, _PLACES[:6], "ends within its head"),
    "map cut off": (Chunk, _PLACES[:100], "in a message of 100"),
    "arrays cut off": (Chunk, _PLACES[:-1], r"\[5, 2000\] of uint8 does not fit 9999 bytes"),
    "bytes after the arrays": (Chunk, _PLACES + b"x", "10001 bytes after the map, of which 10000"),
    "map without its arrays": (Chunk, changed_map(LARGE), "does not fit 0 bytes"),
    "arrays of nobody": (
        Chunk,
        b"".join(join_map(encode(CHUNK), [memoryview(bytes(9000))])),
        "9000 bytes after the map, of which 0",
    ),
    "another place": (Chunk, _other_place(64), "an array at 64 where 0 is due"),
    "negative place": (Chunk, _other_place(-64), "an array at -64 where 0 is due"),
    "a place for a name": (Chunk, changed(CHUNK, actor=["a", 0]), "actor: not of type str"),
}


def test_large_arrays_are_neither_copied_nor_writeable() -> None:
    parts = encode_parts(LARGE)
    assert any(np.shares_memory(np.frombuffer(part, np.uint8), LARGE.records) for part in parts)
    data = bytearray(b"".join(parts))
    found = decode(Chunk, memoryview(data))
    assert_same(found, LARGE)
    assert np.shares_memory(found.records, np.frombuffer(data, np.uint8))
    assert not found.records.flags.writeable
    offset = found.records.__array_interface__["data"][0] - address(data)
    assert offset % 64 == 0


def address(data: bytearray) -> int:
    place: int = np.frombuffer(data, np.uint8).__array_interface__["data"][0]
    return place


@given(st.lists(MESSAGES, min_size=1, max_size=5))
def test_messages_that_travel_together_come_apart_again(messages: list[Any]) -> None:
    data = b"".join(join_set([encode_parts(message) for message in messages]))
    for message, found in zip(messages, split_set(data), strict=True):
        assert_same(decode(type(message), found), message)


SETS = {
    "head alone": (b"\xc1set\x02", "ends within its head"),
    "lengths cut off": (b"\xc1set\x02\0\0\0\x01\0\0\0", "ends within its head"),
    "none": (b"\xc1set\0\0\0\0", "a set of 0 messages"),
    "too many": (b"\xc1set\xff\xff\xff\xff", "a set of 4294967295 messages"),
    "cut off": (b"".join(join_set([[b"a"], [b"b"]]))[:-1], "bytes whose messages have"),
    "too long": (b"".join(join_set([[b"a"], [b"b"]])) + b"c", "bytes whose messages have"),
}


@pytest.mark.parametrize("name", SETS)
def test_a_malformed_set_is_refused_with_its_reason(name: str) -> None:
    data, reason = SETS[name]
    with pytest.raises(WireError, match=reason):
        split_set(data)


@given(st.binary(max_size=200))
def test_a_random_set_raises_nothing_else(data: bytes) -> None:
    with contextlib.suppress(WireError):
        assert sum(map(len, split_set(b"\xc1set" + data))) <= len(data)


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_message_is_refused_with_its_reason(name: str) -> None:
    cls, data, reason = MALFORMED[name]
    with pytest.raises(WireError, match=reason) as refused:
        decode(cls, data)
    assert len(str(refused.value)) < 250
    assert "\n" not in str(refused.value)


def test_whole_numbers_are_numbers() -> None:
    """A peer in another language may send them, even in a pair that is not an array."""
    shares = {"success_rate": 0.5, "collision_rate": 0.5, "timeout_rate": 0}
    rest = {f.name: 1 for f in dataclasses.fields(Evaluation)}
    sent = {**rest, **shares, "schema": "evaluation/1", "worker": "e", "success_interval": [0, 1]}
    found = decode(Evaluation, msgpack.packb(sent))
    assert found.success_interval == (0.0, 1.0)
    assert isinstance(found.mean_score, float)


def test_the_unchanged_message_is_taken() -> None:
    assert_same(decode(Chunk, changed(CHUNK)), CHUNK)


@given(st.sampled_from(CLASSES), st.binary(max_size=200))
def test_random_bytes_raise_nothing_else(cls: type, data: bytes) -> None:
    with pytest.raises(WireError):
        decode(cls, data)


ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | NAMES
    | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=8,
)


@given(message=MESSAGES, data=st.data())
def test_a_field_of_any_other_kind_is_taken_wholly_or_refused(message: Any, data: Any) -> None:
    names = [field.name for field in dataclasses.fields(message)]
    name = data.draw(st.sampled_from(names))
    packed = changed(message, **{name: data.draw(ANYTHING)})
    try:
        found = decode(type(message), packed)
    except WireError:
        return
    assert type(getattr(found, name)) is type(getattr(message, name))


@given(message=MESSAGES, large_from=LARGE_FROM, data=st.data())
def test_a_damaged_byte_raises_nothing_else(message: Any, large_from: int, data: Any) -> None:
    with mock.patch.object(wire, "_LARGE_BYTES", large_from):
        damaged = bytearray(encode(message))
    place = data.draw(st.integers(0, len(damaged) - 1))
    damaged[place] ^= data.draw(st.integers(1, 255))
    with contextlib.suppress(WireError):
        assert type(decode(type(message), bytes(damaged))) is type(message)
