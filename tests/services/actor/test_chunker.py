"""Chunks by hand, and against returns and stacks made the naïve way."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.common.messages.trajectory import Chunk, Float32Array, UInt8Array
from mrcdrl.services.actor.chunker import Chunker, ChunkerConfig

STACK = 4


@dataclass(frozen=True)
class Episode:
    """Rewards of its steps; record t is the byte first + t, the first before any step."""

    first: int
    rewards: tuple[float, ...]
    discount: float  # at its end: 0 terminated, 1 truncated
    ended: bool = True

    def record(self, step: int) -> int:
        return self.first + min(max(step, 0), len(self.rewards))


def run(
    episodes: list[Episode],
    *,
    n_step: int,
    chunk_length: int,
    gamma: float = 0.5,
    stack: int = STACK,
    versions: tuple[int, ...] = (),
    values: tuple[tuple[float, float], ...] = (),
    reward_scale: float = 1.0,
) -> list[Chunk]:
    """The chunks of these episodes; action t is t % 3, counted on over all episodes.

    values: of the action and of the best one in each state that was acted in; chunks bear
    priorities if they are given.
    """
    config = ChunkerConfig("a", 9, gamma, n_step, stack, chunk_length, bool(values), reward_scale)
    chunker, sequence = Chunker(config), iter(range(1000))
    steps = itertools.count()
    chunks: list[Chunk] = []
    for episode in episodes:
        chunker.start(np.array([episode.first], np.uint8))
        for index, reward in enumerate(episode.rewards):
            step = next(steps)
            last = episode.ended and index == len(episode.rewards) - 1
            chunks += chunker.add(
                step % 3,
                reward,
                np.array([episode.record(index + 1)], np.uint8),
                taken_q=values[step][0] if values else 0.0,
                greedy_q=values[step][1] if values else 0.0,
                weights_version=versions[step] if versions else 0,
                last=last,
                discount=episode.discount if last else 1.0,
                sequence=sequence,
            )
    return chunks


def rows(chunk: Chunk) -> list[int]:
    return chunk.records[:, 0].tolist()


def assert_chunk(
    chunk: Chunk,
    records: list[int],
    rewards: list[float],
    discounts: list[float],
    offsets: list[int],
) -> None:
    assert rows(chunk) == records
    assert chunk.rewards.tolist() == rewards
    assert chunk.discounts.tolist() == discounts
    assert chunk.bootstrap_offsets.tolist() == offsets


def test_one_step_returns_of_an_episode_that_terminates() -> None:
    (chunk,) = run([Episode(10, (1, 2, 3), 0.0)], n_step=1, chunk_length=8)
    assert_chunk(chunk, [10, 10, 10, 10, 11, 12, 13], [1, 2, 3], [0.5, 0.5, 0], [1, 1, 1])
    assert chunk.actions.tolist() == [0, 1, 2]
    assert (chunk.actor, chunk.incarnation, chunk.sequence) == ("a", 9, 0)
    assert len(chunk.priorities) == 0


def test_one_step_returns_of_an_episode_that_is_truncated() -> None:
    (chunk,) = run([Episode(10, (1, 2), 1.0)], n_step=1, chunk_length=8)
    assert_chunk(chunk, [10, 10, 10, 10, 11, 12], [1, 2], [0.5, 0.5], [1, 1])


def test_three_step_returns_of_an_episode_that_terminates() -> None:
    (chunk,) = run([Episode(10, (8, 4, 2, 16), 0.0)], n_step=3, chunk_length=8)
    assert_chunk(
        chunk,
        [10, 10, 10, 10, 11, 12, 13, 14, 14, 14],
        [8 + 2 + 0.5, 4 + 1 + 4, 2 + 8, 16],
        [0.125, 0, 0, 0],
        [3, 3, 2, 1],
    )


def test_three_step_returns_of_an_episode_that_is_truncated() -> None:
    (chunk,) = run([Episode(10, (8, 4, 2, 16), 1.0)], n_step=3, chunk_length=8)
    assert chunk.discounts.tolist() == [0.125, 0.125, 0.25, 0.5]
    assert chunk.bootstrap_offsets.tolist() == [3, 3, 2, 1]


def test_an_episode_shorter_than_n() -> None:
    (chunk,) = run([Episode(10, (8,), 0.0)], n_step=3, chunk_length=8)
    assert_chunk(chunk, [10, 10, 10, 10, 11, 11, 11], [8], [0], [1])
    (chunk,) = run([Episode(10, (8, 4), 1.0)], n_step=3, chunk_length=8)
    assert_chunk(chunk, [10, 10, 10, 10, 11, 12, 12, 12], [10, 4], [0.25, 0.5], [2, 1])


def test_a_chunk_boundary_repeats_the_history_and_looks_n_ahead() -> None:
    first, second = run([Episode(10, (1, 2, 4, 8, 16), 0.0)], n_step=1, chunk_length=3)
    assert_chunk(first, [10, 10, 10, 10, 11, 12, 13], [1, 2, 4], [0.5] * 3, [1] * 3)
    assert_chunk(second, [10, 11, 12, 13, 14, 15], [8, 16], [0.5, 0], [1, 1])
    assert [first.sequence, second.sequence] == [0, 1]


def test_a_chunk_boundary_within_three_step_returns() -> None:
    first, second, third = run([Episode(10, (1, 2, 4, 8, 16), 0.0)], n_step=3, chunk_length=2)
    assert_chunk(first, [10, 10, 10, 10, 11, 12, 13, 14], [3, 6], [0.125] * 2, [3, 3])
    assert_chunk(second, [10, 10, 11, 12, 13, 14, 15, 15], [12, 16], [0, 0], [3, 2])
    assert_chunk(third, [11, 12, 13, 14, 15, 15, 15], [16], [0], [1])


def test_a_chunk_is_cut_as_soon_as_its_last_return_is_known() -> None:
    waiting = Episode(10, (1, 2, 4, 8, 16, 32), 1.0, ended=False)
    assert len(run([waiting], n_step=3, chunk_length=4)) == 1
    shorter = Episode(10, (1, 2, 4, 8, 16), 1.0, ended=False)
    assert run([shorter], n_step=3, chunk_length=4) == []


def test_a_new_episode_takes_nothing_of_the_one_before() -> None:
    first, second = run(
        [Episode(10, (1, 2), 0.0), Episode(20, (4,), 1.0)], n_step=1, chunk_length=8
    )
    assert rows(first) == [10, 10, 10, 10, 11, 12]
    assert_chunk(second, [20, 20, 20, 20, 21], [4], [0.5], [1])


def test_a_chunks_version_is_the_oldest_of_its_steps() -> None:
    episode = Episode(10, (0,) * 5, 0.0)
    chunks = run([episode], n_step=1, chunk_length=2, versions=(3, 4, 4, 7, 9))
    assert [chunk.weights_version for chunk in chunks] == [3, 4, 9]


# Of the action taken and of the best one, in five states.
VALUES = ((1.0, 8.0), (2.0, 16.0), (3.0, 32.0), (4.0, 64.0), (5.0, 128.0))


def test_one_step_priorities_by_hand() -> None:
    """r + 0.5 max Q(s') - Q(s, a); nothing after a termination."""
    episode = Episode(10, (1, 2, 4, 8, -6), 0.0)
    (chunk,) = run([episode], n_step=1, chunk_length=8, values=VALUES)
    assert chunk.priorities.tolist() == [
        1 + 8 - 1,
        2 + 16 - 2,
        4 + 32 - 3,
        8 + 64 - 4,
        6 + 5,
    ]
    assert chunk.priorities.dtype == np.float32


def test_three_step_priorities_by_hand() -> None:
    """Returns 1 + 1 + 1, 2 + 2 + 2, 4 + 4 - 2, 8 - 4, -8; the first two have discount 1/8."""
    episode = Episode(10, (1, 2, 4, 8, -8), 0.0)
    (chunk,) = run([episode], n_step=3, chunk_length=8, values=VALUES)
    assert chunk.rewards.tolist() == [3, 6, 6, 4, -8]
    assert chunk.discounts.tolist() == [0.125, 0.125, 0, 0, 0]
    assert chunk.priorities.tolist() == [
        3 + 64 / 8 - 1,
        6 + 128 / 8 - 2,
        6 - 3,
        0,
        8 + 5,
    ]


def test_priorities_of_a_truncated_episode_take_the_state_before_its_last() -> None:
    """The bootstraps of the last three transitions lie in the state that nobody acted in."""
    (chunk,) = run([Episode(10, (0,) * 5, 1.0)], n_step=3, chunk_length=8, values=VALUES)
    assert chunk.discounts.tolist() == [0.125, 0.125, 0.125, 0.25, 0.5]
    assert chunk.priorities.tolist() == [
        64 / 8 - 1,
        128 / 8 - 2,
        128 / 8 - 3,
        128 / 4 - 4,
        128 / 2 - 5,
    ]


def test_rewards_of_priorities_are_scaled_as_in_the_learner() -> None:
    episode = Episode(10, (8, -16), 0.0)
    (chunk,) = run([episode], n_step=1, chunk_length=8, values=VALUES[:2], reward_scale=0.25)
    assert chunk.rewards.tolist() == [8, -16]
    assert chunk.priorities.tolist() == [2 + 8 - 1, 4 + 2]


def test_a_chunk_with_priorities_waits_for_the_value_of_its_last_bootstrap() -> None:
    for n_step, steps in ((1, 3), (3, 5)):
        zeros = ((0.0, 0.0),) * (steps - 1)
        waiting = Episode(10, (0,) * (steps - 1), 1.0, ended=False)
        assert run([waiting], n_step=n_step, chunk_length=2, values=zeros) == []
        cut = Episode(10, (0,) * steps, 1.0, ended=False)
        values = (*zeros, (0.0, 2.0**n_step))
        (chunk,) = run([cut], n_step=n_step, chunk_length=2, values=values)
        assert chunk.priorities.tolist() == [0, 1]
        assert len(chunk.records) == STACK - 1 + 2 + n_step


def naive_return(
    episode: Episode, step: int, n_step: int, gamma: float
) -> tuple[float, float, int]:
    """Sum, discount and offset of the n-step return at `step`."""
    total, offset = 0.0, 0
    while offset < n_step and step + offset < len(episode.rewards):
        total += gamma**offset * episode.rewards[step + offset]
        offset += 1
    at_end = step + offset == len(episode.rewards)
    return total, gamma**offset * (episode.discount if at_end else 1.0), offset


def naive_stack(episode: Episode, step: int, stack: int) -> list[int]:
    return [episode.record(step - age) for age in range(stack - 1, -1, -1)]


def window(chunk: Chunk, start: int, stack: int) -> list[int]:
    return rows(chunk)[start : start + stack]


EPISODES = st.lists(
    st.builds(
        Episode,
        first=st.integers(0, 100),
        rewards=st.lists(st.integers(-64, 64).map(float), min_size=1, max_size=40).map(tuple),
        discount=st.sampled_from([0.0, 1.0]),
    ),
    min_size=1,
    max_size=4,
)


@given(EPISODES, st.integers(1, 5), st.integers(1, 12), st.integers(1, 4), st.booleans())
def test_every_step_is_in_one_transition_with_the_naive_returns_and_stacks(
    episodes: list[Episode], n_step: int, chunk_length: int, stack: int, prioritized: bool
) -> None:
    gamma = 0.9
    count = sum(len(episode.rewards) for episode in episodes)
    values = tuple((float(3 * step % 7), float(5 * step % 11)) for step in range(count))
    chunks = run(
        episodes,
        n_step=n_step,
        chunk_length=chunk_length,
        gamma=gamma,
        stack=stack,
        values=values if prioritized else (),
    )
    assert [chunk.sequence for chunk in chunks] == list(range(len(chunks)))
    steps = [(e, t) for e in episodes for t in range(len(e.rewards))]
    transitions = [(chunk, t) for chunk in chunks for t in range(len(chunk))]
    assert len(transitions) == len(steps)
    for number, ((chunk, t), (episode, step)) in enumerate(zip(transitions, steps, strict=True)):
        total, discount, offset = naive_return(episode, step, n_step, gamma)
        assert chunk.actions[t] == number % 3
        assert chunk.rewards[t] == pytest.approx(total, rel=1e-5, abs=1e-4)
        assert chunk.discounts[t] == pytest.approx(discount, rel=1e-6)
        assert chunk.bootstrap_offsets[t] == offset
        assert window(chunk, t, stack) == naive_stack(episode, step, stack)
        assert window(chunk, t + offset, stack) == naive_stack(episode, step + offset, stack)
        if prioritized:
            ahead = min(step + offset, len(episode.rewards) - 1) - step
            error = total + discount * values[number + ahead][1] - values[number][0]
            assert chunk.priorities[t] == pytest.approx(abs(error), rel=1e-5, abs=1e-4)
    for chunk in chunks:
        assert len(chunk) <= chunk_length
        assert len(chunk.priorities) == (len(chunk) if prioritized else 0)
        assert len(chunk.records) == stack - 1 + len(chunk) + n_step
        assert_dtypes(chunk.records, chunk.rewards, chunk.discounts)


def assert_dtypes(records: UInt8Array, rewards: Float32Array, discounts: Float32Array) -> None:
    assert records.dtype == np.uint8
    assert rewards.dtype == discounts.dtype == np.float32
