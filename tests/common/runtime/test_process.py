"""Signals and priorities: a service stops in time, and lets others go first where it should."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE_S

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


HUNG_UP = """
import signal, sys
from mrcdrl.common.runtime.process import StopSignal
signal.signal(signal.SIGHUP, getattr(signal, sys.argv[1]))
stop = StopSignal().listen()
signal.raise_signal(signal.SIGHUP)
print(stop.is_set(), stop.cause)
"""


@pytest.mark.parametrize(("before", "told"), [("SIG_DFL", "True SIGHUP"), ("SIG_IGN", "False ")])
def test_a_closed_terminal_stops_a_process_unless_nohup_started_it(before: str, told: str) -> None:
    command = [sys.executable, "-c", HUNG_UP, before]
    result = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    assert result.stdout == f"{told}\n"


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_a_command_starts_with_its_output_closed(closed: str) -> None:
    says = "import sys; from mrcdrl.common.runtime.process import run_main; "
    says += "sys.exit(run_main(lambda: print('–', flush=True) or 5))"
    command = ["sh", "-c", f'exec "$0" -c "$1" {closed}', sys.executable, says]
    result = subprocess.run(
        command,
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        timeout=PATIENCE_S,
    )
    assert result.returncode == 5
    assert result.stdout == (b"" if closed.startswith(">&-") else b"\\u2013\n")
    assert result.stderr == b""


def test_a_file_that_cannot_be_used_is_one_line(tmp_path: Path) -> None:
    says = "from pathlib import Path; from mrcdrl.common.runtime.process import run_main; "
    says += f"raise SystemExit(run_main(lambda: Path({str(tmp_path)!r}).read_bytes() and 0))"
    result = subprocess.run(
        [sys.executable, "-c", says], capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 1
    assert result.stderr == f"mrcdrl: [Errno 21] Is a directory: {str(tmp_path)!r}\n"


TWICE = """
import signal
from mrcdrl.common.runtime.process import StopSignal

hurry = StopSignal()
stop = StopSignal().listen(then=hurry)
for number in (signal.SIGTERM, signal.SIGINT):
    signal.raise_signal(number)
    print(stop.cause, hurry.cause or "-", hurry.is_set())
"""


def test_a_second_signal_hurries_however_soon_it_comes() -> None:
    told = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, check=True)
    assert told.stdout == "SIGTERM - False\nSIGTERM Ctrl-C True\n"


YIELDS = """
import os
from pathlib import Path
from mrcdrl.common.runtime.process import yield_cores
group = Path("/proc/self/autogroup")
for nice in (19, 0):
    before = group.read_text() if group.exists() else ""
    yield_cores(nice)
    print(os.nice(0) == nice, before != (group.read_text() if group.exists() else ""))
"""


@pytest.mark.parametrize("leads_its_session", [True, False])
def test_a_process_yields_alone_or_with_the_session_it_leads(leads_its_session: bool) -> None:
    """Where Linux groups by session, the group's own value counts against other sessions."""
    result = subprocess.run(
        [sys.executable, "-c", YIELDS],
        start_new_session=leads_its_session,
        capture_output=True,
        text=True,
        check=True,
    )
    down, up = result.stdout.splitlines()
    grouped = Path("/proc/self/autogroup").exists() and leads_its_session
    assert down == f"True {grouped}"
    assert up == f"True {grouped}" or os.getuid(), "without the right to it, it stays as it is"


def test_a_system_that_forbids_it_is_no_error(tmp_path: Path) -> None:
    code = f"from mrcdrl.common.runtime.process import *; yield_cores(1, Path({str(tmp_path)!r}))"
    subprocess.run([sys.executable, "-c", code], start_new_session=True, check=True)
