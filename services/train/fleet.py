"""The processes of a run on this machine: started, watched, restarted, stopped in order.

Invariants: every process started here has ended when `stop` returns. Each runs in its own session,
so that Ctrl-C reaches the launcher only, and ends with the launcher, however that ends.
"""

import logging
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mrcdrl.common.config import resolved_environment
from mrcdrl.common.errors import ConfigError, DivergedError, MrcdrlError
from mrcdrl.common.runtime.process import ALLOCATOR, last_line, start_service
from mrcdrl.services.monitor.watching import Watching

_LOG = logging.getLogger("train")
_TERM_S = 20.0  # a process that was asked to stop is killed after this
_MIN_LIFE_S = 10.0  # a process that fails sooner would fail again
_LONG_LIFE_S = 300.0  # a process that lived this long gets all its restarts back
_MAX_RESTARTS = 3
_STOP_ORDER = ("actor", "evaluator", "learner", "replay", "router")


@dataclass(slots=True)
class ManagedProcess:
    """A service's command, and the process that runs it now."""

    role: str
    worker: str
    arguments: list[str]
    log_path: Path
    popen: subprocess.Popen[bytes] | None = None
    started_s: float = 0.0
    restarts: int = 0
    log_begin: int = 0  # bytes of the log that earlier processes have written
    log_read: int = 0  # bytes of the log searched for warnings

    def start(self) -> None:
        self.log_begin = self.log_path.stat().st_size if self.log_path.exists() else 0
        self.log_read = min(self.log_read, self.log_begin)  # the log may have been cleared away
        environment = {**ALLOCATOR, **resolved_environment()}
        self.popen = start_service(self.role, self.arguments, self.log_path, environment)
        self.started_s = time.monotonic()

    def last_line(self) -> str:
        return last_line(self.log_path, self.log_begin)

    def new_warnings(self) -> Iterator[str]:
        """Warnings and errors logged since the last call; raises OSError."""
        with self.log_path.open("rb") as log:
            log.seek(self.log_read)
            text = log.read()
        whole = text[: text.rfind(b"\n") + 1]
        self.log_read += len(whole)
        for line in whole.decode("utf-8", "replace").splitlines():
            if " WARNING " in line or " ERROR " in line:
                yield f"{self.worker}: {line.split(': ', 1)[-1]}"


class Fleet:
    """All processes of a run."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._processes: list[ManagedProcess] = []

    def start(self, role: str, worker: str, arguments: list[str]) -> None:
        process = ManagedProcess(role, worker, arguments, self._logs / f"{worker}.log")
        self._processes.append(process)
        process.start()
        process.log_read = process.log_begin

    def watch(self) -> str | None:
        """Restart what crashed; the reason to end the run, if there is one.

        Raises MrcdrlError if a process fails right after its start or repeatedly, if learning
        diverged, or for a setting, such as a custom world that breaks the rules: it would again.
        """
        for process in self._processes:
            code = None if process.popen is None else process.popen.poll()
            if code is None:
                continue
            process.popen = None
            lived_s = time.monotonic() - process.started_s
            if lived_s > _LONG_LIFE_S:
                process.restarts = 0
            if code == 0:
                if process.role == "learner":
                    return "the learner has finished its steps"
                _LOG.warning(
                    "%s was stopped; restart it with mrcdrl %s --run %s --id %s",
                    *(process.worker, process.role, self._logs.parent.name, process.worker),
                )
            elif (
                lived_s < _MIN_LIFE_S
                or process.restarts == _MAX_RESTARTS
                or code in (ConfigError.exit_code, DivergedError.exit_code)
            ):
                raise MrcdrlError(
                    f"{process.worker} failed: {process.last_line()} (log: {process.log_path})"
                )
            else:
                _LOG.warning("%s ended with code %d; restarting it", process.worker, code)
                process.restarts += 1
                process.start()
        return None

    def warnings(self, watching: Watching) -> Iterator[str]:
        """Warnings and errors logged since the last call; a log that cannot be read has none."""
        for process in self._processes:
            with watching(f"reading {process.log_path}"):
                yield from process.new_warnings()

    def stop(self, show: Callable[[], None] = lambda: None) -> None:
        """Stop the roles in order, producers before their consumers; show the state between."""
        for role in _STOP_ORDER:
            stopping = [p for p in self._processes if p.role == role and p.popen is not None]
            if stopping:
                _LOG.info("stopping %s …", ", ".join(p.worker for p in stopping))
                show()
            for process in stopping:
                self._signal(process, signal.SIGTERM)
            for process in stopping:
                self._await(process)

    def _await(self, process: ManagedProcess) -> None:
        if process.popen is None:
            return
        try:
            code = process.popen.wait(_TERM_S)
        except subprocess.TimeoutExpired:
            _LOG.warning("%s did not stop within %g s and was killed", process.worker, _TERM_S)
            self._signal(process, signal.SIGKILL)
            code = process.popen.wait()
        if code not in (0, -signal.SIGTERM, -signal.SIGKILL):
            _LOG.warning("%s ended with code %d: %s", process.worker, code, process.last_line())
        process.popen = None

    def _signal(self, process: ManagedProcess, number: int) -> None:
        if process.popen is not None and process.popen.poll() is None:
            process.popen.send_signal(number)
