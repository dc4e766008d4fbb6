"""A server of the page in this process, and requests as browsers, or worse, make them."""

import asyncio
import http.client
import json
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starlette.types import ASGIApp

from mrcdrl.common.config import Config, TransportConfig, to_toml
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome, Stats
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.web.app import make_app
from mrcdrl.services.web.folder import RunFolder
from mrcdrl.services.web.following import Runs
from mrcdrl.services.web.guard import Guard
from mrcdrl.services.web.scraping import metrics_route
from mrcdrl.services.web.server import Certificates, listen, serve
from tests.patience import PATIENCE_S


@dataclass(frozen=True, slots=True)
class Served:
    """A server that is up."""

    port: int
    runs: Runs

    def get(
        self, path: str, method: str = "GET", body: bytes | None = None, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body of an answer; header names with `_` for `-`."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        try:
            connection.request(method, path, body, given)
            answer = connection.getresponse()
            return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def post(
        self, path: str, change: object, content_type: str = "application/json", **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """The same for a POST of text as it is, or of a value as JSON."""
        text = change if isinstance(change, str) else json.dumps(change)
        return self.get(path, "POST", text.encode(), Content_Type=content_type, **headers)

    def json(self, path: str) -> Any:
        """The value in an answer that has to be there."""
        status, _, body = self.get(path)
        assert status == 200, body
        return json.loads(body)

    def connect(self) -> socket.socket:
        """A connection that has asked nothing yet."""
        return socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S)


@contextmanager
def served(
    folder: Path,
    token: str | None = None,
    transport: TransportConfig | None = None,
    certificates: Certificates | None = None,
    port: int = 0,
) -> Iterator[Served]:
    """Serve a folder of runs in a thread of its own."""
    runs = Runs(transport or TransportConfig())
    found = RunFolder(folder)
    app = Guard(make_app(found, runs, routes=[metrics_route(found, runs)]), [], token)
    with serving(app, runs.tend, runs.close, certificates, port, runs) as up:
        yield up


@contextmanager
def serving(
    app: ASGIApp,
    each_second: Callable[[], None],
    end: Callable[[], Awaitable[None]],
    certificates: Certificates | None = None,
    port: int = 0,
    runs: Runs | None = None,
) -> Iterator[Served]:
    """Serve an application in a thread of its own."""
    stop, listener = StopSignal(), listen("127.0.0.1", port, 0)
    failed: list[BaseException] = []

    def answer() -> None:
        try:
            asyncio.run(serve(app, listener, certificates, stop, each_second, end))
        except BaseException as error:  # noqa: BLE001, raised below
            failed.append(error)

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        yield Served(listener.getsockname()[1], runs or Runs(TransportConfig()))
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
        assert failed == []


def record_run(path: Path, config: Config, seconds: int = 30, episodes: int = 120) -> RunState:
    """Write what a run of some seconds would have recorded; return its state at the end."""
    path.mkdir(parents=True)
    (path / "config.toml").write_text(to_toml(config), "utf-8")
    state = RunState(config)
    with Recorder(path, config) as recorder:
        for second in range(seconds):
            metrics = {"learner_steps": 10.0 * second, "loss": 1 / (1 + second), "mean_q": 0.5}
            if second == seconds // 2:
                metrics |= {f"q_bin_{i}": 0.1 for i in range(10)}
            state.observe_stats(Stats("learner", "learner-0", metrics), second)
            actor = {"env_steps": 20.0 * second, "robot_steps": 40.0 * second, "epsilon_max": 0.5}
            state.observe_stats(Stats("actor", "actor-0", actor), second)
            for number in range(episodes // seconds):
                won = Outcome.SUCCESS if number % 2 else Outcome.COLLISION
                done = EpisodeSummary("actor-0", 0, number + 1, won, 9, second, 0, 0.1, 3, 2.5, 2)
                state.observe_episode(done)
                recorder.record_episode(done, state, second)
            recorder.record_metrics(state, second)
        rates = (0.5, 0.5, 0.0)
        tested = Evaluation("e", 7, 3, 200, 2, 10, *rates, (0.2, 0.8), 5, 5, 0, 9, 1, 0, 1)
        recorder.record_evaluation(state.observe_evaluation(tested, seconds - 1))
        recorder.write_summary(state, seconds, "time limit reached (1 min)")
    return state
