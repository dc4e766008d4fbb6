"""The processes of a run on this machine: started, watched, started again, stopped in order.

Invariants: every process started here has ended when `stop` returns; services get a session of
their own, so that Ctrl-C reaches the launcher only; they end with it, however it ends.
"""

import logging
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mrcdrl.common.config import ENV_PREFIX
from mrcdrl.common.errors import DivergedError, MrcdrlError
from mrcdrl.common.runtime.process import ALLOCATOR, COMMAND, DIE_WITH_PARENT

_LOG = logging.getLogger("train")
_TERM_S = 20.0  # until a service that was asked to stop is killed
_MIN_LIFE_S = 10.0  # a service that fails sooner would fail again
_LONG_LIFE_S = 300.0  # one that lived so long may be started again as often as at first
_MAX_RESTARTS = 3
_STOP_ORDER = ("actor", "evaluator", "learner", "replay", "router")


@dataclass(slots=True)
class Service:
    """One service's command and the process that runs it now."""

    role: str
    worker: str
    arguments: list[str]
    log_path: Path
    process: subprocess.Popen[bytes] | None = None
    started_s: float = 0.0
    restarts: int = 0
    log_read: int = field(default=0)

    def start(self) -> None:
        command = [*COMMAND, self.role, *self.arguments]
        environment = {**ALLOCATOR, **resolved_environment(), DIE_WITH_PARENT: str(os.getpid())}
        with self.log_path.open("ab") as log:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        self.started_s = time.monotonic()

    def last_line(self) -> str:
        """The last line of its log, usually the reason it ended."""
        lines = self.log_path.read_text("utf-8", "replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"


class Fleet:
    """All services of a run."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._services: list[Service] = []

    def start(self, role: str, worker: str, arguments: list[str]) -> None:
        service = Service(role, worker, arguments, self._logs / f"{worker}.log")
        if service.log_path.exists():
            service.log_read = service.log_path.stat().st_size
        self._services.append(service)
        service.start()

    def watch(self) -> str | None:
        """Start again what crashed; why the run must end, if it must.

        Raises MrcdrlError where a service fails right after its start, or again and again, or
        where learning diverged.
        """
        for service in self._services:
            code = None if service.process is None else service.process.poll()
            if code is None:
                continue
            service.process = None
            lived_s = time.monotonic() - service.started_s
            if lived_s > _LONG_LIFE_S:
                service.restarts = 0
            if code == 0:
                if service.role == "learner":
                    return "the learner has done its steps"
                _LOG.warning(
                    "%s was stopped by hand; mrcdrl %s --run %s --id %s starts one again",
                    *(service.worker, service.role, self._logs.parent.name, service.worker),
                )
            elif (
                lived_s < _MIN_LIFE_S
                or service.restarts == _MAX_RESTARTS
                or code == DivergedError.exit_code
            ):
                raise MrcdrlError(
                    f"{service.worker} failed: {service.last_line()} (log: {service.log_path})"
                )
            else:
                _LOG.warning("%s ended with code %d; starting it again", service.worker, code)
                service.restarts += 1
                service.start()
        return None

    def warnings(self) -> Iterator[str]:
        """Warnings and errors that services logged since the last call."""
        for service in self._services:
            with service.log_path.open("rb") as log:
                log.seek(service.log_read)
                text = log.read()
            whole = text[: text.rfind(b"\n") + 1]
            service.log_read += len(whole)
            for line in whole.decode("utf-8", "replace").splitlines():
                if " WARNING " in line or " ERROR " in line:
                    yield f"{service.worker}: {line.split(': ', 1)[-1]}"

    def stop(self) -> None:
        """Stop role after role, those that feed before those that are fed."""
        for role in _STOP_ORDER:
            stopping = [s for s in self._services if s.role == role and s.process is not None]
            for service in stopping:
                self._signal(service, signal.SIGTERM)
            for service in stopping:
                self._await(service)

    def _await(self, service: Service) -> None:
        if service.process is None:
            return
        try:
            code = service.process.wait(_TERM_S)
        except subprocess.TimeoutExpired:
            _LOG.warning("%s did not stop within %g s and was killed", service.worker, _TERM_S)
            self._signal(service, signal.SIGKILL)
            code = service.process.wait()
        if code not in (0, -signal.SIGKILL):
            _LOG.warning("%s ended with code %d: %s", service.worker, code, service.last_line())
        service.process = None

    def _signal(self, service: Service, number: int) -> None:
        if service.process is not None and service.process.poll() is None:
            service.process.send_signal(number)


def resolved_environment() -> dict[str, str]:
    """This process's environment without settings: they are in the run's config.toml already,
    where a flag may have overruled them."""
    return {
        name: value
        for name, value in os.environ.items()
        if not (name.startswith(ENV_PREFIX) and "__" in name)
    }
