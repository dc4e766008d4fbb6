"""Progress of long work, on stderr: a bar on a terminal, elsewhere a line every ten seconds.

Invariant: what cannot be shown ends nothing.
"""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Self, TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from mrcdrl.common.runtime.process import discard
from mrcdrl.services.monitor.display import OpenConsole, can_draw

Item = TypeVar("Item")
Done = Callable[[int], None]  # takes how many are done

_BAR_PERIOD_S = 0.1
_LINE_PERIOD_S = 10.0
_TELLING_SHARE = 0.1  # before, the rate is that of compiling and of the first to end


class Progress:
    """Shows one stage of the work after another; use it in a `with` block.

    with Progress() as progress:
        done = progress.stage("episodes", 100)
        done(1)
    """

    def __init__(self) -> None:
        self._opened = ExitStack()
        self._bar: Bar | None = None
        self._task: TaskID | None = None
        self._stage, self._total, self._done = "", 1, 0
        self._began_s = self._shown_s = 0.0

    def __enter__(self) -> Self:
        console = OpenConsole(stderr=True)
        if can_draw(console):
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
            )
            bar = Bar(*columns, console=console, transient=True, auto_refresh=False)
            with self._showing():
                self._bar = self._opened.enter_context(bar)
        return self

    def __exit__(self, *_: object) -> None:
        with self._showing():
            self._opened.close()

    def stage(self, what: str, total: int = 1) -> Done:
        """Begin a stage, such as the episodes of one policy; return what takes its progress."""
        self._stage, self._total, self._done = what, total, 0
        self._began_s = time.monotonic()
        with self._showing():
            if self._bar is not None:
                if self._task is not None:
                    self._bar.remove_task(self._task)
                self._task = self._bar.add_task(what, total=total)
        self._show()

        def done(number: int) -> None:
            self._done = number
            period_s = _LINE_PERIOD_S if self._bar is None else _BAR_PERIOD_S
            if time.monotonic() >= self._shown_s + period_s:
                self._show()

        return done

    def over(self, items: Iterable[Item], what: str, total: int) -> Iterator[Item]:
        """Yield the items, as a stage."""
        done = self.stage(what, total)
        for number, item in enumerate(items, 1):
            yield item
            done(number)

    def _show(self) -> None:
        self._shown_s = time.monotonic()
        with self._showing():
            if self._bar is None or self._task is None:
                sys.stderr.write(f"{self._line()}\n")
                sys.stderr.flush()
            else:
                self._bar.update(self._task, completed=self._done)
                self._bar.refresh()

    def _line(self) -> str:
        if self._total == 1:
            return f"{self._stage} …"
        line = f"{self._stage}: {self._done} of {self._total}"
        if _TELLING_SHARE * self._total <= self._done < self._total:
            spent_s = time.monotonic() - self._began_s
            line += f", about {spent_s * (self._total - self._done) / self._done:.0f} s left"
        return line

    @contextmanager
    def _showing(self) -> Iterator[None]:
        """Write to stderr in this block, or nowhere once its pipe, terminal or file is gone."""
        try:
            yield
        except (OSError, ValueError):
            self._bar = None
            discard(sys.stderr)
