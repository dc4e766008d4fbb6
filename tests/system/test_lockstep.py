"""A run that takes turns gives the same numbers however often its processes are killed."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.learner import checkpoint
from mrcdrl.services.learner.learner import LearnerState
from tests.patience import eventually
from tests.system.system_processes import (
    PATIENCE_S,
    SMALL,
    Command,
    end_all,
    run_name,
    serves,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]

STEPS = 48  # of the learner, 8 a turn
TURNS = (
    *SMALL,
    "--run.turn_size=64",
    f"--run.learner_steps={STEPS}",
    "--replay.min_size=128",
    "--replay.capacity=300",  # so that transitions go before the end
    "--learner.symmetries=true",
    "--learner.device=cpu",
    "--learner.threads=1",
)


class Run:
    """Replay, learner and actor of a run, each as a process."""

    def __init__(self, folder: Path) -> None:
        self.name, self.endpoint, self.folder = run_name("turns"), free_endpoint(), folder
        folder.mkdir()

    @contextmanager
    def process(self, role: str) -> Iterator[Command]:
        here = [role, "--run", self.name, "--run-dir", self.folder]
        serving = ["--config", "smoke", "--listen", self.endpoint, *TURNS]
        joining = ["--connect", self.endpoint, "--id", f"{role}-0"]
        with Command([*here, *(serving if role == "replay" else joining)], self.folder) as command:
            if role == "replay":
                serves(command)
            yield command

    def session(self) -> Session:
        return Session(TransportConfig(connect=(self.endpoint,)), open_timeout_s=PATIENCE_S)

    def final(self) -> LearnerState:
        loaded = checkpoint.load_latest(self.folder / self.name / "checkpoints")
        assert loaded is not None
        return loaded.checkpoint.state


def ended(learner: Command) -> None:
    eventually(lambda: learner.process.poll() is not None, f"the end: {learner.err}")
    assert learner.wait() == 0, learner.err


def test_the_same_numbers_whatever_is_killed(tmp_path: Path) -> None:
    whole, broken = Run(tmp_path / "whole"), Run(tmp_path / "broken")
    try:
        with whole.process("replay"), whole.process("actor"), whole.process("learner") as learner:
            ended(learner)
        with broken.process("replay") as replay, broken.session() as session:
            reader = WeightsReader(session, Keys(broken.name))

            def reached(step: int) -> bool:
                newer = reader.latest(0.2)
                return newer is not None and newer.learner_step >= step

            with broken.process("actor") as actor, broken.process("learner") as learner:
                eventually(lambda: reached(8), "the first turn's end")
                kill(learner)
                kill(actor)
            with broken.process("learner") as learner, broken.process("actor") as actor:
                eventually(lambda: reached(24), "the third turn's end")
                for process in (actor, replay, learner):
                    kill(process)
        with (
            broken.process("replay"),
            broken.process("actor") as actor,
            broken.process("learner") as learner,
        ):
            ended(learner)
    finally:
        end_all(whole.name)
        end_all(broken.name)
    expected, found = whole.final(), broken.final()
    assert expected.learner_step == STEPS
    assert found == expected


def kill(process: Command) -> None:
    process.signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, process.err
