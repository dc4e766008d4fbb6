"""What viewers of a run that is up are handed, and when."""

import http.client
import json
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest

from mrcdrl.services.web import following
from mrcdrl.services.web.viewers import Channel, Viewer, encoded
from tests.patience import PATIENCE_S, eventually
from tests.services.web.live_run import FRAMES
from tests.services.web.web_server import Served

pytestmark = pytest.mark.timeout(2 * PATIENCE_S)
WATCH = "role=actor&worker=actor-0"


def events(up: Served, opened: ExitStack, query: str = "") -> Iterator[tuple[str, Any]]:
    """The events of a page that is open, each with its name and values."""
    connection = http.client.HTTPConnection("127.0.0.1", up.port, timeout=PATIENCE_S)
    answer = opened.enter_context(closing(connection))
    answer.request("GET", f"/api/runs/live/live?{query}")
    name = ""
    for line in iter(answer.getresponse().readline, b""):
        field, _, value = line.decode().strip().partition(": ")
        if field == "event":
            name = value
        elif field == "data":
            yield name, json.loads(value)


def frames(told: Iterator[tuple[str, Any]]) -> Iterator[dict[str, Any]]:
    return (values for name, values in told if name == "frame")


def test_every_frame_of_an_episode_comes_once_and_in_order(server: Served) -> None:
    with ExitStack() as opened:
        told = frames(events(server, opened, WATCH))
        numbers = [next(told)["frame"] for _ in range(FRAMES)]
    assert numbers == [(numbers[0] + i) % FRAMES for i in range(FRAMES)]


def test_who_comes_late_is_told_at_once_what_is_known(server: Served) -> None:
    with ExitStack() as opened:
        early = events(server, opened, WATCH)
        last = next(frames(early))
        late = events(server, opened, WATCH)
        assert next(late)[0] == "state"
        name, frame = next(late)
        assert (name, frame["episode"] >= last["episode"]) == ("frame", True)


def test_a_worker_is_watched_as_soon_as_somebody_asks(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the first picture, and the server's end, would wait for a tick."""
    monkeypatch.setattr(following, "_TICK_S", 10 * PATIENCE_S)
    with ExitStack() as opened:
        assert next(events(server, opened))[0] == "state"
        assert next(frames(events(server, opened, WATCH)))["worker"] == "actor-0"


def test_a_role_alone_means_its_first_worker(server: Served) -> None:
    with ExitStack() as opened:
        anyone, named = (frames(events(server, opened, q)) for q in ("role=actor", WATCH))
        first = next(anyone)
        assert first["worker"] == next(named)["worker"] == "actor-0"
        numbers = [next(anyone)["frame"] for _ in range(FRAMES // 2)]
    assert numbers == [first["frame"] + 1 + i for i in range(FRAMES // 2)]  # not shared out


def test_a_run_is_joined_while_its_page_is_read(server: Served) -> None:
    assert server.get("/run?name=live")[0] == 200
    eventually(server.runs.measured, "the run is joined")


def test_all_viewers_are_handed_the_same_bytes() -> None:
    """So that many of them cost little more than one."""
    channel, viewers = Channel(), [Viewer(), Viewer()]
    piece = encoded("state", {"name": "two\nlines"})
    with ExitStack() as opened:
        for viewer in viewers:
            opened.enter_context(channel.open_to(viewer))
        channel.publish("state", piece)
    assert all(viewer._pieces.get_nowait() is piece for viewer in viewers)
    assert piece == b'event: state\r\ndata: {"name": "two\\nlines"}\r\n\r\n'


def test_the_first_state_says_who_is_there(server: Served) -> None:
    """A page that told of nobody would stop watching, and watch anew a second later."""
    with ExitStack() as opened:
        name, state = next(events(server, opened))
    there = {service["id"] for service in state["services"] if service["watchable"]}
    assert (name, "actor-0" in there) == ("state", True)
