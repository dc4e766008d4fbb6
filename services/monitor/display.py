"""Shows the state of a run on a live screen, or as plain lines without a terminal."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live

from mrcdrl.common.config import Config
from mrcdrl.services.monitor.screen import plain_line, screen
from mrcdrl.services.monitor.state import RunState

_PLAIN_PERIOD_S = 10.0


@contextmanager
def display(
    state: RunState, config: Config, name: str, clock: Callable[[], float]
) -> Iterator[Callable[[], None]]:
    """Yield a function that shows the state now: on a live screen, or as a plain line."""
    console = Console()
    if not console.is_terminal:
        due_s = [0.0]

        def print_line() -> None:
            if clock() >= due_s[0]:
                due_s[0] = clock() + _PLAIN_PERIOD_S
                console.print(plain_line(state, clock()), soft_wrap=True, highlight=False)

        yield print_line
        return
    with logging_to(state), Live(console=console, screen=True, auto_refresh=False) as live:
        yield lambda: live.update(screen(state, config, clock(), name), refresh=True)


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
