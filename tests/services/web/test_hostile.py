"""Floods, silence and slow readers: the server stays small, serves others, and no run notices."""

import http.client
import json
import os
import socket
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from mrcdrl.services.web import app, server
from mrcdrl.services.web.following import MAX_WORKERS
from mrcdrl.services.web.viewers import QUEUE, Channel, Viewer
from tests.patience import PATIENCE_S, eventually
from tests.services.web.live_run import SMOKE, LiveRun
from tests.services.web.web_server import Served, record_run, served

pytestmark = pytest.mark.timeout(2 * PATIENCE_S)


def closed(connection: socket.socket) -> bool:
    """Whether the server has closed it; waits for that."""
    connection.settimeout(PATIENCE_S)
    try:
        return connection.recv(1) == b""
    except ConnectionError:
        return True


def answers(up: Served) -> bool:
    try:
        return up.get("/api/runs")[0] == 200
    except (OSError, http.client.HTTPException):
        return False


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208


def test_a_thousand_silent_connections_are_bounded(live: LiveRun) -> None:
    with served(live.path.parent) as up, ExitStack() as opened:
        before = open_files()
        connections = [opened.enter_context(up.connect()) for _ in range(1000)]
        bound = before + len(connections) + server.MAX_CONNECTIONS
        eventually(lambda: open_files() <= bound, "the server holds no more than it may")
        recorded = live.path / "metrics.jsonl"
        size = recorded.stat().st_size
        eventually(lambda: recorded.stat().st_size > size, "the run goes on")
        for connection in connections:
            connection.close()
        eventually(lambda: answers(up), "the server answers others again")


def test_silent_connections_are_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "REQUEST_S", 1.0)
    with served(tmp_path) as up, ExitStack() as opened:
        connections = [opened.enter_context(up.connect()) for _ in range(50)]
        assert all(map(closed, connections))
        assert answers(up)


@pytest.mark.parametrize(
    "begun", [b"GET /api", b"GET /api/runs HTTP/1.1\r\nHost: localhost\r\nX-Slow: "], ids=len
)
def test_a_request_that_does_not_end_is_given_up(
    begun: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "REQUEST_S", 0.5)
    with served(tmp_path) as up, up.connect() as connection:
        connection.sendall(begun)
        assert closed(connection)
        assert answers(up)


def test_headers_without_end_are_refused(tmp_path: Path) -> None:
    with served(tmp_path) as up, up.connect() as connection:
        connection.settimeout(PATIENCE_S)
        line = b"X-Long: " + b"x" * 8000 + b"\r\n"
        answer = b""
        try:
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n" + 20 * line)
            answer = connection.recv(1000)
        except ConnectionError:
            pass
        assert answer == b"" or b" 400 " in answer.split(b"\r\n")[0]
        assert answers(up)


def test_no_more_pages_are_live_than_there_is_room_for(
    live: LiveRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "MAX_PAGES", 3)
    with served(live.path.parent) as up, ExitStack() as opened:
        for _ in range(3):
            connection = http.client.HTTPConnection("127.0.0.1", up.port, timeout=PATIENCE_S)
            opened.callback(connection.close)
            connection.request("GET", "/api/runs/live/live")
            assert connection.getresponse().readline().startswith(b"event: ")
        assert up.get("/api/runs/live/live")[0] == 503
        assert answers(up)


def test_more_workers_than_there_is_room_for_are_not_watched(live: LiveRun) -> None:
    with served(live.path.parent) as up, ExitStack() as opened:
        for number in range(MAX_WORKERS + 1):
            connection = http.client.HTTPConnection("127.0.0.1", up.port, timeout=PATIENCE_S)
            opened.callback(connection.close)
            connection.request("GET", f"/api/runs/live/live?role=actor&worker=w{number}")
            event = connection.getresponse().readline()
            assert (event == b"event: refused\r\n") == (number == MAX_WORKERS)


@pytest.mark.parametrize("query", ["role=learner", "role=actor&worker=*", "worker=a/b"])
def test_no_other_key_can_be_subscribed_to(live: LiveRun, query: str) -> None:
    with served(live.path.parent) as up:
        assert up.get(f"/api/runs/live/live?{query}")[0] == 400


def test_a_viewer_that_takes_nothing_is_disconnected_and_holds_nobody(
    live: LiveRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "SEND_S", 0.5)
    big = "x" * 300_000
    monkeypatch.setattr(
        "mrcdrl.services.web.following.live_view", lambda _state, now: {"now": now, "pad": big}
    )
    monkeypatch.setattr("mrcdrl.services.web.following._PERIOD_S", 0.05)
    with served(live.path.parent) as up, up.connect() as slow:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.sendall(b"GET /api/runs/live/live HTTP/1.1\r\nHost: localhost\r\n\r\n")
        connection = http.client.HTTPConnection("127.0.0.1", up.port, timeout=PATIENCE_S)
        connection.request("GET", "/api/runs/live/live")
        lines = iter(connection.getresponse().readline, b"")
        told = (json.loads(line[6:])["now"] for line in lines if line.startswith(b"data: {"))
        first = next(told)
        threading.Event().wait(2.0)  # the slow one fills what lies between
        assert max(next(told) for _ in range(50)) > first
        followed = next(iter(up.runs._followed.values()))
        eventually(lambda: len(followed.states) == 1, "the slow viewer is disconnected")
        connection.close()


def test_a_viewers_queue_drops_the_oldest() -> None:
    channel, viewer = Channel(), Viewer()
    with channel.open_to(viewer):
        for number in range(10 * QUEUE):
            channel.publish("state", b"%d" % number)
    assert viewer.dropped == 9 * QUEUE
    late = Viewer()
    with channel.open_to(late):
        assert late._pieces.get_nowait() == b"%d" % (10 * QUEUE - 1)
    assert len(channel) == 0


def test_a_day_of_history_takes_no_memory_and_no_time(tmp_path: Path) -> None:
    """A day of seconds: what is read of it is bounded, whatever stretch is asked for."""
    record_run(tmp_path / "long", SMOKE)
    line = (tmp_path / "long" / "metrics.jsonl").read_text().splitlines()[-1]
    values = json.loads(line)
    with (tmp_path / "long" / "metrics.jsonl").open("w") as file:
        for second in range(86_400):
            values["time_s"] = float(second)
            file.write(json.dumps(values) + "\n")
    before = memory_bytes()
    with served(tmp_path) as up:
        for stretch in ("", "&from=43200", "&from=100&to=200", "&from=86000"):
            told = up.json(f"/api/runs/long/history?points=600{stretch}")
            assert 100 <= len(told["time_s"]) <= 600
        assert up.json("/api/runs/long")["state"]["point"]["time_s"] == 86_399
    assert memory_bytes() - before < 200e6


def memory_bytes() -> int:
    """Memory of this process that is in use."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
