"""Services started by hand against a run that is up, and a launcher that is killed."""

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.messages.trajectory import NO_SLOT, Evaluation, Stats
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.joining import ENDPOINT_FILE
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport import Presence, QueueSubscriber, Session
from mrcdrl.common.transport.keys import Keys, role_and_worker
from tests.patience import eventually
from tests.system.system_processes import (
    PATIENCE_S,
    Command,
    end_all,
    error_line,
    processes_of,
    run_name,
    smoke_training,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


@dataclass(frozen=True, slots=True)
class Live:
    """A run that is up, and this process as one of its peers."""

    name: str
    folder: Path  # where its run directory lies
    train: Command
    endpoint: str
    session: Session
    presence: Presence
    stats: QueueSubscriber
    evaluations: QueueSubscriber

    @property
    def join(self) -> list[str]:
        """What a person types: no endpoint."""
        return ["--run", self.name, "--run-dir", str(self.folder)]

    def is_there(self, role: str, worker: str) -> bool:
        return (role, worker) in {role_and_worker(key) for key in self.presence.alive()}

    def hear(self, worker: str, metric: str, above: float) -> float:
        """A worker's metric as soon as it is larger."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            item = self.stats.take(0.5)
            if item is None:
                continue
            stats = decode(Stats, item[1])
            if stats.id == worker and stats.metrics.get(metric, above) > above:
                return stats.metrics[metric]
        raise AssertionError(f"{worker} said of no {metric} above {above}")


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """`mrcdrl train` without an evaluator of its own, up and learning."""
    folder, name = tmp_path_factory.mktemp("live"), run_name("live")
    arguments = smoke_training(folder, name)
    more = ["--run.evaluators", "0", "--learner-steps", "100000000"]
    more += ["--exploration.lease_s", "3"]
    note = folder / name / ENDPOINT_FILE
    try:
        with Command([*arguments, *more], folder) as train:
            eventually(lambda: note.exists() or train.process.poll() is not None, "an endpoint")
            endpoint, keys = note.read_text("utf-8"), Keys(name)
            with Session(TransportConfig(connect=(endpoint,))) as session:
                known = Live(
                    *(name, folder, train, endpoint, session),
                    session.presence(keys.everyone()),
                    session.queue_subscriber(keys.every_stats),
                    session.queue_subscriber(keys.every_evaluation),
                )
                known.hear("learner-0", "learner_steps", 0)
                yield known
    finally:
        end_all(name)


def test_a_late_joiner_has_weights(live: Live) -> None:
    stop = StopSignal()
    with Session(TransportConfig(connect=(live.endpoint,))) as session:
        reader = WeightsReader(session, Keys(live.name))
        weights = reader.wait(stop, PATIENCE_S)
    assert weights is not None
    assert weights.version >= 1


def test_an_actor_joins_leaves_and_joins_again_by_hand(live: Live) -> None:
    for worker in ("by-hand", "by-hand-2"):
        with Command(["actor", *live.join, "--id", worker], live.folder) as actor:
            eventually(lambda worker=worker: live.is_there("actor", worker), f"{worker} joins")
            live.hear(worker, "inserts_acknowledged", 0)
            live.hear(worker, "slot", NO_SLOT)
            assert live.is_there("actor", "actor-0")
            actor.signal(signal.SIGTERM)
            assert actor.wait() == 0, actor.err
        eventually(lambda worker=worker: not live.is_there("actor", worker), f"{worker} leaves")
    steps = live.hear("learner-0", "learner_steps", 0)
    live.hear("learner-0", "learner_steps", steps)
    assert live.train.process.poll() is None


def test_an_evaluator_joins_by_hand_and_ends_at_ctrl_c(live: Live) -> None:
    with Command(["evaluator", *live.join, "--id", "judge"], live.folder) as evaluator:
        found = eventually(lambda: live.evaluations.take(0.5), "an evaluation")
        result = decode(Evaluation, found[1])
        evaluator.signal(signal.SIGINT)
        assert evaluator.wait() == 0, evaluator.err
    assert (result.worker, result.episodes, result.num_robots) == ("judge", 2, 2)
    assert result.weights_version >= 1
    best = live.folder / live.name / "checkpoints" / "best.json"
    assert json.loads(best.read_bytes())["worker"] == "judge"


def test_who_would_be_another_is_refused_in_one_line(live: Live) -> None:
    """Each waits a while, since the other might have just ended; so all wait together."""
    impostors = {
        "an actor named actor-0; give each its own --id": ["actor", *live.join, "--id", "actor-0"],
        "a learner; a run has one": ["learner", *live.join, "--id", "second"],
        "a replay service for shard 0; a shard has one": [
            *("replay", "--run", live.name, "--run-dir", str(live.folder / "elsewhere")),
            *("--connect", live.endpoint, "--id", "second"),
        ],
    }
    with ExitStack() as started:
        commands = {
            said: started.enter_context(Command(arguments, live.folder))
            for said, arguments in impostors.items()
        }
        for said, command in commands.items():
            assert command.wait() == 1, command.err
            assert error_line(command.err) == f"mrcdrl: run {live.name} has {said}"
    known = {role_and_worker(key) for key in live.presence.alive()}
    assert {("actor", "actor-0"), ("learner", "learner-0"), ("replay", "replay-0")} == known
    steps = live.hear("learner-0", "learner_steps", 0)
    live.hear("learner-0", "learner_steps", steps)


def test_a_second_launcher_is_refused_while_the_run_is_up(live: Live) -> None:
    arguments = ["train", "--no-web", "--resume", live.name, "--run-dir", live.folder]
    with Command(arguments, live.folder) as second:
        assert second.wait() == 1
    assert "in use by another process" in error_line(second.err)
    assert live.train.process.poll() is None


def test_services_end_with_a_launcher_that_is_killed(live: Live) -> None:
    """The last of this file: the run ends here."""

    def up() -> bool:
        services = processes_of(live.name, "-m mrcdrl", "--id").values()
        return all(any(role in line for line in services) for role in ("learner", "actor"))

    eventually(up, "a learner and an actor")
    os.kill(live.train.process.pid, signal.SIGKILL)
    assert live.train.wait() == -signal.SIGKILL
    eventually(lambda: not processes_of(live.name), "its services end")
