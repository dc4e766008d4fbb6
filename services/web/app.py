"""The pages, and the data behind them, as one ASGI application.

    /                        the list of runs              /api/runs
    /run?name=NAME           one run                       /api/runs/NAME, …/history, …/episodes,
                                                           …/evaluations, …/log, …/live (events)
    /compare?runs=A,B        several runs side by side
    /guide                   what the figures mean: docs/metrics.md
    /files/NAME/FILE         what a run has left           /static/…  the pages' own files

Invariants: GET only; what is read is bounded, and read in a few threads, so that the loop never
waits for a disk; what is wrong with a request is said in one line.
"""

import math
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import anyio
from anyio.to_thread import run_sync
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

from mrcdrl.common.errors import MrcdrlError, RunDirectoryError
from mrcdrl.common.runtime.names import is_name
from mrcdrl.services.monitor.recall import recall_ending
from mrcdrl.services.monitor.records import finite
from mrcdrl.services.monitor.run_info import RunInfo, config_of
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import rule_of
from mrcdrl.services.web import history
from mrcdrl.services.web.folder import FILES, RunFolder
from mrcdrl.services.web.following import Runs
from mrcdrl.services.web.log import log_lines
from mrcdrl.services.web.view import WATCHED, live_view, settings_view

STATIC = Path(str(resources.files("mrcdrl.services.web") / "static"))
MAX_PAGES = 64  # that are live at a time
MAX_EVALUATIONS = 5000
_READERS = 4  # threads that read records
SEND_S = 10.0  # a viewer that takes nothing for this long is disconnected
PING_S = 15


class Pages:
    """The handlers of all requests."""

    def __init__(self, folder: RunFolder, runs: Runs, home: str) -> None:
        """home: the run whose page `/` leads to; empty for the list."""
        self._folder = folder
        self._runs = runs
        self._home = home
        self._readers = anyio.CapacityLimiter(_READERS)
        self._live = 0

    def routes(self) -> list[BaseRoute]:
        """All routes."""
        data: dict[str, Callable[[Path, Mapping[str, str]], Any]] = {
            "": self._run,
            "/history": _history,
            "/episodes": _episodes,
            "/evaluations": lambda run, _: history.evaluations(run, MAX_EVALUATIONS),
            "/log": lambda run, _: log_lines(run),
        }
        return [
            Route("/", self.page("runs.html")),
            Route("/run", self.run_page),
            Route("/compare", self.page("compare.html")),
            Route("/guide", self.page("guide.html")),
            Route("/metrics.md", self.page("metrics.md")),
            Route("/favicon.ico", self.page("icon.svg")),
            Route("/api/runs", self.list_runs),
            *(Route(f"/api/runs/{{name}}{path}", self.data(d)) for path, d in data.items()),
            Route("/api/runs/{name}/live", self.live),
            Route("/files/{name}/{file}", self.file),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]

    def page(self, name: str) -> Callable[[Request], Any]:
        """A handler that sends one of the pages."""

        async def send(_: Request) -> Response:
            return FileResponse(STATIC / name)

        return send

    async def run_page(self, request: Request) -> Response:
        """The page of a run; the run is joined while a browser reads it."""
        with suppress(RunDirectoryError, OSError):
            name = request.query_params.get("name", "")
            run_dir = await run_sync(self._folder.find, name, limiter=self._readers)
            self._runs.expect(run_dir)
        return FileResponse(STATIC / "run.html")

    async def list_runs(self, _: Request) -> Response:
        """The runs of the folder, those active last first."""
        infos = await run_sync(self._folder.infos, limiter=self._readers)
        told = {"folder": str(self._folder.path), "home": self._home}
        return JSONResponse(told | {"runs": [_told(info) for info in infos]})

    def data(self, read: Callable[[Path, Mapping[str, str]], Any]) -> Callable[[Request], Any]:
        """A handler that sends what `read` makes of a run's directory and the query."""

        async def send(request: Request) -> Response:
            def found() -> Any:
                run_dir = self._folder.find(request.path_params["name"])
                return finite(read(run_dir, request.query_params))

            try:
                return JSONResponse(await run_sync(found, limiter=self._readers))
            except RunDirectoryError as error:
                raise HTTPException(404, str(error)) from error
            except OSError as error:
                raise HTTPException(404, "the run's records cannot be read") from error

        return send

    async def file(self, request: Request) -> Response:
        """A picture, film or text that a run has left."""
        name, file = request.path_params["name"], request.path_params["file"]
        try:
            path = await run_sync(self._folder.file, name, file, limiter=self._readers)
        except (RunDirectoryError, OSError) as error:
            raise HTTPException(404, "the run has no such file") from error
        return FileResponse(path, media_type=FILES[file])

    async def live(self, request: Request) -> Response:
        """The state of a run that is up, as events: `state` once a second, `waiting`, `ended`.

        With `role` and `worker` also each `frame` of a worker's arena; with `role` alone, of the
        first worker in that role.
        """
        try:
            name = request.path_params["name"]
            run_dir = await run_sync(self._folder.find, name, limiter=self._readers)
        except RunDirectoryError as error:
            raise HTTPException(404, str(error)) from error
        if self._live >= MAX_PAGES:
            raise HTTPException(503, f"{MAX_PAGES} pages are open already")
        role, worker = (request.query_params.get(name, "") for name in ("role", "worker"))
        if (role and role not in WATCHED) or (worker and not (role and is_name(worker))):
            raise HTTPException(400, "role is actor or evaluator, and worker its name")
        events = self._events(run_dir, (role, worker) if role else None)
        return EventSourceResponse(events, ping=PING_S, send_timeout=SEND_S)

    async def _events(
        self, run_dir: Path, worker: tuple[str, str] | None
    ) -> AsyncIterator[bytes | ServerSentEvent]:
        self._live += 1
        try:
            async with self._runs.viewing(run_dir, worker) as viewer:
                async for piece in viewer.pieces():
                    yield piece
        except MrcdrlError as error:
            yield ServerSentEvent(str(error), event="refused")
        finally:
            self._live -= 1

    def _run(self, run_dir: Path, _query: Mapping[str, str]) -> dict[str, Any]:
        """All that is known of a run but its curves."""
        info, config = self._folder.info(run_dir.name), config_of(run_dir)
        told: dict[str, Any] = {
            "info": _told(info),
            "files": [name for name in FILES if (run_dir / name).is_file()],
            "settings": None if config is None else settings_view(config),
            "state": None,
        }
        if config is not None:
            state = RunState(config)
            now = recall_ending(run_dir, state)
            told["state"] = live_view(state, now) | {"time_left_s": None}
        return told


def _told(info: RunInfo) -> dict[str, Any]:
    told = asdict(info) | {"rule": rule_of(info.stop_reason or "")}
    del told["path"]
    return {name: finite(value) for name, value in told.items()}


def _history(run_dir: Path, query: Mapping[str, str]) -> dict[str, Any]:
    return dict(history.history(run_dir, *_stretch(query)))


def _episodes(run_dir: Path, query: Mapping[str, str]) -> dict[str, Any]:
    return dict(history.episodes(run_dir, *_stretch(query)))


def _stretch(query: Mapping[str, str]) -> tuple[int, float, float]:
    """The number of points, and the times in seconds from which and to which; raises 400."""
    try:
        num = int(query.get("points", "500"))
        begin_s, end_s = float(query.get("from", "0")), float(query.get("to", "inf"))
    except ValueError as error:
        raise HTTPException(400, "points, from and to are numbers") from error
    if not 2 <= num <= history.MAX_POINTS or math.isnan(begin_s + end_s):
        raise HTTPException(400, f"points is between 2 and {history.MAX_POINTS}")
    return num, begin_s, end_s


async def refused(_: Request, error: Exception) -> Response:
    """An error as one line."""
    code = error.status_code if isinstance(error, HTTPException) else 500
    return PlainTextResponse(f"{getattr(error, 'detail', 'failed')}\n", code)


def make_app(
    folder: RunFolder, runs: Runs, *, home: str = "", routes: Sequence[BaseRoute] = ()
) -> Starlette:
    """The application; routes: more of them, such as that of metrics."""
    pages = Pages(folder, runs, home)

    return Starlette(
        routes=[*pages.routes(), *routes],
        exception_handlers={HTTPException: refused},
    )
