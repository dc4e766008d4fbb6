"""The heartbeat: a file that says when a process last worked, for a container's health check.

Invariants: the main loop writes it, in one move, which shows that the loop still runs; all times
are of one machine's monotonic clock; without MRCDRL_HEARTBEAT nothing is written. A loop whose next
pass may take long for a good reason says so before it. Only the standard library is imported: a
check every few seconds must cost next to nothing.
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
        """The heartbeat that the environment asks for; forgets that of an earlier process."""
        name = os.environ.get(FILE_VARIABLE)
        path = Path(name) if name else None
        if path is not None:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        return cls(path)

    def worked(self, at_s: float | None = None) -> None:
        """Note that work was done, or that there is none to do, at `at_s` (now by default)."""
        self._worked_s = max(self._worked_s, time.monotonic() if at_s is None else at_s)

    def beat(self, patience_s: float = 0.0) -> None:
        """Write that the main loop runs, and when it last worked.

        patience_s: how long its next pass may take; a check allows at least that much silence.
        """
        if self._path is None:
            return
        new = self._path.with_suffix(".new")
        with contextlib.suppress(OSError):  # a failure shows as silence
            new.write_text(
                f"{os.getpid()} {time.monotonic()} {self._worked_s} {patience_s}", "ascii"
            )
            new.replace(self._path)


@dataclass(frozen=True, slots=True)
class Pulse:
    """The content of a heartbeat's file."""

    pid: int
    beat_s: float  # when it was written
    worked_s: float
    patience_s: float = 0.0

    @classmethod
    def read(cls, path: Path) -> "Pulse":
        """Read the file; raises OSError or ValueError if there is no whole one."""
        pid, beat_s, worked_s, patience_s = path.read_text("ascii").split()
        return cls(int(pid), float(beat_s), float(worked_s), float(patience_s))

    def silent_longer_than(self, age_s: float, now_s: float) -> bool:
        """Whether the main loop has been silent for that long, and for longer than it asked for."""
        return now_s - self.beat_s > max(age_s, self.patience_s)

    def problem(self, now_s: float, max_age_s: float) -> str | None:
        """The problem, in words; None if the process does its work."""
        if self.silent_longer_than(max_age_s, now_s):
            return f"hung: no heartbeat from its main loop for {now_s - self.beat_s:.0f} s"
        idle_s = (self.beat_s if self.patience_s else now_s) - self.worked_s
        if idle_s > max_age_s:
            return f"idle: no work and no message for {idle_s:.0f} s"
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
    limit_s = arguments.kill_after
    if limit_s is not None and pulse.silent_longer_than(limit_s, now_s):
        os.kill(pulse.pid, signal.SIGKILL)  # its supervisor restarts it
    return 1 if problem else 0


def _seconds(text: str) -> float:
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be above 0 and finite")
    return number


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
