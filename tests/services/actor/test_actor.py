"""Which weights an actor acts by, and what it tells of those that it refuses."""

from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

from mrcdrl.common.config import TransportConfig, load_config
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.joining import Joining
from mrcdrl.services.actor.actor import Actor
from mrcdrl.services.actor.lease import ALONE
from tests.common.sync.test_weights import Wire

SMALL = {"arena.view_px": "32", "actor.num_arenas": "1", "learner.precision": "float32"}
CONFIG = load_config("smoke", SMALL, environ={})


class ActorsWire(Wire):
    """A session of an actor, which publishes to nobody."""

    def publisher(self, _key: str) -> MagicMock:
        return MagicMock()


def actor_on(wire: Wire) -> Actor:
    sender: Any = MagicMock(chunks=0, transitions=0, spooled=0)
    lease: Any = MagicMock(rank=ALONE, slot=0)
    joining = Joining("acted", "a", Path(), TransportConfig(), {})
    return Actor(CONFIG, joining, wire, sender, lease)  # type: ignore[arg-type]


def weights(epoch: int, version: int, view_px: int = 32) -> bytes:
    network = QNetwork(CONFIG.agent.kind, view_px=view_px)
    return encode(Weights.of(epoch, version, 10 * version, weights_to_bytes(network)))


def test_refused_weights_are_counted_and_do_not_block_good_ones() -> None:
    wire = ActorsWire()
    actor = actor_on(wire)

    def hears(epoch: int, version: int, whole: bytes) -> None:
        wire.says(whole, epoch, version)
        for _ in range(3):  # it notices, asks, and looks for the answer
            actor._adopt_newer()

    for version in (1, 2):
        hears(2, version, weights(2, version, view_px=40))
        wire.noticed = b"five!"
        actor._adopt_newer()
        hears(1, version, weights(1, version))
        found = actor._metrics()
        assert (found.weights_version, found.weights_refused) == (version, 2 * version)


def test_it_collects_nothing_before_it_has_adopted_weights() -> None:
    wire, stop = ActorsWire(), StopSignal()
    actor = actor_on(wire)
    collected = actor._collector.step = MagicMock(return_value=([], []))  # type: ignore[method-assign]
    wire.says(weights(2, 10**6, view_px=40), 2, 10**6)
    asked = 0

    def report() -> None:
        nonlocal asked
        asked += 1
        if asked == 3:
            stop.set()

    actor._report = report  # type: ignore[method-assign]
    actor.run(stop)
    assert collected.call_count == 0
    assert actor._metrics().weights_refused >= 1
