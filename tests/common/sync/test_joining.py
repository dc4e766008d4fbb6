"""A process that joins a run is told in one line what is wrong with what the run serves."""

import threading
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.transport import Session, free_endpoint


@pytest.mark.parametrize(
    "served", [b"\xff\xfe\x1b[31m", b"arena = \x1b[31m", b"[arena]\nnum_robots = 99\n"]
)
def test_what_is_no_configuration_is_said_in_one_printable_line(served: bytes) -> None:
    joining, ended = Joining("odd", "a", Path(), TransportConfig(), {}), threading.Event()
    with Session(TransportConfig(listen=(free_endpoint(),))) as session:
        server = session.server(joining.keys.config)

        def serve() -> None:
            while not ended.is_set():
                request = server.take(0.1)
                if request is not None:
                    request.reply(served)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            with pytest.raises(MrcdrlError) as refused:
                fetch_config(session, joining, StopSignal())
        finally:
            ended.set()
            thread.join()
    assert str(refused.value).isprintable()
