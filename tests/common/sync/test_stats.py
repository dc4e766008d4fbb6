"""Statistics while functions are compiled, which may hold up a service's main loop."""

import threading

import pytest
from numba.core import caching

from mrcdrl.common.messages.metrics import EvaluatorMetrics
from mrcdrl.common.messages.trajectory import COMPILING, DOING, Stats
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.runtime.compiled import compiled
from mrcdrl.common.sync.stats import StatsReporter
from mrcdrl.common.transport import Publisher


class Kept(Publisher):
    """Keeps what is published."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[Stats] = []

    def put(self, payload: bytes) -> None:
        self.messages.append(decode(Stats, payload))


def metrics() -> EvaluatorMetrics:
    return EvaluatorMetrics(evaluations=3, weights_version=7, weights_refused=0, busy=False)


@pytest.mark.parametrize("thread", ["main", "other"])
def test_that_a_service_compiles_is_published_when_it_begins(
    thread: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])

    def third(number: float) -> float:
        return number / 3

    third.__module__ = "mrcdrl.somewhere"
    publisher = Kept()
    reporter = StatsReporter(publisher, "evaluator", "e")
    function = compiled(third)
    if thread == "main":
        function(1.0)
    else:
        worker = threading.Thread(target=function, args=(1.0,))
        worker.start()
        worker.join()
    (first,) = publisher.messages
    assert (first.role, first.id, first.metrics) == ("evaluator", "e", {})
    assert first.text[DOING] == COMPILING
    reporter.publish(metrics)
    assert publisher.messages[-1].metrics["evaluations"] == 3
    assert DOING not in publisher.messages[-1].text
    function(1)  # compiles again, within the second
    assert len(publisher.messages) == 2
