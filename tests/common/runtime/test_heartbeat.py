"""The heartbeat's file, and the health check that reads it."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mrcdrl.common.runtime.heartbeat import FILE_VARIABLE, Heartbeat, Pulse, main
from tests.patience import PATIENCE_S


@pytest.mark.parametrize(
    ("beat_s", "worked_s", "problem"),
    [
        (100, 100, None),
        (71, 71, None),
        (100, 60, "idle"),
        (60, 60, "hung"),
        (60, 20, "hung"),
    ],
)
def test_problem(beat_s: float, worked_s: float, problem: str | None) -> None:
    found = Pulse(1, beat_s, worked_s).problem(100, 30)
    assert found == problem or (problem and found and found.startswith(problem))


@pytest.mark.parametrize(
    ("silent_s", "problem"), [(8, None), (31, None), (600, None), (601, "hung")]
)
def test_a_loop_that_said_its_next_pass_takes_long_is_given_the_time(
    silent_s: float, problem: str | None
) -> None:
    """As at a first frame, with functions to compile, where ten others want the cores."""
    pulse = Pulse(1, 100, 100, patience_s=600)
    found = pulse.problem(100 + silent_s, 30)
    assert found == problem or (problem and found and found.startswith(problem))
    assert Pulse(1, 100, 60, patience_s=600).problem(101, 30) == (
        "idle: no work and no message for 40 s"
    )
    assert pulse.silent_longer_than(120, 100 + silent_s) == (problem is not None)


def test_what_an_earlier_process_wrote_is_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "heartbeat"
    monkeypatch.setenv(FILE_VARIABLE, str(path))
    Heartbeat(path).beat()
    heartbeat = Heartbeat.from_environment()
    assert not path.exists()
    heartbeat.beat(600.0)
    assert Pulse.read(path).patience_s == 600.0


def test_a_beat_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "heartbeat"
    before_s = time.monotonic()
    heartbeat = Heartbeat(path)
    heartbeat.worked()
    heartbeat.beat()
    pulse = Pulse.read(path)
    assert pulse.pid == os.getpid()
    assert before_s <= pulse.worked_s <= pulse.beat_s <= time.monotonic()


def test_work_is_never_taken_back(tmp_path: Path) -> None:
    heartbeat = Heartbeat(tmp_path / "heartbeat")
    heartbeat.worked(at_s=5e9)
    heartbeat.worked(at_s=1.0)
    heartbeat.beat()
    assert Pulse.read(tmp_path / "heartbeat").worked_s == 5e9


def test_a_missing_directory_is_not_an_error(tmp_path: Path) -> None:
    Heartbeat(tmp_path / "gone" / "heartbeat").beat()


def test_without_a_file_named_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(FILE_VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)
    Heartbeat.from_environment().beat()
    assert list(tmp_path.iterdir()) == []


def test_no_heartbeat_is_unhealthy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FILE_VARIABLE, str(tmp_path / "heartbeat"))
    assert main([]) == 1
    (tmp_path / "heartbeat").write_text("torn")
    assert main([]) == 1


@pytest.mark.parametrize(
    ("silent_s", "patience_s", "code", "alive"),
    [(0, 0, 0, True), (60, 0, 1, True), (200, 0, 1, False), (200, 600, 0, True)],
)
def test_a_process_that_hangs_is_killed(
    silent_s: float,
    patience_s: float,
    code: int,
    alive: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = tmp_path / "heartbeat"
    monkeypatch.setenv(FILE_VARIABLE, str(path))
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        then_s = time.monotonic() - silent_s
        path.write_text(f"{process.pid} {then_s} {then_s} {patience_s}")
        assert main(["--max-age", "30", "--kill-after", "120"]) == code
        if alive:
            assert process.poll() is None
        else:
            assert process.wait(PATIENCE_S) == -9
        process.kill()


@pytest.mark.parametrize("age", ["nan", "inf", "0", "-1"])
def test_an_age_that_no_file_exceeds_is_refused(
    age: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([f"--max-age={age}"])
    assert f"{age}: must be above 0 and finite" in capsys.readouterr().err
