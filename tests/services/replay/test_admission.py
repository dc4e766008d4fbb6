"""When a sample is admitted: at the rate limiter's pace, or turn by turn in lockstep."""

import numpy as np
import pytest

from mrcdrl.common.config import Config, ReplayConfig, RunConfig
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.trajectory import SampleRequest
from mrcdrl.common.sync.lockstep import Lockstep
from mrcdrl.services.replay.admission import InLockstep, RateLimited, make_admission
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.sampler import UniformSampler
from mrcdrl.services.replay.table import Table
from tests.services.replay.harness import make_chunk

LOCKSTEP = Lockstep(first=10, size=20, steps=4)
BATCH = 8


def table_of(inserts: int) -> Table:
    table = Table(100, 2, 1, 10, 4, UniformSampler(np.random.default_rng(0)))
    for sequence in range(inserts // 10):
        table.insert(make_chunk(sequence, 10, tail=2, record_bytes=4))
    return table


@pytest.mark.parametrize(
    ("inserts", "samples", "reason"),
    [
        (9, 0, "the table holds 9 of the first 10 transitions"),
        (10, 0, None),
        (10, 8, "the actors have not inserted enough for another sample yet"),
        (20, 8, None),
    ],
)
def test_the_rate_limiter_admits_samples(inserts: int, samples: int, reason: str | None) -> None:
    limiter = RateLimiter(1.0, 10, 10.0, 10, BATCH, inserts, samples)
    admission = RateLimited(limiter)
    request = SampleRequest(BATCH)
    assert admission.can_sample(request) == (reason is None)
    if reason is not None:
        assert admission.why_not(request) == reason


@pytest.mark.parametrize(("step", "due"), [(0, 30), (3, 30), (4, 50)])
def test_lockstep_admits_a_step_when_exactly_its_turns_are_inserted(step: int, due: int) -> None:
    request = SampleRequest(BATCH, step)
    early, in_time, late = (InLockstep(LOCKSTEP, table_of(n), 7) for n in (due - 10, due, due + 10))
    assert not early.can_sample(request)
    assert early.why_not(request) == "the actors have not inserted enough for another sample yet"
    assert in_time.can_sample(request)
    with pytest.raises(WireError, match=f"{due + 10} transitions where {due} are due"):
        late.can_sample(request)


def test_lockstep_refuses_a_request_without_a_learner_step() -> None:
    with pytest.raises(WireError, match="must state its learner step"):
        InLockstep(LOCKSTEP, table_of(30), 7).can_sample(SampleRequest(BATCH))


def test_a_repeated_step_has_the_same_samples_and_no_other_step_has() -> None:
    admission = InLockstep(LOCKSTEP, table_of(30), 7)

    def keys(step: int) -> list[int]:
        admission.reseed(SampleRequest(BATCH, step))
        return admission.table.sample(BATCH).keys.tolist()

    first = keys(0)
    assert keys(1) != first
    assert keys(0) == first


def test_the_rate_limiter_leaves_the_random_stream_alone() -> None:
    limiter = RateLimiter(0.0, 10, 0.0, 10, BATCH)
    table, untouched = table_of(30), table_of(30)
    RateLimited(limiter).reseed(SampleRequest(BATCH))
    assert table.sample(BATCH).keys.tolist() == untouched.sample(BATCH).keys.tolist()


@pytest.mark.parametrize(("turn_size", "kind"), [(0, RateLimited), (64, InLockstep)])
def test_the_configuration_chooses(turn_size: int, kind: type) -> None:
    config = Config(
        replay=ReplayConfig(capacity=1000, min_size=96), run=RunConfig(turn_size=turn_size)
    )
    limiter = RateLimiter.from_config(config)
    assert type(make_admission(config, Table.from_config(config), limiter)) is kind
    assert (limiter.samples_per_insert == 0) == bool(turn_size)
