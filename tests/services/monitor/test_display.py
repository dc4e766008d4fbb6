"""The display of a run: which one, what it does when it cannot show, and log lines meanwhile."""

import logging
import os
import pty
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rich.console import Console

from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.services.monitor import display as display_module
from mrcdrl.services.monitor.display import can_draw, display, logging_to
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.watching import Watching

RUN, KEYS = Path("runs/run"), "Ctrl-C ends the run"


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


@pytest.mark.parametrize(
    ("terminal", "encoding", "draws"),
    [
        ("xterm-256color", "utf-8", True),
        ("dumb", "utf-8", False),
        ("unknown", "utf-8", False),
        ("xterm-256color", "ascii", False),
        ("xterm-256color", "latin-1", False),
    ],
)
def test_the_screen_needs_a_terminal_that_can_show_it(
    terminal: str, encoding: str, draws: bool, tmp_path: Path
) -> None:
    with (tmp_path / "file").open("w", encoding=encoding) as file:
        environment = {"TERM": terminal}
        assert can_draw(Console(file=file, force_terminal=True, _environ=environment)) == draws
        assert not can_draw(Console(file=file, force_terminal=False, _environ=environment))


@contextmanager
def stdout_to(descriptor: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have sys.stdout write to the descriptor, which it closes."""
    with os.fdopen(descriptor, "w", encoding="utf-8") as stream, monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", stream)
        yield


def test_lines_that_nobody_reads_are_given_up_and_that_is_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(display_module, "_PLAIN_PERIOD_S", 0.0)
    reader, writer = os.pipe()
    os.close(reader)
    with (
        stdout_to(writer, monkeypatch),
        display(RunState(Config()), RUN, KEYS, lambda: 1.0, Watching()) as show,
    ):
        for _ in range(3):
            show()
    assert caplog.messages == ["the display failed: Broken pipe; the run goes on"]


def test_a_terminal_that_was_closed_ends_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    master, slave = pty.openpty()
    monkeypatch.setenv("TERM", "xterm-256color")
    state = RunState(Config())
    with stdout_to(slave, monkeypatch):
        with display(state, RUN, KEYS, lambda: 1.0, Watching()) as show:
            show()
            logging.getLogger("train").warning("on the screen")
            os.close(master)
            show()
        logging.getLogger("train").warning("over")
    assert list(state.log) == ["on the screen"]
    assert caplog.messages[-1] == "over"


def test_a_state_that_cannot_be_drawn_is_drawn_again_when_it_can(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(display_module, "_PLAIN_PERIOD_S", 0.0)
    state = RunState(Config())
    with display(state, RUN, KEYS, lambda: 1.0, Watching()) as show:
        for steps in (7.0, float("nan"), float("nan"), 8.0):
            state.observe_stats(Stats("learner", "0", {"learner_steps": steps}), 1.0)
            show()
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition("learner steps ")[2][0] for line in lines] == ["7", "8"]
    assert caplog.messages == [
        "the display failed: ValueError: cannot convert float NaN to integer; the run goes on"
    ]
