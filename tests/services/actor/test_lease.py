"""An actor's lease over real Zenoh sessions, and over processes that are stopped and killed."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.messages.trajectory import NO_SLOT, LeaseRequest
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.actor.lease import ALONE, ExplorationRank, LeaseClient
from mrcdrl.services.replay.leases import LeaseTable
from tests.patience import PATIENCE_S, eventually
from tests.system.system_processes import REPOSITORY, Command, end_all, run_name

RENEWED_S = 1.0  # as if leases were so short
LEASE_S = 1000.0  # as they are


class Network:
    """A replay that leases slots, by a clock that stands still, and actors that ask it."""

    def __init__(self) -> None:
        self.endpoint, self.keys = free_endpoint(), Keys("leases")
        self.router = Session(TransportConfig(listen=(self.endpoint,)))
        self.sessions: list[Session] = []
        self.server = self.router.server(self.keys.leases)
        self.start_replay(now=0.0)
        self.now = LEASE_S

    def start_replay(self, now: float) -> None:
        self.table, self.now = LeaseTable(LEASE_S, 0, now), now

    def join(self, actor: str) -> LeaseClient:
        session = Session(TransportConfig(connect=(self.endpoint,)))
        self.sessions.append(session)
        return LeaseClient(session, self.keys, actor, RENEWED_S)

    def answer(self) -> None:
        """What has been asked."""
        while (request := self.server.take(0.01)) is not None:
            wish = decode(LeaseRequest, request.payload)
            request.reply(encode(self.table.answer(wish, self.now)))

    def until(self, clients: Sequence[LeaseClient], ranks: Sequence[ExplorationRank]) -> None:
        """Actors work on until they have these ranks."""

        def settled() -> bool:
            for client in clients:
                client.follow()
            self.answer()
            return [client.rank for client in clients] == list(ranks)

        eventually(settled, f"ranks {ranks}", pause_s=0.001)

    def close(self) -> None:
        for session in (*self.sessions, self.router):
            session.close()


@pytest.fixture
def network() -> Iterator[Network]:
    opened = Network()
    yield opened
    opened.close()


def test_actors_that_ask_at_once_get_different_ranks(network: Network) -> None:
    first, second = network.join("a"), network.join("b")
    eventually(lambda: asked_by(network, first, second), "both have asked")
    network.until([first, second], [(first.slot, 2), (second.slot, 2)])
    network.until([first, second], [(first.slot, 2), (second.slot, 2)])
    assert {first.slot, second.slot} == {0, 1}


def asked_by(network: Network, *clients: LeaseClient) -> bool:
    """Whether all have asked and been answered; each asks once in that."""
    for client in clients:
        client.follow()
    network.answer()
    return all(client.slot != NO_SLOT for client in clients)


def test_a_slot_given_back_is_the_next_ones(network: Network) -> None:
    first, second = network.join("a"), network.join("b")
    network.until([first], [(0, 1)])
    network.until([first, second], [(0, 2), (1, 2)])
    leaving = threading.Thread(target=first.give_back)
    leaving.start()
    eventually(lambda: network.answer() or not leaving.is_alive(), "it has given its slot back")
    leaving.join()
    network.until([second], [(0, 1)])
    assert second.slot == 1
    third = network.join("c")
    network.until([third, second], [(0, 2), (1, 2)])


def test_holders_keep_their_slots_when_replay_starts_again(network: Network) -> None:
    first, second = network.join("a"), network.join("b")
    network.until([first], [(0, 1)])
    network.until([first, second], [(0, 2), (1, 2)])
    network.start_replay(now=5000.0)
    newcomer = network.join("c")
    network.until([second], [(0, 1)])
    assert second.slot == 1, "by its claim: nobody else has claimed yet"
    network.until([first, second, newcomer], [(0, 2), (1, 2), ALONE])
    network.now += LEASE_S / 2
    network.until([first, second, newcomer], [(0, 2), (1, 2), ALONE])
    for client in (first, second):  # as they do all the time
        renewed_until(network, client)
    network.now += LEASE_S / 2
    network.until([first, second, newcomer], [(0, 3), (1, 3), (2, 3)])


def renewed_until(network: Network, client: LeaseClient) -> None:
    """Work on until it has been answered at the time that it is."""
    seen = network.table.answer
    answered: list[str] = []

    def answer(request: LeaseRequest, now: float):  # type: ignore[no-untyped-def]
        answered.append(request.actor)
        return seen(request, now)

    network.table.answer = answer  # type: ignore[method-assign]
    eventually(lambda: client.follow() or network.answer() or answered, "it renews")


def test_without_replay_an_actor_waits_for_nothing_but_at_its_end() -> None:
    endpoint = free_endpoint()
    with (
        Session(TransportConfig(listen=(endpoint,))),
        Session(TransportConfig(connect=(endpoint,))) as session,
    ):
        client = LeaseClient(session, Keys("nobody"), "a", RENEWED_S)
        for _ in range(1000):
            client.follow()
        assert (client.rank, client.slot) == (ALONE, NO_SLOT)
        client.give_back()


def test_an_answer_that_is_none_is_passed_over(network: Network) -> None:
    client = network.join("a")

    def refused() -> bool:
        client.follow()
        request = network.server.take(0.01)
        if request is not None:
            request.reply(b"\x80")
        return request is not None

    eventually(refused, "it asks")
    network.until([client], [(0, 1)])


HOLDER = """
import sys, time
from mrcdrl.common.config import TransportConfig
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.actor.lease import LeaseClient
endpoint, run, name, lease_s = sys.argv[1:]
stop = StopSignal().listen(30)
with Session(TransportConfig(connect=(endpoint,))) as session:
    client = LeaseClient(session, Keys(run), name, float(lease_s))
    while not stop.wait(0.02):
        client.follow()
        now, slot = time.monotonic(), client.slot
        if slot >= 0:
            print(now, slot, flush=True)
        else:
            print("none", flush=True)
    client.give_back()
"""


class Holder:
    """A process that holds a slot, and writes down when it believed so."""

    def __init__(self, endpoint: str, run: str, name: str, lease_s: float, folder: Path) -> None:
        self.out = folder / f"{name}-{len(list(folder.iterdir()))}.out"
        with self.out.open("wb") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-c", HOLDER, endpoint, run, name, str(lease_s)],
                stdin=subprocess.DEVNULL,
                stdout=out,
                cwd=REPOSITORY,
            )

    @property
    def lines(self) -> list[str]:
        text = self.out.read_text("ascii")
        return text[: text.rfind("\n") + 1].splitlines()

    @property
    def slot(self) -> int:
        """As last written down."""
        last = self.lines[-1:]
        return NO_SLOT if last in ([], ["none"]) else int(last[0].split()[1])

    def held(self) -> list[tuple[float, float, int]]:
        """From when to when it held which slot without a break."""
        spans: list[tuple[float, float, int]] = []
        broken = True
        for line in self.lines:
            if line == "none":
                broken = True
                continue
            now_s, slot = float(line.split()[0]), int(line.split()[1])
            began_s = now_s if broken or spans[-1][2] != slot else spans.pop()[0]
            spans.append((began_s, now_s, slot))
            broken = False
        return spans

    def end(self) -> None:
        self.process.kill()
        self.process.wait(PATIENCE_S)


@pytest.mark.system
@pytest.mark.timeout(600)
def test_no_two_processes_hold_a_slot_whatever_happens_to_them(tmp_path: Path) -> None:
    endpoint, run, lease_s = free_endpoint(), run_name("leases"), 2.0
    arguments = ["replay", "--run", run, "--run-dir", tmp_path, "--config", "smoke"]
    arguments += ["--listen", endpoint, "--exploration.lease_s", str(lease_s)]
    arguments += ["--exploration.slots", "2"]
    holders: list[Holder] = []

    def start(name: str) -> Holder:
        holders.append(Holder(endpoint, run, name, lease_s, tmp_path))
        return holders[-1]

    try:
        with Command(arguments, tmp_path) as replay:
            first, second = start("actor-0"), start("actor-1")
            eventually(lambda: {first.slot, second.slot} == {0, 1}, "both have a slot")
            stopped_slot = first.slot
            first.process.send_signal(signal.SIGSTOP)
            written = len(first.lines)
            third = start("actor-2")
            eventually(lambda: third.slot == stopped_slot, "its slot is another's")
            first.process.send_signal(signal.SIGCONT)
            eventually(lambda: "none" in first.lines[written:], "it knows that it lost its slot")
            given_slot = second.slot
            second.process.send_signal(signal.SIGTERM)
            assert second.process.wait(PATIENCE_S) == 0
            eventually(lambda: first.slot == given_slot, "it has the slot that was given back")
            replay.process.kill()
            replay.wait()
        with Command(arguments, tmp_path) as replay:
            eventually(lambda: "serving" in replay.err, "replay is back")
            ended_s = time.monotonic() + lease_s  # of leases that the killed one granted
            eventually(
                lambda: time.monotonic() > ended_s and {first.slot, third.slot} == {0, 1},
                "both have a slot again",
            )
            fourth = start("actor-1")
            eventually(lambda: fourth.lines, "one more asks for a slot")
            free_slot = 1 - first.slot
            third.process.kill()
            eventually(lambda: fourth.slot == free_slot, "it has the slot of the one that died")
    finally:
        for holder in holders:
            holder.end()
        end_all(run)
    spans = sorted((s[2], s[0], s[1]) for holder in holders for s in holder.held())
    for (slot, _, ended), (next_slot, began, _) in pairwise(spans):
        assert slot != next_slot or ended < began, f"two held slot {slot} at once"
