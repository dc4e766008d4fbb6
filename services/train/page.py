"""The page of a run: `mrcdrl web`, started beside its services, which do not need it.

Invariant: whatever becomes of it, the run goes on.
"""

import logging
import socket
import subprocess

from mrcdrl.common.config import resolved_environment
from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.runtime.closing import Closing
from mrcdrl.common.runtime.extras import PACKAGES, require
from mrcdrl.common.runtime.process import end_service, last_line, start_service
from mrcdrl.services.monitor.run_directory import RunDirectory
from mrcdrl.services.web.flags import DEFAULT_HOST, DEFAULT_PORT, page_address

_LOG = logging.getLogger("train")
_TERM_S = 5.0


class Page(Closing):
    """The process, if it could be started; close it, or use it in `with`."""

    def __init__(self, run: RunDirectory, *, wanted: bool = True) -> None:
        self.address = ""  # empty: there is none
        self._log = run.logs / "web.log"
        self._process: subprocess.Popen[bytes] | None = None
        self._port = 0
        self._told = False  # where it is
        if wanted:
            try:
                require(*PACKAGES["web"])
                self._start(run)
            except (MrcdrlError, OSError) as error:
                _LOG.warning("no page to watch the run by: %s", error)

    def check(self) -> None:
        """Say once where the page is, when it answers, and once that it has ended."""
        if self._process is None:
            return
        if self._process.poll() is not None:
            self._process, self.address = None, ""
            _LOG.warning("the page has ended: %s", last_line(self._log))
        elif not self._told and self._answers():
            self._told = True
            _LOG.info("watch it at %s", self.address)

    def _answers(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex((DEFAULT_HOST, self._port)) == 0

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            end_service(process, _TERM_S)

    def _start(self, run: RunDirectory) -> None:
        port = self._port = _free_port()
        flags = [str(run.path.resolve()), "--host", DEFAULT_HOST, "--port", str(port)]
        self._process = start_service("web", flags, self._log, resolved_environment())
        self.address = page_address(DEFAULT_HOST, port, f"run?name={run.path.name}")


def _free_port() -> int:
    """The usual port, or another one if it is in use."""
    for port in (DEFAULT_PORT, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((DEFAULT_HOST, port))
            except OSError:
                continue
            found: int = probe.getsockname()[1]
            return found
    raise MrcdrlError("no port of this machine is free")
