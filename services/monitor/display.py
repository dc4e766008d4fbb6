"""Shows the state of a run on a live screen, or as plain lines without a terminal."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live

from mrcdrl.services.monitor.screen import Screen, plain_line
from mrcdrl.services.monitor.state import RunState

_PLAIN_PERIOD_S = 10.0
Show = Callable[[], None]


@contextmanager
def display(state: RunState, name: str, clock: Callable[[], float]) -> Iterator[Show]:
    """Yield a function that shows the state now: on a live screen, or as a plain line."""
    console = Console()
    if not console.is_terminal:

        def print_line() -> None:
            console.print(plain_line(state, clock()), soft_wrap=True, highlight=False)

        yield at_most_every(_PLAIN_PERIOD_S, clock, print_line)
        return
    with logging_to(state), Live(console=console, screen=True, auto_refresh=False) as live:
        yield lambda: live.update(Screen(state, clock(), name), refresh=True)


def at_most_every(period_s: float, clock: Callable[[], float], show: Show) -> Show:
    """`show`, skipped until a period has passed since the last time."""
    due_s = 0.0

    def show_when_due() -> None:
        nonlocal due_s
        if clock() >= due_s:
            due_s = clock() + period_s
            show()

    return show_when_due


@contextmanager
def logging_to(state: RunState) -> Iterator[None]:
    """Send this process's log lines to the state; written to the terminal, they would garble it."""
    root = logging.getLogger()
    streams, root.handlers = root.handlers, [_StateHandler(state)]
    try:
        yield
    finally:
        root.handlers = streams


class _StateHandler(logging.Handler):
    def __init__(self, state: RunState) -> None:
        super().__init__()
        self._state = state

    def emit(self, record: logging.LogRecord) -> None:
        self._state.observe_log(record.getMessage())
