"""The access log: each refusal in Zenoh's trace, and nothing that only looks like one."""

import logging

import pytest

from mrcdrl.common.transport.access_log import AccessLogParser, _Repeats

MODULE = "zenoh::net::routing::interceptor::access_control"
ACTOR = "2ffa on Interface(lo)+CertCommonName(actor)+Transport(Tls)+2ffa"
KINDS = (
    "Query",
    "Reply",
    "Put",
    "Delete",
    "Declare/Undeclare Subscriber",
    "Declare/Undeclare Queryable",
    "Declare/Undeclare Liveliness Token",
    "Liveliness Query",
    "Declare Liveliness Subscriber",
)


def line(text: str, *, module: str = MODULE, level: str = "TRACE", thread: str = "rx-1") -> str:
    return (
        f"\x1b[2m2026-11-22T17:15:55.354229Z\x1b[0m \x1b[35m{level}\x1b[0m  {thread} ThreadId(09) "
        f"\x1b[2m{module}\x1b[0m\x1b[2m:\x1b[0m {text}\n"
    )


def caching(flow: str, key: str, thread: str = "rx-1") -> list[str]:
    """Zenoh's lines when it caches its decisions for a new key."""
    decisions = [f"{ACTOR} is unauthorized to {kind} ({flow}) on {key}" for kind in KINDS]
    lines = [f"ACL ({flow}): caching permissions for `{key}` ...", *decisions]
    return [line(text, thread=thread) for text in lines]


def read(*lines: str) -> list[str]:
    parser = AccessLogParser()
    return [message for one in lines if (message := parser.parse(one)) is not None]


def test_caching_permissions_refuses_nobody() -> None:
    assert (
        read(*caching("ingress", "mrcdrl/r/weights"), *caching("egress", "mrcdrl/r/weights")) == []
    )


def test_a_refusal_names_role_message_and_key() -> None:
    cached = "Using cached result: 2ffa is unauthorized to Put (ingress) on mrcdrl/r/weights"
    assert read(*caching("ingress", "mrcdrl/r/weights"), line(cached)) == [
        "refused actor: Put on mrcdrl/r/weights"
    ]


def test_a_refusal_without_a_cached_permission() -> None:
    text = f"{ACTOR} is unauthorized to Put (ingress) on mrcdrl/r/weights"
    assert read(line(text)) == ["refused actor: Put on mrcdrl/r/weights"]
    cached = caching("ingress", "mrcdrl/r/weights")
    assert read(*cached, line(text)) == ["refused actor: Put on mrcdrl/r/weights"]
    assert len(read(*cached[:4], line(text, thread="rx-0"))) == 1


def test_what_is_allowed_and_what_goes_out_is_not_a_refusal() -> None:
    assert (
        read(
            line(f"{ACTOR} is authorized to Put (ingress) on mrcdrl/r/episodes/a"),
            line("Using cached result: 2ffa is authorized to Put (ingress) on mrcdrl/r/episodes/a"),
            line("Using cached result: 2ffa is unauthorized to Put (egress) on mrcdrl/r/weights"),
        )
        == []
    )


def test_a_certificate_without_a_role() -> None:
    text = "2ffa did not match any configured ACL subject. Default permission `Deny` will be …"
    assert read(line(text, level="INFO")) == [
        "refused everything from 2ffa: its certificate has no role here"
    ]


def test_a_handshake_that_failed() -> None:
    text = "peer sent no certificates. Hint: increase the system open file limit."
    said = read(line(text, module="zenoh_link_tls::unicast", level="WARN"))
    assert said == ["refused a connection: peer sent no certificates."]


def test_other_warnings_are_passed_on() -> None:
    assert read(line("odd", module="zenoh::else", level="WARN")) == ["zenoh::else: odd"]
    assert read("not a log line\n", "\n") == ["not a log line"]


def test_repetitions_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    repeats = _Repeats()
    with caplog.at_level(logging.WARNING):
        for _ in range(1000):
            repeats.add("refused actor: Put on mrcdrl/r/weights")
        repeats.flush()
    assert [record.message for record in caplog.records] == [
        "refused actor: Put on mrcdrl/r/weights",
        "refused actor: Put on mrcdrl/r/weights (999 more times)",
    ]


def test_a_flood_of_kinds_does_not_flood_the_log(caplog: pytest.LogCaptureFixture) -> None:
    repeats = _Repeats()
    with caplog.at_level(logging.WARNING):
        for number in range(10_000):
            repeats.add(f"refused actor: Put on {number}")
        repeats.flush()
    assert len(caplog.records) <= 110
    assert "refused more requests, of other kinds (9899 more times)" in caplog.text
