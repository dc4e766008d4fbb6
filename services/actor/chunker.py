"""Cuts one robot's steps into self-contained chunks: history, n-step returns, bootstrap states.

Invariants: every step becomes exactly one transition, in order, in exactly one chunk; n-step
returns are summed here only; pure.

    R_t = sum_{i<k} gamma^i r_{t+i},   discount_t = gamma^k, or 0 if the episode terminated there,
    k = min(n, steps left in the episode)

Initial priorities are TD errors, from the values the actions were chosen by (Ape-X, section 3):

    p_t = |scale R_t + discount_t max_a Q(s_{t+k}, a) - Q(s_t, a_t)|
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import Chunk, Float32Array, UInt8Array


@dataclass(frozen=True, slots=True)
class ChunkerConfig:
    """The actor that makes the chunks, and how they are cut."""

    actor: str
    incarnation: int
    gamma: float
    n_step: int
    stack: int
    chunk_length: int
    # Chunks with priorities are cut one step later, when the last bootstrap's value is known.
    prioritized: bool = False
    reward_scale: float = 1.0  # scales rewards in the TD errors, as in the learner

    @classmethod
    def from_config(cls, config: Config, actor: str, incarnation: int) -> Self:
        return cls(
            actor,
            incarnation,
            gamma=config.agent.gamma,
            n_step=config.agent.n_step,
            stack=config.arena.stack,
            chunk_length=config.actor.chunk_length,
            prioritized=config.replay.prioritized,
            reward_scale=config.agent.reward_scale,
        )


class Chunker:
    """The stream of one robot: `start` at each episode, `add` at each step."""

    def __init__(self, config: ChunkerConfig) -> None:
        self._config = config
        self._history = config.stack - 1
        self._records: list[UInt8Array] = []
        self._actions: list[int] = []
        self._rewards: list[float] = []
        self._versions: list[int] = []
        self._taken_q: list[float] = []
        self._greedy_q: list[float] = []

    def start(self, record: UInt8Array) -> None:
        """Begin an episode with its first record, uint8 [R], repeated to fill the first state."""
        self._records = [record] * self._config.stack
        for column in self._columns:
            column.clear()

    @property
    def _columns(self) -> tuple[list[Any], ...]:
        """The lists with one item per step."""
        return (self._actions, self._rewards, self._versions, self._taken_q, self._greedy_q)

    def add(
        self,
        action: int,
        reward: float,
        record: UInt8Array,
        *,
        taken_q: float,
        greedy_q: float,
        weights_version: int,
        last: bool,
        discount: float,
        sequence: Iterator[int],
    ) -> list[Chunk]:
        """Add a step, its reward and the record uint8 [R] after it; return the chunks now complete.

        taken_q, greedy_q: values of this action and of the best one, in the state before the step.
        discount: 0 if the episode terminated at this step. sequence: the actor's next numbers.
        """
        self._records.append(record)
        self._actions.append(action)
        self._rewards.append(reward)
        self._versions.append(weights_version)
        self._taken_q.append(taken_q)
        self._greedy_q.append(greedy_q)
        if last:
            return self._finish(discount, sequence)
        length, n = self._config.chunk_length, self._config.n_step
        if len(self._actions) < length + n - 1 + self._config.prioritized:
            return []
        return [self._cut(length, discount=1.0, sequence=sequence)]

    def _finish(self, discount: float, sequence: Iterator[int]) -> list[Chunk]:
        """Cut all remaining steps of an ended episode; its last record is repeated as a tail."""
        self._records += [self._records[-1]] * (self._config.n_step - 1)
        chunks = []
        while self._actions:
            length = min(self._config.chunk_length, len(self._actions))
            chunks.append(self._cut(length, discount=discount, sequence=sequence))
        return chunks

    def _cut(self, length: int, *, discount: float, sequence: Iterator[int]) -> Chunk:
        """Cut the first `length` steps into a chunk; keep the records that later steps need."""
        config = self._config
        rewards, discounts, offsets = self._returns(length, discount)
        chunk = Chunk(
            actor=config.actor,
            incarnation=config.incarnation,
            sequence=next(sequence),
            weights_version=min(self._versions[:length]),
            records=np.stack(self._records[: self._history + length + config.n_step]),
            actions=np.array(self._actions[:length], np.uint8),
            rewards=rewards,
            discounts=discounts,
            bootstrap_offsets=offsets,
            priorities=self._priorities(rewards, discounts, offsets),
        )
        for column in (self._records, *self._columns):
            del column[:length]
        return chunk

    def _returns(
        self, length: int, discount: float
    ) -> tuple[Float32Array, Float32Array, UInt8Array]:
        """n-step returns, discounts and bootstrap offsets of the first `length` steps.

        discount: for the returns that reach the episode's end.
        """
        gamma, n = self._config.gamma, self._config.n_step
        steps = np.arange(length)
        offsets = np.minimum(n, len(self._actions) - steps)
        rewards = np.zeros(length + n, np.float64)
        known = self._rewards[: length + n]
        rewards[: len(known)] = known
        sums = sum(gamma**i * rewards[i : i + length] * (i < offsets) for i in range(n))
        at_end = steps + offsets == len(self._actions)
        discounts = gamma**offsets * np.where(at_end, discount, 1.0)
        return (
            np.asarray(sums, np.float32),
            discounts.astype(np.float32),
            offsets.astype(np.uint8),
        )

    def _priorities(
        self, rewards: Float32Array, discounts: Float32Array, offsets: UInt8Array
    ) -> Float32Array:
        """Absolute TD errors of the first transitions, [len(rewards)]; [0] if not prioritized.

        No action is taken in an episode's last state, so its value is unknown. It only matters
        after a truncation; the value of the state before it is used instead.
        """
        if not self._config.prioritized:
            return np.empty(0, np.float32)
        length = len(rewards)
        bootstraps = np.minimum(np.arange(length) + offsets, len(self._greedy_q) - 1)
        taken_q = np.array(self._taken_q[:length], np.float32)
        next_q = np.array(self._greedy_q, np.float32)[bootstraps]
        errors = np.float32(self._config.reward_scale) * rewards + discounts * next_q - taken_q
        priorities: Float32Array = np.abs(errors)
        return priorities
