"""The faults do what they say and leave nothing behind, and the observer would notice."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from benchmarks.replay_load import counting_chunk
from mrcdrl.common.config import load_config
from mrcdrl.common.messages.trajectory import Stats, Weights
from mrcdrl.common.messages.wire import encode
from mrcdrl.services.replay.inspect.contents import Contents
from tests.chaos.chaos_faults import (
    cut_off,
    disk,
    full,
    lossy,
    shifted_clock,
    slow,
    stopped,
    why_no_hosts,
)
from tests.chaos.chaos_hosts import Host, hosts, owned_name, run
from tests.chaos.chaos_observer import Life, Observer, compare
from tests.patience import PATIENCE_S, eventually
from tests.system.system_processes import REPOSITORY, environment

SIZE, PORT = 100_000, 7000
SERVER = f"""
import socketserver
class Handler(socketserver.BaseRequestHandler):
    def handle(self):
        self.request.sendall(bytes({SIZE}))
socketserver.ThreadingTCPServer(("0.0.0.0", {PORT}), Handler).serve_forever()
"""
CLIENT = f"""
import socket, sys
with socket.create_connection((sys.argv[1], {PORT}), timeout=float(sys.argv[2])) as connection:
    assert len(connection.makefile("rb").read()) == {SIZE}
"""


@pytest.fixture(scope="module")
def _hosts() -> None:
    if (why := why_no_hosts()) is not None:
        pytest.skip(f"NO HOSTS OF OUR OWN, FAULTS OF NETWORKS ARE NOT TESTED: {why}")


@contextmanager
def two_hosts() -> Iterator[tuple[Host, Host, str]]:
    """A server, a client, and the server's address."""
    with hosts() as made:
        network = made.network("network")
        serving, asking = made.host("serving", network), made.host("asking", network)
        server = subprocess.Popen([*serving.prefix, sys.executable, "-c", SERVER])
        try:
            yield serving, asking, serving.address(network)
        finally:
            server.kill()
            server.wait()


def reaches(host: Host, address: str, patience_s: float = 1.0) -> bool:
    """Whether all bytes arrive, each at most `patience_s` after the one before."""
    command = [*host.prefix, sys.executable, "-c", CLIENT, address, str(patience_s)]
    return (
        subprocess.run(command, capture_output=True, timeout=PATIENCE_S, check=False).returncode
        == 0
    )


@pytest.mark.usefixtures("_hosts")
def test_networks_are_cut_lossy_and_slow_only_while_it_lasts() -> None:
    with two_hosts() as (serving, asking, address):
        eventually(lambda: reaches(asking, address), "a connection between two hosts")
        for host in (serving, asking):
            for fault in (cut_off(host), lossy(host, 1.0)):
                with fault:
                    assert not reaches(asking, address)
                eventually(lambda: reaches(asking, address), "a connection after the fault")
            with slow(host, 800):
                began_s = time.monotonic()
                assert reaches(asking, address, 30.0)
                assert time.monotonic() - began_s > 0.5  # 0.1 MB, of which a burst is at once
            assert "tbf" not in run("tc", "-n", host.namespace, "qdisc", "show")


@pytest.mark.usefixtures("_hosts")
def test_hosts_are_gone_after_a_failure_and_after_a_killed_process() -> None:
    with pytest.raises(OSError, match="File exists"), hosts() as made:
        made.network(made.network("network").name)
    assert owned_name("") not in run("ip", "netns", "list")
    leaving = "import os; from tests.chaos.chaos_hosts import hosts, owned_name; block = hosts();"
    leaving += "block.__enter__().network('left'); print(owned_name('left'), flush=True);"
    leaving += "os.kill(os.getpid(), 9)"
    said = subprocess.run(
        [sys.executable, "-c", leaving], cwd=REPOSITORY, capture_output=True, text=True, check=False
    ).stdout.strip()
    assert said in run("ip", "netns", "list")
    with hosts():
        assert said not in run("ip", "netns", "list")


@pytest.mark.usefixtures("_hosts")
def test_a_disk_is_full_only_while_it_lasts(tmp_path: Path) -> None:
    with disk(tmp_path, 1 << 20):
        (tmp_path / "before").write_bytes(bytes(10_000))
        with full(tmp_path), pytest.raises(OSError, match="No space left"):
            (tmp_path / "meanwhile").write_bytes(bytes(10_000))
        (tmp_path / "after").write_bytes(bytes(10_000))
    assert not list(tmp_path.iterdir())


def test_a_process_is_stopped_only_while_it_lasts() -> None:
    def state() -> str:
        return Path(f"/proc/{sleeper.pid}/stat").read_text("ascii").rpartition(") ")[2][0]

    with subprocess.Popen(["sleep", "600"]) as sleeper:
        try:
            with stopped(sleeper.pid):
                eventually(lambda: state() == "T", "the process is stopped")
            eventually(lambda: state() == "S", "the process goes on")
        finally:
            sleeper.kill()


@pytest.mark.parametrize("shift_s", [-86_400, 86_400])
def test_a_clock_is_ahead_in_that_process_only(shift_s: int) -> None:
    ask = [sys.executable, "-c", "import time; print(time.time(), time.time_ns())"]
    said = subprocess.check_output(ask, env=environment(**shifted_clock(shift_s)), text=True)
    seconds, nanoseconds = map(float, said.split())
    assert abs(seconds - time.time() - shift_s) < 3600
    assert abs(nanoseconds / 1e9 - seconds) < 3600


CHUNKS = 4
LENGTH = 50
TAMPERED: dict[str, tuple[list[int], int, dict[str, object]]] = {
    "nothing": ([0, 1, 2, 3], 0, {"lost": [], "doubled": 0, "acknowledged": 200}),
    "one missing": ([0, 1, 3, 4], 0, {"lost": ["actor-0: chunks [2] of 0 … 4"]}),
    "the newest lost": ([0, 1, 2], 0, {"lost": ["actor-0: 200 acknowledged, 150 kept"]}),
    "all lost": ([], 0, {"lost": ["actor-0: 200 acknowledged, 0 kept"]}),
    "one doubled": ([0, 1, 2, 3], 1, {"lost": [], "doubled": 1}),
}


@pytest.mark.parametrize("name", TAMPERED)
def test_the_observer_would_notice(name: str) -> None:
    """What a log holds of four acknowledged chunks, and the expected verdict."""
    numbers, doubled, said = TAMPERED[name]
    config = load_config("smoke", {"actor.chunk_length": str(LENGTH)}, environ={})
    contents = Contents(chunks=[counting_chunk(config, "actor-0", 8, n) for n in numbers])
    contents.files.duplicate_chunks = doubled
    told = {Life("actor-0", 7): {"inserts_acknowledged": float(CHUNKS * LENGTH)}}
    found = compare(contents, told)
    assert {key: found[key] for key in said} == said


@dataclass
class Said:
    """Published messages, in place of a subscriber."""

    waiting: list[bytes]

    def take(self, _timeout_s: float = 0.0) -> tuple[str, bytes] | None:
        return ("", self.waiting.pop(0)) if self.waiting else None

    def drain(self) -> Iterator[tuple[str, bytes]]:
        return iter(self.take, None)


def heard(figures: list[Stats], weights: list[Weights]) -> Observer:
    """An observer that has listened to these messages."""
    session = MagicMock()
    session.queue_subscriber.side_effect = [Said([*map(encode, s)]) for s in (figures, weights)]
    observer = Observer(MagicMock(run="run"), session)
    while observer.hear() is not None:
        pass
    return observer


def acting_by(version: int, incarnation: int) -> Stats:
    return Stats(
        "actor", "actor-0", {"weights_version": version}, {"incarnation": str(incarnation)}
    )


@pytest.mark.parametrize(
    ("orders", "backwards"),
    [
        ([(1, 1), (1, 2), (1, 10_001), (2, 1)], 0),
        ([(1, 1), (1, 2), (1, 2)], 1),
        ([(1, 5), (1, 4), (1, 6)], 1),
        ([(2, 1), (1, 9)], 1),
    ],
)
def test_the_observer_would_notice_older_weights(
    orders: list[tuple[int, int]], backwards: int
) -> None:
    found = heard([acting_by(1, 1)], [Weights.of(*order, 0, b"") for order in orders])
    assert found.orders == orders
    assert len(found.backwards) == backwards


@pytest.mark.parametrize(
    ("lives", "backwards"),
    [
        ([(-1, 1), (3, 1), (3, 1), (4, 1)], 0),
        ([(3, 1), (2, 1), (4, 1)], 1),
        ([(3, 1), (-1, 2), (2, 2)], 0),
    ],
)
def test_the_observer_would_notice_who_goes_back_to_older_weights(
    lives: list[tuple[int, int]], backwards: int
) -> None:
    """The reported (version, process of the actor)."""
    assert len(heard([acting_by(*life) for life in lives], []).backwards) == backwards
