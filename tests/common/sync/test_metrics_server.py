"""The server of metrics: it holds nobody up, whoever asks and however."""

import http.client
import logging
import socket
import threading
import time
from collections.abc import Iterator

import pytest
from prometheus_client import CollectorRegistry, Gauge
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from mrcdrl.common.config import TransportConfig, load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.sync.metrics_server import MAX_CONNECTIONS, MetricsServer, serve_registry
from tests.patience import PATIENCE_S, eventually


class Counting(Collector):
    """Counts how often it is collected; fails if told to."""

    def __init__(self) -> None:
        self.collected = 0
        self.error: Exception | None = None

    def collect(self) -> Iterator[Metric]:
        self.collected += 1
        if self.error:
            raise self.error
        metric = Metric("given", "What is given.", "gauge")
        metric.add_sample("given", {}, 3.0)
        yield metric

    def describe(self) -> Iterator[Metric]:
        return iter(())


@pytest.fixture
def counting() -> Counting:
    return Counting()


@pytest.fixture
def server(counting: Counting) -> Iterator[MetricsServer]:
    registry = CollectorRegistry()
    registry.register(counting)
    with MetricsServer(registry, "127.0.0.1", 0, "actor") as made:
        yield made


def port(server: MetricsServer) -> int:
    return int(server.address.rsplit(":", 1)[1].split("/")[0])


def get(server: MetricsServer, path: str = "/metrics", host: str | None = None) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port(server), timeout=PATIENCE_S)
    try:
        connection.request("GET", path, headers={} if host is None else {"Host": host})
        response = connection.getresponse()
        return response.status, response.read().decode()
    finally:
        connection.close()


def handlers() -> list[threading.Thread]:
    """Threads that answer a client."""
    return [thread for thread in threading.enumerate() if "process_request" in thread.name]


def test_it_serves_metrics_and_nothing_else(server: MetricsServer) -> None:
    status, text = get(server)
    assert status == 200
    assert text.splitlines()[-1] == "given 3.0"
    assert get(server, "/etc/passwd")[0] == 404
    assert get(server, "/metrics/../config.toml")[0] == 404


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost:9464", 200),
        ("127.0.0.1", 200),
        ("[::1]:9464", 200),
        ("evil.example:9464", 403),
        ("localhost.evil.example", 403),
        ("", 403),
    ],
)
def test_on_loopback_other_names_are_refused(server: MetricsServer, host: str, status: int) -> None:
    assert get(server, host=host)[0] == status


def test_it_collects_once_a_second_however_often_it_is_asked(
    server: MetricsServer, counting: Counting
) -> None:
    began = time.monotonic()
    for _ in range(20):
        assert get(server)[0] == 200
    assert 1 <= counting.collected <= 1 + time.monotonic() - began


def test_what_cannot_be_collected_is_said_once(
    server: MetricsServer, counting: Counting, caplog: pytest.LogCaptureFixture
) -> None:
    counting.error = RuntimeError("no figures")
    assert [get(server)[0] for _ in range(3)] == [500] * 3
    assert [r.getMessage() for r in caplog.records] == [
        "metrics cannot be collected: RuntimeError('no figures')"
    ]
    counting.error = None
    assert get(server)[0] == 200


def test_a_port_in_use_is_one_warning_and_no_end(caplog: pytest.LogCaptureFixture) -> None:
    worked = False
    with socket.create_server(("127.0.0.1", 0)) as taken:
        config = TransportConfig(metrics_port=taken.getsockname()[1])
        with serve_registry(config, "learner", CollectorRegistry):
            worked = True
    assert worked
    (record,) = caplog.records
    assert (record.levelno, record.name) == (logging.WARNING, "learner")
    assert "transport.metrics_port" in record.getMessage()


def test_it_is_off_by_default() -> None:
    before = threading.active_count()

    def refuse() -> CollectorRegistry:
        raise AssertionError("nobody asked for metrics")

    with serve_registry(TransportConfig(), "actor", refuse):
        assert threading.active_count() == before


def test_slow_clients_hold_up_neither_others_nor_the_end() -> None:
    registry = CollectorRegistry()
    Gauge("given", "What is given.", registry=registry)
    server = MetricsServer(registry, "127.0.0.1", 0, "actor")
    slow = [
        socket.create_connection(("127.0.0.1", port(server)), PATIENCE_S)
        for _ in range(3 * MAX_CONNECTIONS)
    ]
    try:
        for connection in slow:
            connection.sendall(b"GET /met")  # and never the rest
        assert get(server)[0] == 200
        eventually(lambda: len(handlers()) <= MAX_CONNECTIONS)
        server.close()
        eventually(lambda: not handlers())
    finally:
        for connection in slow:
            connection.close()


@pytest.mark.parametrize(
    "words", ["POST /metrics HTTP/1.1", "nonsense", "\x00\xff", "GET " + "/" * 70000]
)
def test_odd_requests_end_nothing(server: MetricsServer, words: str) -> None:
    with socket.create_connection(("127.0.0.1", port(server)), PATIENCE_S) as odd:
        odd.sendall(words.encode() + b"\r\n\r\n")
        while odd.recv(4096):
            pass
    assert get(server)[0] == 200


def test_an_address_is_an_ip_address() -> None:
    with pytest.raises(ConfigError, match=r"metrics_address.*'localhost' is not an IP address"):
        load_config("quick", {"transport.metrics_address": "localhost"}, environ={})


def test_it_serves_over_ipv6() -> None:
    try:
        server = MetricsServer(CollectorRegistry(), "::1", 0, "actor")
    except OSError as error:
        pytest.skip(f"NO IPV6 HERE: {error}")
    with server:
        assert server.address.startswith("http://[::1]:")
