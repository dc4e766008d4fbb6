"""Encoding and decoding of messages, both pure; docs/wire.md describes it for other languages.

A message is one msgpack map: its fields by name, and `schema`, the message's name and version.
A number array is a pair [shape, bytes], C order, little-endian, of the dtype that `trajectory.py`
declares; a large one follows the map (`framing.py`), and its pair is [shape, place].

Invariants: what `decode` returns has exactly the declared types, dtypes and matching shapes, and
values that `checks.py` allows; any other bytes raise WireError with the reason, in printable text;
large arrays are never copied.
"""

import enum
import math
import types
from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import msgpack
import numpy as np

from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.checks import SENDERS, problem
from mrcdrl.common.messages.framing import Part, join_map, padded, split_map
from mrcdrl.common.messages.trajectory import (
    ArenaFrame,
    Chunk,
    EpisodeSummary,
    Evaluation,
    InsertReply,
    LeaseReply,
    LeaseRequest,
    Priorities,
    PrioritiesReply,
    SampleRequest,
    Samples,
    Stats,
    Weights,
    WeightsNotice,
)
from mrcdrl.common.runtime.names import printable

M = TypeVar("M")
_MAX_NDIM = 8
_LARGE_BYTES = 8192  # arrays of this size or more follow the map

_SCHEMAS: dict[type, str] = {
    Chunk: "chunk/1",
    InsertReply: "insert_reply/1",
    SampleRequest: "sample_request/2",
    Samples: "samples/2",
    Priorities: "priorities/1",
    PrioritiesReply: "priorities_reply/1",
    LeaseRequest: "lease_request/1",
    LeaseReply: "lease_reply/1",
    Weights: "weights/2",
    WeightsNotice: "weights_notice/1",
    EpisodeSummary: "episode/2",
    Evaluation: "evaluation/1",
    Stats: "stats/1",
    ArenaFrame: "arena_frame/1",
}


def encode(message: Any) -> bytes:
    """The bytes of a message."""
    return b"".join(encode_parts(message))


def encode_parts(message: Any) -> list[Part]:
    """The bytes of a message in parts; large arrays are views of the message's memory."""
    table: dict[str, Any] = {"schema": _SCHEMAS[type(message)]}
    large: list[memoryview] = []
    place = 0
    for field in fields(message):
        value = getattr(message, field.name)
        if isinstance(value, np.ndarray):
            little = value.astype(value.dtype.newbyteorder("<"), order="C", copy=False)
            if little.nbytes < _LARGE_BYTES:
                value = [list(value.shape), little.tobytes()]
            else:
                value = [list(value.shape), place]
                large.append(little.reshape(-1).view(np.uint8).data)
                place += padded(little.nbytes)
        table[field.name] = value
    return join_map(msgpack.packb(table), large)


def decode(cls: type[M], data: Part) -> M:
    """The message of class `cls` in `data`; its arrays are read-only views of `data`.

    Raises WireError, with the reason, for anything that `encode` would not have written.
    """
    packed, arrays = split_map(memoryview(data).toreadonly())
    try:
        table = msgpack.unpackb(packed, raw=False, strict_map_key=True, use_list=True)
    except (ValueError, msgpack.exceptions.UnpackException, RecursionError) as error:
        raise WireError(f"not msgpack: {type(error).__name__}") from error
    if not isinstance(table, dict):
        raise WireError("not a map")
    schema = table.pop("schema", None)
    if schema != _SCHEMAS[cls]:
        given = schema[:40] if isinstance(schema, str) else type(schema).__name__
        raise WireError(f"schema {given!r} where {_SCHEMAS[cls]!r} is due")
    readers = _READERS[cls]
    if table.keys() != readers.keys():
        odd = sorted(map(str, table.keys() ^ readers.keys()))
        raise WireError(f"missing or unknown fields: {printable(', '.join(odd)[:120])[:150]}")
    values, end = {}, 0
    for name, read in readers.items():
        value = table[name]
        is_large = name in _ARRAYS[cls] and _follows(value)
        try:
            if is_large:
                value = [value[0], _begin(arrays, value[1], padded(end))]
            values[name] = read(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise WireError(f"{name}: {error}") from error
        if is_large:
            end = padded(end) + values[name].nbytes
    if end != len(arrays):
        raise WireError(f"{len(arrays)} bytes after the map, of which {end} are arrays")
    message = cls(**values)
    if (reason := problem(message)) is not None:
        raise WireError(reason)
    return message


def decode_published(cls: type[M], key: str, data: Part) -> M:
    """The message of class `cls` that was published on `key`.

    Raises WireError as `decode` does, and if the key names another sender than the message.
    """
    message = decode(cls, data)
    names = [getattr(message, name) for name in SENDERS[cls]]
    if key.split("/")[-len(names) :] != names:
        raise WireError(f"a message of {'/'.join(names)} on key {printable(key)}")
    return message


def _follows(value: Any) -> bool:
    """Whether this is the pair of an array that follows the map."""
    return isinstance(value, list) and len(value) == 2 and type(value[1]) is int


def _begin(arrays: memoryview, place: int, due: int) -> memoryview:
    """The bytes from `place` on; raises ValueError if the next array is due elsewhere."""
    if place != due:
        raise ValueError(f"an array at {place} where {due} is due")
    return arrays[place:]


def _readers_of(cls: type) -> dict[str, Callable[[Any], Any]]:
    hints = get_type_hints(cls)
    return {field.name: _reader(hints[field.name]) for field in fields(cls)}


def _reader(hint: Any) -> Callable[[Any], Any]:
    """A function from the unpacked value to the declared type; raises TypeError or ValueError."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is np.ndarray:
        return _array_reader(np.dtype(get_args(args[1])[0]))
    if origin in (Union, types.UnionType):
        inner = _reader(next(a for a in args if a is not type(None)))
        return lambda value: None if value is None else inner(value)
    if origin is tuple:
        return _tuple_reader([_reader(a) for a in args])
    if origin is dict:
        return _dict_reader(_reader(args[1]))
    if isinstance(hint, type) and issubclass(hint, enum.StrEnum):
        return _enum_reader(hint)
    if hint is float:
        return _read_float
    if hint is int:
        return _read_int
    return _exact(hint)


def _array_reader(dtype: np.dtype[Any]) -> Callable[[Any], Any]:
    def read(value: Any) -> Any:
        if not (isinstance(value, list) and len(value) == 2):
            raise TypeError("not a pair [shape, bytes]")
        shape, data = value
        if not isinstance(data, Part) or not isinstance(shape, list) or len(shape) > _MAX_NDIM:
            raise TypeError("not a pair [shape, bytes]")
        if any(type(n) is not int or n < 0 for n in shape):
            raise ValueError("the shape has a length that is not a natural number")
        length = math.prod(shape) * dtype.itemsize
        if isinstance(data, memoryview) and length <= len(data):
            data = data[:length]
        if length != len(data):
            raise ValueError(f"shape {shape} of {dtype} does not fit {len(data)} bytes")
        little = np.frombuffer(data, dtype.newbyteorder("<")).reshape(shape)
        return little.astype(dtype, copy=False)

    return read


def _tuple_reader(readers: list[Callable[[Any], Any]]) -> Callable[[Any], Any]:
    def read(value: Any) -> Any:
        if not isinstance(value, list) or len(value) != len(readers):
            raise TypeError(f"not a list of {len(readers)}")
        return tuple(r(v) for r, v in zip(readers, value, strict=True))

    return read


def _dict_reader(reader: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def read(value: Any) -> Any:
        if not isinstance(value, dict) or any(type(k) is not str for k in value):
            raise TypeError("not a map with string keys")
        return {k: reader(v) for k, v in value.items()}

    return read


def _enum_reader(expected: type[enum.StrEnum]) -> Callable[[Any], Any]:
    members = {str(member): member for member in expected}

    def read(value: Any) -> Any:
        if not isinstance(value, str) or value not in members:
            raise TypeError(f"not one of {', '.join(members)}")
        return members[value]

    return read


def _read_float(value: Any) -> float:
    if type(value) not in (float, int):
        raise TypeError("not a number")
    return float(value)


def _read_int(value: Any) -> int:
    if type(value) is not int:
        raise TypeError("not an integer")
    if not -(2**63) <= value < 2**63:
        raise ValueError("integer outside 64 bits")
    return value


def _exact(expected: type) -> Callable[[Any], Any]:
    def read(value: Any) -> Any:
        if type(value) is not expected:
            raise TypeError(f"not of type {expected.__name__}")
        return value

    return read


_READERS = {cls: _readers_of(cls) for cls in _SCHEMAS}
_ARRAYS = {
    cls: {name for name, hint in get_type_hints(cls).items() if get_origin(hint) is np.ndarray}
    for cls in _SCHEMAS
}
