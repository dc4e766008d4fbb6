"""Log lines of the process while its screen is up."""

import logging

import pytest

from mrcdrl.common.config import Config
from mrcdrl.services.monitor.display import logging_to
from mrcdrl.services.monitor.state import RunState


def test_log_lines_go_to_the_state_and_not_over_the_screen(
    capsys: pytest.CaptureFixture[str],
) -> None:
    state = RunState(Config())
    with logging_to(state):
        logging.getLogger("train").warning("%s ended with code %d", "actor-0", 1)
    assert list(state.log) == ["actor-0 ended with code 1"]
    assert capsys.readouterr().err == ""


def test_log_lines_are_written_as_before_after_it(caplog: pytest.LogCaptureFixture) -> None:
    state = RunState(Config())
    with logging_to(state):
        pass
    logging.getLogger("train").warning("over")
    assert caplog.messages == ["over"]
    assert not state.log
