"""Hands a run's figures to an experiment tracker, which works in a process of its own.

Invariants: nothing here waits for the tracker while a run is up. What waits for it is bounded; a
tracker that fails, hangs or does not keep up is ended, which is said once, and the run goes on.
"""

import json
import logging
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from mrcdrl.common.config import Config
from mrcdrl.common.runtime.closing import Closing
from mrcdrl.common.runtime.process import last_line
from mrcdrl.services.monitor.records import finite

_LOG = logging.getLogger("train")
_PROGRAM = (sys.executable, "-P", "-m", "mrcdrl.services.monitor.tracking")
_PERIOD_S = 10.0  # between two points
_MAX_WAITING_BYTES = 1 << 20
_PATIENCE_S = 60.0  # for an answer, and at the end
_LOG_FILE = "logs/tracker.log"


class Tracker(Closing):
    """One run in an experiment tracker; close it at the end.

    program: the tracker's process. It takes a message a line on its standard input, and answers
    each with a byte on its standard output.
    """

    def __init__(
        self,
        module: str,
        init: Mapping[str, Any],
        log: Path,
        *,
        program: Sequence[str] = _PROGRAM,
        patience_s: float = _PATIENCE_S,
    ) -> None:
        """Raises OSError if the process cannot be started."""
        self._module = module
        self._log = log
        self._patience_s = patience_s
        self._latest: dict[str, float] = {}
        self._due_s = 0.0
        self._waiting = bytearray()
        self._unanswered, self._answered_s = 0, time.monotonic()
        log.parent.mkdir(exist_ok=True)
        with log.open("ab") as output:
            self._process: subprocess.Popen[bytes] | None = subprocess.Popen(
                program,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=output,
                start_new_session=True,
                bufsize=0,
            )
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                os.set_blocking(pipe.fileno(), False)
        self._send({"module": module, "init": init})

    @classmethod
    def of_run(cls, run_dir: Path, config: Config) -> Self | None:
        """The tracker that the run's configuration names; None if it names none."""
        module = config.run.tracker
        if module == "none":
            return None
        init = {
            "project": config.run.tracker_project,
            "name": run_dir.name,
            "config": finite(config.model_dump(mode="json", exclude={"transport"})),
        }
        return cls(module, init, run_dir / _LOG_FILE)

    def __repr__(self) -> str:
        return f"Tracker({self._module!r}, waiting={len(self._waiting)}, up={self.up})"

    @property
    def up(self) -> bool:
        """Whether it still works."""
        return self._process is not None

    def add(self, tag: str, value: float) -> None:
        """Note a value; the latest of each tag is told."""
        self._latest[tag] = value

    def tell(self, now: float) -> None:
        """Tell what was noted, every ten seconds; now: seconds the run has lasted, its axis."""
        if self._latest and now >= self._due_s:
            self._due_s = now + _PERIOD_S
            self._send({"log": self._latest | {"time_s": round(now, 3)}, "step": int(now)})
            self._latest = {}
        self._pump()

    def tell_files(self, files: Sequence[Path]) -> None:
        """Hand on pictures and films."""
        self._send({"files": {path.stem: str(path) for path in files}})

    def close(self) -> None:
        """Tell the rest, and let it end; not for long."""
        if self._latest:
            self._send({"log": self._latest})
        deadline = time.monotonic() + self._patience_s
        while (process := self._process) is not None and process.stdin is not None:
            if not self._waiting or time.monotonic() > deadline:
                break
            select.select([], [process.stdin], [], 0.2)
            self._pump()
        if process is None or process.stdin is None:
            return
        process.stdin.close()
        try:
            code = process.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._drop(f"it did not end within {self._patience_s:g} s")
        else:
            self._process = None
            _close(process)
            if code:
                _LOG.warning("%s ended early: %s", self._module, last_line(self._log))

    def _send(self, message: Mapping[str, Any]) -> None:
        if self._process is None:
            return
        if not self._unanswered:
            self._answered_s = time.monotonic()
        self._unanswered += 1
        self._waiting += json.dumps(finite(message)).encode() + b"\n"
        self._pump()

    def _pump(self) -> None:
        """Write what its pipe takes, read its answers, and drop it if there is a reason to."""
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            return
        try:
            while self._waiting and (written := process.stdin.write(self._waiting)):
                del self._waiting[:written]
            answers = process.stdout.read(4096)
        except OSError as error:  # it has closed its end
            self._drop(f"{last_line(self._log)} ({error.strerror})")
            return
        if answers:
            self._unanswered -= len(answers)
            self._answered_s = time.monotonic()
        if process.poll() is not None:
            self._drop(last_line(self._log))
        elif self._unanswered and time.monotonic() - self._answered_s > self._patience_s:
            self._drop(f"no answer for {self._patience_s:g} s")
        elif len(self._waiting) > _MAX_WAITING_BYTES:
            self._drop("it does not keep up")

    def _drop(self, why: str) -> None:
        """End its process and say so."""
        process, self._process = self._process, None
        self._waiting.clear()
        if process is None:
            return
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        _close(process)
        _LOG.warning("%s is given up: %s; the run goes on", self._module, why)


def _close(process: "subprocess.Popen[bytes]") -> None:
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
