"""A run whose processes speak over TLS, each in its role, through `mrcdrl router`.

Who has no certificate, or plays another's role, is refused, and the router's log says so.
"""

import json
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import DeadlineError, EndpointError
from mrcdrl.common.runtime.heartbeat import FILE_VARIABLE, Pulse
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.tools.certificates import make
from tests.patience import eventually
from tests.system.system_processes import (
    PATIENCE_S,
    SMALL,
    Command,
    run_name,
    serves,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


def files(folder: Path) -> dict[str, str]:
    """What `folder` holds, as settings of [transport]."""
    return {name: str(folder / f"{name}.pem") for name in ("ca", "certificate", "key")}


def variables(folder: Path) -> dict[str, str]:
    return {f"MRCDRL_TRANSPORT__{name.upper()}": path for name, path in files(folder).items()}


@dataclass(frozen=True)
class Secured:
    """A router that is up."""

    process: Command
    endpoint: str
    certificates: Path

    def join(self, role: str, wait_s: float = PATIENCE_S, **other: str) -> Session:
        given = files(self.certificates / role) | other
        config = TransportConfig(connect=(self.endpoint,), timeout_s=PATIENCE_S, **given)
        return Session(config, open_timeout_s=wait_s)

    def says(self, text: str) -> None:
        eventually(lambda: text in self.process.err, f"the router's log says {text!r}")


@pytest.fixture(scope="module")
def secured(certificates: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secured]:
    folder = tmp_path_factory.mktemp("secured")
    endpoint = free_endpoint().replace("tcp/", "tls/")
    arguments = ["router", "--listen", endpoint]
    with Command(arguments, folder, **variables(certificates / "router")) as process:
        router = Secured(process, endpoint, certificates)
        router.says("listening on tls/")
        yield router


def test_without_a_certificate_nobody_is_let_in(secured: Secured) -> None:
    host, port = secured.endpoint.removeprefix("tls/").split(":")
    context = ssl.create_default_context(cafile=secured.certificates / "actor" / "ca.pem")
    with (
        socket.create_connection((host, int(port)), timeout=PATIENCE_S) as plain,
        context.wrap_socket(plain, server_hostname=host) as wrapped,
        pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"),
    ):
        wrapped.recv(1)
    secured.says("refused a connection: peer sent no certificates")


def test_a_certificate_of_another_authority_is_refused(secured: Secured, tmp_path: Path) -> None:
    make(tmp_path, ["learner"], ["localhost"], timedelta(days=1))
    foreign = files(tmp_path / "learner") | {"ca": files(secured.certificates / "learner")["ca"]}
    with pytest.raises(EndpointError, match="does not accept this certificate"):
        secured.join("learner", 0.0, **foreign)
    secured.says("refused a connection: invalid peer certificate")


def test_a_router_of_another_authority_is_not_trusted(secured: Secured, tmp_path: Path) -> None:
    make(tmp_path, ["learner"], ["localhost"], timedelta(days=1))
    with pytest.raises(EndpointError, match="nobody answers"):
        secured.join("learner", 0.0, ca=files(tmp_path / "learner")["ca"])


def test_an_actor_publishes_no_weights(secured: Secured) -> None:
    keys = Keys("forged")
    with (
        secured.join("robot") as robot,
        secured.join("actor") as actor,
        secured.join("learner") as learner,
    ):
        followed = robot.queue_subscriber(keys.weights)
        forged, real = actor.publisher(keys.weights), learner.publisher(keys.weights)
        came: list[bytes] = []

        def put(publisher: Callable[[], None], done: Callable[[], bool]) -> bool:
            publisher()
            came.extend(payload for _, payload in followed.drain())
            return done()

        refused = f"refused actor: Put on {keys.weights}"
        eventually(
            lambda: put(lambda: forged.put(b"forged"), lambda: refused in secured.process.err),
            "the router refuses the actor's weights",
        )
        eventually(
            lambda: put(lambda: real.put(b"real"), lambda: b"real" in came),
            "the learner's weights arrive",
        )
    assert set(came) == {b"real"}


@pytest.mark.parametrize("what", ["sample", "insert"])
def test_an_evaluator_neither_samples_nor_inserts(secured: Secured, what: str) -> None:
    keys = Keys("tried")
    key = {"sample": keys.sample(), "insert": keys.insert()}[what]
    other = {"sample": "learner", "insert": "actor"}[what]
    with (
        secured.join("replay") as replay,
        secured.join(other) as allowed,
        secured.join("evaluator") as evaluator,
    ):
        server = replay.server(key)

        def reached() -> bool:
            pending = allowed.client(key, "replay").ask(b"allowed")
            request = server.take(1.0)
            if request is not None:
                request.reply(b"answer")
            return request is not None and bytes(pending.result()) == b"answer"

        eventually(reached, f"the {other} reaches replay")
        with pytest.raises(DeadlineError):
            evaluator.client(key, "replay").ask(b"not allowed").result()
        secured.says(f"refused evaluator: Query on {key}")
        assert server.take(0.0) is None


def test_a_run_trains(secured: Secured, tmp_path: Path) -> None:
    name = run_name("secure")
    joining = ["--run", name, "--run-dir", tmp_path, "--connect", secured.endpoint]

    def command(role: str, *more: str) -> Command:
        folder = secured.certificates / role
        beats = {FILE_VARIABLE: str(tmp_path / f"{role}.heartbeat")}
        return Command([role, *joining, *more], tmp_path, **variables(folder), **beats)

    with ExitStack() as started:
        smoke = ("--config", "smoke", "--run.learner_steps", "0", *SMALL)
        replay = started.enter_context(command("replay", *smoke))
        serves(replay)
        learner = started.enter_context(command("learner"))
        others = [started.enter_context(command(role)) for role in ("actor", "evaluator")]
        watching = started.enter_context(command("status", "--watch", "--json"))

        def trained() -> bool:
            for process in (replay, learner, *others, watching):
                assert process.process.poll() is None, process.err
            lines = watching.out.splitlines()[:-1]
            said = json.loads(lines[-1]) if lines else {}
            there = {service["role"] for service in said.get("services", ()) if service["alive"]}
            return (
                there == {"replay", "learner", "actor", "evaluator"}
                and said["learner_steps"] >= 20
                and said["actor/" + _worker(said, "actor") + "/weights_version"] > 0
                and said["success_rate"] is not None
            )

        eventually(trained, "the run learns, acts by its weights and judges them")
        for role in ("replay", "learner", "actor", "evaluator"):
            beats = tmp_path / f"{role}.heartbeat"
            eventually(lambda: Pulse.read(beats).patience_s == 0, f"{role} has warmed up")  # noqa: B023
            assert Pulse.read(beats).problem(time.monotonic(), PATIENCE_S) is None
    assert f"mrcdrl/{name}" not in secured.process.err, "the router refused something of the run"


def _worker(said: dict[str, list[dict[str, str]]], role: str) -> str:
    return next(service["id"] for service in said["services"] if service["role"] == role)
