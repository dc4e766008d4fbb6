"""The page of `mrcdrl demo`, and what it asks, as an ASGI application.

    /         the page          /live     what is played, as events: `about`, `frame`, `refused`
    /change   POST, JSON: {"move": "target", "index": 0, "x": 100, "y": 200}, {"robots": 3} or
              {"restart": true}

Invariants: a change has one of these shapes, or is refused; what a page asks is bounded.
"""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from sse_starlette import EventSourceResponse
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from mrcdrl.services.tools.demo.playground import Playground
from mrcdrl.services.web.app import PING_S, SEND_S, STATIC, refused
from mrcdrl.services.web.viewers import Viewer

CHANGE = "/change"
MAX_PAGES = 16
_MAX_BYTES = 1000  # of a change
_MOST = 1e6  # of a number in a change


class DemoPage:
    """The page of one playground."""

    def __init__(self, playground: Playground) -> None:
        self._playground = playground
        self._playing: asyncio.Task[None] | None = None

    def app(self) -> Starlette:
        """The application; the playground plays while it is up."""
        routes = [
            Route("/", self.page),
            Route("/live", self.live),
            Route(CHANGE, self.change, methods=["POST"]),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        return Starlette(
            routes=routes,
            lifespan=self._lifespan,
            exception_handlers={HTTPException: refused},
        )

    def check(self) -> None:
        """Raise what ended the playing, if anything did."""
        if self._playing is not None and self._playing.done():
            self._playing.result()

    async def page(self, _: Request) -> Response:
        """The page."""
        return FileResponse(STATIC / "demo.html")

    async def live(self, _: Request) -> Response:
        """What is played, as it is played."""
        if len(self._playground.channel) >= MAX_PAGES:
            raise HTTPException(503, f"{MAX_PAGES} pages are open already")
        return EventSourceResponse(self._events(), ping=PING_S, send_timeout=SEND_S)

    async def change(self, request: Request) -> Response:
        """Ask for a change; it is made before the next frame."""
        body = b""
        async for piece in request.stream():
            body += piece
            if len(body) > _MAX_BYTES:
                raise HTTPException(413, "a change is shorter")
        try:
            asked = json.loads(body)
        except ValueError as error:
            raise HTTPException(400, "a change is an object in JSON") from error
        match asked:
            case {"move": ("robot" | "target") as thing, "index": int(index), "x": x, "y": y} if (
                is_number(x, y)
            ):
                self._playground.move(thing, index, float(x), float(y))
            case {"robots": int(number)} if is_number(number):
                self._playground.set_robots(number)
            case {"restart": True}:
                self._playground.restart()
            case _:
                raise HTTPException(400, "there is no such change")
        return Response(status_code=204)

    async def _events(self) -> AsyncIterator[bytes]:
        viewer = Viewer()
        with self._playground.channel.open_to(viewer):
            async for piece in viewer.pieces():
                yield piece

    @asynccontextmanager
    async def _lifespan(self, _: Starlette) -> AsyncIterator[None]:
        self._playing = asyncio.create_task(self._playground.play())
        yield
        self._playing.cancel()


def is_number(*values: object) -> bool:
    """Whether these are numbers that a change may have: finite, and not huge."""
    plain = (isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    return all(plain) and all(abs(v) < _MOST for v in values)  # type: ignore[arg-type]  # no NaN
