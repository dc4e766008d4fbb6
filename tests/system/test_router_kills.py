"""A router that is killed and started again while many have joined it."""

import signal
from contextlib import ExitStack
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from tests.patience import PATIENCE_S, eventually
from tests.system.system_processes import Command, run_name

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]

PEERS = 50


def test_all_are_back_and_heard_after_a_kill(tmp_path: Path) -> None:
    """The router has no place for any of them twice."""
    keys, endpoint = Keys(run_name("router")), free_endpoint()
    config = TransportConfig(connect=(endpoint,))
    router = ["router", "--listen", endpoint, f"--transport.max_peers={PEERS + 1}"]
    names = {keys.live("actor", str(number)) for number in range(PEERS)}
    with ExitStack() as opened:
        killed = opened.enter_context(Command(router, tmp_path))
        watcher = opened.enter_context(Session(config, open_timeout_s=PATIENCE_S))
        presence = watcher.presence(keys.everyone())
        weights = watcher.publisher(keys.weights)
        followers = []
        for name in sorted(names):
            peer = opened.enter_context(Session(config, open_timeout_s=PATIENCE_S))
            peer.announce(name)
            followers.append(peer.latest_subscriber(keys.weights))
        eventually(lambda: presence.alive() == names, "all are there")
        killed.signal(signal.SIGKILL)
        eventually(lambda: not presence.alive(), "all are lost")
        opened.enter_context(Command(router, tmp_path))
        eventually(lambda: presence.alive() == names, "all are back")
        deaf = set(followers)

        def all_hear() -> bool:
            """A subscription may come back after the presence: publish more than once."""
            weights.put(b"newer")
            deaf.difference_update([follower for follower in deaf if follower.take()])
            return not deaf

        eventually(all_hear, "all hear of new weights", pause_s=0.5)
