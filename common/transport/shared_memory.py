"""Shared memory for large messages between processes of one host.

A client offers its peer a shared buffer, a sealed memfd (a "slot" on the wire), by an address
`<boot> <process> <descriptor> <token>`. The peer opens it through /proc, reads a large request from
it, or writes a large answer into it. `SealedMemory` is for what many processes read: a memfd that
nobody can alter once it is filled.

Invariants: a buffer has no name in any file system, so nothing is left when either end is killed;
only a sealed memfd of ours that begins with the token is ever mapped, and it cannot shrink under
its reader; a buffer carries one request and its answer at a time, and is never reused if the
answer did not come, because the peer may still write to it. A peer that cannot open the buffer
(another host, user or container) is served over the network.
"""

import fcntl
import logging
import mmap
import os
import re
import secrets
import sys
import weakref
from collections import OrderedDict
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from mrcdrl.common.errors import SharedMemoryError
from mrcdrl.common.messages.framing import ALIGNMENT, Part

_LOG = logging.getLogger("transport")
LARGE_BYTES = 32 << 10  # smaller messages are as fast over the network
_NAME = "mrcdrl-slot"
_SEALED_NAME = "mrcdrl-sealed"
_ADDRESS = re.compile(r"([0-9a-f-]{36}) (\d{1,10}) (\d{1,10}) ([0-9a-f]{32})")
_TOKEN_BYTES = 16
_MAX_MAPPED = 4096  # one or two a client
_CHECKED = 2  # buffers looked at when another is mapped: has the client closed them?
_SEALS = (
    fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL if sys.platform == "linux" else 0
)
_WRITE_SEAL = fcntl.F_SEAL_WRITE if sys.platform == "linux" else 0


class SharedBuffer:
    """Memory for one request at a time; raises OSError if the system has none to give."""

    def __init__(self, size: int) -> None:
        """size: bytes of `memory`, rounded up to whole pages."""
        whole = -(-(ALIGNMENT + size) // mmap.PAGESIZE) * mmap.PAGESIZE
        self._descriptor = os.memfd_create(_NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(self._descriptor, whole)
            fcntl.fcntl(self._descriptor, fcntl.F_ADD_SEALS, _SEALS)
            self._map = mmap.mmap(self._descriptor, whole)
        except OSError:
            os.close(self._descriptor)
            raise
        weakref.finalize(self, os.close, self._descriptor)  # the map is freed with its last view
        token = secrets.token_bytes(_TOKEN_BYTES)
        self._map[:_TOKEN_BYTES] = token
        self.address = f"{_boot_id()} {os.getpid()} {self._descriptor} {token.hex()}"
        self.memory = memoryview(self._map)[ALIGNMENT:]


class SealedMemory:
    """A message that any process of this host and user can read while this object lives.

    Raises OSError if the system has no memory to give.
    """

    def __init__(self, message: Part) -> None:
        descriptor = os.memfd_create(_SEALED_NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        weakref.finalize(self, os.close, descriptor)
        token = secrets.token_bytes(_TOKEN_BYTES)
        for part in (token.ljust(ALIGNMENT, b"\0"), message):
            left = memoryview(part)
            while left:
                left = left[os.write(descriptor, left) :]
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, _SEALS | _WRITE_SEAL)
        self.address = f"{_boot_id()} {os.getpid()} {descriptor} {token.hex()}"


def open_sealed(address: str, num_bytes: int) -> memoryview:
    """The message of a SealedMemory, which stays even if its owner ends.

    Raises SharedMemoryError if it is out of reach.
    """
    memory = _map(address, _SEALED_NAME, _WRITE_SEAL)
    if len(memory) != num_bytes:
        raise SharedMemoryError(f"{len(memory)} bytes where {num_bytes} are due")
    return memory


class BufferPool:
    """The buffers that a client shares with one peer, one for each request in flight."""

    def __init__(self, whom: str, *, enabled: bool) -> None:
        """whom: the peer's name in the log."""
        self._whom = whom
        self._free: list[SharedBuffer] = []
        self.enabled = enabled and sys.platform == "linux"
        self.near: bool | None = None
        """Whether the peer can open them; None before its first answer."""

    def borrow(self, size: int) -> SharedBuffer | None:
        """A buffer for `size` bytes; None if they are few, the peer is far or memory is short.

        The first small message gets one too, to see whether the peer can open it.
        """
        if not self.enabled or self.near is False or (self.near and size < LARGE_BYTES):
            return None
        for index, buffer in enumerate(self._free):
            if len(buffer.memory) >= size:
                return self._free.pop(index)
        if self._free:  # messages have outgrown it
            self._free.pop()
        try:
            return SharedBuffer(size)
        except OSError as error:
            self._decide(near=False, why=f"no memory to share: {error.strerror}")
            return None

    def give_back(self, buffer: SharedBuffer) -> None:
        """Return a buffer that the peer no longer touches."""
        self._free.append(buffer)

    def opened(self) -> None:
        """Note that the peer could open a buffer."""
        self._decide(near=True, why="")

    def refused(self, why: str) -> None:
        """Note that the peer could not open a buffer."""
        self._decide(near=False, why=why)

    def _decide(self, *, near: bool, why: str) -> None:
        if near is self.near:
            return
        self.near = near
        if near:
            _LOG.info("large messages to and from %s go through shared memory", self._whom)
        else:
            self._free.clear()
            _LOG.info("large messages to and from %s go over the network: %s", self._whom, why)


class OpenedBuffers:
    """Buffers of clients, opened by the peer they asked; for one thread."""

    def __init__(self) -> None:
        self._mapped: OrderedDict[str, memoryview] = OrderedDict()
        self._to_check: OrderedDict[str, None] = OrderedDict()  # those mapped, by their turn

    def open(self, address: str) -> memoryview:
        """Memory of a client's buffer; raises SharedMemoryError, saying why it is out of reach."""
        memory = self._mapped.get(address)
        if memory is None:
            memory = _map(address)
            self._forget_closed()
            self._mapped[address] = memory
            self._to_check[address] = None
        self._mapped.move_to_end(address)
        while len(self._mapped) > _MAX_MAPPED:
            self._to_check.pop(self._mapped.popitem(last=False)[0], None)
        return memory

    def _forget_closed(self) -> None:
        """Look at some in turn, so that a further one costs the same however many are mapped."""
        for _ in range(min(_CHECKED, len(self._to_check))):
            address, _ = self._to_check.popitem(last=False)
            if _is_named(_path(address), _NAME):
                self._to_check[address] = None
            else:
                del self._mapped[address]


@cache
def _boot_id() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()


def _path(address: str) -> Path:
    """Where this host shows the memory; raises SharedMemoryError for any other address."""
    match = _ADDRESS.fullmatch(address)
    if not match or sys.platform != "linux":
        raise SharedMemoryError("no address of a slot")
    if match[1] != _boot_id():
        raise SharedMemoryError("another host")
    return Path("/proc") / match[2] / "fd" / match[3]


def _is_named(path: Path, name: str) -> bool:
    try:
        return str(path.readlink()).startswith(f"/memfd:{name}")
    except OSError:
        return False


def _map(address: str, name: str = _NAME, more_seals: int = 0) -> memoryview:
    """The memory of a memfd of this name; to be read only, if it is sealed against writing."""
    path, seals = _path(address), _SEALS | more_seals
    if not _is_named(path, name):
        raise SharedMemoryError("another container or user")
    try:
        descriptor = os.open(path, (os.O_RDONLY if more_seals else os.O_RDWR) | os.O_CLOEXEC)
    except OSError as error:
        raise SharedMemoryError(f"not to be opened: {error.strerror}") from error
    try:
        # Once open it cannot be swapped for another file; sealed, it cannot shrink.
        sealed = fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & seals == seals
        if not sealed or os.fstat(descriptor).st_size <= ALIGNMENT:
            raise SharedMemoryError("no sealed memory")
        access = mmap.ACCESS_READ if more_seals else mmap.ACCESS_DEFAULT
        mapped = mmap.mmap(descriptor, 0, access=access)
    except (OSError, ValueError) as error:
        raise SharedMemoryError(f"not to be mapped: {error}") from error
    finally:
        os.close(descriptor)
    if mapped[:_TOKEN_BYTES].hex() != address.split()[-1]:
        raise SharedMemoryError("memory of another process")
    return memoryview(mapped)[ALIGNMENT:]


def put(memory: memoryview, parts: Sequence[Part]) -> tuple[int, int] | None:
    """Copy a message into memory and return (start, length); None if it does not fit.

    A last part that lies in this memory already stays in place, and the others go before it.
    """
    length = sum(map(len, parts))
    existing = _place_in(memory, parts[-1])
    start = 0 if existing is None else existing - (length - len(parts[-1]))
    if start < 0 or start + length > len(memory):
        return None
    place = start
    for part in parts if existing is None else parts[:-1]:
        memory[place : place + len(part)] = part
        place += len(part)
    return start, length


def room(memory: memoryview, size: int) -> memoryview | None:
    """The last `size` bytes, starting at a multiple of the alignment; None if there are fewer."""
    start = (len(memory) - size) // ALIGNMENT * ALIGNMENT
    return memory[start : start + size] if start >= 0 else None


def _place_in(memory: memoryview, part: Part) -> int | None:
    """The offset of a part in memory; None if it lies elsewhere."""
    place = _address(part) - _address(memory)
    return place if place >= 0 and place + len(part) <= len(memory) else None


def _address(part: Part) -> int:
    address: int = np.frombuffer(part, np.uint8).__array_interface__["data"][0]
    return address
