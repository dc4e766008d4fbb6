"""A file that says when a process last did its work: what a container's health is judged by.

Invariants: written in one move, from the main loop, which thereby shows that it still runs; all
times are of one machine's monotonic clock; without MRCDRL_HEARTBEAT nothing is written. Imports
nothing but the standard library: a check every few seconds must cost next to nothing.
"""

import argparse
import contextlib
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

FILE_VARIABLE = "MRCDRL_HEARTBEAT"


class Heartbeat:
    """Writes the file, if the environment names one."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._worked_s = time.monotonic()

    @classmethod
    def of_environment(cls) -> "Heartbeat":
        name = os.environ.get(FILE_VARIABLE)
        return cls(Path(name) if name else None)

    def worked(self, at_s: float | None = None) -> None:
        """Something was done, or there is nothing to do; `at_s`: then, by default now."""
        self._worked_s = max(self._worked_s, time.monotonic() if at_s is None else at_s)

    def beat(self) -> None:
        """Write that the main loop runs, and when it last worked."""
        if self._path is None:
            return
        new = self._path.with_suffix(".new")
        with contextlib.suppress(OSError):  # it then shows as silence
            new.write_text(f"{os.getpid()} {time.monotonic()} {self._worked_s}", "ascii")
            new.replace(self._path)


@dataclass(frozen=True, slots=True)
class Pulse:
    """What a heartbeat's file says."""

    pid: int
    beat_s: float  # when it was written
    worked_s: float

    @classmethod
    def read(cls, path: Path) -> "Pulse":
        """Raises OSError or ValueError where there is none."""
        pid, beat_s, worked_s = path.read_text("ascii").split()
        return cls(int(pid), float(beat_s), float(worked_s))

    def illness(self, now_s: float, max_age_s: float) -> str | None:
        """What is wrong, in words; None where the process does its work."""
        if now_s - self.beat_s > max_age_s:
            return f"hung: its main loop has not come round for {now_s - self.beat_s:.0f} s"
        if now_s - self.worked_s > max_age_s:
            return f"idle: nothing done or heard of for {now_s - self.worked_s:.0f} s"
        return None


def main(argv: Sequence[str]) -> int:
    """Judge the heartbeat: 0 healthy, 1 not. Kills what has hung for too long."""
    parser = argparse.ArgumentParser(
        prog="python -m mrcdrl.common.runtime.heartbeat", description=main.__doc__
    )
    parser.add_argument("--max-age", type=float, default=30.0, metavar="S")
    parser.add_argument("--kill-after", type=float, metavar="S", help="by default never")
    arguments = parser.parse_args(argv)
    now_s = time.monotonic()
    try:
        pulse = Pulse.read(Path(os.environ[FILE_VARIABLE]))
    except (KeyError, OSError, ValueError):
        sys.stdout.write("no heartbeat yet\n")
        return 1
    illness = pulse.illness(now_s, arguments.max_age)
    sys.stdout.write(f"{illness or 'works'}\n")
    if arguments.kill_after is not None and now_s - pulse.beat_s > arguments.kill_after:
        os.kill(pulse.pid, signal.SIGKILL)  # whoever watches it starts it again
    return 1 if illness else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
