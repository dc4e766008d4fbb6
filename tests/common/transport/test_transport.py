"""Real Zenoh sessions on loopback: every wait ends, every queue behaves as stated when full."""

import logging
import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from itertools import repeat
from pathlib import Path

import pytest
import zenoh

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import (
    ConfigError,
    DeadlineError,
    EndpointError,
    RefusedError,
    ThrottledError,
    UnreachableError,
    WireError,
)
from mrcdrl.common.messages.trajectory import Weights, WeightsNotice
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.claim import claim_name
from mrcdrl.common.sync.weights import WeightsReader, WeightsWriter
from mrcdrl.common.transport import (
    ROUTER_FILE,
    Client,
    PendingReply,
    Priority,
    Publisher,
    Request,
    Server,
    Session,
    free_endpoint,
)
from mrcdrl.common.transport.keys import Keys
from mrcdrl.common.transport.publications import QueueSubscriber
from tests.patience import PATIENCE_S, eventually

KEY = "mrcdrl/test/query"
KEYS = Keys("test")


class Network:
    """Opens sessions of one router."""

    def __init__(self, endpoint: str, max_message_bytes: int) -> None:
        self.endpoint = endpoint
        self._max_bytes = max_message_bytes
        self._sessions: list[Session] = []

    def join(self, *, shared_memory: bool = True) -> Session:
        config = TransportConfig(
            connect=(self.endpoint,),
            max_message_bytes=self._max_bytes,
            timeout_s=PATIENCE_S,
            shared_memory=shared_memory,
        )
        session = Session(config)
        self._sessions.append(session)
        return session

    def pair(self, *, capacity: int = 256, timeout_s: float = PATIENCE_S) -> tuple[Server, Client]:
        """A server, and a client that reaches it already."""
        self.server_session, session = self.join(), self.join()
        server = self.server_session.server(KEY, capacity)
        until_served(session, KEY, server)
        return server, session.client(KEY, "the peer", timeout_s)

    def close(self) -> None:
        for session in reversed(self._sessions):
            session.close()


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    """The endpoint of a router that all tests here share."""
    endpoint = free_endpoint()
    with Session(TransportConfig(listen=(endpoint,))):
        yield endpoint


@pytest.fixture
def network(router: str) -> Iterator[Network]:
    opened = Network(router, 1 << 20)
    yield opened
    opened.close()


@pytest.fixture
def small_network(router: str) -> Iterator[Network]:
    opened = Network(router, 1000)
    yield opened
    opened.close()


def until_served(session: Session, key: str, server: Server) -> None:
    """Wait until queries of the session reach the server: declarations travel, too."""
    probe = session.client(key, "the server")
    deadline = time.monotonic() + PATIENCE_S
    while True:
        probe.ask(b"probe")
        request = server.take(0.2)
        if request is not None:
            break
        assert time.monotonic() < deadline, "no query arrived"
    while request is not None:  # those that were late
        request.reply(b"")
        request = server.take(0.1)


def answer_next(server: Server, answer: str, text: str) -> bytes:
    """Take one request, answer it by `reply`, `refuse` or `throttle`, and return its payload."""
    request = server.take(PATIENCE_S)
    assert request is not None
    if answer == "reply":
        request.reply(text.encode())
    elif answer == "refuse":
        request.refuse(text)
    else:
        request.throttle(text)
    return request.payload


def test_a_query_is_answered_across_the_router(network: Network) -> None:
    server, client = network.pair()
    with ThreadPoolExecutor(1) as other:
        taken = other.submit(answer_next, server, "reply", "back")
        assert client.ask(b"there").result() == b"back"
        assert taken.result() == b"there"


def test_several_queries_may_be_in_flight(network: Network) -> None:
    server, client = network.pair()
    pending = [client.ask(str(number).encode()) for number in range(5)]
    requests = [server.take(PATIENCE_S) for _ in pending]
    for request in reversed(requests):
        assert request is not None
        request.reply(request.payload * 2)
    assert [reply.result() for reply in pending] == [b"00", b"11", b"22", b"33", b"44"]


def test_a_refusal_brings_its_reason(network: Network) -> None:
    server, client = network.pair()
    with ThreadPoolExecutor(1) as other:
        other.submit(answer_next, server, "refuse", "wrong arena")
        with pytest.raises(RefusedError, match=r"^the peer refused: wrong arena$") as refused:
            client.ask(b"").result()
    assert not isinstance(refused.value, ThrottledError)


def test_a_throttled_request_differs_from_a_refused_one(network: Network) -> None:
    server, client = network.pair()
    with ThreadPoolExecutor(1) as other:
        other.submit(answer_next, server, "throttle", "not yet")
        with pytest.raises(ThrottledError, match=r"^not yet$"):
            client.ask(b"").result()


def test_where_nobody_serves_the_answer_is_at_once_a_deadline_error(network: Network) -> None:
    client = network.join().client(KEY, "the peer", timeout_s=10 * PATIENCE_S)
    before = time.monotonic()
    with pytest.raises(DeadlineError, match="no answer from the peer"):
        client.ask(b"").result()
    assert time.monotonic() - before < PATIENCE_S


def test_a_silent_peer_is_given_up_at_the_timeout(network: Network) -> None:
    server, client = network.pair(timeout_s=0.3)
    before = time.monotonic()
    pending = client.ask(b"")
    request = server.take(PATIENCE_S)
    assert request is not None
    with pytest.raises(DeadlineError, match="no answer from the peer in time"):
        pending.result()
    assert 0.2 < time.monotonic() - before < PATIENCE_S
    request.reply(b"too late")  # disturbs nobody


def test_a_peer_that_leaves_is_given_up(network: Network) -> None:
    server, client = network.pair(timeout_s=2.0)
    pending = client.ask(b"")
    request = server.take(PATIENCE_S)
    assert request is not None
    network.server_session.close()
    with pytest.raises(DeadlineError, match="no answer from the peer"):
        pending.result()


def test_a_request_that_is_too_large_is_refused(small_network: Network) -> None:
    server, client = small_network.pair()
    with pytest.raises(RefusedError, match="1001 bytes exceed the limit of 1000"):
        client.ask(b"x" * 1001).result()
    assert server.refused == 1
    assert server.take(0.01) is None


def test_an_answer_that_is_too_large_is_refused(small_network: Network) -> None:
    server, client = small_network.pair()
    with ThreadPoolExecutor(1) as other:
        other.submit(answer_next, server, "reply", "x" * 1001)
        with pytest.raises(RefusedError, match="the answer of the peer exceeds 1000 bytes"):
            client.ask(b"").result()


def asked_of_two(network: Network) -> tuple[Client, PendingReply, Request, Request]:
    """A client, its request to two servers of one key, and the request as each has it.

    The servers call themselves incomplete, so that Zenoh asks both wherever they are. It also asks
    a complete one in the router beside a complete one elsewhere.
    """
    servers = Server(KEY, 1 << 20, 256), Server(KEY, 1 << 20, 256)
    session = network.join()
    for server in servers:
        handler = zenoh.handlers.Callback(server.offer, indirect=False)
        network.join()._session.declare_queryable(KEY, handler)
        until_served(session, KEY, server)
    while servers[0].take(0.1) is not None:  # what `until_served` asked
        pass
    client = session.client(KEY, "the peer")
    pending = client.ask(b"")
    one, other = (server.take(PATIENCE_S) for server in servers)
    assert one is not None
    assert other is not None
    return client, pending, one, other


def test_of_two_answers_the_first_counts_and_the_other_is_told(
    network: Network, caplog: pytest.LogCaptureFixture
) -> None:
    client, pending, one, other = asked_of_two(network)
    one.reply(b"one")
    assert pending.result() == b"one"
    assert client.others == 0
    other.reply(b"other")
    eventually(lambda: client.others == 1)
    assert pending.result() == b"one"
    with caplog.at_level(logging.WARNING, "transport"):
        for _ in range(3):
            client.ask(b"")
    assert len(caplog.messages) == 1
    assert "another process answers for the peer, too (1 answers so far)" in caplog.text


def test_an_answer_that_cannot_be_read_does_not_hide_one_that_can(network: Network) -> None:
    client, pending, one, other = asked_of_two(network)
    one.reply(b"\xc1lz4" + bytes(8))
    with pytest.raises(WireError):
        pending.result()
    other.reply(b"other")
    eventually(lambda: client.others == 1)
    assert pending.result() == b"other"


def test_a_reply_carries_the_servers_own_key(network: Network) -> None:
    server, _ = network.pair()
    session = network.join()
    replies = session._session.get(KEY.replace("test", "*"))
    answer_next(server, "reply", "mine")
    assert [str(reply.ok.key_expr) for reply in replies] == [KEY]


def test_what_a_peer_says_in_words_is_printable_and_bounded(network: Network) -> None:
    server, client = network.pair()
    for text in ("\x1b[2J\r\nfine\x9b", "held: \x1b[31m", "far: \x07", "x" * 10**6):
        with ThreadPoolExecutor(1) as asking:
            answer = asking.submit(lambda: client.ask(b"").result())
            answer_next(server, "refuse", text)
            with pytest.raises(RefusedError) as refused:
                answer.result()
        assert str(refused.value).isprintable()
        assert len(str(refused.value)) < 400


def test_an_attachment_that_is_no_text_disturbs_nobody(network: Network) -> None:
    session, key = network.join(), f"{KEY}/odd"

    def answer(query: zenoh.Query) -> None:
        query.reply(key, b"whole", attachment=b"\xff\x1b\xfe")
        query.drop()

    handler = zenoh.handlers.Callback(answer, indirect=False)
    queryable = session._session.declare_queryable(key, handler, complete=True)
    client = network.join().client(key, "the peer")
    eventually(lambda: answers(client, b"whole"))
    queryable.undeclare()


def answers(client: Client, payload: bytes) -> bool:
    try:
        return client.ask(b"").result() == payload
    except DeadlineError:
        return False


def test_a_full_server_throttles_further_requests(network: Network) -> None:
    server, client = network.pair(capacity=1)
    first = client.ask(b"first")
    with pytest.raises(ThrottledError, match="1 requests are waiting"):
        client.ask(b"second").result()
    assert (server.throttled, server.refused) == (1, 0)
    assert answer_next(server, "reply", "done") == b"first"
    assert first.result() == b"done"


def test_large_requests_that_wait_are_limited_to_four_of_the_largest(
    small_network: Network,
) -> None:
    server = small_network.join().server(KEY)
    client = small_network.join().client(KEY, "the peer")
    waiting = [client.ask(b"x" * 900) for _ in range(4)]
    with pytest.raises(ThrottledError, match="4 requests are waiting"):
        client.ask(b"x" * 900).result()
    for request in waiting:
        answer_next(server, "reply", "done")
        assert request.result() == b"done"
    last = client.ask(b"x" * 900)
    answer_next(server, "reply", "done")
    assert last.result() == b"done"


def payload_of(item: tuple[str, bytes] | None) -> bytes | None:
    return None if item is None else item[1]


def until_known(publisher: Publisher, take: Callable[[float], bytes | None]) -> None:
    """Publish until the subscription is known over there: what is put before is lost."""
    while take(0.1) is None:
        publisher.put(b"early")
    publisher.put(b"known")
    while take(PATIENCE_S) != b"known":
        pass


def test_the_latest_subscriber_keeps_the_newest_only(network: Network) -> None:
    session, other = network.join(), network.join()
    subscriber = session.latest_subscriber(KEY)
    marks = session.queue_subscriber("mrcdrl/test/mark")
    publisher, marker = other.publisher(KEY), other.publisher("mrcdrl/test/mark")
    until_known(publisher, subscriber.take)
    until_known(marker, lambda timeout_s: payload_of(marks.take(timeout_s)))
    for number in range(100):
        publisher.put(str(number).encode())
    marker.put(b"end")
    while marks.take(PATIENCE_S) != ("mrcdrl/test/mark", b"end"):  # then all before it have come
        pass
    assert subscriber.take() == b"99"
    assert subscriber.take() is None
    assert subscriber.take(0.01) is None


def test_the_queue_keeps_the_order_and_counts_what_it_drops(network: Network) -> None:
    subscriber = network.join().queue_subscriber("mrcdrl/test/queue/*", capacity=10)
    session = network.join()
    publisher = session.publisher("mrcdrl/test/queue/a")
    until_known(publisher, lambda timeout_s: payload_of(subscriber.take(timeout_s)))
    for number in range(25):
        publisher.put(bytes([number]))
    eventually(lambda: subscriber.dropped == 15)
    assert list(subscriber.drain()) == [("mrcdrl/test/queue/a", bytes([n])) for n in range(10)]
    publisher.put(b"later")
    assert subscriber.take(PATIENCE_S) == ("mrcdrl/test/queue/a", b"later")
    assert subscriber.take(0.0) is None
    assert subscriber.take(0.01) is None


class Arriving(bytes):
    """A publication as Zenoh hands it over."""

    key_expr = KEY

    @property
    def payload(self) -> "Arriving":
        return self

    def to_bytes(self) -> bytes:
        return bytes(self)


def test_what_arrives_while_a_queue_is_drained_waits_for_the_next_time() -> None:
    """A peer that floods keeps nobody who reads from other work."""
    waiting = QueueSubscriber(100, capacity=10)
    waiting.offer(Arriving(b"first"))
    taken = []
    for item in waiting.drain():
        taken.append(item)
        waiting.offer(Arriving(b"more"))
    assert taken == [(KEY, b"first")]
    assert waiting.take(0.0) == (KEY, b"more")


def test_a_publication_that_is_too_large_is_counted_and_dropped(small_network: Network) -> None:
    latest = small_network.join().latest_subscriber(KEY)
    waiting = small_network.join().queue_subscriber(KEY)
    publisher = small_network.join().publisher(KEY)
    until_known(publisher, latest.take)
    until_known(publisher, lambda timeout_s: payload_of(waiting.take(timeout_s)))
    publisher.put(b"ready")
    while waiting.take(PATIENCE_S) != (KEY, b"ready"):
        pass
    publisher.put(b"x" * 1001)
    publisher.put(b"x" * 1000)
    assert waiting.take(PATIENCE_S) == (KEY, b"x" * 1000)
    eventually(lambda: latest.take(0.1) == b"x" * 1000)
    assert (waiting.dropped, latest.oversized) == (1, 1)


def test_presence_sees_tokens_held_already_new_ones_and_those_given_up(network: Network) -> None:
    first, second = KEYS.live("actor", "actor-0"), KEYS.live("actor", "actor-1")
    network.join().announce(first)
    presence = network.join().presence(KEYS.everyone("actor"))
    eventually(lambda: presence.alive() == {first})
    leaver = network.join()
    leaver.announce(second)
    network.join().announce(KEYS.live("learner", "learner-0"))
    eventually(lambda: presence.alive() == {first, second})
    leaver.close()
    eventually(lambda: presence.alive() == {first})
    assert list(presence.changes()) == []


def weights(epoch: int, version: int) -> Weights:
    return Weights.of(epoch, version, learner_step=10 * version, payload=b"p" * 100)


@pytest.fixture
def writer(network: Network) -> Iterator[WeightsWriter]:
    opened = WeightsWriter(network.join(), KEYS)
    yield opened
    opened.close()


def test_who_joins_late_gets_the_newest_weights_without_another_publication(
    network: Network, writer: WeightsWriter
) -> None:
    for version in range(3):
        writer.publish(weights(0, version))
    reader = WeightsReader(network.join(), KEYS)
    assert reader.wait(StopSignal()) == weights(0, 2)


def test_weights_are_announced_as_often_as_those_who_ask_for_them_allow(network: Network) -> None:
    """What one reader of another host took is spent nearly never; the end waits for nobody."""
    far = network.join(shared_memory=False)
    reader = WeightsReader(far, KEYS)
    follower = network.join().latest_subscriber(KEYS.weights_notice)
    until_known(network.join().publisher(KEYS.weights_notice), follower.take)
    with closing(WeightsWriter(network.join(), KEYS, bytes_per_s=0.01)) as writer:
        writer.publish(weights(0, 1))
        assert version_of(follower.take(PATIENCE_S)) == 1
        assert reader.wait(StopSignal()) == weights(0, 1)
        writer.publish(weights(0, 2))
        assert follower.take(0.5) is None
        assert WeightsReader(network.join(), KEYS).wait(StopSignal()) == weights(0, 1)
    assert version_of(follower.take(PATIENCE_S)) == 2


def version_of(notice: bytes | None) -> int:
    assert notice is not None
    return decode(WeightsNotice, notice).version


def test_readers_of_the_learners_host_cost_its_link_nothing(network: Network) -> None:
    with closing(WeightsWriter(network.join(), KEYS, bytes_per_s=0.01)) as writer:
        reader = WeightsReader(network.join(), KEYS)
        writer.publish(weights(0, 1))
        assert reader.wait(StopSignal()) == weights(0, 1)
        for version in range(2, 5):
            writer.publish(weights(0, version))
            assert reader.latest(PATIENCE_S) == weights(0, version)


@pytest.mark.parametrize("shared_memory", [True, False])
def test_averages_are_got_by_those_who_ask_for_them(
    network: Network, writer: WeightsWriter, *, shared_memory: bool
) -> None:
    """Where there are none, they get what all get."""
    session = network.join(shared_memory=shared_memory)
    tester, actor = WeightsReader(session, KEYS, averages=True), WeightsReader(session, KEYS)
    for version in range(1, 4):
        average = Weights.of(0, version, 10 * version, b"a" * 100) if version < 3 else None
        writer.publish(weights(0, version), average)
        for reader, expected in ((tester, average), (actor, None)):
            found = reader.wait(StopSignal()) if version == 1 else reader.latest(PATIENCE_S)
            assert found == (expected or weights(0, version))


def test_whoever_subscribes_to_weights_in_full_gets_them(network: Network) -> None:
    follower = network.join().latest_subscriber(KEYS.weights)
    with closing(WeightsWriter(network.join(), KEYS)) as writer:
        eventually(lambda: writer._whole.watched)
        writer.publish(weights(0, 1))
        assert follower.take(PATIENCE_S) == encode(weights(0, 1))


@pytest.mark.parametrize("shared_memory", [True, False])
def test_readers_follow_wherever_they_are(network: Network, *, shared_memory: bool) -> None:
    with closing(WeightsWriter(network.join(), KEYS)) as writer:
        reader = WeightsReader(network.join(shared_memory=shared_memory), KEYS)
        for version in range(5):
            writer.publish(weights(0, version))
            found = reader.wait(StopSignal()) if version == 0 else reader.latest(PATIENCE_S)
            assert found == weights(0, version)


def test_who_waits_gets_the_first_weights(network: Network, writer: WeightsWriter) -> None:
    reader = WeightsReader(network.join(), KEYS)
    with ThreadPoolExecutor(1) as other:
        waiting = other.submit(reader.wait, StopSignal())
        writer.publish(weights(0, 0))
        assert waiting.result(PATIENCE_S) == weights(0, 0)


def test_waiting_for_weights_ends_when_stopped(network: Network) -> None:
    reader, stop = WeightsReader(network.join(), KEYS), StopSignal()
    with ThreadPoolExecutor(1) as other:
        waiting = other.submit(reader.wait, stop)
        stop.set()
        assert waiting.result(PATIENCE_S) is None


@pytest.mark.parametrize("older", [weights(1, 4), weights(1, 5), weights(0, 9)])
def test_weights_never_go_back(network: Network, writer: WeightsWriter, older: Weights) -> None:
    reader = WeightsReader(network.join(), KEYS)
    writer.publish(weights(1, 5))
    assert reader.wait(StopSignal()) == weights(1, 5)
    reader.latest(0.2)  # its notice, by the subscription
    writer.publish(older)
    assert reader.latest(0.2) is None
    writer.publish(weights(2, 0))
    assert reader.latest(PATIENCE_S) == weights(2, 0)


def test_foreign_weights_are_counted_and_dropped(network: Network, writer: WeightsWriter) -> None:
    reader = WeightsReader(network.join(), KEYS)
    publisher = network.join().publisher(KEYS.weights_notice)
    publisher.put(b"nonsense")
    eventually(lambda: reader.latest(0.1) is None and reader.refused == 1)
    writer.publish(weights(0, 1))
    assert reader.latest(PATIENCE_S) == weights(0, 1)


def test_a_port_in_use_is_one_line(network: Network) -> None:
    with pytest.raises(EndpointError, match=r"cannot listen on tcp/127.0.0.1:.* in use") as refused:
        Session(TransportConfig(listen=(network.endpoint,)))
    assert "\n" not in str(refused.value)


def test_nobody_at_the_endpoint_is_one_line() -> None:
    endpoint = free_endpoint()
    with pytest.raises(EndpointError, match=f"nobody answers at {endpoint}") as refused:
        Session(TransportConfig(connect=(endpoint,)), open_timeout_s=0.0)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("side", "endpoint"),
    [
        ("listen", "nonsense"),
        ("listen", "tcp/127.0.0.1"),
        ("listen", "carrier-pigeon/1:2"),
        ("connect", "nonsense"),
    ],
)
def test_an_endpoint_that_is_none_is_refused(side: str, endpoint: str) -> None:
    with pytest.raises(EndpointError, match=endpoint):
        Session(TransportConfig.model_validate({side: (endpoint,)}), open_timeout_s=0.0)


class Deaf:
    """A TCP relay to a router, through which its first clients are let in and then never heard."""

    def __init__(self, endpoint: str, clients: int) -> None:
        self._to = endpoint.removeprefix("tcp/").rsplit(":", 1)
        self._left = clients
        self._sockets: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._serve(self._accept)

    def close(self) -> None:
        for each in (self._listener, *self._sockets):
            with suppress(OSError):  # ends who accepts, or receives
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        while True:
            client, _ = self._listener.accept()
            router = socket.create_connection((self._to[0], int(self._to[1])))
            self._sockets += [client, router]
            heard = 2 if self._left > 0 else None  # the two messages by which a client joins
            self._left -= 1
            self._serve(lambda a=client, b=router, n=heard: self._pass_on(a, b, n))
            self._serve(lambda a=router, b=client: self._pass_on(a, b, None))

    def _pass_on(self, source: socket.socket, sink: socket.socket, messages: int | None) -> None:
        while data := source.recv(1 << 16):
            if messages is None or messages > 0:
                sink.sendall(data)
            messages = None if messages is None else messages - 1
        sink.shutdown(socket.SHUT_RDWR)

    def _serve(self, work: Callable[[], None]) -> None:
        def quietly() -> None:
            with suppress(OSError):
                work()

        threading.Thread(target=quietly, daemon=True).start()


def test_a_session_that_is_let_in_and_not_heard_is_opened_again(network: Network) -> None:
    follower = network.join().latest_subscriber(KEY)
    with closing(Deaf(network.endpoint, clients=2)) as relay:
        config = TransportConfig(connect=(relay.endpoint,), timeout_s=1.0)
        with Session(config, open_timeout_s=PATIENCE_S) as session:
            until_known(session.publisher(KEY), follower.take)


def test_without_an_endpoint_nothing_is_opened() -> None:
    with pytest.raises(EndpointError, match="give --connect or --listen"):
        Session(TransportConfig())


def test_the_with_block_leaves_neither_session_nor_thread_nor_port() -> None:
    before = set(threading.enumerate())
    endpoint = free_endpoint()
    with (
        Session(TransportConfig(listen=(endpoint,))) as router,
        Session(TransportConfig(connect=(endpoint,))) as peer,
    ):
        assert "open" in repr(router)
        router.server(KEY)
        router.latest_subscriber(KEY)
        peer.queue_subscriber(KEY)
        peer.publisher(KEY).put(b"x")
        peer.presence(KEYS.everyone())
        peer.announce(KEYS.live("actor", "a"))
        writer = WeightsWriter(peer, KEYS)
        writer.close()
    assert "closed" in repr(router)
    assert "closed" in repr(peer)
    router.close()  # again is harmless
    assert set(threading.enumerate()) <= before
    host, port = endpoint.removeprefix("tcp/").split(":")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((host, int(port)), timeout=PATIENCE_S)


def test_a_session_that_zenoh_cannot_close_in_time_ends_without_an_error() -> None:
    class Slow:
        def is_closed(self) -> bool:
            return False

        def close(self) -> None:
            raise zenoh.ZError("timeout")

    with Session(TransportConfig(listen=(free_endpoint(),))) as session:
        real, session._session = session._session, Slow()  # type: ignore[assignment]
    real.close()  # type: ignore[no-untyped-call]


def test_a_free_endpoint_is_free() -> None:
    with Session(TransportConfig(listen=(free_endpoint(),))) as session:
        assert "open" in repr(session)


def test_a_router_is_of_use_before_the_one_it_links_to_and_links_again_to_each_that_comes() -> None:
    near, far = free_endpoint(), free_endpoint()
    with (
        Session(TransportConfig(listen=(near,), connect=(far,))),
        Session(TransportConfig(connect=(near,))) as serving,
        Session(TransportConfig(connect=(near,))) as neighbour,
    ):
        server = serving.server(KEY)
        until_served(neighbour, KEY, server)
        for _ in range(2):
            with (
                Session(TransportConfig(listen=(far,))),
                Session(TransportConfig(connect=(far,))) as distant,
            ):
                until_served(distant, KEY, server)


@pytest.mark.parametrize("endpoint", ["tcp", "127.0.0.1:7447", "tcp/", ""])
def test_a_malformed_endpoint_is_refused_at_once(endpoint: str) -> None:
    with pytest.raises(EndpointError, match="is not an endpoint"):
        Session(TransportConfig(connect=(endpoint,)))


def test_an_encrypted_endpoint_needs_certificates() -> None:
    with pytest.raises(EndpointError, match=r"needs transport\.ca, transport\.certificate and"):
        Session(TransportConfig(connect=("tls/127.0.0.1:7447",)), open_timeout_s=0.0)


@pytest.mark.parametrize("side", ["listen", "connect"])
def test_who_has_certificates_speaks_in_the_clear_to_nobody(certificates: Path, side: str) -> None:
    files = {"ca": "ca.pem", "certificate": "certificate.pem", "key": "key.pem"}
    given = {name: str(certificates / "router" / file) for name, file in files.items()}
    config = TransportConfig.model_validate({side: ("tcp/127.0.0.1:7447",), **given})
    with pytest.raises(EndpointError, match=r"is not encrypted, .* write tls/127\.0\.0\.1:7447"):
        Session(config, open_timeout_s=0.0)


def test_a_certificate_that_is_not_there_is_named(certificates: Path) -> None:
    config = TransportConfig(
        connect=("tls/127.0.0.1:7447",),
        ca=str(certificates / "actor" / "ca.pem"),
        certificate=str(certificates / "actor" / "certificate.pem"),
        key=str(certificates / "nobody" / "key.pem"),
    )
    with pytest.raises(EndpointError, match=r"transport\.key .*nobody.*: No such file"):
        Session(config, open_timeout_s=0.0)


@pytest.mark.parametrize(
    ("host", "level", "said"),
    [
        ("127.0.0.1", "INFO", "from this machine only"),
        ("0.0.0.0", "WARNING", "anyone who can reach it"),
    ],
)
def test_who_listens_in_the_clear_says_so(
    caplog: pytest.LogCaptureFixture, host: str, level: str, said: str
) -> None:
    endpoint = free_endpoint().replace("127.0.0.1", host)
    with caplog.at_level("INFO"), Session(TransportConfig(listen=(endpoint,))):
        [record] = [r for r in caplog.records if r.name == "transport"]
    assert record.levelname == level
    assert said in record.message


def test_a_router_listens_where_its_file_says(tmp_path: Path) -> None:
    endpoint, file = free_endpoint(), tmp_path / "router.json5"
    file.write_text(ROUTER_FILE.read_text().replace("tcp/127.0.0.1:7447", endpoint))
    with (
        Session(TransportConfig(), router_file=file),
        Session(TransportConfig(connect=(endpoint,)), open_timeout_s=PATIENCE_S) as peer,
    ):
        assert "open" in repr(peer)


@pytest.mark.parametrize(
    ("accept_timeout", "max_peers", "silent"),
    [
        ("900000", 2000, 300),  # there are places enough
        ("5000", 10, 30),  # or they are free again soon
    ],
)
def test_silent_connections_keep_nobody_out(
    accept_timeout: str, max_peers: int, silent: int, tmp_path: Path
) -> None:
    file, endpoint = tmp_path / "router.json5", free_endpoint()
    written, given = ROUTER_FILE.read_text("utf-8"), "accept_timeout: 20000"
    assert given in written
    file.write_text(written.replace(given, f"accept_timeout: {accept_timeout}"), "utf-8")
    host, port = endpoint.removeprefix("tcp/").split(":")
    listening = TransportConfig(listen=(endpoint,), max_peers=max_peers)
    with Session(listening, router_file=file), ExitStack() as opened:
        for _ in range(silent):
            opened.enter_context(socket.create_connection((host, int(port)), timeout=PATIENCE_S))
        with Session(TransportConfig(connect=(endpoint,)), open_timeout_s=PATIENCE_S) as peer:
            assert "open" in repr(peer)


class GatedLink:
    """Passes one connection on to an endpoint; on the way back, as many bytes as are allowed."""

    def __init__(self, endpoint: str, allowed: float = math.inf) -> None:
        host, port = endpoint.removeprefix("tcp/").split(":")
        self._far, self._left = (host, int(port)), allowed
        self._changed = threading.Condition()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listening.getsockname()[1]}"
        self.passed = 0  # bytes, on the way back
        threading.Thread(target=self._run, daemon=True).start()

    def allow(self, octets: float) -> None:
        """Let so many more bytes pass."""
        with self._changed:
            self._left += octets
            self._changed.notify_all()

    def shut(self, after: int) -> None:
        """Let only so many more bytes pass."""
        with self._changed:
            self._left = after

    @property
    def is_shut(self) -> bool:
        return self._left == 0

    def close(self) -> None:
        self.allow(math.inf)
        self._listening.close()

    def _run(self) -> None:
        near, _ = self._listening.accept()
        far = socket.create_connection(self._far)
        threading.Thread(target=self._pass_on, args=(near, far), daemon=True).start()
        self._pass_back(far, near)

    def _pass_on(self, near: socket.socket, far: socket.socket) -> None:
        with near, far, suppress(OSError):
            while data := near.recv(1 << 16):
                far.sendall(data)

    def _pass_back(self, far: socket.socket, near: socket.socket) -> None:
        with near, far, suppress(OSError):
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._left > 0)
                    most = int(min(self._left, 1 << 14))
                if not (data := far.recv(most)):
                    return
                with self._changed:
                    self._left -= len(data)
                    self.passed += len(data)
                near.sendall(data)


def test_an_acknowledgement_overtakes_weights_on_one_session(tmp_path: Path) -> None:
    """Only half of the weights can pass, and yet it comes."""
    endpoint, file, half = free_endpoint(), tmp_path / "router.json5", 16 << 20
    patient = ROUTER_FILE.read_text("utf-8").replace("_close: 5000000", "_close: 900000000")
    file.write_text(patient, "utf-8")
    config = TransportConfig(connect=(endpoint,), timeout_s=PATIENCE_S)
    with (
        Session(TransportConfig(listen=(endpoint,)), router_file=file) as router,
        Session(config) as learner,
        closing(GatedLink(endpoint)) as link,
        Session(config.model_copy(update={"connect": (link.endpoint,)})) as actor,
        ThreadPoolExecutor(2) as others,
    ):
        server, weights = router.server(KEY), learner.publisher(KEYS.weights, Priority.LOW)
        client, latest = actor.client(KEY, "replay"), actor.latest_subscriber(KEYS.weights)
        until_served(actor, KEY, server)

        def arrived() -> bytes | None:
            weights.put(b"small")
            return latest.take(0.1)

        eventually(arrived, "the subscription has reached the learner")
        link.shut(after=1 << 16)
        published = others.submit(weights.put, bytes(2 * half))
        eventually(lambda: link.is_shut, "weights are on the way")
        pending = client.ask(b"chunk")
        answer_next(server, "reply", "stored")
        link.allow(half)
        assert pending.result() == b"stored"
        link.allow(math.inf)
        published.result()
        eventually(lambda: len(latest.take(0.1) or b"") == 2 * half)


def test_an_actor_hears_nothing_of_another_that_joins() -> None:
    endpoint = free_endpoint()
    config, stop = TransportConfig(connect=(endpoint,)), StopSignal()

    def join(session: Session, name: str) -> None:
        claim_name(session, KEYS, "actor", name, stop)
        session.announce(KEYS.live("actor", name))
        session.publisher(KEYS.stats("actor", name))
        session.watched_publisher(KEYS.arena("actor", name))
        session.client(KEYS.insert(), "replay")
        WeightsReader(session, KEYS)

    with Session(TransportConfig(listen=(endpoint,))) as router, ExitStack() as opened:
        router.server(KEYS.insert())
        presence = router.presence(KEYS.everyone())
        link = opened.enter_context(closing(GatedLink(endpoint)))
        actor = opened.enter_context(Session(TransportConfig(connect=(link.endpoint,))))
        join(actor, "first")
        eventually(lambda: len(presence.alive()) == 1)
        before = link.passed
        for number in range(20):
            join(opened.enter_context(Session(config)), f"other-{number}")
        eventually(lambda: len(presence.alive()) == 21)
        # A token's key alone has 25 bytes; what may come in the meantime is to keep the link alive.
        assert link.passed - before < 20 * 25


def test_a_full_router_says_so_and_lets_in_who_waits(caplog: pytest.LogCaptureFixture) -> None:
    endpoint = free_endpoint()
    config = TransportConfig(connect=(endpoint,))
    with Session(TransportConfig(listen=(endpoint,), max_peers=2)), Session(config):
        leaver = Session(config)
        with pytest.raises(UnreachableError, match=f"{endpoint} .*all places .*max_peers.* taken"):
            Session(config, open_timeout_s=0.0)
        eventually(lambda: "2 peers have joined, as many as transport.max_peers" in caplog.text)
        with ThreadPoolExecutor(1) as other:
            waiting = other.submit(Session, config, open_timeout_s=PATIENCE_S)
            eventually(lambda: "it is not a router; trying again" in caplog.text)
            assert not waiting.done()
            leaver.close()
            with waiting.result(PATIENCE_S) as late:
                assert "open" in repr(late)


def test_all_come_back_to_a_router_that_was_restarted() -> None:
    endpoint, peers = free_endpoint(), 50
    config = TransportConfig(connect=(endpoint,))
    listening = TransportConfig(listen=(endpoint,), max_peers=peers + 1)
    router = Session(listening)
    with ExitStack() as opened:
        keys = {KEYS.live("actor", str(number)) for number in range(peers)}
        for key in keys:
            opened.enter_context(Session(config)).announce(key)
        router.close()
        with Session(listening), Session(config, open_timeout_s=PATIENCE_S) as watcher:
            presence = watcher.presence(KEYS.everyone("actor"))
            eventually(lambda: presence.alive() == keys, "all have announced themselves again")


def test_a_lost_session_takes_no_second_place(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has long enough to come back before its successor joins."""
    endpoint = free_endpoint()
    config = TransportConfig(connect=(endpoint,))
    listening = TransportConfig(listen=(endpoint,), max_peers=2)
    monkeypatch.setattr("mrcdrl.common.transport.session.random_pauses", lambda: repeat(2.5))
    router = Session(listening)
    with Session(config) as one:
        one.announce(KEYS.live("actor", "a"))
        router.close()
        caplog.clear()
        with Session(listening) as restarted:
            presence = restarted.presence(KEYS.everyone())
            eventually(lambda: presence.alive(), "it has announced itself again")
            assert "2 peers have joined" not in caplog.text


@pytest.mark.parametrize("content", ["{mode: ", '{mode: "wanderer"}', "{nonsense: 1}"])
def test_a_bad_router_file_is_one_line(tmp_path: Path, content: str) -> None:
    file = tmp_path / "router.json5"
    file.write_text(content)
    with pytest.raises(ConfigError, match=r"router\.json5") as refused:
        Session(TransportConfig(), router_file=file)
    assert "\n" not in str(refused.value)
    with pytest.raises(ConfigError, match="No such file"):
        Session(TransportConfig(), router_file=tmp_path / "none.json5")


def test_a_linked_router_waits_for_the_other() -> None:
    """Started in either order, they link."""
    first, second = free_endpoint(), free_endpoint()
    with Session(TransportConfig(listen=(second,), connect=(first,))) as router:
        server = router.server(KEY)
        with (
            Session(TransportConfig(listen=(first,))),
            Session(TransportConfig(connect=(first,))) as peer,
        ):
            until_served(peer, KEY, server)


def test_a_client_whose_link_was_lost_goes_on_as_another() -> None:
    """Everything is declared again, while a router may still clear away the old link."""
    endpoint = free_endpoint()
    router = Session(TransportConfig(listen=(endpoint,)))
    config = TransportConfig(connect=(endpoint,), timeout_s=PATIENCE_S)
    with Session(config) as one, Session(config) as other:
        server, client = one.server(KEY), other.client(KEY, "the peer")
        latest, queue = one.latest_subscriber("test/latest"), one.queue_subscriber("test/queue")
        publishers = other.publisher("test/latest"), other.publisher("test/queue")
        one.announce(KEYS.live("actor", "a"))
        presence = other.presence(KEYS.everyone())
        until_served(other, KEY, server)
        identities = one._session.zid(), other._session.zid()
        router.close()
        with Session(TransportConfig(listen=(endpoint,))):
            eventually(lambda: (one._session.zid(), other._session.zid()) != identities)
            until_served(other, KEY, server)
            assert one._session.zid() != identities[0]
            assert other._session.zid() != identities[1]
            pending = client.ask(b"question")
            assert answer_next(server, "reply", "answer") == b"question"
            assert pending.result() == b"answer"
            for publisher, subscriber in zip(publishers, (latest, queue), strict=True):
                publisher.put(b"news")
                assert subscriber.take(PATIENCE_S) is not None
            eventually(lambda: KEYS.live("actor", "a") in presence.alive())


def renewing() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name == "renew"}


def test_closing_waits_for_no_router_and_joins_the_thread_that_renews() -> None:
    endpoint, others = free_endpoint(), renewing()
    router = Session(TransportConfig(listen=(endpoint,)))
    assert renewing() == others  # a router has nothing to renew
    session = Session(TransportConfig(connect=(endpoint,)))
    session.server(KEY)
    assert len(renewing() - others) == 1
    router.close()  # the session now tries to connect again
    began_s = time.monotonic()
    session.close()
    assert time.monotonic() - began_s < PATIENCE_S
    assert "closed" in repr(session)
    assert renewing() == others


def test_a_renewed_session_leaves_no_thread_either() -> None:
    endpoint, others = free_endpoint(), renewing()
    router = Session(TransportConfig(listen=(endpoint,)))
    with Session(TransportConfig(connect=(endpoint,))) as session:
        session.server(KEY)
        for _ in range(2):
            identity = session._session.zid()
            router.close()
            router = Session(TransportConfig(listen=(endpoint,)))
            eventually(lambda lost=identity: session._session.zid() != lost)
            assert len(renewing() - others) == 1
    router.close()
    assert renewing() == others


def test_a_session_that_cannot_declare_everything_is_replaced_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    endpoint, config = free_endpoint(), TransportConfig(timeout_s=PATIENCE_S)
    router = Session(config.model_copy(update={"listen": (endpoint,)}))
    with (
        Session(config.model_copy(update={"connect": (endpoint,)})) as one,
        Session(config.model_copy(update={"connect": (endpoint,)})) as other,
    ):
        server = one.server(KEY)
        [declaration] = one._declarations
        declare, failures = declaration.make, [1, 1]

        def fail_twice(session: zenoh.Session) -> object:
            if failures:
                failures.pop()
                raise zenoh.ZError("the link is lost")
            return declare(session)

        monkeypatch.setattr(declaration, "make", fail_twice)
        router.close()
        with Session(config.model_copy(update={"listen": (endpoint,)})):
            eventually(lambda: not failures, "it is replaced")
            until_served(other, KEY, server)
