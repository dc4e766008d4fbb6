"""Real processes for the system tests: started, watched, and ended whatever the test does.

Invariants: every process has its own session and is ended by its id; output goes to files, so that
no pipe fills; every wait has a deadline and says what it waited for.
"""

import os
import re
import signal
import subprocess
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mrcdrl.common.runtime.process import COMMAND
from tests.patience import PATIENCE_S, eventually

REPOSITORY = Path(__file__).resolve().parents[2]
T = TypeVar("T")

# Every part at its smallest: images of 32 px, short episodes.
SMALL = (
    "--arena.view_px=32",
    "--arena.max_frames=30",
    "--learner.precision=float32",
    "--evaluator.episodes=2",
    "--learner.checkpoint_period_s=0.5",
)


def run_name(stem: str) -> str:
    """A name that no other process on this machine has in its command line."""
    return f"{stem}-{uuid.uuid4().hex[:12]}"


def smoke_training(folder: Path, name: str) -> list[str | Path]:
    """Arguments that train the smoke preset at its smallest, with its run in a folder."""
    named = ["--run-dir", folder, "--name", name]
    return ["train", "--config", "smoke", "--no-web", *named, *SMALL]


def environment(**more: str) -> dict[str, str]:
    """This process's environment without settings of mrcdrl, plus more."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("MRCDRL_")}
    return {**kept, **more}


class Command:
    """`mrcdrl …` as a process; `end` it, or use it in `with`."""

    def __init__(
        self,
        arguments: Sequence[str | Path],
        folder: Path,
        *,
        prefix: Sequence[str] = (),
        terminal: int | None = None,
        **variables: str,
    ) -> None:
        label = uuid.uuid4().hex[:6]
        self.out_path = folder / f"{arguments[0]}-{label}.out"
        self.err_path = folder / f"{arguments[0]}-{label}.err"
        with self.out_path.open("wb") as out, self.err_path.open("wb") as err:
            self.process = subprocess.Popen(
                [*prefix, *COMMAND, *map(str, arguments)],
                stdin=subprocess.DEVNULL if terminal is None else terminal,
                stdout=out if terminal is None else terminal,
                stderr=err if terminal is None else terminal,
                env=environment(**variables),
                cwd=REPOSITORY,
                start_new_session=terminal is None,
            )

    def __enter__(self) -> "Command":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def out(self) -> str:
        return self.out_path.read_text("utf-8", "replace")

    @property
    def err(self) -> str:
        return self.err_path.read_text("utf-8", "replace")

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def wait(self, timeout_s: float = PATIENCE_S) -> int:
        """The exit code."""
        return self.process.wait(timeout_s)

    def wait_without_plots(self) -> int:
        """The exit code of a run that is asked, once it has ended, for neither plots nor video."""
        eventually(
            lambda: "writing plots" in self.err or self.process.poll() is not None, "the run ends"
        )
        self.signal(signal.SIGINT)
        return self.wait()

    def end(self) -> int:
        """Ask it to stop, insist after a while."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                return self.process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
        return self.process.wait(PATIENCE_S)


def printed(
    folder: Path, *arguments: str | Path, timeout_s: float = PATIENCE_S, **variables: str
) -> str:
    """What a command that must not fail prints, with these variables."""
    with Command(arguments, folder, **variables) as command:
        assert command.wait(timeout_s) == 0, command.err
    assert "Traceback" not in command.err
    return command.out


@dataclass(frozen=True, slots=True)
class Finished:
    """A run of `mrcdrl train` that ended by itself, and what it left."""

    name: str
    path: Path
    code: int
    out: str
    err: str
    processes_left: dict[int, str]
    shared_memory: set[Path]  # files that its processes had mapped


def serves(replay: Command) -> None:
    """Wait until a replay process answers: who joins waits for it as long as a person would."""
    eventually(lambda: "replay: serving" in replay.err or replay.process.poll(), "replay serves")
    assert replay.process.poll() is None, replay.err


def processes_of(*words: str) -> dict[int, str]:
    """Process id to command line of all other processes with these words in theirs."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode("utf-8", "replace")
        except OSError:
            continue
        if all(word in line for word in words):
            found[int(entry.name)] = line
    return found


def end_all(name: str) -> None:
    """Kill the processes that a failed test left of a run."""
    for pid in processes_of(name):
        os.kill(pid, signal.SIGKILL)


def shared_memory_of(name: str) -> set[Path]:
    """Files below /dev/shm that a run's processes have mapped."""
    found = set()
    for pid in processes_of(name):
        try:
            maps = Path(f"/proc/{pid}/maps").read_text("utf-8")
        except OSError:  # it ended meanwhile
            continue
        found |= {Path(path) for path in re.findall(r"/dev/shm/\S+", maps)}
    return found


def error_line(stderr: str) -> str:
    """The line that says what is wrong; log lines, with a time, and progress may precede it."""
    assert "Traceback" not in stderr, stderr
    other = re.compile(r"\d{4}-\d\d-\d\d |\w+: \d+ of \d+")
    lines = [line for line in stderr.splitlines() if not other.match(line)]
    assert len(lines) == 1, stderr
    assert lines[0].startswith("mrcdrl: "), stderr
    return lines[0]
