"""The table against a plain list of transitions: same data, same keys, oldest out first."""

from collections.abc import Callable
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

from common.errors import WireError
from common.trajectory import Chunk, UInt8Array
from services.replay.table import Table

RECORD_BYTES = 4


def make_chunk(number: int, length: int, *, stack: int = 4, n_step: int = 1) -> Chunk:
    """Chunk `number`, its records and columns unlike those of any other of 65536."""
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
        priorities=np.empty(0, np.float32),
    )


CHUNK_LENGTH = 8


def make_table(capacity: int, *, stack: int = 4, n_step: int = 1, seed: int = 0) -> Table:
    return Table(capacity, stack, n_step, CHUNK_LENGTH, RECORD_BYTES, np.random.default_rng(seed))


@dataclass(frozen=True)
class Transition:
    """What the model keeps of one transition."""

    records: UInt8Array
    action: int
    reward: np.float32
    discount: np.float32
    offset: int
    version: int


class TableAgainstList(RuleBasedStateMachine):
    """Every transition ever inserted stands in a list, at its key."""

    @initialize(capacity=st.integers(1, 40), stack=st.integers(1, 4), n_step=st.integers(1, 3))
    def make(self, capacity: int, stack: int, n_step: int) -> None:
        self.capacity, self.stack, self.n_step = capacity, stack, n_step
        self.table = make_table(capacity, stack=stack, n_step=n_step)
        self.model: list[Transition] = []
        self.lengths: list[int] = []

    @rule(data=st.data(), times=st.integers(1, 4))
    def insert(self, data: st.DataObject, times: int) -> None:
        for _ in range(times):
            length = data.draw(st.integers(1, min(self.capacity, 12)))
            chunk = make_chunk(len(self.lengths), length, stack=self.stack, n_step=self.n_step)
            self.table.insert(chunk)
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

    @precondition(lambda self: self.model)
    @rule(size=st.integers(1, 64))
    def sample(self, size: int) -> None:
        samples = self.table.sample(size)
        oldest = len(self.model) - len(self.table)
        assert len(samples) == size
        assert samples.table_size == len(self.table)
        assert samples.probabilities.tolist() == [1 / len(self.table)] * size
        for index, key in enumerate(samples.keys.tolist()):
            assert oldest <= key < len(self.model)
            expected = self.model[key]
            np.testing.assert_array_equal(samples.records[index], expected.records)
            assert samples.actions[index] == expected.action
            assert samples.rewards[index] == expected.reward
            assert samples.discounts[index] == expected.discount
            assert samples.bootstrap_offsets[index] == expected.offset
            assert samples.weights_versions[index] == expected.version

    @invariant()
    def holds_the_newest_whole_chunks(self) -> None:
        self.table.check_invariants()
        held = len(self.table)
        assert held <= self.capacity
        newest_first = np.cumsum(self.lengths[::-1]).tolist()
        assert held in (0, *newest_first)
        if newest_first:
            assert held >= newest_first[0]


TestTableAgainstList = TableAgainstList.TestCase
TestTableAgainstList.settings = settings(max_examples=60, stateful_step_count=25, deadline=None)


def test_full_chunks_fill_the_whole_capacity_and_leave_in_order() -> None:
    table = make_table(1000)
    for number in range(65):
        table.insert(make_chunk(number, 50))
        assert len(table) == min(50 * (number + 1), 1000)
    keys = table.sample(20_000).keys
    assert (keys.min(), keys.max()) == (65 * 50 - 1000, 65 * 50 - 1)


def test_each_transition_is_drawn_as_often_as_any_other() -> None:
    table = make_table(200, seed=5)
    for number in range(5):
        table.insert(make_chunk(number, 50))
    draws, held = 200_000, 200
    counts = np.bincount(table.sample(draws).keys - 50)
    assert len(counts) == held
    expected = draws / held
    chi_square = float(((counts - expected) ** 2 / expected).sum())
    assert chi_square < 266.4  # 99.9 % of chi-square with 199 degrees of freedom


def test_the_same_seed_draws_the_same() -> None:
    tables = [make_table(20, seed=3), make_table(20, seed=3)]
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


def test_memory_is_the_rows_and_the_columns() -> None:
    table = Table(1000, 4, 1, 50, 80, np.random.default_rng(0))
    per_transition = 8 + 1 + 4 + 4 + 1 + 8
    assert table.nbytes == (1160 + 2 * 5) * 80 + 1000 * per_transition
    assert table.capacity == 1000
