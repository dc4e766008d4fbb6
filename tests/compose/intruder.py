"""Attacks on a secured stack, from a container beside it with the image `certs`.

Invariant: the text of this file, run with the name of an attempt, exits with 0 only if the attempt
failed while a service that is allowed to do the same, if there is one, succeeded.
"""

import shutil
import socket
import ssl
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import DeadlineError, EndpointError, ThrottledError
from mrcdrl.common.messages.trajectory import SampleRequest
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.tools.certificates import make

HOST, PORT = "router", 7447
CERTIFICATES = Path("/certs")
KEYS = Keys("stack")
PATIENCE_S = 240.0  # less than those who wait for it have


def join(folder: Path, wait_s: float = PATIENCE_S, **other: str) -> Session:
    files = {name: str(folder / f"{name}.pem") for name in ("ca", "certificate", "key")}
    endpoint = f"tls/{HOST}:{PORT}"
    config = TransportConfig(connect=(endpoint,), timeout_s=5.0, **(files | other))
    return Session(config, open_timeout_s=wait_s)


@contextmanager
def refused(error: type[Exception], text: str = "") -> Iterator[None]:
    said = None
    try:
        yield
    except error as raised:
        said = str(raised)
    assert said is not None, "not refused"
    assert text in said, said


def without_a_certificate(_: Path) -> None:
    context = ssl.create_default_context(cafile=CERTIFICATES / "actor" / "ca.pem")
    with (
        socket.create_connection((HOST, PORT), timeout=PATIENCE_S) as plain,
        context.wrap_socket(plain, server_hostname=HOST) as wrapped,
        refused(ssl.SSLError, "CERTIFICATE_REQUIRED"),
    ):
        wrapped.recv(1)


def with_a_foreign_authority(folder: Path) -> None:
    make(folder, ["learner"], [HOST], timedelta(days=1))
    ca = str(CERTIFICATES / "learner" / "ca.pem")
    with refused(EndpointError, "does not accept this certificate"):
        join(folder / "learner", 0.0, ca=ca).close()


def in_no_role(folder: Path) -> None:
    shutil.copytree(CERTIFICATES / "ca", folder / "ca")
    make(folder, ["visitor"], [HOST], timedelta(days=1))
    with join(folder / "visitor") as visitor, refused(DeadlineError):
        visitor.client(KEYS.config, "replay").ask(b"").result()


def weights_as_an_actor(_: Path) -> None:
    with join(CERTIFICATES / "robot") as robot, join(CERTIFICATES / "actor") as actor:
        followed, forged = robot.queue_subscriber(KEYS.weights), actor.publisher(KEYS.weights)
        until_s, came = time.monotonic() + PATIENCE_S, None
        while came is None and time.monotonic() < until_s:
            forged.put(b"forged")
            came = followed.take(0.5)
        assert came is not None, "the learner's weights did not come"
        assert all(payload != b"forged" for _, payload in (came, *followed.drain()))


def samples_as_an_evaluator(_: Path) -> None:
    request = encode(SampleRequest(1))
    with join(CERTIFICATES / "learner") as learner, join(CERTIFICATES / "evaluator") as evaluator:
        allowed = learner.client(KEYS.sample(1), "replay")
        until_s, sampled = time.monotonic() + PATIENCE_S, False
        while not sampled and time.monotonic() < until_s:
            try:
                sampled = bool(allowed.ask(request).result())
            except (DeadlineError, ThrottledError):  # not joined yet, or ahead of the actors
                continue
        assert sampled, "the learner gets no samples"
        with refused(DeadlineError):
            evaluator.client(KEYS.sample(1), "replay").ask(request).result()


ATTEMPTS: dict[str, Callable[[Path], None]] = {
    attempt.__name__: attempt
    for attempt in (
        without_a_certificate,
        with_a_foreign_authority,
        in_no_role,
        weights_as_an_actor,
        samples_as_an_evaluator,
    )
}

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        ATTEMPTS[sys.argv[1]](Path(scratch))
