"""`mrcdrl train` as a person uses it: to its end, interrupted, resumed, and with parts killed."""

import fcntl
import json
import os
import pty
import re
import select
import shutil
import signal
import struct
import termios
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import av
import pytest

from mrcdrl.common.config import validate_config
from mrcdrl.services.learner import checkpoint
from mrcdrl.services.monitor.records import read_episodes, read_evaluations, read_last_metrics
from tests.patience import eventually
from tests.system.system_processes import (
    PATIENCE_S,
    Command,
    Finished,
    end_all,
    processes_of,
    run_name,
    shared_memory_of,
    smoke_training,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]

NEVER = "100000000"


def summary_of(run: Path) -> dict[str, object]:
    summary: dict[str, object] = json.loads((run / "summary.json").read_bytes())
    return summary


def no_trace_of(name: str, run: Path) -> None:
    """Nothing runs any more, and only files to keep are left."""
    assert processes_of(name) == {}
    assert not (run / "endpoint").exists()
    assert not (run / "lock").exists()
    assert not [path for path in run.rglob(".*") if path.name.endswith(".part")]


def metric(run: Path, name: str) -> float:
    return float(read_last_metrics(run).get(name) or 0.0)


# -- a run that ends by itself --------------------------------------------------------------


def test_a_run_ends_by_itself_and_shows_plain_lines(finished: Finished) -> None:
    assert finished.code == 0, finished.err
    clock, line = r"^\d+:\d\d:\d\d  ", r".*robot steps \d+ .*replay \d+/20000  learner steps"
    assert re.search(f"{clock}starting, waiting for {line}", finished.err, re.M)
    assert "\x1b" not in finished.out + finished.err
    first, _, end = finished.out.partition("\n")
    assert first == "ended     learner step limit reached (60)"
    assert "Traceback" not in finished.err
    assert "learner step limit reached (60)" in finished.err
    named = [line.split()[0] for line in end.splitlines() if not line.startswith(" ")]
    assert named == ["success", "took", "next", "files"]
    assert re.match(r"success   \d+\.\d % of \d+ episodes", end)
    assert re.search(rf"^ +mrcdrl train --resume {finished.path} --minutes 30", end, re.M)
    assert re.search(r"^files .*summary\.json.*training\.png.*evaluation\.mp4$", end, re.M)


def test_nothing_of_a_finished_run_is_left_behind(finished: Finished) -> None:
    assert finished.processes_left == {}
    assert not [path for path in finished.shared_memory if path.exists()]
    no_trace_of(finished.name, finished.path)


def test_a_run_leaves_its_files(finished: Finished) -> None:
    run = finished.path
    plots = [f"{name}.{kind}" for name in ("training", "trajectories") for kind in ("png", "svg")]
    for name in (*plots, "evaluation.mp4"):
        assert (run / name).stat().st_size > 1000, name
    config = validate_config(tomllib.loads((run / "config.toml").read_text("utf-8")))
    assert (config.arena.view_px, config.run.learner_steps) == (32, 60)
    loaded = checkpoint.load_latest(run / "checkpoints")
    assert loaded is not None
    assert loaded.skipped == ()
    assert loaded.checkpoint.state.learner_step == 60
    assert (run / "checkpoints" / "best.safetensors").is_file()
    assert list((run / "tensorboard").glob("events.*"))
    assert read_last_metrics(run)["learner_steps"] > 0
    assert read_episodes(run)
    assert read_evaluations(run)
    with av.open(run / "evaluation.mp4") as film:
        assert sum(1 for _ in film.decode(video=0)) > 10


def test_the_summary_has_its_fields(finished: Finished) -> None:
    summary = summary_of(finished.path)
    for name in ("env_steps", "robot_steps", "learner_steps", "inserts", "samples"):
        assert isinstance(summary[name], int), name
        assert summary[name] > 0, name
    assert summary["learner_steps"] == 60
    assert summary["robot_steps"] == 2 * int(str(summary["env_steps"]))
    assert int(str(summary["inserts"])) <= int(str(summary["robot_steps"]))
    assert int(str(summary["samples"])) >= 60 * 32
    assert int(str(summary["weights_version"])) >= 60 // 10
    assert summary["wall_s"] > 0
    assert {"training_success_per_100", "evaluation", "versions", "machine"} <= summary.keys()
    evaluation = summary["evaluation"]
    assert isinstance(evaluation, dict)
    assert evaluation["count"] >= 1


# -- resumed, interrupted -------------------------------------------------------------------


def test_resume_goes_on_until_interrupted(finished: Finished, tmp_path: Path) -> None:
    name = run_name("resumed")
    run = tmp_path / name
    shutil.copytree(finished.path, run)
    episodes, before = len(read_episodes(run)), summary_of(run)
    arguments = [
        "train",
        "--no-web",
        "--resume",
        name,
        "--run-dir",
        tmp_path,
        "--learner-steps",
        NEVER,
    ]
    with Command(arguments, tmp_path) as train:
        eventually(
            lambda: metric(run, "learner_steps") >= 80 and train.process.poll() is None,
            "learner steps go on",
        )
        eventually(lambda: len(read_episodes(run)) > episodes, "episodes appended")
        train.signal(signal.SIGINT)
        assert train.wait_without_plots() == 0, train.err
    assert "stopping (Ctrl-C) …" in train.err
    assert "Traceback" not in train.err
    no_trace_of(name, run)
    after = summary_of(run)
    for counter in ("learner_steps", "weights_version", "robot_steps", "inserts", "wall_s"):
        assert float(str(after[counter])) > float(str(before[counter])), counter
    loaded = checkpoint.load_latest(run / "checkpoints")
    assert loaded is not None
    assert loaded.skipped == ()
    assert loaded.checkpoint.state.learner_step == after["learner_steps"]
    assert loaded.checkpoint.weights_version >= int(str(after["weights_version"]))
    steps = [record.learner_steps for record in read_episodes(run)]
    assert steps == sorted(steps)


# -- a terminal, and parts that are killed ----------------------------------------------------


class Terminal:
    """A pseudo-terminal of 120 x 40 and what was drawn on it."""

    def __init__(self) -> None:
        self._master, self.slave = pty.openpty()
        fcntl.ioctl(self.slave, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
        self.raw = b""

    @property
    def text(self) -> str:
        """Everything drawn so far, control sequences taken out."""
        return re.sub(
            r"\x1b(\[[0-9;?]*[a-zA-Z]|\][^\x07]*\x07)", "", self.raw.decode("utf-8", "replace")
        )

    def read(self, until: Callable[[], object], what: str) -> None:
        """Take in what is drawn until something is so."""
        deadline = time.monotonic() + PATIENCE_S
        while not until():
            assert time.monotonic() < deadline, (
                f"in {PATIENCE_S:g} s not: {what}\n{self.text[-6000:]}"
            )
            if select.select([self._master], [], [], 0.1)[0]:
                self.raw += os.read(self._master, 65536)

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def close(self) -> None:
        os.close(self._master)
        os.close(self.slave)


def service_process(name: str, role: str) -> int | None:
    """Its process id; None where it is not there."""
    return next(iter(processes_of(name, f"-m mrcdrl {role}")), None)


def test_live_screen_shows_the_run_outlives_kills_and_ends_at_ctrl_c(tmp_path: Path) -> None:
    name = run_name("screen")
    run = tmp_path / name
    terminal = Terminal()
    arguments = smoke_training(tmp_path, name)
    command = Command(
        [*arguments, "--learner-steps", NEVER],
        tmp_path,
        prefix=["setsid", "--ctty"],  # makes the terminal the controlling one: Ctrl-C is a signal
        terminal=terminal.slave,
        TERM="xterm-256color",
    )
    try:
        with command as train:
            terminal.read(lambda: metric(run, "learner_steps") >= 20, "learner steps")
            terminal.read(lambda: "% success" in terminal.text, "an evaluation")
            for word in (
                *("mrcdrl", name, "actor", "replay", "learner", "evaluator", "robot steps"),
                *("env steps", "learner steps", "samples per insert", "ε", "weights v"),
                *("successes in the last", "bottleneck", "evaluation", "left"),
            ):
                assert word in terminal.text, word
            mapped = shared_memory_of(name)
            _kill_and_see_it_back(run, name, terminal, train)
            mapped |= shared_memory_of(name)
            terminal.type(b"\x03")
            terminal.read(lambda: train.process.poll() is not None, "the end")
            assert train.wait() == 0, terminal.text[-3000:]
            terminal.read(lambda: "evaluation.mp4" in terminal.text, "the last line")
        assert terminal.raw.rstrip().endswith(b"evaluation.mp4")
        assert b"\x1b[?1049l" in terminal.raw  # the screen as it was before
        assert b"\x1b[?25h" in terminal.raw  # the cursor shown again
        assert "Traceback" not in terminal.text
        no_trace_of(name, run)
        assert not [path for path in mapped if path.exists()]
        assert checkpoint.load_latest(run / "checkpoints") is not None
    finally:
        terminal.close()
        end_all(name)


def _kill_and_see_it_back(run: Path, name: str, terminal: Terminal, train: Command) -> None:
    """The learner and an actor end by SIGKILL; the launcher starts both again."""
    lived_until_s = time.monotonic() + 11.0
    terminal.read(lambda: time.monotonic() > lived_until_s, "lived long enough")
    step, version = metric(run, "learner_steps"), metric(run, "weights_version")
    killed = [service_process(name, role) for role in ("learner", "actor")]
    for pid in killed:
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
    for role, pid in zip(("learner", "actor"), killed, strict=True):
        terminal.read(
            lambda role=role, pid=pid: service_process(name, role) not in (None, pid),
            f"another {role}",
        )
    terminal.read(lambda: metric(run, "learner_steps") > step + 20, "the learner goes on")
    terminal.read(lambda: metric(run, "weights_version") > version, "newer weights")
    assert train.process.poll() is None
    terminal.read(lambda: "restarting it" in terminal.text, "word of it on the screen")
    found = checkpoint.load_latest(run / "checkpoints")
    assert found is not None
    assert found.checkpoint.state.learner_step > 0
