"""Whatever becomes of a message on its way, decoding gives that class or WireError, nothing else.

Messages are cut, flipped, spliced, taken for another class, blown up, and changed in one place
of their structure. `benchmarks/fuzz_wire.py` does the same for as long as one likes.
"""

from typing import Any
from unittest import mock

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st

from mrcdrl.common.errors import WireError
from mrcdrl.common.messages import wire
from mrcdrl.common.messages.framing import join_set, split_set
from mrcdrl.common.messages.wire import decode, encode
from tests.common.messages.test_wire import CLASSES, MESSAGES

# What stands in a message's places, and what a peer that means ill would put there.
SHAPES = st.lists(st.sampled_from([0, 1, 2, 3, 5, -1, 2**31, 2**63]), max_size=9)
ODD = st.one_of(
    st.none(),
    st.booleans(),
    st.sampled_from([0, -1, 2**63 - 1, -(2**63), 2**64 - 1, 0.0, float("nan"), float("inf")]),
    st.sampled_from(["", "\0", "x" * 70, "\U0001f600"]),
    st.binary(max_size=40),
    st.tuples(SHAPES, st.binary(max_size=40)),
    st.lists(st.none(), max_size=20),
    st.dictionaries(st.sampled_from(["", "a"]), st.integers(0, 9)),
    st.just(msgpack.ExtType(7, b"a")),
    st.just(msgpack.Timestamp(2**33, 999_999_999)),
)


def decode_or_refuse(cls: type, data: bytes) -> Any:
    """The message, which comes back from its bytes as it is; None where it was refused."""
    reason = ""
    try:
        found = decode(cls, data)
    except WireError as error:
        found, reason = None, str(error)
    assert (found is None) == (0 < len(reason) < 250)
    if found is not None:
        assert type(found) is cls
        again = encode(found)
        assert encode(decode(cls, again)) == again  # bytes, so that NaN is equal to itself
    return found


@given(message=MESSAGES, data=st.data())
def test_truncated(message: Any, data: st.DataObject) -> None:
    whole = encode(message)
    cut = data.draw(st.integers(0, len(whole) - 1))
    assert decode_or_refuse(type(message), whole[:cut]) is None


@settings(max_examples=300)
@given(message=MESSAGES, data=st.data())
def test_flipped(message: Any, data: st.DataObject) -> None:
    damaged = bytearray(encode(message))
    for bit in data.draw(st.lists(st.integers(0, 8 * len(damaged) - 1), min_size=1, max_size=8)):
        damaged[bit // 8] ^= 1 << bit % 8
    decode_or_refuse(type(message), bytes(damaged))


@settings(max_examples=300)
@given(first=MESSAGES, second=MESSAGES, data=st.data())
def test_spliced(first: Any, second: Any, data: st.DataObject) -> None:
    """A piece of one in the place of a piece of another."""
    into, of = encode(first), encode(second)
    start, stop = sorted(data.draw(st.tuples(*[st.integers(0, len(into))] * 2)))
    begin, end = sorted(data.draw(st.tuples(*[st.integers(0, len(of))] * 2)))
    decode_or_refuse(type(first), into[:start] + of[begin:end] + into[stop:])


@given(message=MESSAGES, cls=st.sampled_from(CLASSES))
def test_taken_for_another(message: Any, cls: type) -> None:
    found = decode_or_refuse(cls, encode(message))
    assert (found is None) == (cls is not type(message))


@given(message=MESSAGES, cls=st.sampled_from(CLASSES))
def test_under_the_schema_of_another(message: Any, cls: type) -> None:
    table = msgpack.unpackb(encode(message))
    for other in CLASSES:
        table["schema"] = f"{other.__name__.lower()}/1"
        if decode_or_refuse(cls, msgpack.packb(table)) is not None:
            assert cls is type(message) is other


@given(message=MESSAGES, more=st.binary(min_size=1, max_size=30), times=st.integers(1, 50_000))
def test_longer_than_it_says(message: Any, more: bytes, times: int) -> None:
    assert decode_or_refuse(type(message), encode(message) + more * times) is None


@settings(max_examples=500)
@given(message=MESSAGES, data=st.data())
def test_odd_in_one_place(message: Any, data: st.DataObject) -> None:
    """A field, or something in it, is replaced."""
    table = msgpack.unpackb(encode(message))
    place, key = table, data.draw(st.sampled_from(sorted(table)))
    while isinstance(inner := place[key], dict | list) and inner and data.draw(st.booleans()):
        keys = range(len(inner)) if isinstance(inner, list) else sorted(inner)
        place, key = inner, data.draw(st.sampled_from(keys))
    place[key] = data.draw(ODD)
    decode_or_refuse(type(message), msgpack.packb(table))


def apart(message: Any) -> bytes:
    """A message whose arrays follow its map, however small."""
    with mock.patch.object(wire, "_LARGE_BYTES", 1):
        return encode(message)


@settings(max_examples=300)
@given(message=MESSAGES, data=st.data())
def test_arrays_after_the_map_flipped_or_cut(message: Any, data: st.DataObject) -> None:
    damaged = bytearray(apart(message))
    for bit in data.draw(st.lists(st.integers(0, 8 * len(damaged) - 1), max_size=8)):
        damaged[bit // 8] ^= 1 << bit % 8
    cut = data.draw(st.integers(0, len(damaged)))
    decode_or_refuse(type(message), bytes(damaged[:cut]))


@settings(max_examples=300)
@given(messages=st.lists(MESSAGES, min_size=2, max_size=4), data=st.data())
def test_a_set_flipped_or_cut(messages: list[Any], data: st.DataObject) -> None:
    """It falls apart into messages, sound ones or not, or is refused."""
    damaged = bytearray(b"".join(join_set([[apart(message)] for message in messages])))
    head = 8 * min(len(damaged), 24)
    for bit in data.draw(st.lists(st.integers(0, head - 1), max_size=4)):
        damaged[bit // 8] ^= 1 << bit % 8
    cut = data.draw(st.sampled_from([0, 3, 7, 8, 9, 12, 63, 64, 65, len(damaged)]))
    try:
        parts = split_set(bytes(damaged[:cut]))
    except WireError:
        return
    for part in parts:
        decode_or_refuse(type(messages[0]), bytes(part))
