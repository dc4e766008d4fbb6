"""Ways to hand new weights to many readers of one host, in turns: pushed, advanced, by notice.

    python -m benchmarks.weights_ways --readers 50 --rounds 3

`pushed` is a plain Zenoh publisher of the whole weights, `advanced` is zenoh.ext's advanced
publisher with a cache for late joiners and detection of what was missed, `notice` is what the
learner does. Each way hands over the same number of weights of the real size, one after another
as soon as all readers have the one before. Everything runs in one process. Prints a line of JSON
for each way and round: milliseconds, and those of a core, for each weights and reader.
"""

import argparse
import json
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import zenoh

from benchmarks.machine import emit
from mrcdrl.common.config import TransportConfig
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.sync.weights import WeightsReader, WeightsWriter
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys

_BYTES = 4_441_232  # of the paper's duel network in float32
_PUBLICATIONS = 5
_KEY = "mrcdrl/ways/whole"


class Counted:
    """Counts what came, and waits for it."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._came = 0

    def one(self, _sample: object = None) -> None:
        with self._changed:
            self._came += 1
            self._changed.notify_all()

    def wait(self, number: int) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._came >= number)


def pushed(endpoint: str, readers: int, owned: ExitStack, *, advanced: bool) -> Callable[[], None]:
    """Readers that subscribe to whole weights; returns what hands them over."""
    settings = zenoh.Config()
    settings.insert_json5("mode", '"client"')
    settings.insert_json5("connect/endpoints", json.dumps([endpoint]))
    counted, payload, given = Counted(), b"w" * _BYTES, 0

    def opened() -> zenoh.Session:
        session = zenoh.open(settings)
        owned.callback(session.close)
        return session

    kept: list[Any] = []
    for _ in range(readers):
        handler = zenoh.handlers.Callback(lambda s: counted.one(len(s.payload.to_bytes())))
        session = opened()
        if advanced:
            kept.append(zenoh.ext.declare_advanced_subscriber(session, _KEY, handler))
        else:
            kept.append(session.declare_subscriber(_KEY, handler))
    session = opened()
    block = zenoh.CongestionControl.BLOCK
    publisher: Any
    if advanced:
        publisher = zenoh.ext.declare_advanced_publisher(
            session,
            _KEY,
            congestion_control=block,
            cache=zenoh.ext.CacheConfig(max_samples=1),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(),
        )
    else:
        publisher = session.declare_publisher(_KEY, congestion_control=block)
    kept.append(publisher)
    time.sleep(1.0)  # until the router knows all

    def hand_over() -> None:
        nonlocal given
        given += readers
        publisher.put(payload)
        counted.wait(given)

    owned.callback(kept.clear)
    return hand_over


def by_notice(endpoint: str, readers: int, owned: ExitStack) -> Callable[[], None]:
    """Readers that follow notices; returns what hands weights over."""
    config, keys, version = TransportConfig(connect=(endpoint,)), Keys("ways"), 0
    following = [WeightsReader(owned.enter_context(Session(config)), keys) for _ in range(readers)]
    writer = WeightsWriter(owned.enter_context(Session(config)), keys)
    owned.callback(writer.close)
    time.sleep(1.0)

    def hand_over() -> None:
        nonlocal version
        version += 1
        writer.publish(Weights.of(1, version, version, b"w" * _BYTES))
        for reader in following:
            while reader.latest(1.0) is None:
                pass

    return hand_over


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--readers", type=int, default=50)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    ways: dict[str, Callable[[str, ExitStack], Callable[[], None]]] = {
        "pushed": lambda e, o: pushed(e, arguments.readers, o, advanced=False),
        "advanced": lambda e, o: pushed(e, arguments.readers, o, advanced=True),
        "notice": lambda e, o: by_notice(e, arguments.readers, o),
    }
    for number in range(arguments.rounds):
        for name, way in ways.items():
            with ExitStack() as owned:
                endpoint = free_endpoint()
                owned.enter_context(Session(TransportConfig(listen=(endpoint,))))
                hand_over = way(endpoint, owned)
                hand_over()
                began_s, cpu_s = time.monotonic(), time.process_time()
                for _ in range(_PUBLICATIONS):
                    hand_over()
                each = _PUBLICATIONS * arguments.readers
                emit(
                    {
                        "bench": "weights_ways",
                        "round": number,
                        "way": name,
                        "readers": arguments.readers,
                        "ms": 1000 * (time.monotonic() - began_s) / each,
                        "cpu_ms": 1000 * (time.process_time() - cpu_s) / each,
                    }
                )


if __name__ == "__main__":
    main()
