"""Signals: a service stops when told to, and does not outlive its deadline."""

import signal
import subprocess
import sys

STUCK = """
import sys, threading
from mrcdrl.common.runtime.process import StopSignal
stop = StopSignal().listen(int(sys.argv[1]))
print("listening", flush=True)
stop.wait(60)
print("told", flush=True)
threading.Event().wait(float(sys.argv[2]))
"""


def run_stuck(deadline_s: int, lingers_s: float) -> tuple[int, str]:
    """Exit code and output of a process that lingers after it is told to stop."""
    command = [sys.executable, "-c", STUCK, str(deadline_s), str(lingers_s)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        rest = process.stdout.read()
    return process.returncode, first + rest


def test_a_process_that_lingers_is_ended_at_its_deadline() -> None:
    assert run_stuck(1, 60) == (-signal.SIGALRM, "listening\ntold\n")


def test_a_process_that_ends_in_time_ends_by_itself() -> None:
    assert run_stuck(30, 0) == (0, "listening\ntold\n")


def test_without_a_deadline_it_takes_its_time() -> None:
    assert run_stuck(0, 1.5) == (0, "listening\ntold\n")
