"""What a person gets wrong: one clear line, an exit code, and nothing half-written."""

import json
import os
import signal
import socket
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path

import pytest

from mrcdrl.common.transport import free_endpoint
from mrcdrl.services.learner import checkpoint
from tests.patience import eventually
from tests.system.system_processes import (
    Command,
    Finished,
    end_all,
    error_line,
    processes_of,
    run_name,
    smoke_training,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


def refused(folder: Path, arguments: Sequence[str | Path], **variables: str) -> str:
    """The one line with which a command is refused."""
    with Command(arguments, folder, **variables) as command:
        code = command.wait()
    assert code > 0, f"exit code {code}; {command.err}"
    assert command.out == ""
    return error_line(command.err)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A folder for runs that must stay empty."""
    folder = tmp_path / "runs"
    folder.mkdir()
    return folder


# -- settings ------------------------------------------------------------------------------------

SETTINGS = {
    "unknown command": (["trian"], ["trian", "train"]),
    "unknown flag": (["train", "--robot", "2"], ["--robot", "did you mean --robots?"]),
    "unknown setting": (
        ["train", "--learner.bach_size", "3"],
        ["--learner.bach_size", "did you mean --learner.batch_size?"],
    ),
    "no robots": (["train", "--robots", "0"], ["arena.num_robots", "0"]),
    "too many robots": (["train", "--robots", "11"], ["arena.num_robots", "10", "11"]),
    "no number": (["train", "--robots", "two"], ["arena.num_robots", "two"]),
    "robots that do not fit": (
        ["train", "--robots", "10", "--arena.size_px", "200"],
        ["robots", "px"],
    ),
    "an arena too small for any": (
        ["train", "--arena.size_px", "120", "--arena.robot_radius_px", "60"],
        ["no robot of radius 60", "fits"],
    ),
    "a table that never serves": (
        ["train", "--replay.capacity", "10", "--replay.min_size", "50"],
        ["min_size 50 exceeds capacity 10"],
    ),
    "no such preset": (["train", "--config", "papr"], ["papr", "paper", "quick"]),
    "resume of nothing": (["train", "--resume", "nothing"], ["no run 'nothing'", "--run-dir"]),
    "resume with a name": (
        ["train", "--resume", "a", "--name", "b"],
        ["--resume", "--name"],
    ),
    "a name that is none": (["train", "--name", "a b"], ["run name", "a b"]),
}


@pytest.mark.parametrize("case", SETTINGS)
def test_impossible_settings_leave_no_run(case: str, tmp_path: Path, runs: Path) -> None:
    arguments, words = SETTINGS[case]
    more = ["--run-dir", runs] if arguments[0] == "train" else []
    line = refused(tmp_path, [*arguments, *more])
    for word in words:
        assert word in line
    assert list(runs.iterdir()) == []


def test_unknown_names_in_file_and_environment_show_the_nearest(tmp_path: Path, runs: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('extends = "smoke"\n[arena]\nnum_robot = 3\n', "utf-8")
    line = refused(tmp_path, ["train", "--config", file, "--run-dir", runs])
    assert "did you mean arena.num_robots?" in line
    line = refused(tmp_path, ["train", "--run-dir", runs], MRCDRL_AGENT__GAMA="0.9")
    assert "did you mean agent.gamma?" in line
    assert list(runs.iterdir()) == []


# -- weights -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def weights(finished: Finished) -> bytes:
    assert finished.code == 0, finished.err
    return (finished.path / "checkpoints" / "best.safetensors").read_bytes()


def test_weights_that_cannot_be_read(tmp_path: Path, weights: bytes) -> None:
    absent, torn, whole = (tmp_path / f"{name}.safetensors" for name in ("absent", "torn", "whole"))
    torn.write_bytes(weights[: len(weights) // 2])
    whole.write_bytes(weights)
    for path in (absent, torn):
        line = refused(tmp_path, ["evaluate", path, "--episodes", "1"])
        assert "weights" in line or "unreadable" in line, path
    line = refused(tmp_path, ["evaluate", whole, "--config", "quick", "--episodes", "1"])
    assert "32 px" in line
    assert "60 px" in line


SUBJECTS = {
    "neither": ([], "give either weights or --controller"),
    "no episodes": (["--controller", "greedy", "--episodes", "0"], "at least 1"),
    "do not fit": (
        ["--controller", "greedy", "--robots", "10", "--arena.size_px", "200"],
        "10 robots of radius 25 px do not fit",
    ),
    "an empty folder": (["."], "holds no weights"),
}


@pytest.mark.parametrize("case", SUBJECTS)
def test_subjects_of_an_evaluation_that_make_no_sense(case: str, tmp_path: Path) -> None:
    arguments, words = SUBJECTS[case]
    given = [tmp_path if a == "." else a for a in arguments]
    assert words in refused(tmp_path, ["evaluate", *given])


# -- folders and ports ---------------------------------------------------------------------------


def test_a_run_that_exists_is_not_touched(tmp_path: Path, runs: Path) -> None:
    taken = runs / "mine"
    taken.mkdir()
    (taken / "config.toml").write_text("[arena]\n", "utf-8")
    line = refused(tmp_path, ["train", "--run-dir", runs, "--name", "mine"])
    assert "exists" in line
    assert "--resume mine" in line
    assert [path.name for path in taken.iterdir()] == ["config.toml"]


def test_no_permission_to_write(tmp_path: Path) -> None:
    file = tmp_path / "a-file"
    file.write_text("", "utf-8")
    for folder in (file / "runs", Path("/proc/runs")):
        assert "cannot create" in refused(tmp_path, ["train", "--run-dir", folder])


@pytest.fixture
def busy_endpoint() -> Iterator[str]:
    """An endpoint on whose port somebody else listens."""
    with closing(socket.socket()) as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield f"tcp/127.0.0.1:{other.getsockname()[1]}"


def test_a_port_in_use(tmp_path: Path, runs: Path, busy_endpoint: str) -> None:
    listen = ["--transport.listen", json.dumps([busy_endpoint])]
    line = refused(tmp_path, ["train", "--config", "smoke", "--run-dir", runs, *listen])
    assert busy_endpoint in line
    assert "in use" in line
    assert list(runs.iterdir()) == []
    serving = ["replay", "--run", "any", "--run-dir", runs, "--config", "smoke"]
    line = refused(tmp_path, [*serving, "--listen", busy_endpoint])
    assert busy_endpoint in line
    assert "in use" in line


def test_a_service_without_a_run_to_join(tmp_path: Path, runs: Path) -> None:
    line = refused(tmp_path, ["actor", "--run", "nobody", "--run-dir", runs])
    assert "--connect" in line


def test_a_service_that_cannot_start_says_why_at_once(tmp_path: Path, runs: Path) -> None:
    """Replay is refused its memory; nobody waits for it."""
    name = run_name("huge")
    arguments = ["train", "--config", "smoke", "--run-dir", runs, "--name", name]
    try:
        line = refused(tmp_path, [*arguments, "--replay.capacity", str(10**15)])
        assert "replay-0 failed" in line
        assert "replay.capacity" in line
        assert processes_of(name) == {}
    finally:
        end_all(name)


# -- a full disk ---------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own with room for two checkpoints of 2 MB, not for the third."""
    folder = tmp_path / "small"
    folder.mkdir()
    options = ["-t", "tmpfs", "-o", "size=5m", "tmpfs", str(folder)]
    if os.geteuid() or subprocess.run(["mount", *options], capture_output=True).returncode:
        pytest.skip("FULL DISK NOT TESTED: mounting a tmpfs needs root and a machine that lets it")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(disk: Path) -> None:
    """Leave no room on a disk."""
    with (disk / "ballast").open("ab", buffering=0) as ballast, suppress(OSError):
        while True:
            ballast.write(bytes(1 << 12))


def test_a_run_outlives_a_full_disk_and_leaves_whole_checkpoints_only(
    tmp_path: Path, small_disk: Path
) -> None:
    name = run_name("full")
    run = small_disk / name
    arguments = smoke_training(small_disk, name)
    more = ["--learner-steps", "100000000", "--replay.fsync", "off"]
    try:
        with Command([*arguments, *more], tmp_path) as train:
            eventually(lambda: checkpoint.latest(run / "checkpoints"), "a checkpoint")

            def full() -> bool:
                fill(small_disk)  # again: a checkpoint that was not written has left room
                return "recording failed: No space left on device; the run goes on" in train.err

            eventually(full, "a full disk")
            train.signal(signal.SIGTERM)
            assert train.wait() == 0, train.err
        assert "Traceback" not in train.err
        assert processes_of(name) == {}
    finally:
        end_all(name)
    loaded = checkpoint.load_latest(run / "checkpoints")
    assert loaded is not None
    assert loaded.skipped == ()
    assert [path.name for path in run.rglob("*.part")] == []
    assert not (run / "lock").exists()
    assert not (run / "endpoint").exists()


def test_a_disk_too_full_for_a_run_gets_none(tmp_path: Path, small_disk: Path) -> None:
    fill(small_disk)
    line = refused(tmp_path, ["train", "--run-dir", small_disk, "--name", "none"])
    assert "No space left on device" in line
    assert not (small_disk / "none").exists()


def test_free_endpoints_are_free() -> None:
    """The launcher's choice of a port may be listened on at once."""
    host, port = free_endpoint().removeprefix("tcp/").split(":")
    with closing(socket.socket()) as listener:
        listener.bind((host, int(port)))
