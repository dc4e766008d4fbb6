"""Shows the state of a run on a live screen, or as plain lines without a terminal.

Invariants: what cannot be shown ends nothing. Output that fails, such as a closed pipe or terminal,
is given up, and a warning says so.
"""

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NoReturn, TextIO

from rich.console import Console
from rich.live import Live

from mrcdrl.common.runtime.process import discard
from mrcdrl.services.monitor.screen import Screen, plain_line
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.watching import Watching

_PLAIN_PERIOD_S = 10.0
_PART = "the display"  # as a failure is said
Show = Callable[[], None]


@contextmanager
def display(
    state: RunState,
    run_dir: Path,
    keys: str,
    clock: Callable[[], float],
    watching: Watching,
    lines: Show | None = None,
    *,
    stream: TextIO | None = None,
) -> Iterator[Show]:
    """Yield a function that shows the state now: on a live screen, or as a plain line.

    keys: what Ctrl-C does. watching: guards all that is written. lines: what to call instead of
    both. stream: written to; stdout by default.
    """
    shown, written = ExitStack(), stream or sys.stdout
    draw = lines or _plain(state, clock, written)

    def show() -> None:
        nonlocal draw
        with watching(_PART):
            try:
                draw()
            except OSError:
                draw = _nothing
                _give_up(shown, written)
                raise

    with watching(_PART):
        if lines is None and can_draw(console := OpenConsole(file=written)):
            draw = shown.enter_context(_screen(console, state, run_dir, keys, clock))
    try:
        yield show
    finally:
        with watching(_PART):
            shown.close()


class OpenConsole(Console):
    """A console that leaves it to its user what a closed pipe ends; rich's ends the process."""

    def on_broken_pipe(self) -> NoReturn:
        raise BrokenPipeError("its reader has ended")


def can_draw(console: Console) -> bool:
    """Whether this is a terminal with a cursor that moves and with Unicode."""
    unicode = console.encoding.startswith("utf")
    return console.is_terminal and not console.is_dumb_terminal and unicode


def _plain(state: RunState, clock: Callable[[], float], stream: TextIO) -> Show:
    def print_line() -> None:
        stream.write(f"{plain_line(state, clock())}\n")
        stream.flush()

    return at_most_every(_PLAIN_PERIOD_S, clock, print_line)


@contextmanager
def _screen(
    console: Console, state: RunState, run_dir: Path, keys: str, clock: Callable[[], float]
) -> Iterator[Show]:
    with logging_to(state), Live(console=console, screen=True, auto_refresh=False) as live:
        yield lambda: live.update(Screen(state, clock(), run_dir, keys), refresh=True)


def _nothing() -> None:
    """Show nothing."""


def _give_up(shown: ExitStack, stream: TextIO) -> None:
    """Leave the screen and drop what waits to be written."""
    discard(stream)
    shown.close()


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
