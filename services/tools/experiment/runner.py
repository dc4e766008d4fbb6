"""Runs the cells of a grid, several at once, each as one process after another.

Invariants: a cell is worked at by one process at a time, whoever started it; what fails is one
cell, and the others go on. Processes end with this one.
"""

import contextlib
import logging
import os
import subprocess
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from mrcdrl.common.config import resolved_environment
from mrcdrl.common.runtime.files import atomic_write
from mrcdrl.common.runtime.process import COMMAND, DIE_WITH_PARENT, StopSignal, last_line
from mrcdrl.services.tools.experiment.cell import CellFiles, lock

_LOG = logging.getLogger("experiment")
_POLL_S = 0.25
_ASKED_S = 20.0  # a process that was asked to end is asked again; train then skips its plots
_TIMES_ASKED = 6  # then it is killed


class Work:
    """One cell at work; its log is locked until its last process has ended."""

    def __init__(self, files: CellFiles, command: str) -> None:
        self.files = files
        self._command = command
        self._log = files.log.open("ab")
        self._process: subprocess.Popen[bytes] | None = None
        self._steps: Iterator[None] = iter(())

    def begin(self) -> bool:
        """Begin, or go on; whether nobody else is at it and something is left to do."""
        if not lock(self._log) or self.files.result() is not None:
            self._log.close()
            return False
        self.files.begin()
        self._steps = self._to_the_end()
        self.advance()
        return True

    def advance(self) -> bool:
        """Start what is next, once the process before has ended; whether the cell goes on."""
        if self._process is not None:
            code = self._process.poll()
            if code is None:
                return True
            if code:
                return self._fail(f"code {code}: {last_line(self.files.log)}")
        if next(self._steps, self) is self:  # there was no further step
            self._log.close()
            return False
        return True

    def stop(self) -> None:
        """Ask the process to end; the cell can be resumed."""
        if self._process is not None:
            self._process.terminate()

    def join(self) -> None:
        """Wait until the process has ended, ask it again, or kill it."""
        process = self._process
        if process is not None:
            for _ in range(_TIMES_ASKED):
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_ASKED_S)
                    break
                process.terminate()
            else:
                process.kill()
                process.wait()
        self._log.close()

    def _to_the_end(self) -> Iterator[None]:
        """Start one process after another, then write the result."""
        files = self.files
        if not files.trained:
            self._start(files.train(), None)
            yield
            if not files.trained:
                reason = files.summary.get("stop_reason", "it left no summary")
                self._fail(f"training did not come to its end: {reason}")
                return
        for arguments, target in files.evaluations_due():
            printed = target.with_suffix(f"{target.suffix}.part")
            self._start(arguments, printed)
            yield
            atomic_write(target, printed.read_bytes())
            printed.unlink()
        files.finish(self._command)

    def _start(self, arguments: Sequence[str], printed: Path | None) -> None:
        """Start a command; what it prints goes to a file, all else to the log."""
        output = printed.open("wb") if printed else self._log
        try:
            self._process = subprocess.Popen(
                [*COMMAND, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=self._log,
                env={**resolved_environment(), DIE_WITH_PARENT: str(os.getpid())},
                start_new_session=True,
            )
        finally:
            if printed:
                output.close()

    def _fail(self, reason: str) -> bool:
        self.files.fail(reason)
        _LOG.warning("%s failed: %s (log: %s)", self.files.run.name, reason, self.files.log)
        self._log.close()
        return False


def run_cells(
    cells: Sequence[CellFiles],
    jobs: int,
    command: str,
    stop: StopSignal,
    tick: Callable[[int], None],
) -> None:
    """Run the cells that are not done, `jobs` at once, until all have ended or a signal comes.

    tick: called several times a second, with the number of cells at work. A cell that another
    process works at is waited for.
    """
    waiting = deque(files for files in cells if files.result() is None)
    at_work: list[Work] = []
    while (waiting or at_work) and not stop.is_set():
        at_work = [work for work in at_work if work.advance()]
        for _ in range(min(len(waiting), jobs - len(at_work))):
            work = Work(waiting.popleft(), command)
            if work.begin():
                _LOG.info("%s begins", work.files.run.name)
                at_work.append(work)
            elif work.files.result() is None:  # another process is at it
                waiting.append(work.files)
        tick(len(at_work))
        stop.wait(_POLL_S)
    if at_work:
        _LOG.info("stopping %d cells (%s) …", len(at_work), stop.cause)
    for work in at_work:
        work.stop()
    for work in at_work:
        work.join()
