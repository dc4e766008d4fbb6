"""Checks of a run that is up: its endpoints, who is there, their clocks and versions."""

import re
import socket
import time
from collections.abc import Iterator, Mapping

from mrcdrl.common.config import Config, TransportConfig
from mrcdrl.common.errors import EndpointError, TransportError, WireError
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.versions import versions
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.transport import Presence, QueueSubscriber, Session
from mrcdrl.common.transport.keys import role_and_worker
from mrcdrl.services.tools.doctor.finding import Finding, failed, ok, warning

_TCP = re.compile(r"(?:tcp|tls)/\[?(?P<host>[^\]]+?)\]?:(?P<port>\d+)")
_REACH_S = 5.0
_LISTEN_S = 3.0  # every service speaks once a second
_CLOCKS_S = 1.0  # by which clocks may differ, messages' way included
_WRONG_S = 60.0
_NEEDED = ("replay", "actor", "learner")


def endpoints(transport: TransportConfig) -> Iterator[Finding]:
    """Whether each can be reached."""
    for endpoint in transport.connect:
        match = _TCP.match(endpoint)
        if match is None:
            yield ok("endpoint", f"{endpoint} is no TCP endpoint; see the session")
            continue
        try:
            socket.create_connection((match["host"], int(match["port"])), _REACH_S).close()
        except (OSError, OverflowError) as error:
            mend = "start the run, open the port, or give --connect its endpoint"
            yield failed("endpoint", f"{endpoint}: {error}", mend)
        else:
            yield ok("endpoint", f"{endpoint} can be reached")


def look(joining: Joining, stop: StopSignal) -> tuple[list[Finding], Config | None]:
    """Checks of the run, and its configuration where it could be had."""
    found = list(endpoints(joining.transport))
    try:
        session = Session(joining.transport, open_timeout_s=_REACH_S)
    except EndpointError as error:
        mend = "give --connect the endpoint at which the run's router or replay listens"
        return [*found, failed("session", str(error), mend)], None
    with session:
        presence = session.presence(joining.keys.everyone())
        heard = session.queue_subscriber(joining.keys.every_stats)
        try:
            config = fetch_config(session, joining, stop, timeout_s=_REACH_S)
        except TransportError as error:
            mend = "give --run its name; start `mrcdrl replay`, which serves the configuration"
            return [*found, failed("session", str(error), mend)], None
        found.append(ok("session", f"run {joining.run!r} answers with its configuration"))
        stats = listen(heard, _LISTEN_S)
    return [*found, *judged(stats, presence)], config


def listen(heard: QueueSubscriber, seconds: float) -> dict[str, tuple[Stats, float]]:
    """What each service said last, by its name, and by how much our clock is ahead of its."""
    until_s, said = time.monotonic() + seconds, dict[str, tuple[Stats, float]]()
    while (left_s := until_s - time.monotonic()) > 0:
        item = heard.take(left_s)
        if item is None:
            break
        try:
            stats = decode(Stats, item[1])
            ahead_s = (time.time_ns() - int(stats.text["clock_ns"])) / 1e9
        except (WireError, KeyError, ValueError):
            continue
        said[stats.id] = (stats, ahead_s)
    return said


def judged(said: Mapping[str, tuple[Stats, float]], presence: Presence) -> Iterator[Finding]:
    """All that is judged by what services say."""
    there = [role_and_worker(key) for key in presence.alive()]
    yield services([role for role, _ in there], [name for _, name in there if name not in said])
    yield clocks({name: ahead_s for name, (_, ahead_s) in said.items()})
    yield same_versions({name: stats.text for name, (stats, _) in said.items()}, versions())


def services(roles: list[str], silent: list[str]) -> Finding:
    """roles: of all that are there. silent: the names of those that said nothing."""
    counts = {role: roles.count(role) for role in dict.fromkeys((*_NEEDED, *sorted(roles)))}
    said = ", ".join(f"{count} {role}" for role, count in counts.items())
    missing = [role for role in _NEEDED if not counts[role]]
    if missing:
        mend = f"start `mrcdrl {missing[0]}`: the others wait for it"
        return warning("services", said, mend)
    return ok("services", said + (f"; silent: {', '.join(sorted(silent))}" if silent else ""))


def clocks(ahead_s: Mapping[str, float]) -> Finding:
    """ahead_s: seconds that this machine's clock is ahead of a service's."""
    check = "clocks"
    if not ahead_s:
        return warning(check, "no service said its time", "wait until services are up")
    name = max(ahead_s, key=lambda name: abs(ahead_s[name]))
    said = f"{name}'s and this machine's differ by {abs(ahead_s[name]):.1f} s"
    mend = "set both clocks (NTP): starts of learners and actors are ordered by them"
    if abs(ahead_s[name]) > _WRONG_S:
        return failed(check, said, mend)
    if abs(ahead_s[name]) > _CLOCKS_S:
        return warning(check, said, mend)
    return ok(check, f"all within {_CLOCKS_S:g} s of this machine's")


def same_versions(theirs: Mapping[str, Mapping[str, str]], ours: Mapping[str, str]) -> Finding:
    """theirs: of each service, by package."""
    check = "versions of the run"
    other = [
        f"{name} has {package} {text[package]}"
        for name, text in sorted(theirs.items())
        for package in ("mrcdrl", "zenoh")
        if text.get(package, ours.get(package)) != ours.get(package)
    ]
    if other:
        here = f"mrcdrl {ours.get('mrcdrl')}, zenoh {ours.get('zenoh')}"
        said = f"{', '.join(other)}; here are {here}"
        return warning(check, said, "install the same mrcdrl and eclipse-zenoh everywhere")
    return ok(check, f"mrcdrl {ours.get('mrcdrl')} and zenoh {ours.get('zenoh')} everywhere")
