"""The fleet with real processes: small ones in place of the services."""

import logging
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mrcdrl.common.config import resolved_environment
from mrcdrl.common.errors import DivergedError, MrcdrlError
from mrcdrl.common.runtime import process
from mrcdrl.services.monitor.watching import Watching
from mrcdrl.services.train import fleet as fleet_module
from mrcdrl.services.train.fleet import Fleet
from tests.patience import PATIENCE_S

_WAITS = """
import os, signal, sys
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
print("2026-11-22 10:00:00,000 INFO actor: up as", *sys.argv[1:], flush=True)
print("2026-11-22 10:00:01,000 WARNING actor: replay is late", flush=True)
open(os.environ["READY"], "w").write(str(os.getpid()))
while True:
    signal.pause()
"""
_IGNORES = _WAITS.replace("lambda *_: sys.exit(0)", "signal.SIG_IGN")
_FAILS = "import sys; sys.exit('mrcdrl: no such arena')"
_ENDS = ""


@pytest.fixture
def beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The directory that processes start in; they write to its pipe `ready`."""
    monkeypatch.chdir(tmp_path)
    os.mkfifo(tmp_path / "ready")
    monkeypatch.setenv("READY", str(tmp_path / "ready"))
    start = tmp_path / "start.py"
    start.write_text("import runpy, sys; runpy.run_path(sys.argv.pop(1) + '.py')")
    monkeypatch.setattr(process, "COMMAND", (sys.executable, str(start)))
    return tmp_path


@pytest.fixture
def fleet(beside: Path) -> Iterator[Fleet]:
    started = Fleet(beside)
    yield started
    started.stop()


def put(beside: Path, role: str, code: str) -> None:
    """Have a service of this role run this code."""
    (beside / f"{role}.py").write_text(code)


def ready(beside: Path) -> int:
    """Wait until a process is up; return its id."""
    with (beside / "ready").open() as pipe:
        return int(pipe.read())


def ended(pid: int) -> bool:
    """Whether no process has this id (ours are reaped when they have ended)."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def watch_until_ended(fleet: Fleet) -> str | None:
    """Wait until the only process has ended, without reaping it, and call `watch`."""
    (process,) = fleet._processes
    assert process.popen is not None
    os.waitid(os.P_PID, process.popen.pid, os.WEXITED | os.WNOWAIT)
    return fleet.watch()


def test_processes_run_and_have_ended_when_stop_returns(beside: Path, fleet: Fleet) -> None:
    for role in ("actor", "replay"):
        put(beside, role, _WAITS)
    pids = []
    for role in ("replay", "actor"):
        fleet.start(role, f"{role}-0", ["--run", "r"])
        pids.append(ready(beside))
    assert fleet.watch() is None
    assert not any(ended(pid) for pid in pids)
    assert len({os.getsid(pid) for pid in (os.getpid(), *pids)}) == 3
    fleet.stop()
    assert all(ended(pid) for pid in pids)
    assert "up as --run r" in (beside / "actor-0.log").read_text()
    fleet.stop()  # again is harmless


def test_producers_are_stopped_before_their_consumers(
    beside: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    await_ended = Fleet._await

    def watched(self: Fleet, process: fleet_module.ManagedProcess) -> None:
        await_ended(self, process)
        order.append(process.role)

    monkeypatch.setattr(Fleet, "_await", watched)
    for role in ("replay", "learner", "actor"):
        put(beside, role, _WAITS)
        fleet.start(role, f"{role}-0", [])
        ready(beside)
    fleet.stop()
    assert order == ["actor", "learner", "replay"]


def test_a_process_that_ignores_the_signal_is_killed(
    beside: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_module, "_TERM_S", 0.2)
    put(beside, "actor", _IGNORES)
    fleet.start("actor", "actor-0", [])
    pid = ready(beside)
    fleet.stop()
    assert ended(pid)


def test_a_process_that_fails_at_once_ends_the_run_with_its_reason(
    beside: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_module, "_MIN_LIFE_S", PATIENCE_S)
    put(beside, "actor", _FAILS)
    fleet.start("actor", "actor-0", [])
    with pytest.raises(MrcdrlError, match=r"actor-0 failed: mrcdrl: no such arena .log: .*actor-0"):
        watch_until_ended(fleet)


def test_the_reason_of_an_end_is_not_quoted_from_an_earlier_run(
    beside: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_module, "_MIN_LIFE_S", PATIENCE_S)
    (beside / "actor-0.log").write_text("10:00 INFO actor: all was well\n")
    put(beside, "actor", "import sys; sys.exit(1)")
    fleet.start("actor", "actor-0", [])
    with pytest.raises(MrcdrlError, match=r"actor-0 failed: its log is empty"):
        watch_until_ended(fleet)


def test_a_process_that_was_killed_is_restarted(
    beside: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_module, "_MIN_LIFE_S", 0.0)
    put(beside, "actor", _WAITS)
    fleet.start("actor", "actor-0", ["--id", "actor-0"])
    first = ready(beside)
    os.kill(first, signal.SIGKILL)
    assert watch_until_ended(fleet) is None
    second = ready(beside)
    assert second != first
    assert not ended(second)
    assert (beside / "actor-0.log").read_text().count("up as --id actor-0") == 2


def test_a_process_that_ends_repeatedly_ends_the_run(
    beside: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_module, "_MIN_LIFE_S", 0.0)
    monkeypatch.setattr(fleet_module, "_MAX_RESTARTS", 1)
    put(beside, "actor", _FAILS)
    fleet.start("actor", "actor-0", [])
    assert watch_until_ended(fleet) is None
    with pytest.raises(MrcdrlError, match="actor-0 failed"):
        watch_until_ended(fleet)


def test_a_learner_that_diverged_is_not_restarted(
    beside: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_module, "_MIN_LIFE_S", 0.0)
    code = DivergedError.exit_code
    put(beside, "learner", f"import sys; print('mrcdrl: learning diverged'); sys.exit({code})")
    fleet.start("learner", "learner-0", [])
    with pytest.raises(MrcdrlError, match="learner-0 failed: mrcdrl: learning diverged"):
        watch_until_ended(fleet)


@pytest.mark.parametrize(
    ("role", "reason"), [("learner", "the learner has finished its steps"), ("actor", None)]
)
def test_a_learner_that_ends_well_ends_the_run(
    beside: Path, fleet: Fleet, role: str, reason: str | None
) -> None:
    put(beside, role, _ENDS)
    fleet.start(role, f"{role}-0", [])
    assert watch_until_ended(fleet) == reason
    assert fleet.watch() is None


def test_warnings_in_the_logs_are_reported_once(beside: Path, fleet: Fleet) -> None:
    (beside / "actor-0.log").write_text("before: 1 WARNING actor: of an earlier start\n")
    put(beside, "actor", _WAITS)
    fleet.start("actor", "actor-0", [])
    ready(beside)
    watching = Watching()
    assert list(fleet.warnings(watching)) == ["actor-0: replay is late"]
    assert list(fleet.warnings(watching)) == []
    with (beside / "actor-0.log").open("a") as log:
        log.write("10:00 ERROR actor: not whole")
        log.flush()
        assert list(fleet.warnings(watching)) == []
        log.write(" yet\n")
    assert list(fleet.warnings(watching)) == ["actor-0: not whole yet"]


def test_a_log_that_was_deleted_is_said_once_and_the_others_are_read(
    beside: Path, fleet: Fleet, caplog: pytest.LogCaptureFixture
) -> None:
    watching = Watching()
    for role in ("replay", "actor"):
        put(beside, role, _WAITS)
        fleet.start(role, f"{role}-0", [])
        ready(beside)
    (beside / "replay-0.log").unlink()
    assert list(fleet.warnings(watching)) == ["actor-0: replay is late"]
    assert list(fleet.warnings(watching)) == []
    assert [r.getMessage() for r in caplog.records] == [
        f"reading {beside}/replay-0.log failed: No such file or directory; the run goes on"
    ]


def test_a_service_is_restarted_although_the_logs_were_cleared_away(
    beside: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_module, "_MIN_LIFE_S", 0.0)
    monkeypatch.setattr(fleet, "_logs", beside / "logs")
    put(beside, "actor", _WAITS)
    watching = Watching()
    (beside / "logs").mkdir()
    fleet.start("actor", "actor-0", [])
    first = ready(beside)
    assert list(fleet.warnings(watching)) == ["actor-0: replay is late"]
    shutil.rmtree(beside / "logs")
    os.kill(first, signal.SIGKILL)
    assert watch_until_ended(fleet) is None
    ready(beside)
    assert list(fleet.warnings(watching)) == ["actor-0: replay is late"]
    shutil.rmtree(beside / "logs")
    assert process.last_line(beside / "logs" / "actor-0.log") == (
        "its log cannot be read: No such file or directory"
    )


def test_each_step_of_the_end_is_said_and_a_service_stopped_by_us_is_no_warning(
    beside: Path, fleet: Fleet, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    put(beside, "replay", _WAITS)
    put(beside, "actor", _WAITS.replace("lambda *_: sys.exit(0)", "signal.SIG_DFL"))
    for worker in ("replay-0", "actor-0", "actor-1"):
        fleet.start(worker[:-2], worker, [])
        ready(beside)
    fleet.stop()
    assert [(r.levelname, r.getMessage()) for r in caplog.records] == [
        ("INFO", "stopping actor-0, actor-1 …"),
        ("INFO", "stopping replay-0 …"),
    ]


def test_settings_in_the_environment_are_not_passed_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MRCDRL_LEARNER__SEED", "1")
    monkeypatch.setenv("MRCDRL_DIE_WITH_PARENT", "1")
    environment = resolved_environment()
    assert "MRCDRL_LEARNER__SEED" not in environment
    assert environment["MRCDRL_DIE_WITH_PARENT"] == "1"
    assert environment["PATH"] == os.environ["PATH"]
