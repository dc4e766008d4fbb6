"""Who is who: of several processes that claim one name at a time, exactly one has it."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import NameTakenError
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.claim import claim_learner, claim_name, claim_shard
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from tests.patience import PATIENCE_S, eventually

KEYS = Keys("claimed")
CLAIMANTS = 4


@pytest.fixture(scope="module")
def router() -> Iterator[TransportConfig]:
    """How to reach a router that all tests here share."""
    endpoint = free_endpoint()
    with Session(TransportConfig(listen=(endpoint,))):
        yield TransportConfig(connect=(endpoint,), timeout_s=PATIENCE_S)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> StopSignal:
    """A signal that does not come; nobody waits for a name that is taken."""
    monkeypatch.setattr("mrcdrl.common.sync.claim._LAPSE_S", 0.0)
    return StopSignal()


def test_a_name_that_is_taken_is_refused_in_one_line(
    router: TransportConfig, impatient: StopSignal
) -> None:
    stop = impatient
    with Session(router) as first, Session(router) as second:
        claim_name(first, KEYS, "actor", "a", stop)
        with pytest.raises(NameTakenError) as refused:
            claim_name(second, KEYS, "actor", "a", stop)
        assert str(refused.value) == "run claimed has an actor named a; give each its own --id"
        claim_name(second, KEYS, "actor", "b", stop)
        claim_name(second, KEYS, "evaluator", "a", stop)
        claim_name(second, Keys("another"), "actor", "a", stop)


def test_a_run_has_one_learner_and_a_shard_one_process(
    router: TransportConfig, impatient: StopSignal
) -> None:
    with Session(router) as first, Session(router) as second:
        claim_learner(first, KEYS, impatient)
        claim_shard(first, KEYS, 0, impatient)
        claim_shard(second, KEYS, 1, impatient)
        with pytest.raises(NameTakenError, match="run claimed has a learner; a run has one"):
            claim_learner(second, KEYS, impatient)
        with pytest.raises(NameTakenError, match="a replay service for shard 0; a shard has one"):
            claim_shard(second, KEYS, 0, impatient)


def test_a_name_is_free_again_when_its_process_has_ended(router: TransportConfig) -> None:
    stop = StopSignal()
    with Session(router) as second, ThreadPoolExecutor(1) as other:
        with Session(router) as first:
            claim_name(first, KEYS, "actor", "ended", stop)
            claimed = other.submit(claim_name, second, KEYS, "actor", "ended", stop)
        claimed.result()


def test_who_waits_for_a_name_can_be_stopped(router: TransportConfig) -> None:
    stop = StopSignal()
    stop.set()
    with Session(router) as first, Session(router) as second:
        claim_name(first, KEYS, "actor", "stopped", stop)
        with pytest.raises(NameTakenError):
            claim_name(second, KEYS, "actor", "stopped", stop)


def test_of_those_that_start_at_once_one_has_the_name(
    router: TransportConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mrcdrl.common.sync.claim._LAPSE_S", 600.0)
    together, decided = Barrier(CLAIMANTS), StopSignal()

    def claim(_number: int) -> Session | None:
        session = Session(router)
        together.wait()
        try:
            claim_name(session, KEYS, "actor", "at-once", decided)
        except NameTakenError:
            session.close()
            return None
        decided.set()
        return session

    with ThreadPoolExecutor(CLAIMANTS) as claimants:
        holders = [session for session in claimants.map(claim, range(CLAIMANTS)) if session]
    held = holders[0].tokens(KEYS.claim("actor", "at-once", "*")) if holders else set()
    for session in holders:
        session.close()
    assert len(holders) == len(held) == 1


def test_a_link_that_comes_back_keeps_its_name(impatient: StopSignal) -> None:
    endpoint = free_endpoint()
    listening = TransportConfig(listen=(endpoint,))
    router = Session(listening)
    joining = TransportConfig(connect=(endpoint,), timeout_s=PATIENCE_S)
    with Session(joining) as first:
        claim_name(first, KEYS, "actor", "cut-off", impatient)
        lost = first._session  # which comes and goes until another has taken its place
        router.close()
        with Session(listening), Session(joining, open_timeout_s=PATIENCE_S) as second:
            eventually(lost.is_closed, "another Zenoh session")
            with pytest.raises(NameTakenError):
                claim_name(second, KEYS, "actor", "cut-off", impatient)
