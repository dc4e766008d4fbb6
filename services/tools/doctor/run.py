"""Checks of a run that is up: endpoints, services, their clocks and versions."""

import re
import socket
import time
from collections.abc import Iterator, Mapping

from mrcdrl.common.config import Config, TransportConfig
from mrcdrl.common.errors import EndpointError, TransportError, WireError
from mrcdrl.common.messages.checks import MAX_REPORT_BYTES
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.common.messages.wire import decode_published
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.versions import versions
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.transport import Presence, QueueSubscriber, Session
from mrcdrl.common.transport.keys import role_and_worker
from mrcdrl.services.tools.doctor.finding import Finding, failed, ok, warning

_TCP = re.compile(r"(?:tcp|tls)/\[?(?P<host>[^\]]+?)\]?:(?P<port>\d+)")
_REACH_S = 5.0
_LISTEN_S = 3.0  # every service publishes statistics once a second
_CLOCKS_S = 1.0  # tolerated difference between clocks, message latency included
_WRONG_S = 60.0
_NEEDED = ("replay", "actor", "learner")


def endpoints(transport: TransportConfig) -> Iterator[Finding]:
    """Check that each endpoint can be reached."""
    for endpoint in transport.connect:
        match = _TCP.match(endpoint)
        if match is None:
            yield ok("endpoint", f"{endpoint} is not a TCP endpoint; see the session")
            continue
        try:
            socket.create_connection((match["host"], int(match["port"])), _REACH_S).close()
        except (OSError, OverflowError) as error:
            fix = "start the run, open the port, or give the right endpoint to --connect"
            yield failed("endpoint", f"{endpoint}: {error}", fix)
        else:
            yield ok("endpoint", f"{endpoint} can be reached")


def look(joining: Joining, stop: StopSignal) -> tuple[list[Finding], Config | None]:
    """Check the run; also return its configuration, or None if it did not answer."""
    found = list(endpoints(joining.transport))
    try:
        session = Session(joining.transport, open_timeout_s=_REACH_S)
    except EndpointError as error:
        fix = "give --connect the endpoint that the run's router or replay listens on"
        return [*found, failed("session", str(error), fix)], None
    with session:
        presence = session.presence(joining.keys.everyone())
        heard = session.queue_subscriber(
            joining.keys.every_stats, max_message_bytes=MAX_REPORT_BYTES
        )
        try:
            config = fetch_config(session, joining, stop, timeout_s=_REACH_S)
        except TransportError as error:
            fix = "check the name; start `mrcdrl replay`, which serves the configuration"
            return [*found, failed("session", str(error), fix)], None
        found.append(ok("session", f"run {joining.run!r} answers with its configuration"))
        stats = listen(heard, _LISTEN_S)
    return [*found, *findings(stats, presence)], config


def listen(heard: QueueSubscriber, seconds: float) -> dict[str, tuple[Stats, float]]:
    """Each service's last statistics, and the seconds that our clock is ahead of its; by name."""
    until_s, last = time.monotonic() + seconds, dict[str, tuple[Stats, float]]()
    while (left_s := until_s - time.monotonic()) > 0:
        item = heard.take(left_s)
        if item is None:
            break
        try:
            stats = decode_published(Stats, *item)
            ahead_s = (time.time_ns() - int(stats.text["clock_ns"])) / 1e9
        except (WireError, KeyError, ValueError):
            continue
        last[stats.id] = (stats, ahead_s)
    return last


def findings(last: Mapping[str, tuple[Stats, float]], presence: Presence) -> Iterator[Finding]:
    """Check the services that are up by their last statistics."""
    alive = [role_and_worker(key) for key in presence.alive()]
    last = {name: heard for name, heard in last.items() if (heard[0].role, name) in alive}
    yield services([role for role, _ in alive], [name for _, name in alive if name not in last])
    refused = {name: stats.metrics.get("weights_refused", 0.0) for name, (stats, _) in last.items()}
    yield weights(refused)
    yield clocks({name: ahead_s for name, (_, ahead_s) in last.items()})
    yield same_versions({name: stats.text for name, (stats, _) in last.items()}, versions())


def services(roles: list[str], silent: list[str]) -> Finding:
    """Check that the run is complete.

    roles: of all services that are up. silent: names of those without statistics.
    """
    counts = {role: roles.count(role) for role in dict.fromkeys((*_NEEDED, *sorted(roles)))}
    said = ", ".join(f"{count} {role}" for role, count in counts.items())
    missing = [role for role in _NEEDED if not counts[role]]
    if missing:
        fix = f"start `mrcdrl {missing[0]}`: the others wait for it"
        return warning("services", said, fix)
    return ok("services", said + (f"; silent: {', '.join(sorted(silent))}" if silent else ""))


def weights(refused: Mapping[str, float]) -> Finding:
    """Check that weights are adopted. refused: messages with weights, by the service's name."""
    check = "weights"
    name = max(refused, key=lambda name: refused[name], default="")
    if not name or not refused[name]:
        return ok(check, "none refused")
    fix = "its log says why; a peer that is not this run's learner may publish under its name"
    return warning(check, f"{name} has refused {refused[name]:.0f}", fix)


def clocks(ahead_s: Mapping[str, float]) -> Finding:
    """Compare clocks. ahead_s: seconds that this machine's is ahead of each service's."""
    check = "clocks"
    if not ahead_s:
        return warning(check, "no service has sent its time", "wait until services are up")
    name = max(ahead_s, key=lambda name: abs(ahead_s[name]))
    said = f"those of {name} and this machine differ by {abs(ahead_s[name]):.1f} s"
    fix = "set both clocks (NTP): they order the starts of learners and actors"
    if abs(ahead_s[name]) > _WRONG_S:
        return failed(check, said, fix)
    if abs(ahead_s[name]) > _CLOCKS_S:
        return warning(check, said, fix)
    return ok(check, f"all within {_CLOCKS_S:g} s of this machine's")


def same_versions(theirs: Mapping[str, Mapping[str, str]], ours: Mapping[str, str]) -> Finding:
    """Compare versions. theirs: by service, then by package. ours: by package."""
    check = "versions of the run"
    other = [
        f"{name} has {package} {text[package]}"
        for name, text in sorted(theirs.items())
        for package in ("mrcdrl", "zenoh")
        if text.get(package, ours.get(package)) != ours.get(package)
    ]
    if other:
        here = f"mrcdrl {ours.get('mrcdrl')}, zenoh {ours.get('zenoh')}"
        said = f"{', '.join(other)}; this machine has {here}"
        return warning(check, said, "install the same mrcdrl and eclipse-zenoh everywhere")
    return ok(check, f"mrcdrl {ours.get('mrcdrl')} and zenoh {ours.get('zenoh')} everywhere")
