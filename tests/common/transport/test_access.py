"""The access rules of configs/router.json5, with real sessions over TLS on loopback.

Each role tries everything, and exactly what its row allows comes through. The other side has a
router's certificate, with which all is allowed. What comes later on the same connection, a
question or an answer, shows that what did not come by then was refused.
"""

import datetime
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import DeadlineError, EndpointError
from mrcdrl.common.transport import Server, Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.tools.certificates import make
from tests.patience import PATIENCE_S

_STATISTICS_S = 0.04  # apart: twice what the router's file asks for
RUN = Keys("access")
ROLES = ("replay", "learner", "actor", "evaluator", "status", "viewer", "robot")
SERVED = {
    "config": RUN.config,
    "leases": RUN.leases,
    "insert": RUN.insert(),
    "sample": RUN.sample(),
    "priorities": RUN.priorities(),
    "weights": RUN.weights,
    "notice": RUN.weights_notice,
    "average": RUN.weights_average,
}
PUBLISHED = {
    "weights": RUN.weights,
    "notice": RUN.weights_notice,
    "episodes": RUN.episodes("w"),
    "evaluation": RUN.evaluation("w"),
    **{f"stats of {role}": RUN.stats(role, "w") for role in ROLES},
    **{f"arena of {role}": RUN.arena(role, "w") for role in ("actor", "evaluator")},
}
LIVE = {f"live {role}": RUN.live(role, "w") for role in ROLES}
CLAIMS = {role: RUN.claim(role, "w", "1") for role in ROLES}
CLAIMERS = {"replay", "learner", "actor", "evaluator"}


@dataclass(frozen=True)
class Row:
    """A role's permissions, by the names above; it may do nothing else."""

    put: tuple[str, ...] = ()
    follow: tuple[str, ...] = ()
    ask: tuple[str, ...] = ("config",)
    serve: tuple[str, ...] = ()
    announce: tuple[str, ...] = ()
    watch: tuple[str, ...] = ()


MAY = {
    "replay": Row(
        put=("stats of replay",),
        ask=(),
        serve=("config", "leases", "insert", "sample", "priorities"),
        announce=("live replay",),
    ),
    "learner": Row(
        put=("weights", "notice", "stats of learner"),
        ask=("config", "sample", "priorities"),
        serve=("weights", "notice", "average"),
        announce=("live learner",),
    ),
    "actor": Row(
        put=("episodes", "arena of actor", "stats of actor"),
        follow=("weights", "notice"),
        ask=("config", "leases", "insert", "weights", "notice", "average"),
        announce=("live actor",),
    ),
    "evaluator": Row(
        put=("evaluation", "arena of evaluator", "stats of evaluator"),
        follow=("weights", "notice"),
        ask=("config", "weights", "notice", "average"),
        announce=("live evaluator",),
    ),
    "status": Row(
        follow=("episodes", "evaluation", *(f"stats of {role}" for role in ROLES)),
        announce=("live status",),
        watch=tuple(LIVE),
    ),
    "viewer": Row(
        follow=(
            *("weights", "notice", "episodes", "evaluation"),
            *("arena of actor", "arena of evaluator"),
            *(f"stats of {role}" for role in ROLES),
        ),
        ask=("config", "weights", "notice", "average"),
        watch=tuple(LIVE),
    ),
    "robot": Row(follow=("weights", "notice"), ask=("config", "weights", "notice", "average")),
}


def transport(certificates: Path, role: str, **ends: tuple[str, ...]) -> TransportConfig:
    folder = certificates / role
    return TransportConfig(
        ca=str(folder / "ca.pem"),
        certificate=str(folder / "certificate.pem"),
        key=str(folder / "key.pem"),
        **ends,
    )


def tls_endpoint() -> str:
    return free_endpoint().replace("tcp/", "tls/")


@pytest.fixture(scope="module")
def endpoint(certificates: Path) -> Iterator[str]:
    """The endpoint of a router that all tests here share."""
    where = tls_endpoint()
    with Session(transport(certificates, "router", listen=(where,))):
        yield where


@pytest.fixture
def other(certificates: Path, endpoint: str) -> Iterator[Session]:
    with Session(transport(certificates, "router", connect=(endpoint,))) as session:
        yield session


@dataclass
class Pair:
    """A role's session, and the other side's."""

    role: str
    own: Session
    other: Session

    def __post_init__(self) -> None:
        if "config" in MAY[self.role].serve:
            self._server = self.own.server(RUN.config)
            self._client = self.other.client(RUN.config, self.role, PATIENCE_S)
        else:
            self._server = self.other.server(RUN.config)
            self._client = self.own.client(RUN.config, "the other side", PATIENCE_S)

    def settle(self) -> None:
        """Return when all that was sent on the connection before, either way, has been judged."""
        for _ in range(1000):
            pending = self._client.ask(b"")
            request = self._server.take(PATIENCE_S if self._settled else 0.1)
            if request is not None:
                request.reply(b"")
                assert pending.result() == b""
                self._settled = True
                return
        raise AssertionError("never joined")

    _settled = False


@pytest.fixture
def pair(
    request: pytest.FixtureRequest, certificates: Path, endpoint: str, other: Session
) -> Iterator[Pair]:
    role = request.param
    with Session(transport(certificates, role, connect=(endpoint,))) as own:
        joined = Pair(role, own, other)
        joined.settle()
        yield joined


every_role = pytest.mark.parametrize("pair", ROLES, indirect=True)


def came_through(names: dict[str, str], tried: Callable[[str], bool]) -> tuple[str, ...]:
    return tuple(name for name, key in names.items() if tried(key))


def published(sender: Session, receiver: Session, settle: Callable[[], None], key: str) -> bool:
    followed, publisher = receiver.queue_subscriber(key), sender.publisher(key)
    settle()  # the publisher knows by now who follows
    begun_s = time.monotonic()
    while "/stats/" in key and time.monotonic() - begun_s < _STATISTICS_S:
        settle()
    publisher.put(b"payload")
    settle()
    return followed.take(0.0) is not None


def answered(asker: Session, server: Server, settle: Callable[[], None], key: str) -> bool:
    settle()
    pending = asker.client(key, "the other", PATIENCE_S).ask(b"question")
    settle()
    request = server.take(0.0)
    if request is None:
        with pytest.raises(DeadlineError):
            pending.result()
        return False
    request.reply(b"answer")
    return bytes(pending.result()) == b"answer"


@every_role
def test_publishing(pair: Pair) -> None:
    came = came_through(PUBLISHED, lambda key: published(pair.own, pair.other, pair.settle, key))
    assert set(came) == set(MAY[pair.role].put)


@every_role
def test_following(pair: Pair) -> None:
    came = came_through(PUBLISHED, lambda key: published(pair.other, pair.own, pair.settle, key))
    assert set(came) == set(MAY[pair.role].follow)


@every_role
def test_asking(pair: Pair) -> None:
    asked = {name: key for name, key in SERVED.items() if name != "config"}
    came = came_through(
        asked, lambda key: answered(pair.own, pair.other.server(key), pair.settle, key)
    )
    assert {*came, "config"} == {*MAY[pair.role].ask, "config"}


@every_role
def test_serving(pair: Pair) -> None:
    served = {name: key for name, key in SERVED.items() if name != "config"}
    came = came_through(
        served, lambda key: answered(pair.other, pair.own.server(key), pair.settle, key)
    )
    assert set(came) == set(MAY[pair.role].serve) - {"config"}


@every_role
def test_being_there(pair: Pair) -> None:
    presence = pair.other.presence(RUN.everyone())
    for key in LIVE.values():
        pair.own.announce(key)
    pair.settle()
    assert presence.alive() == {LIVE[name] for name in MAY[pair.role].announce}


@every_role
def test_seeing_who_is_there(pair: Pair) -> None:
    for key in LIVE.values():
        pair.other.announce(key)
    seen = {name: pair.own.presence(RUN.everyone(name.removeprefix("live "))) for name in LIVE}
    everyone = pair.own.presence(RUN.everyone())
    pair.settle()
    pair.settle()
    assert {n for n, presence in seen.items() if presence.alive()} == set(MAY[pair.role].watch)
    assert everyone.alive() <= {LIVE[name] for name in MAY[pair.role].watch}


@every_role
def test_claiming_names_and_seeing_who_has_them(pair: Pair) -> None:
    for key in CLAIMS.values():
        pair.own.announce(key)
    pair.settle()
    held = pair.other.tokens(RUN.claim("*", "w", "*"))
    assert held == ({CLAIMS[pair.role]} if pair.role in CLAIMERS else set())
    assert pair.own.tokens(RUN.claim("*", "w", "*")) >= held
    pair.other.announce(RUN.claim("actor", "v", "2"))
    pair.settle()
    pair.settle()
    found = {RUN.claim("actor", "v", "2")} if pair.role in CLAIMERS else set()
    assert pair.own.tokens(RUN.claim("*", "v", "*")) == found


@pytest.mark.parametrize("pair", ["status"], indirect=True)
@pytest.mark.parametrize("key", ["mrcdrl/**", "mrcdrl/*/weights", "**", "mrcdrl/access/stats/**"])
def test_a_wider_key_reaches_no_further(pair: Pair, key: str) -> None:
    followed, publisher = pair.own.queue_subscriber(key), pair.other.publisher(RUN.weights)
    pair.settle()
    publisher.put(b"payload")
    pair.settle()
    assert followed.take(0.0) is None


@pytest.mark.parametrize("pair", ["actor"], indirect=True)
def test_a_statistic_too_large_is_dropped(pair: Pair) -> None:
    followed = pair.other.queue_subscriber(RUN.episodes("w"))
    publisher = pair.own.publisher(RUN.episodes("w"))
    pair.settle()
    publisher.put(bytes((1 << 20) + 1))
    publisher.put(bytes(1 << 20))
    pair.settle()
    assert [len(payload) for _, payload in followed.drain()] == [1 << 20]


@pytest.mark.parametrize("pair", ["actor"], indirect=True)
def test_statistics_too_often_are_dropped(pair: Pair) -> None:
    followed = pair.other.queue_subscriber(RUN.stats("actor", "w"))
    publisher = pair.own.publisher(RUN.stats("actor", "w"))
    pair.settle()
    for _ in range(1000):
        publisher.put(b"statistic")
    pair.settle()
    assert 1 <= len(list(followed.drain())) < 1000


@pytest.mark.parametrize("role", ["replay", "actor"])
def test_only_a_router_is_believed_to_be_one(certificates: Path, role: str) -> None:
    endpoint = tls_endpoint()
    with (
        Session(transport(certificates, role, listen=(endpoint,))),
        pytest.raises(EndpointError, match="nobody answers"),
    ):
        Session(transport(certificates, "actor", connect=(endpoint,)), open_timeout_s=0.0)


def test_a_certificate_of_no_role_may_do_nothing(
    certificates: Path, tmp_path: Path, endpoint: str, other: Session
) -> None:
    shutil.copytree(certificates / "ca", tmp_path / "ca")
    make(tmp_path, ["visitor"], ["localhost"], datetime.timedelta(days=1))
    server = other.server(RUN.config)
    with (
        Session(transport(tmp_path, "visitor", connect=(endpoint,))) as visitor,
        pytest.raises(DeadlineError),
    ):
        visitor.client(RUN.config, "the other side", 5.0).ask(b"").result()
    assert server.take(0.0) is None
