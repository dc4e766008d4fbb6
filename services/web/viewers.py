"""Events for many viewers: each is encoded once, and handed to all who look.

Invariants: used by the server's event loop only; a viewer's queue is bounded, and drops the oldest
events where its reader is slow; who publishes never waits.
"""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from typing import Any

from sse_starlette import ServerSentEvent

QUEUE = 32  # pieces that wait for a viewer


def encoded(name: str, values: dict[str, Any]) -> bytes:
    """An event as it is sent; raises ValueError for numbers that JSON lacks."""
    return ServerSentEvent(json.dumps(values, allow_nan=False), event=name).encode()


class Viewer:
    """One open page."""

    def __init__(self) -> None:
        self._pieces: asyncio.Queue[bytes | None] = asyncio.Queue(QUEUE)
        self.dropped = 0

    def put(self, piece: bytes | None) -> None:
        """Hand it encoded events; None ends it."""
        if self._pieces.full():
            self._pieces.get_nowait()
            self.dropped += 1
        self._pieces.put_nowait(piece)

    async def pieces(self) -> AsyncIterator[bytes]:
        """The events as they come, until the end."""
        while (piece := await self._pieces.get()) is not None:
            yield piece


class Channel:
    """All viewers of one thing, and the newest events of each name for those who come late."""

    def __init__(self) -> None:
        self._viewers: set[Viewer] = set()
        self._newest: dict[str, bytes] = {}

    def __len__(self) -> int:
        return len(self._viewers)

    def publish(self, name: str, piece: bytes) -> None:
        """Hand encoded events of one name to every viewer."""
        self._newest[name] = piece
        for viewer in self._viewers:
            viewer.put(piece)

    def end(self) -> None:
        """Tell every viewer that nothing follows."""
        for viewer in self._viewers:
            viewer.put(None)

    @contextmanager
    def open_to(self, viewer: Viewer) -> Iterator[None]:
        """Hand a viewer the newest events, and all that follow in this block."""
        for piece in self._newest.values():
            viewer.put(piece)
        self._viewers.add(viewer)
        try:
            yield
        finally:
            self._viewers.discard(viewer)
