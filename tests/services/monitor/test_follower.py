"""A follower believes of a publication only what its key and the checks allow."""

import dataclasses
import logging
import time
from collections.abc import Callable, Iterator

import pytest

from mrcdrl.common.config import Config, RunConfig, TransportConfig
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome, Stats
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys, role_and_worker
from mrcdrl.services.monitor.follower import Follower
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule
from tests.patience import PATIENCE_S

KEYS = Keys("followed")
CONFIG = Config(run=RunConfig(target_success_rate=0.9))
EPISODE = EpisodeSummary("a", 0, 1, Outcome.SUCCESS, 9, 1.5, 0, 0.1, 3, 2.5, 2)


def learner(version: float) -> Stats:
    return Stats("learner", "0", {"weights_epoch": 7.0, "weights_version": version})


def judged(version: int) -> Evaluation:
    counts = (5.0, 5.0, 0.0, 9.0, 1.0, 0, 1.0)
    return Evaluation("e", 7, version, 100, 2, 10, 1.0, 0.0, 0.0, (0.7, 1.0), *counts)


@pytest.fixture
def session() -> Iterator[Session]:
    with Session(TransportConfig(listen=(free_endpoint(),))) as opened:
        for role, worker in (("learner", "0"), ("actor", "a"), ("evaluator", "e")):
            opened.announce(KEYS.live(role, worker))
        yield opened


def listen_until(follower: Follower, heard: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not heard():
        assert time.monotonic() < deadline
        follower.listen(0.05)


def test_a_message_on_the_key_of_another_is_refused(
    session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    state = RunState(CONFIG)
    follower = Follower(session, KEYS, state, None, StoppingRule(CONFIG.run))
    caplog.set_level(logging.WARNING)
    session.publisher(KEYS.stats("learner", "x1")).put(encode(learner(10**6)))
    session.publisher(KEYS.stats("actor", "0")).put(encode(learner(10**6)))
    session.publisher(KEYS.episodes("b")).put(encode(EPISODE))
    session.publisher(KEYS.evaluation("b")).put(encode(judged(1)))
    session.publisher(KEYS.stats("learner", "0")).put(encode(learner(5)))
    session.publisher(KEYS.episodes("a")).put(encode(EPISODE))
    session.publisher(KEYS.evaluation("e")).put(encode(judged(2)))
    listen_until(follower, lambda: bool(state.evaluations and state.episodes and state.services))
    heard = [(s.role, s.id) for s in state.services if s.metrics]
    assert heard == [("learner", "0")]
    assert (state.published, state.episodes, len(state.evaluations)) == ((7.0, 5), 1, 1)
    refused = [r.getMessage() for r in caplog.records if "refused" in r.getMessage()]
    assert len(refused) == 3
    assert "Stats message refused, 1 so far: a message of learner/0 on key" in refused[0]
    assert "4 so far" in refused[-1]


def test_the_run_ends_by_an_evaluation_once_its_weights_are_published(session: Session) -> None:
    state = RunState(CONFIG)
    follower = Follower(session, KEYS, state, None, StoppingRule(CONFIG.run))
    session.publisher(KEYS.evaluation("e")).put(encode(judged(9)))
    listen_until(follower, lambda: bool(state.evaluations))
    assert follower.stop_reason(learner_ended=False) is None
    statistics = session.publisher(KEYS.stats("learner", "0"))
    statistics.put(encode(learner(8)))
    listen_until(follower, lambda: state.weights_version == 8)
    assert follower.stop_reason(learner_ended=False) is None
    statistics.put(encode(learner(9)))
    listen_until(follower, lambda: state.weights_version == 9)
    assert "run.target_success_rate" in str(follower.stop_reason(learner_ended=False))


def test_who_holds_no_token_counts_for_nothing(
    session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever a stranger claims: steps, published weights, a hundred successes, many episodes."""
    config = Config(run=RunConfig(target_success_rate=0.9, learner_steps=9, patience_episodes=1))
    state = RunState(config)
    follower = Follower(session, KEYS, state, None, StoppingRule(config.run))
    caplog.set_level(logging.WARNING)
    claimed = {"learner_steps": 1e15, "weights_epoch": 7.0, "weights_version": 1e15}
    statistics = session.publisher(KEYS.stats("learner", "x1"))
    statistics.put(encode(Stats("learner", "x1", claimed)))
    for number in range(300):
        claim = dataclasses.replace(EPISODE, actor="x1", episode=number)
        session.publisher(KEYS.episodes("x1")).put(encode(claim))
    best = dataclasses.replace(judged(3), worker="x1")
    session.publisher(KEYS.evaluation("x1")).put(encode(best))
    session.publisher(KEYS.stats("learner", "0")).put(encode(learner(5)))
    session.publisher(KEYS.episodes("a")).put(encode(EPISODE))
    session.publisher(KEYS.evaluation("e")).put(encode(judged(6)))
    listen_until(follower, lambda: bool(state.evaluations and state.episodes and state.published))
    assert (state.learner_steps, state.published, state.episodes) == (0, (7.0, 5), 1)
    assert [record.evaluation.worker for record in state.evaluations] == ["e"]
    assert follower.stop_reason(learner_ended=True) is None
    assert "learner x1 holds no liveliness token" in caplog.text


def test_learner_steps_that_are_only_told_end_no_run(session: Session) -> None:
    config = Config(run=RunConfig(learner_steps=9))
    state = RunState(config)
    follower = Follower(session, KEYS, state, None, StoppingRule(config.run))
    claimed = Stats("learner", "0", {"learner_steps": 9.0})
    session.publisher(KEYS.stats("learner", "0")).put(encode(claimed))
    listen_until(follower, lambda: state.learner_steps == 9)
    assert follower.stop_reason(learner_ended=False) is None
    assert follower.stop_reason(learner_ended=True) == "learner step limit reached (9)"


def test_a_liveliness_token_of_no_name_is_ignored(session: Session) -> None:
    state = RunState(CONFIG)
    follower = Follower(session, KEYS, state, None, StoppingRule(CONFIG.run))
    session.announce(f"mrcdrl/{KEYS.run}/live/actor/\x1b[31m")
    session.announce(KEYS.live("actor", "last"))
    listen_until(follower, lambda: state.knows("actor", "last"))
    assert {s.id for s in state.services} == {"0", "a", "e", "last"}


def test_the_name_in_a_liveliness_token_is_printable() -> None:
    role, worker = role_and_worker("mrcdrl/run/live/act\x1bor/" + "\n" * 1000)
    assert (role + worker).isprintable()
    assert len(worker) <= 64
    assert role_and_worker(KEYS.live("actor", "a-0")) == ("actor", "a-0")
