"""The shell that all commands share: signals, logging, and a clean exit.

Invariants: SIGTERM, SIGINT and SIGHUP set one StopSignal; errors raised on purpose end the process
with one line and their exit code, and so do files that cannot be used; bugs crash with a traceback.
Output that nobody reads any more, or characters that the locale lacks, are no bugs.
"""

import contextlib
import ctypes
import errno
import io
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import TextIO

from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.runtime.files import reason

DIE_WITH_PARENT = "MRCDRL_DIE_WITH_PARENT"  # the process id of the launcher, which sets it
# Environment of processes that learn: they keep freed memory. Otherwise each large tensor is mapped
# anew at every step.
ALLOCATOR = {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": str(1 << 32),
    "MALLOC_TOP_PAD_": str(64 << 20),
}
STOP_DEADLINE_S = 30  # for a service, from the signal to its exit
# Starts a command in its own process. -P: nothing is imported from the current directory.
COMMAND = (sys.executable, "-P", "-m", "mrcdrl")
CLOSED_PIPE = 128 + signal.SIGPIPE  # exit code, as a shell reports a process that SIGPIPE ended
_PR_SET_PDEATHSIG = 1  # from <linux/prctl.h>
_LOG_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


class StopSignal:
    """A flag set once, by a signal or from within; many threads may wait for it."""

    def __init__(self) -> None:
        self.cause = ""  # the signal that set it, as a user knows it
        self._event = threading.Event()
        self._deadline_s = 0
        self._then: StopSignal | None = None

    def listen(self, deadline_s: int = 0, then: "StopSignal | None" = None) -> "StopSignal":
        """Have SIGTERM, SIGINT and SIGHUP set it; call from the main thread.

        A SIGHUP that is ignored stays ignored: nohup starts what outlives its terminal.

        deadline_s: if above 0, the kernel ends a process that still runs this long after the
        signal, whatever it waits for. then: is set by the next signal, however soon it comes.
        """
        self._deadline_s, self._then = deadline_s, then
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, self._on_signal)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            signal.signal(signal.SIGHUP, self._on_signal)
        return self

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._then is not None and self.is_set():
            self._then._on_signal(number, frame)
            return
        self.cause = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        self._event.set()
        signal.alarm(self._deadline_s)

    def set(self) -> None:
        self._event.set()

    def is_set(self) -> bool:
        return self._event.is_set()

    def wait(self, timeout_s: float) -> bool:
        """Wait; whether it was set within the time."""
        return self._event.wait(timeout_s)


def run_main(main: Callable[[], int | None]) -> int:
    """Run a command and return its exit code; a MrcdrlError becomes one line on stderr.

    A command whose output nobody reads any more ends with CLOSED_PIPE and without a word.
    """
    _open_output()
    logging.basicConfig(level=logging.INFO, format=_LOG_FORMAT, stream=sys.stderr)
    parent = os.environ.get(DIE_WITH_PARENT)
    if parent and sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != int(parent):  # it ended before the line above
            return 0
    try:
        return _exit_code(main)
    finally:
        _close_output()


def _exit_code(main: Callable[[], int | None]) -> int:
    try:
        try:
            return main() or 0
        finally:
            sys.stdout.flush()
    except MrcdrlError as error:
        _say(str(error))
        return error.exit_code
    except KeyboardInterrupt:
        _say("interrupted")
        return 130
    except SystemExit as end:  # of rich, which takes a closed pipe for the end of the process
        if isinstance(end.__context__, BrokenPipeError):
            return CLOSED_PIPE
        raise
    except OSError as error:
        if error.errno == errno.ENOSPC or error.filename is not None:
            _say(str(error))
            return 1
        if isinstance(error, BrokenPipeError):
            return CLOSED_PIPE
        raise


def _say(line: str) -> None:
    with contextlib.suppress(OSError):
        sys.stderr.write(f"mrcdrl: {line}\n")


def _open_output() -> None:
    """Have stdout and stderr take every character in any locale, and nowhere if they are closed."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _close_output() -> None:
    """Flush stdout and stderr; drop what cannot be written, which the interpreter would report."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            discard(stream)


def discard(stream: TextIO) -> None:
    """Drop what is written to the stream from now on, and what waits in it."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    with contextlib.suppress(io.UnsupportedOperation):  # a stream without a file
        os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def start_service(
    role: str, flags: Sequence[str], log: Path, environment: Mapping[str, str]
) -> "subprocess.Popen[bytes]":
    """Start a service in its own session, its output appended to the log; it ends with us."""
    log.parent.mkdir(exist_ok=True)  # someone may have cleared it away meanwhile
    with log.open("ab") as output:
        return subprocess.Popen(
            [*COMMAND, role, *flags],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env={**environment, DIE_WITH_PARENT: str(os.getpid())},
            start_new_session=True,
        )


def end_service(process: "subprocess.Popen[bytes]", patience_s: float) -> None:
    """Ask a service to end, wait, and kill it if that takes longer; harmless if it has ended."""
    process.terminate()
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def last_line(log: Path, begin: int = 0) -> str:
    """The last line of a log from this byte on, usually the reason why its service ended."""
    try:
        lines = log.read_bytes()[begin:].decode("utf-8", "replace").strip().splitlines()
    except OSError as error:
        return f"its log cannot be read: {reason(error)}"
    return lines[-1] if lines else "its log is empty"


def yield_cores(nice: int, autogroup: Path = Path("/proc/self/autogroup")) -> None:
    """Set this process's priority: above 0, other processes go first where cores are short.

    nice: 0 ... 19; a lower one than now needs the right to it, and is left out without. Where Linux
    schedules sessions as groups (sched_autogroup_enabled), a process's own value counts within its
    session only, and the session's counts against others. A process that leads its session sets
    that too; another one would slow its terminal down.
    """
    with contextlib.suppress(OSError):  # not Linux, no groups, or no right to it
        os.setpriority(os.PRIO_PROCESS, 0, nice)
        if os.getsid(0) == os.getpid():
            autogroup.write_text(f"{nice}\n", "ascii")
