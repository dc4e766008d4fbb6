"""Framing: large arrays that follow a message's map, and messages that travel as a set.

    0xC1 "map", length of the map uint32, the map, zeros, array, zeros, array, …
    0xC1 "set", number of messages uint32, length of each uint32, zeros, message, zeros, …

Invariants: no msgpack begins with 0xC1, so a map without arrays needs no head; each array and
message begins at a multiple of 64 from the start; neither joining nor splitting copies anything.
"""

import struct
from collections.abc import Sequence

from mrcdrl.common.errors import WireError

Part = bytes | memoryview

ALIGNMENT = 64
_HEAD = struct.Struct("<4sI")
_MAP, _SET = b"\xc1map", b"\xc1set"
_MAX_MESSAGES = 4096


def padded(length: int) -> int:
    """The next multiple of the alignment."""
    return -(-length // ALIGNMENT) * ALIGNMENT


def join_map(packed: bytes, arrays: Sequence[memoryview]) -> list[Part]:
    """A map and the arrays that follow it, in parts."""
    if not arrays:
        return [packed]
    return _in_line(_HEAD.pack(_MAP, len(packed)) + packed, [[array] for array in arrays])


def split_map(data: memoryview) -> tuple[memoryview, memoryview]:
    """The map, and the arrays after it; raises WireError if the head is wrong."""
    if data[: len(_MAP)] != _MAP:
        return data, data[:0]
    if len(data) < _HEAD.size:
        raise WireError("the message ends within its head")
    _, length = _HEAD.unpack_from(data)
    end = _HEAD.size + length
    if end > len(data):
        raise WireError(f"a map of {length} bytes in a message of {len(data)}")
    return data[_HEAD.size : end], data[padded(end) :]


def join_set(messages: Sequence[Sequence[Part]]) -> list[Part]:
    """Join messages, each in parts, to a set; a single one needs no head."""
    if len(messages) == 1:
        return list(messages[0])
    lengths = [sum(map(len, parts)) for parts in messages]
    head = _HEAD.pack(_SET, len(lengths)) + struct.pack(f"<{len(lengths)}I", *lengths)
    return _in_line(head, messages)


def split_set(data: Part) -> list[memoryview]:
    """The messages of a set; raises WireError if `join_set` would not have made it."""
    view = memoryview(data)
    if view[: len(_SET)] != _SET:
        return [view]
    try:
        _, count = _HEAD.unpack_from(view)
        if not 1 <= count <= _MAX_MESSAGES:
            raise WireError(f"a set of {count} messages, not 1 to {_MAX_MESSAGES}")
        lengths = struct.unpack_from(f"<{count}I", view, _HEAD.size)
    except struct.error as error:
        raise WireError("the set ends within its head") from error
    messages, end = [], _HEAD.size + 4 * count
    for length in lengths:
        start = padded(end)
        end = start + length
        messages.append(view[start:end])
    if end != len(view):
        raise WireError(f"a set of {len(view)} bytes whose messages have {end}")
    return messages


def _in_line(head: bytes, messages: Sequence[Sequence[Part]]) -> list[Part]:
    line: list[Part] = [head]
    length = len(head)
    for parts in messages:
        line += [bytes(padded(length) - length), *parts]
        length = sum(map(len, parts))
    return line
