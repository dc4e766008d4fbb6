"""A process that joins a run is told in one line what is wrong with what the run serves."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.transport import Session, free_endpoint

JOINING = Joining("odd", "a", Path(), TransportConfig(), {})


@contextmanager
def serving(answers: Sequence[bytes]) -> Iterator[Session]:
    """Answer requests for the configuration by these in turn, the last one again and again."""
    ended, left = threading.Event(), list(answers)
    with Session(TransportConfig(listen=(free_endpoint(),))) as session:
        server = session.server(JOINING.keys.config)

        def serve() -> None:
            while not ended.is_set():
                request = server.take(0.1)
                if request is not None:
                    answer = left.pop(0) if len(left) > 1 else left[0]
                    (request.reply if answer else request.refuse)(answer or "no")  # type: ignore[operator]

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield session
        finally:
            ended.set()
            thread.join()


@pytest.mark.parametrize(
    "served", [b"\xff\xfe\x1b[31m", b"arena = \x1b[31m", b"[arena]\nnum_robots = 99\n"]
)
def test_what_is_no_configuration_is_said_in_one_printable_line(served: bytes) -> None:
    with serving([served]) as session, pytest.raises(MrcdrlError) as refused:
        fetch_config(session, JOINING, StopSignal(), timeout_s=0.5)
    assert str(refused.value).isprintable()


def test_who_answers_in_replays_place_keeps_nobody_from_joining() -> None:
    with serving([b"\xff", b"", b"[arena]\nnum_robots = 99\n", b"[run]\nseed = 7\n"]) as session:
        assert fetch_config(session, JOINING, StopSignal()).run.seed == 7
