"""The table against a plain list of transitions: same data, same keys, oldest out first.

Uses both samplers; test_sampler.py tests how prioritized samples are spread and weighted.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)

from mrcdrl.common.config import load_config
from mrcdrl.common.config.returns import largest_n_step_return, largest_return
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.trajectory import Chunk, Float64Array, Int64Array, UInt8Array
from mrcdrl.services.replay.sampler import PrioritizedSampler, UniformSampler
from mrcdrl.services.replay.table import Table
from tests.services.replay import harness

RECORD_BYTES = 4
EXPONENT = 0.6


def make_chunk(
    number: int,
    length: int,
    *,
    stack: int = 4,
    n_step: int = 1,
    priorities: Sequence[float] = (),
) -> Chunk:
    """Chunk `number`; its records and columns differ from those of 65535 others."""
    rows = np.arange(stack - 1 + length + n_step, dtype=np.uint16)
    marks = np.stack([np.full_like(rows, number), rows], axis=1)
    steps = np.arange(length)
    return Chunk(
        actor="a",
        incarnation=0,
        sequence=number,
        weights_version=number + 7,
        records=marks.view(np.uint8),
        actions=((number + steps) % 3).astype(np.uint8),
        rewards=(number + steps / 1024).astype(np.float32),
        discounts=(1 / (1 + number + steps)).astype(np.float32),
        bootstrap_offsets=(1 + (number + steps) % n_step).astype(np.uint8),
        priorities=np.array(priorities, np.float32),
    )


CHUNK_LENGTH = 8


def make_table(
    capacity: int, *, stack: int = 4, n_step: int = 1, seed: int = 0, prioritized: bool = False
) -> Table:
    rng = np.random.default_rng(seed)
    sampler = PrioritizedSampler(capacity, EXPONENT, rng) if prioritized else UniformSampler(rng)
    return Table(capacity, stack, n_step, CHUNK_LENGTH, RECORD_BYTES, sampler)


@dataclass(frozen=True)
class Transition:
    """A transition in the model."""

    records: UInt8Array
    action: int
    reward: np.float32
    discount: np.float32
    offset: int
    version: int


PRIORITIES = st.floats(0, 1000, width=32)


class TableAgainstList(RuleBasedStateMachine):
    """Lists every transition ever inserted, and its priority, by key."""

    @initialize(
        capacity=st.integers(1, 40),
        stack=st.integers(1, 4),
        n_step=st.integers(1, 3),
        prioritized=st.booleans(),
    )
    def make(self, capacity: int, stack: int, n_step: int, prioritized: bool) -> None:
        self.capacity, self.stack, self.n_step = capacity, stack, n_step
        self.prioritized = prioritized
        self.table = make_table(capacity, stack=stack, n_step=n_step, prioritized=prioritized)
        self.model: list[Transition] = []
        self.priorities: list[float] = []
        self.largest = 1.0
        self.lengths: list[int] = []

    @rule(data=st.data(), times=st.integers(1, 4))
    def insert(self, data: st.DataObject, times: int) -> None:
        for _ in range(times):
            length = data.draw(st.integers(1, min(self.capacity, 12)))
            given = data.draw(
                st.one_of(st.just([]), st.lists(PRIORITIES, min_size=length, max_size=length))
            )
            chunk = make_chunk(
                len(self.lengths), length, stack=self.stack, n_step=self.n_step, priorities=given
            )
            if self.model and data.draw(st.booleans()):
                back = data.draw(
                    st.integers(1, min(4, len(self.lengths)))
                )  # robots' chunks alternate
                last = len(self.model) - 1 - sum(self.lengths[len(self.lengths) - back + 1 :])
                chunk = continuing(chunk, self.model[last].records)
            self.table.insert(chunk)
            self.priorities += given or [self.largest] * length
            self.largest = max(self.largest, *given, 0.0)
            self.lengths.append(length)
            self.model += [
                Transition(
                    records=chunk.records[t : t + self.stack + self.n_step],
                    action=int(chunk.actions[t]),
                    reward=chunk.rewards[t],
                    discount=chunk.discounts[t],
                    offset=int(chunk.bootstrap_offsets[t]),
                    version=chunk.weights_version,
                )
                for t in range(length)
            ]

    @rule(data=st.data())
    def update_priorities(self, data: st.DataObject) -> None:
        keys = data.draw(st.lists(st.integers(-3, len(self.model) + 3), max_size=12))
        given = data.draw(st.lists(PRIORITIES, min_size=len(keys), max_size=len(keys)))
        taken = self.table.update_priorities(np.array(keys, np.int64), np.array(given, np.float32))
        present = [
            (key, priority)
            for key, priority in zip(keys, given, strict=True)
            if self.oldest <= key < len(self.model)
        ]
        assert taken == (len(present) if self.prioritized else 0)
        for key, priority in present:
            self.priorities[key] = priority
            self.largest = max(self.largest, priority)

    @precondition(lambda self: self.model)
    @rule(size=st.integers(1, 64))
    def sample(self, size: int) -> None:
        samples = self.table.sample(size)
        assert len(samples) == size
        assert samples.table_size == len(self.table)
        np.testing.assert_allclose(samples.probabilities, self.probabilities(samples.keys), 1e-9)
        for index, key in enumerate(samples.keys.tolist()):
            assert self.oldest <= key < len(self.model)
            expected = self.model[key]
            np.testing.assert_array_equal(samples.records[index], expected.records)
            assert samples.actions[index] == expected.action
            assert samples.rewards[index] == expected.reward
            assert samples.discounts[index] == expected.discount
            assert samples.bootstrap_offsets[index] == expected.offset
            assert samples.weights_versions[index] == expected.version

    @property
    def oldest(self) -> int:
        return len(self.model) - len(self.table)

    def probabilities(self, keys: Int64Array) -> Float64Array:
        """Probabilities of these keys, by definition."""
        if not self.prioritized:
            return np.full(len(keys), 1 / len(self.table))
        scaled = (np.array(self.priorities) + 1e-6) ** EXPONENT
        scaled[: self.oldest] = 0
        return scaled[keys] / scaled.sum()

    @invariant()
    def holds_the_newest_whole_chunks(self) -> None:
        self.table.check_invariants()
        size = len(self.table)
        assert size <= self.capacity
        newest_first = np.cumsum(self.lengths[::-1]).tolist()
        assert size in (0, *newest_first)
        if newest_first:
            assert size >= newest_first[0]


TestTableAgainstList = TableAgainstList.TestCase
TestTableAgainstList.settings = settings(max_examples=60, stateful_step_count=25, deadline=None)


def test_full_chunks_fill_the_whole_capacity_and_leave_in_order() -> None:
    table = make_table(1000)
    for number in range(65):
        table.insert(make_chunk(number, 50))
        assert len(table) == min(50 * (number + 1), 1000)
    keys = table.sample(20_000).keys
    assert (keys.min(), keys.max()) == (65 * 50 - 1000, 65 * 50 - 1)


def test_each_transition_is_sampled_as_often_as_any_other() -> None:
    table = make_table(200, seed=5)
    for number in range(5):
        table.insert(make_chunk(number, 50))
    num_samples, size = 200_000, 200
    counts = np.bincount(table.sample(num_samples).keys - 50)
    assert len(counts) == size
    expected = num_samples / size
    chi_square = float(((counts - expected) ** 2 / expected).sum())
    assert chi_square < 266.4  # 99.9 % of chi-square with 199 degrees of freedom


@pytest.mark.parametrize("prioritized", [False, True])
def test_the_same_seed_gives_the_same_samples(prioritized: bool) -> None:
    tables = [make_table(20, seed=3, prioritized=prioritized) for _ in range(2)]
    for table in tables:
        table.insert(make_chunk(0, 20))
    first, second = (table.sample(50).keys for table in tables)
    np.testing.assert_array_equal(first, second)


def test_an_empty_table_gives_no_sample() -> None:
    with pytest.raises(ValueError, match="empty"):
        make_table(4).sample(1)


@pytest.mark.parametrize(
    ("chunk", "reason"),
    [
        (lambda: make_chunk(0, 3, stack=3), "of 4 bytes, 3 more than transitions, where 4 and 4"),
        (lambda: make_chunk(0, 3, n_step=2), "another arena or agent"),
        (lambda: make_chunk(0, 11), "11 transitions exceed the capacity 10"),
        (lambda: make_chunk(2, 3, stack=2, n_step=3), "offset exceeds agent.n_step, 1"),
    ],
    ids=["stack", "n_step", "too long", "offset"],
)
def test_a_chunk_of_other_settings_is_refused(chunk: Callable[[], Chunk], reason: str) -> None:
    table = make_table(10)
    with pytest.raises(WireError, match=reason):
        table.insert(chunk())
    assert len(table) == 0
    table.check_invariants()


def continuing(chunk: Chunk, before: UInt8Array) -> Chunk:
    """The chunk, beginning with the records that end an earlier window [W, R]."""
    overlap = len(before) - 1
    records = np.concatenate([before[-overlap:], chunk.records[overlap:]])
    return dataclasses.replace(chunk, records=records)


def test_one_robots_consecutive_chunks_share_their_records() -> None:
    table = make_table(100, stack=4, n_step=1)
    stream = np.arange(4 + 1000, dtype=np.uint32).view(np.uint8).reshape(-1, 4)
    for number in range(100):
        first = 10 * number
        records = stream[first : first + 3 + 10 + 1]
        table.insert(dataclasses.replace(make_chunk(number, 10), records=records))
        table.check_invariants()
    assert len(table) == 100
    samples = table.sample(400)
    starts = samples.keys
    expected = stream[starts[:, None] + np.arange(5)]
    np.testing.assert_array_equal(samples.records, expected)


def alternate_robots(table: Table, num_robots: int, num_chunks: int, *, follow: bool) -> None:
    """Insert full chunks of which each continues its robot's last one, or none does."""
    robots = [np.arange(4 + 8 * num_chunks, dtype=np.uint16) for _ in range(num_robots)]
    streams = [np.stack([np.full_like(r, i), r], 1).view(np.uint8) for i, r in enumerate(robots)]
    for number in range(num_chunks):
        robot, first = number % num_robots, number // num_robots * (8 if follow else 12)
        records = streams[robot][first : first + 3 + 8 + 1]
        table.insert(dataclasses.replace(make_chunk(number, 8), records=records))
        table.check_invariants()


def test_alternating_chunks_of_many_robots_share_their_records() -> None:
    sharing, apart = make_table(800), make_table(800)
    alternate_robots(sharing, 10, 400, follow=True)
    alternate_robots(apart, 10, 400, follow=False)
    assert len(sharing) == 800
    assert 0.9 * 800 < len(apart) < 800  # surplus tails take rows of the ring
    samples = sharing.sample(400)
    robot, row = samples.records.view(np.uint16)[..., 0], samples.records.view(np.uint16)[..., 1]
    number, step = samples.keys // 8, samples.keys % 8
    np.testing.assert_array_equal(robot, np.repeat(number % 10, 5).reshape(-1, 5))
    first = number // 10 * 8 + step
    np.testing.assert_array_equal(row, first[:, None] + np.arange(5))


def test_records_are_gathered_into_the_callers_memory() -> None:
    table = make_table(100)
    table.insert(make_chunk(1, 10))
    memory = bytearray(table.sample_bytes(6))
    samples = table.sample(6, memoryview(memory))
    assert np.shares_memory(samples.records, np.frombuffer(memory, np.uint8))
    assert samples.records.tobytes() == memory
    stored = {bytes(window) for window in table.sample(400).records}
    assert {bytes(window) for window in samples.records} <= stored


def test_memory_is_the_rows_and_the_columns() -> None:
    rng = np.random.default_rng(0)
    table = Table(1000, 4, 1, 50, 80, UniformSampler(rng))
    per_transition = 4 + 1 + 4 + 1 + 4 + 4 + 1 + 8
    assert table.nbytes == (1000 + 50 + 4 + 17 * 4) * 80 + 1000 * per_transition
    assert table.capacity == 1000
    prioritized = Table(1000, 4, 1, 50, 80, PrioritizedSampler(1000, EXPONENT, rng))
    assert prioritized.nbytes == table.nbytes + 2 * 1024 * 8


def test_a_return_that_no_arena_gives_is_refused() -> None:
    config = load_config("smoke", {"arena.success_reward": "10", "agent.n_step": "3"}, environ={})
    table, chunk = Table.from_config(config), harness.make_chunk(5)
    table.insert(chunk)
    most = largest_n_step_return(config)
    for odd in (1e38, -1e38, most + 1):
        rewards = chunk.rewards.copy()
        rewards[-1] = odd
        with pytest.raises(
            WireError, match=r"a return of .* where no arena .* more than 28: other"
        ):
            table.insert(dataclasses.replace(chunk, rewards=rewards))
    rewards = np.full(len(chunk), -most, np.float32)
    table.insert(dataclasses.replace(chunk, rewards=rewards))
    assert len(table) == 2 * len(chunk)


def test_one_priority_cannot_take_over_the_sampling() -> None:
    """Whether it comes with a chunk or as an update; sane ones are taken as they are."""
    config = harness.settings()
    table, exponent = Table.from_config(config), config.replay.priority_exponent
    sane = largest_return(config)
    for number, priority in enumerate((sane, 1e38)):
        table.insert(harness.make_chunk(number, priority=priority))
    length = len(table) // 2
    expected = np.array([sane, 10 * sane]).repeat(length)
    found = table.sampler.scaled_priorities(table.keys)
    assert found == pytest.approx(expected**exponent, rel=1e-5)
    assert table.sampler.largest == pytest.approx(10 * sane)
    table.update_priorities(np.array([0, 1]), np.array([3e38, sane / 2], np.float32))
    found = table.sampler.scaled_priorities(table.keys)
    assert found[:2] == pytest.approx(np.array([10 * sane, sane / 2]) ** exponent, rel=1e-5)
