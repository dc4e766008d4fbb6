"""The limiter keeps both sides at the ratio, and one of them may always proceed."""

import hypothesis.strategies as st
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from mrcdrl.common.errors import ConfigError
from mrcdrl.services.replay.limiter import RateLimiter


class TwoSides(RuleBasedStateMachine):
    """Actors and a learner that ask before they act."""

    @initialize(
        ratio=st.sampled_from([0.5, 1.0, 4.0, 8.0]),
        min_size=st.integers(1, 60),
        tolerance=st.sampled_from([0.0, 0.1, 1.0]),
        insert=st.integers(1, 16),
        sample=st.integers(1, 32),
    )
    def make(self, ratio: float, min_size: int, tolerance: float, insert: int, sample: int) -> None:
        self.largest_insert, self.largest_sample = insert, sample
        self.limiter = RateLimiter.with_tolerance(ratio, min_size, tolerance, insert, sample)

    @rule(data=st.data(), times=st.integers(1, 8))
    def insert(self, data: st.DataObject, times: int) -> None:
        for _ in range(times):
            count = data.draw(st.integers(1, self.largest_insert))
            if self.limiter.can_insert(count):
                self.limiter.inserts += count

    @rule(data=st.data(), times=st.integers(1, 8))
    def sample(self, data: st.DataObject, times: int) -> None:
        for _ in range(times):
            count = data.draw(st.integers(1, self.largest_sample))
            if self.limiter.can_sample(count):
                self.limiter.samples += count

    @rule(lost=st.integers(0, 500), ratio=st.sampled_from([0.5, 1.0, 4.0, 8.0]))
    def continue_in_another_process(self, lost: int, ratio: float) -> None:
        """The last samples were not saved, and the ratio may have changed."""
        before = self.limiter
        tolerance = before.error_buffer / (before.min_size * before.samples_per_insert)
        self.limiter = RateLimiter.with_tolerance(
            ratio, before.min_size, tolerance, self.largest_insert, self.largest_sample
        )
        if before.inserts < before.min_size:
            self.limiter.resume(before.inserts)
        else:
            self.limiter.restore(before.inserts, max(before.samples - lost, 0))
        assert self.limiter.inserts == before.inserts
        if ratio == before.samples_per_insert and lost == 0:
            assert self.limiter.samples == before.samples

    @invariant()
    def samples_stay_within_the_buffer(self) -> None:
        limiter = self.limiter
        if limiter.inserts < limiter.min_size:
            assert limiter.samples == 0
            return
        due = limiter.samples_per_insert * (limiter.inserts - limiter.min_size)
        assert abs(due - limiter.samples) <= limiter.error_buffer

    @invariant()
    def one_side_may_make_its_largest_request(self) -> None:
        limiter = self.limiter
        assert limiter.can_insert(self.largest_insert) or limiter.can_sample(self.largest_sample)


TestTwoSides = TwoSides.TestCase
TestTwoSides.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)


def test_nothing_is_sampled_before_min_size_and_inserts_continue_meanwhile() -> None:
    limiter = RateLimiter(8.0, 1000, 500.0, 50, 32)
    for _ in range(19):
        assert limiter.can_insert(50)
        limiter.inserts += 50
        assert not limiter.can_sample(1)
    limiter.inserts += 50
    assert limiter.can_sample(32)


def test_by_hand_at_both_edges() -> None:
    limiter = RateLimiter(4.0, 10, 40.0, 10, 20, inserts=15, samples=0)
    assert limiter.can_insert(5)  # 5 x 4 + 5 x 4 = 40 samples due
    assert not limiter.can_insert(6)
    limiter.samples = 40
    assert limiter.can_sample(20)  # 60 sampled where 20 are due
    assert not limiter.can_sample(21)


def test_ratio_0_limits_nothing_but_the_first_sample() -> None:
    limiter = RateLimiter(0.0, 5, 0.0, 50, 32)
    assert not limiter.can_sample(32)
    limiter.inserts = 5
    assert limiter.can_sample(10**9)
    assert limiter.can_insert(10**9)


def test_the_ratio_counts_from_the_first_insert_that_could_be_sampled() -> None:
    limiter = RateLimiter(4.0, 100, 400.0, 50, 32)
    assert limiter.ratio == 0
    limiter.inserts, limiter.samples = 150, 200
    assert limiter.ratio == 4.0


@pytest.mark.parametrize(
    ("ratio", "min_size", "buffer", "insert", "sample", "reason"),
    [
        (8.0, 1000, 399.0, 50, 32, "a lead of 399 samples, one request moves 400"),
        (0.5, 1000, 31.0, 50, 32, "wait for each other forever"),
        (-1.0, 1000, 1e6, 50, 32, "samples_per_insert >= 0"),
        (1.0, 0, 1e6, 50, 32, "min_size >= 1"),
    ],
)
def test_settings_that_would_deadlock_are_refused(
    ratio: float, min_size: int, buffer: float, insert: int, sample: int, reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        RateLimiter(ratio, min_size, buffer, insert, sample)


@pytest.mark.parametrize(
    ("tolerance", "buffer"), [(0.1, 0.1 * 50_000 * 8), (0.0, 2 * 8 * 50), (1e-9, 2 * 8 * 50)]
)
def test_the_tolerance_scales_with_min_size_but_allows_two_requests(
    tolerance: float, buffer: float
) -> None:
    limiter = RateLimiter.with_tolerance(8.0, 50_000, tolerance, 50, 32)
    assert limiter.error_buffer == pytest.approx(buffer)
