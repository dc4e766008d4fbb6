"""What every service's shell shares: signals, logging, joining a run, and a clean exit.

Invariants: SIGTERM and SIGINT set one StopSignal; errors on purpose end the process with one
line and their exit code; bugs of ours crash with a traceback.
"""

import ctypes
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

from mrcdrl.common.errors import MrcdrlError

DIE_WITH_PARENT = "MRCDRL_DIE_WITH_PARENT"  # its process id, set by who starts services
# Of the environment of processes that learn: freed memory stays with them. Else each large tensor
# is mapped afresh at every step.
ALLOCATOR = {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": str(1 << 32),
    "MALLOC_TOP_PAD_": str(64 << 20),
}
STOP_DEADLINE_S = 30  # of a service, from the signal to its end
# Starts a command of ours as a process of its own. -P: no file of the current folder is imported.
COMMAND = (sys.executable, "-P", "-m", "mrcdrl")
_PR_SET_PDEATHSIG = 1  # of <linux/prctl.h>
_LOG_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


class StopSignal:
    """Set once, by a signal or from within; many may wait for it."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._deadline_s = 0

    def listen(self, deadline_s: int = 0) -> "StopSignal":
        """Have SIGTERM and SIGINT set it; call from the main thread.

        deadline_s: if above 0, a process still there so long after the signal is ended by the
        kernel, whatever it waits for.
        """
        self._deadline_s = deadline_s
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, self._on_signal)
        return self

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._event.set()
        signal.alarm(self._deadline_s)

    def set(self) -> None:
        self._event.set()

    def is_set(self) -> bool:
        return self._event.is_set()

    def wait(self, timeout_s: float) -> bool:
        """Whether it is set within the time."""
        return self._event.wait(timeout_s)


def run_main(main: Callable[[], int | None]) -> int:
    """Run a command; the exit code. MrcdrlError becomes one line on stderr."""
    logging.basicConfig(level=logging.INFO, format=_LOG_FORMAT, stream=sys.stderr)
    parent = os.environ.get(DIE_WITH_PARENT)
    if parent and sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != int(parent):  # it was gone before it could be watched
            return 0
    try:
        return main() or 0
    except MrcdrlError as error:
        sys.stderr.write(f"mrcdrl: {error}\n")
        return error.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("mrcdrl: interrupted\n")
        return 130


def available_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
