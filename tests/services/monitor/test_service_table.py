"""What a service's row says."""

import pytest

from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.services.monitor.service_table import figures
from mrcdrl.services.monitor.state import RunState


@pytest.mark.parametrize("role", ["actor", "evaluator"])
def test_refused_weights_are_told_where_there_are_any(role: str) -> None:
    state = RunState(Config())
    for count, said in ((0.0, False), (12.0, True)):
        state.observe_stats(Stats(role, "0", {"weights_refused": count}), 1.0)
        assert ("· 12 weights refused" in figures(state, state.services[0], 1.0)) == said
