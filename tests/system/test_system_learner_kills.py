"""The learner is killed again and again: versions never go back, and training goes on."""

import signal
from pathlib import Path

import pytest

from common.config import TransportConfig
from common.keys import Keys
from common.trajectory import Evaluation, Weights
from common.transport import Session, free_endpoint
from common.weights import WeightsReader
from common.wire import decode
from tests.system.system_processes import SMALL, Command, end_all, eventually, run_name

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]

KILLS = 3
MORE = 20  # learner steps between two of them


class Follower:
    """Hears all that is published of weights and evaluations, and what a reader makes of it."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self._reader = WeightsReader(session, keys)
        self._published = session.queue_subscriber(keys.weights)
        self._evaluations = session.queue_subscriber(keys.every_evaluation)
        self.taken: list[Weights] = []
        self.published: list[Weights] = []
        self.judged: list[int] = []

    def listen(self) -> None:
        """For half a second at most, or until the reader has newer weights."""
        newer = self._reader.latest(0.5)
        self.taken += [newer] if newer else []
        while (item := self._published.take(0.0)) is not None:
            self.published.append(decode(Weights, item[1]))
        while (item := self._evaluations.take(0.0)) is not None:
            self.judged.append(decode(Evaluation, item[1]).weights_version)
        assert self._reader.refused == 0

    def reaches(self, learner_step: int) -> bool:
        self.listen()
        return bool(self.taken) and self.taken[-1].learner_step >= learner_step

    def has_judged(self, version: int) -> bool:
        self.listen()
        return bool(self.judged) and self.judged[-1] >= version


def test_versions_never_go_back_and_training_goes_on(tmp_path: Path) -> None:
    name, endpoint = run_name("kills"), free_endpoint()
    here = ["--run", name, "--run-dir", tmp_path]
    joining = [*here, "--connect", endpoint, "--id"]
    serving = ["replay", *here, "--config", "smoke", "--listen", endpoint, *SMALL]
    try:
        with (
            Command([*serving, "--run.learner_steps=0"], tmp_path),
            Session(TransportConfig(connect=(endpoint,)), open_timeout_s=120) as session,
            Command(["actor", *joining, "actor-0"], tmp_path),
            Command(["evaluator", *joining, "evaluator-0"], tmp_path),
        ):
            follower, reached = Follower(session, Keys(name)), 0
            versions_at_kill = []
            for _ in range(KILLS):
                with Command(["learner", *joining, "learner-0"], tmp_path) as learner:
                    due = reached + MORE
                    eventually(lambda due=due: follower.reaches(due), f"learner step {due}")
                    learner.signal(signal.SIGKILL)
                    assert learner.wait() == -signal.SIGKILL
                follower.listen()
                reached = follower.taken[-1].learner_step
                versions_at_kill.append(follower.taken[-1].version)
            with Command(["learner", *joining, "learner-0"], tmp_path) as learner:
                due = reached + MORE
                eventually(lambda: follower.reaches(due), f"learner step {due}")
                newest = follower.taken[-1].version
                eventually(lambda: follower.has_judged(newest), f"version {newest} is judged")
                learner.signal(signal.SIGTERM)
                assert learner.wait() == 0, learner.err
                assert "going on from" in learner.err
    finally:
        end_all(name)
    orders = [weights.order for weights in follower.published]
    assert orders == sorted(set(orders)), "nothing older, nothing twice, not even on the wire"
    assert len({weights.epoch for weights in follower.published}) == 1
    assert follower.judged == sorted(follower.judged)
    assert versions_at_kill == sorted(set(versions_at_kill))
    assert newest > versions_at_kill[-1]
