"""The heartbeat: a file that says when a process last worked, for a container's health check.

Invariants: the main loop writes it, in one move, which shows that the loop still runs; all times
are of one machine's monotonic clock; without MRCDRL_HEARTBEAT nothing is written. Only the standard
library is imported: a check every few seconds must cost next to nothing.
"""

import argparse
import contextlib
import math
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

FILE_VARIABLE = "MRCDRL_HEARTBEAT"


class Heartbeat:
    """Writes the file, if there is a path."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._worked_s = time.monotonic()

    @classmethod
    def from_environment(cls) -> "Heartbeat":
        name = os.environ.get(FILE_VARIABLE)
        return cls(Path(name) if name else None)

    def worked(self, at_s: float | None = None) -> None:
        """Note that work was done, or that there is none to do, at `at_s` (now by default)."""
        self._worked_s = max(self._worked_s, time.monotonic() if at_s is None else at_s)

    def beat(self) -> None:
        """Write that the main loop runs, and when it last worked."""
        if self._path is None:
            return
        new = self._path.with_suffix(".new")
        with contextlib.suppress(OSError):  # a failure shows as silence
            new.write_text(f"{os.getpid()} {time.monotonic()} {self._worked_s}", "ascii")
            new.replace(self._path)


@dataclass(frozen=True, slots=True)
class Pulse:
    """The content of a heartbeat's file."""

    pid: int
    beat_s: float  # when it was written
    worked_s: float

    @classmethod
    def read(cls, path: Path) -> "Pulse":
        """Read the file; raises OSError or ValueError if there is no whole one."""
        pid, beat_s, worked_s = path.read_text("ascii").split()
        return cls(int(pid), float(beat_s), float(worked_s))

    def problem(self, now_s: float, max_age_s: float) -> str | None:
        """The problem, in words; None if the process does its work."""
        if now_s - self.beat_s > max_age_s:
            return f"hung: no heartbeat from its main loop for {now_s - self.beat_s:.0f} s"
        if now_s - self.worked_s > max_age_s:
            return f"idle: no work and no message for {now_s - self.worked_s:.0f} s"
        return None


def main(argv: Sequence[str]) -> int:
    """Check the heartbeat: exit 0 if healthy, else 1. Kill a process that hung too long."""
    parser = argparse.ArgumentParser(
        prog="python -m mrcdrl.common.runtime.heartbeat", description=main.__doc__
    )
    parser.add_argument("--max-age", type=_seconds, default=30.0, metavar="S")
    parser.add_argument("--kill-after", type=_seconds, metavar="S", help="default: never")
    arguments = parser.parse_args(argv)
    now_s = time.monotonic()
    try:
        pulse = Pulse.read(Path(os.environ[FILE_VARIABLE]))
    except (KeyError, OSError, ValueError):
        sys.stdout.write("no heartbeat yet\n")
        return 1
    problem = pulse.problem(now_s, arguments.max_age)
    sys.stdout.write(f"{problem or 'works'}\n")
    if arguments.kill_after is not None and now_s - pulse.beat_s > arguments.kill_after:
        os.kill(pulse.pid, signal.SIGKILL)  # its supervisor restarts it
    return 1 if problem else 0


def _seconds(text: str) -> float:
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be above 0 and finite")
    return number


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
