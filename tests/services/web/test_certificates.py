"""With certificates: a viewer follows a run and its arenas, and browsers are let in by theirs."""

import http.client
import ssl
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig, load_config
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.web.access import _certificates, _token
from mrcdrl.services.web.flags import parser
from mrcdrl.services.web.server import Certificates
from tests.patience import PATIENCE_S, eventually
from tests.services.web.web_server import record_run, served

KEYS = Keys("secured")


def transport(certificates: Path, role: str, **ends: tuple[str, ...]) -> TransportConfig:
    folder = certificates / role
    return TransportConfig(
        ca=str(folder / "ca.pem"),
        certificate=str(folder / "certificate.pem"),
        key=str(folder / "key.pem"),
        **ends,
    )


def test_a_viewer_watches_an_arena_through_a_router_that_judges(certificates: Path) -> None:
    where = (free_endpoint().replace("tcp/", "tls/"),)
    with (
        Session(transport(certificates, "router", listen=where)),
        Session(transport(certificates, "actor", connect=where)) as actor,
        Session(transport(certificates, "viewer", connect=where)) as viewer,
    ):
        publisher = actor.watched_publisher(KEYS.arena("actor", "a"))
        waiting, withdraw = viewer.passing_subscriber(KEYS.arena("actor", "a"), 8, 1000)
        eventually(lambda: publisher.watched, "the actor knows that it is watched")
        publisher.put(b"frame")
        assert waiting.take(PATIENCE_S) == (KEYS.arena("actor", "a"), b"frame")
        withdraw()
        eventually(lambda: not publisher.watched, "nobody watches any more")


def test_a_secured_run_is_followed_as_a_viewer(certificates: Path, tmp_path: Path) -> None:
    where = (free_endpoint().replace("tcp/", "tls/"),)
    record_run(tmp_path / "secured", load_config("smoke", {}, environ={}))
    (tmp_path / "secured" / "endpoint").write_text(where[0], "ascii")
    with (
        Session(transport(certificates, "router", listen=where)),
        Session(transport(certificates, "learner", connect=where)) as learner,
        served(tmp_path, transport=transport(certificates, "viewer")) as server,
    ):
        learner.announce(KEYS.live("learner", "learner-0"))
        statistics = learner.publisher(KEYS.stats("learner", "learner-0"))
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
        connection.request("GET", "/api/runs/secured/live")
        answer = connection.getresponse()
        seen = b""
        while b'"loss": 0.75' not in seen:
            statistics.put(encode(Stats("learner", "learner-0", {"loss": 0.75})))
            (tmp_path / "secured" / "metrics.jsonl").touch()
            seen = answer.readline()
            assert b"ended" not in seen
        connection.close()


@pytest.fixture
def https(certificates: Path) -> Certificates:
    folder = certificates / "router"
    return Certificates(folder / "certificate.pem", folder / "key.pem", folder / "ca.pem")


def test_only_browsers_with_a_certificate_are_let_in(
    certificates: Path, https: Certificates, tmp_path: Path
) -> None:
    (tmp_path / "runs").mkdir()
    with served(tmp_path / "runs", certificates=https) as server:
        context = ssl.create_default_context(cafile=str(https.client_ca))

        def status() -> int:
            connection = http.client.HTTPSConnection(
                "localhost", server.port, timeout=PATIENCE_S, context=context
            )
            try:
                connection.request("GET", "/api/runs")
                return connection.getresponse().status
            finally:
                connection.close()

        with pytest.raises((ssl.SSLError, ConnectionError)):
            status()
        folder = certificates / "viewer"
        context.load_cert_chain(folder / "certificate.pem", folder / "key.pem")
        assert status() == 200


def test_certificates_of_browsers_stand_for_a_token(https: Certificates) -> None:
    words = ["--host", "0.0.0.0", "--https-certificate", str(https.certificate)]
    words += ["--https-key", str(https.key)]
    arguments = parser().parse_args(words)
    assert _token(arguments, _certificates(arguments)) is not None
    arguments = parser().parse_args([*words, "--https-client-ca", str(https.client_ca)])
    assert _certificates(arguments) == https
    assert _token(arguments, _certificates(arguments)) is None
