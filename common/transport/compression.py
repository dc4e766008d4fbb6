"""Compression of large messages between hosts, each as a whole.

    0xC1 "lz4", length uint32, one LZ4 block

Invariants: a message without this mark is sent as it is, and no message of ours begins with the
mark; nothing expands beyond the largest message allowed.
"""

import struct
from collections.abc import Sequence

import lz4.block

from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.framing import Part

_HEAD = struct.Struct("<4sI")
_MARK = b"\xc1lz4"


def compressed(parts: Sequence[Part]) -> bytes:
    """Compress a message, given in parts, as one block."""
    message = b"".join(parts)
    block: bytes = lz4.block.compress(message, store_size=False)
    return _HEAD.pack(_MARK, len(message)) + block


def expanded(payload: bytes, max_message_bytes: int) -> bytes:
    """Expand a payload if it is compressed; raises WireError if it is damaged or too large."""
    if payload[: len(_MARK)] != _MARK:
        return payload
    if len(payload) < _HEAD.size:
        raise WireError("the compressed message ends within its head")
    _, length = _HEAD.unpack_from(payload)
    if length > max_message_bytes:
        raise WireError(f"{length} bytes exceed the limit of {max_message_bytes}")
    try:
        message: bytes = lz4.block.decompress(payload[_HEAD.size :], uncompressed_size=length)
    except lz4.block.LZ4BlockError as error:
        raise WireError("the compressed message is damaged") from error
    if len(message) != length:
        raise WireError(f"the compressed message has {len(message)} bytes, not {length}")
    return message
