"""What only watches a run ends nothing: odd locales, closed pipes and terminals, hurried ends."""

import json
import os
import signal
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from mrcdrl.common.runtime.process import CLOSED_PIPE, COMMAND
from mrcdrl.services.monitor.records import read_evaluations, read_last_metrics
from tests.patience import eventually
from tests.system.system_processes import (
    PATIENCE_S,
    REPOSITORY,
    Command,
    end_all,
    environment,
    error_line,
    processes_of,
    run_name,
    smoke_training,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]

COMMANDS_THAT_PRINT = [["config"], ["--help"], ["doctor", "--json"]]


def start(arguments: Sequence[str | Path], stdout: int, stderr: int) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        env=environment(PYTHONIOENCODING="ascii"),
        cwd=REPOSITORY,
    )


@pytest.mark.parametrize("arguments", COMMANDS_THAT_PRINT, ids=" ".join)
def test_a_command_whose_output_nobody_reads_ends_in_silence(arguments: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    process = start(arguments, writer, subprocess.PIPE)
    os.close(writer)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, said) == (CLOSED_PIPE, b"")


@pytest.mark.parametrize("arguments", COMMANDS_THAT_PRINT[:2], ids=" ".join)
def test_a_full_disk_under_the_output_is_one_line(arguments: list[str]) -> None:
    full = os.open("/dev/full", os.O_WRONLY)
    process = start(arguments, full, subprocess.PIPE)
    os.close(full)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "No space left on device" in error_line(said.decode())


def test_a_run_outlives_the_reader_of_its_lines_in_a_locale_without_its_characters(
    tmp_path: Path,
) -> None:
    name = run_name("unread")
    run = tmp_path / name
    arguments = smoke_training(tmp_path, name)
    try:
        limits = ["--run.minutes", "0.3", "--learner-steps", "100000000"]
        train = start([*arguments, *limits], subprocess.DEVNULL, subprocess.PIPE)
        assert train.stderr is not None
        assert any(rb"evaluation \u2013" in line for line in train.stderr)
        train.stderr.close()
        assert train.wait(PATIENCE_S) == 0
        assert json.loads((run / "summary.json").read_bytes())["stop_reason"].startswith("time")
        assert processes_of(name) == {}
    finally:
        end_all(name)


@pytest.fixture
def heeded_hangups() -> Iterator[None]:
    """Children heed SIGHUP, also where the tests themselves were started by nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("heeded_hangups")
def test_status_tells_the_runs_time_and_a_closed_terminal_and_a_second_signal_end_it(
    tmp_path: Path,
) -> None:
    name = run_name("hung-up")
    run = tmp_path / name
    arguments = smoke_training(tmp_path, name)
    asked: list[str | Path] = ["status", "--run", name, "--run-dir", tmp_path]
    try:
        with Command([*arguments, "--learner-steps", "100000000"], tmp_path) as train:
            eventually(lambda: run.is_dir() and read_evaluations(run), "an evaluation")
            recorded = read_last_metrics(run)
            with Command([*asked, "--json"], tmp_path) as status:
                assert status.wait() == 0, status.err
            told = json.loads(status.out)
            assert told["time_since"] == "the run began"
            assert told["time_s"] > recorded["time_s"]
            assert told["episodes"] >= recorded["episodes"]
            assert told["success_rate"] is not None
            _watch_and_leave([*asked, "--watch", "--json"])
            train.signal(signal.SIGHUP)
            eventually(lambda: "stopping (SIGHUP)" in train.err, "the end begins")
            train.signal(signal.SIGINT)
            assert train.wait() == 0, train.err
        assert "stopping learner-0 …" in train.err
        assert f"plots and video skipped (Ctrl-C); `mrcdrl report {run}` writes them" in train.err
        assert f"\nfiles     {run}: summary.json" in train.out
        assert "training.png" not in train.out
        assert "ended with code" not in train.err
        with Command(asked, tmp_path) as status:
            assert status.wait() == 1
        line = error_line(status.err)
        assert f"run {name} is not up: no run is up in {run}; last seen 2" in line
        assert "after it began" in line
        with Command([*asked, "--connect", "tcp/127.0.0.1:9"], tmp_path) as status:
            assert status.wait() == 1
        line = error_line(status.err)
        assert f"run {name} is not up: nobody answers at tcp/127.0.0.1:9; last seen 2" in line
    finally:
        end_all(name)


def _watch_and_leave(arguments: list[str | Path]) -> None:
    """Who only shows a run ends when nobody looks any more."""
    watch = start(arguments, subprocess.PIPE, subprocess.PIPE)
    assert watch.stdout is not None
    assert json.loads(watch.stdout.readline())["services"] is not None
    watch.stdout.close()
    watch.stdout = None
    _, said = watch.communicate(timeout=PATIENCE_S)
    assert (watch.returncode, said) == (CLOSED_PIPE, b"")
