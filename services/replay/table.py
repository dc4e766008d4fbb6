"""The table: a ring of observation records in stream order, and the transitions over them.

Invariants (`check_invariants`): transition keys are consecutive, the newest `size` of all ever
inserted; chunks are evicted whole. The records past a chunk's last transition, its tail, are set
apart until the same robot's next chunk arrives, which begins with them; its rows then serve both
chunks, as it outlives the earlier one. Pure: no clock, lock or transport.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Self

import numpy as np

from mrcdrl.common.config import Config
from mrcdrl.common.config.returns import largest_n_step_return, largest_return
from mrcdrl.common.config.schema import MOST_ACTIONS
from mrcdrl.common.errors import ConfigError, WireError
from mrcdrl.common.messages.fitting import check_actions, check_returns
from mrcdrl.common.messages.trajectory import Chunk, Float32Array, Int64Array, Samples, UInt8Array
from mrcdrl.services.replay.capacity import TAILS_PER_CHUNK, capacity_of
from mrcdrl.services.replay.sampler import Sampler, make_sampler

_LARGEST_ERRORS = 10.0  # largest returns; greater TD errors say only that values have diverged


@dataclass(slots=True)
class _Extent:
    """Where a chunk lies."""

    first_key: int
    num_transitions: int
    first_row: int
    num_rows: int  # in the ring; a tail among them stays there
    tail_hash: int
    tail_row: int | None  # first row of a tail that is set apart


class Table:
    """Keeps transitions first in, first out; a sampler chooses those of a mini-batch.

    capacity: transitions. stack: records in a state. n_step: longest return; a transition's
    window is stack + n_step records. chunk_length: transitions in most chunks; with many chunks
    that are shorter, or that no later chunk continues, the table holds less than its capacity.
    record_bytes: length of one record. sampler: of the same capacity, for this table alone.
    num_actions, largest_return: a chunk with another action or a greater n-step return is refused.
    largest_error: greater absolute TD errors count as this one. All memory is allocated, and
    touched, at once.
    """

    def __init__(
        self,
        capacity: int,
        stack: int,
        n_step: int,
        chunk_length: int,
        record_bytes: int,
        sampler: Sampler,
        *,
        num_actions: int = MOST_ACTIONS,
        largest_return: float = math.inf,
        largest_error: float = math.inf,
    ) -> None:
        window = stack + n_step
        overlap = window - 1
        num_ring_rows = capacity + chunk_length + overlap
        num_rows = num_ring_rows + overlap * (int(TAILS_PER_CHUNK * capacity / chunk_length) + 1)
        if num_rows > np.iinfo(np.int32).max:
            raise ConfigError(f"replay.capacity {capacity} needs {num_rows} rows; lower it")
        try:
            self._rows: UInt8Array = np.full((num_rows, record_bytes), 0, np.uint8)
        except MemoryError as error:
            raise ConfigError(
                f"replay.capacity {capacity} needs {num_rows * record_bytes >> 20} MiB for its "
                "records, more than this machine has; lower it"
            ) from error
        self._capacity = capacity
        self._window = window
        self._n_step = n_step
        self._in_window = np.arange(window)
        self._num_ring_rows = num_ring_rows
        self._start_rows = np.zeros(capacity, np.int32)
        self._num_own = np.zeros(capacity, np.uint8)  # rows of the window that follow its start
        self._rest_rows = np.zeros(capacity, np.int32)  # where the window's other rows begin
        self._actions = np.zeros(capacity, np.uint8)
        self._rewards = np.zeros(capacity, np.float32)
        self._discounts = np.zeros(capacity, np.float32)
        self._bootstrap_offsets = np.zeros(capacity, np.uint8)
        self._weights_versions = np.zeros(capacity, np.int64)
        self._extents: deque[_Extent] = deque()
        self._free_tails = list(range(num_ring_rows, num_rows, overlap))
        self._waiting: dict[int, _Extent] = {}  # by the hash of their tail, which is set apart
        self._next_key = 0
        self._next_row = 0
        self._sampler = sampler
        self._num_actions = num_actions
        self._largest_return = largest_return
        self._largest_error = np.float32(largest_error)

    @classmethod
    def from_config(cls, config: Config, *, record_bytes: int | None = None) -> Self:
        """The table of one shard.

        record_bytes: kept of each record; None: all of them. Raises ConfigError where
        replay.capacity_bytes leaves no room for replay.min_size.
        """
        capacity = capacity_of(config)
        return cls(
            capacity=capacity,
            stack=config.arena.stack,
            n_step=config.agent.n_step,
            # In lockstep the capacity alone decides what is evicted, not where chunks lie.
            chunk_length=1 if config.run.turn_size else config.actor.chunk_length,
            record_bytes=config.arena.record_bytes if record_bytes is None else record_bytes,
            sampler=make_sampler(config.replay, capacity),
            num_actions=config.arena.action_count,
            largest_return=largest_n_step_return(config),
            largest_error=_LARGEST_ERRORS * largest_return(config),
        )

    def __len__(self) -> int:
        return self._next_key - self.first_key

    @property
    def first_key(self) -> int:
        """Key of the oldest transition; in an empty table, of the next one."""
        return self._extents[0].first_key if self._extents else self._next_key

    @property
    def next_key(self) -> int:
        """Key of the next transition; the number of transitions ever inserted."""
        return self._next_key

    def number_from(self, key: int) -> None:
        """Give the next transition this key; ValueError unless the table is empty."""
        if len(self):
            raise ValueError("only an empty table can be renumbered")
        self._next_key = key

    @property
    def keys(self) -> range:
        """Keys of the transitions in the table."""
        return range(self.first_key, self._next_key)

    @property
    def sampler(self) -> Sampler:
        """The sampler of this table's transitions."""
        return self._sampler

    def rewards(self, keys: range) -> Float32Array:
        """A copy of the n-step returns [len(keys)] of transitions in the table."""
        return self._rewards[np.arange(keys.start, keys.stop) % self._capacity]

    @property
    def capacity(self) -> int:
        return self._capacity

    @property
    def nbytes(self) -> int:
        """Memory of the records, the columns and the sampler."""
        columns = (
            self._rows,
            self._start_rows,
            self._num_own,
            self._rest_rows,
            self._actions,
            self._rewards,
            self._discounts,
            self._bootstrap_offsets,
            self._weights_versions,
        )
        return sum(column.nbytes for column in columns) + self._sampler.nbytes

    def check(self, chunk: Chunk) -> None:
        """Raise WireError unless the chunk fits this table."""
        num_rows, record_bytes = chunk.records.shape
        tail = num_rows - len(chunk)
        if record_bytes != self._rows.shape[1] or tail != self._window - 1:
            raise WireError(
                f"records of {record_bytes} bytes, {tail} more than transitions, where "
                f"{self._rows.shape[1]} and {self._window - 1} are due: another arena or agent?"
            )
        check_actions(chunk, self._num_actions)
        check_returns(chunk, self._n_step, self._largest_return)
        if len(chunk) > self._capacity:
            raise WireError(f"{len(chunk)} transitions exceed the capacity {self._capacity}")

    def insert(self, chunk: Chunk) -> None:
        """Append the chunk's transitions; evict the oldest chunks to make room."""
        self.check(chunk)
        length, oldest = len(chunk), self.first_key
        while len(self) + length > self._capacity:
            self._evict_oldest()
        num_rows = length if self._free_tails else len(chunk.records)
        first_row = self._make_room(num_rows)
        if self.first_key > oldest:
            self._sampler.evict(range(oldest, self.first_key))
        self._rows[first_row : first_row + num_rows] = chunk.records[:num_rows]
        self._hand_over(chunk, first_row)
        extent = _Extent(self._next_key, length, first_row, num_rows, 0, None)
        rest_row = first_row + length
        if num_rows == length:
            rest_row = self._set_apart(extent, chunk.records[length:])
        places = (self._next_key + np.arange(length)) % self._capacity
        self._start_rows[places] = first_row + np.arange(length)
        self._num_own[places] = np.minimum(self._window, length - np.arange(length))
        self._rest_rows[places] = rest_row
        self._actions[places] = chunk.actions
        self._rewards[places] = chunk.rewards
        self._discounts[places] = chunk.discounts
        self._bootstrap_offsets[places] = chunk.bootstrap_offsets
        self._weights_versions[places] = chunk.weights_version
        self._extents.append(extent)
        self._next_key += length
        self._next_row = first_row + num_rows
        self._sampler.insert(
            range(self._next_key - length, self._next_key), self._bounded(chunk.priorities)
        )

    def update_priorities(self, keys: Int64Array, priorities: Float32Array) -> int:
        """Set transitions' absolute TD errors, both [N]; return how many were used.

        Evicted transitions are ignored; with uniform sampling, all are.
        """
        present = (keys >= self.first_key) & (keys < self._next_key)
        return self._sampler.update(keys[present], self._bounded(priorities[present]))

    def _bounded(self, priorities: Float32Array) -> Float32Array:
        """Absolute TD errors, the greatest of which cannot take over the sampling."""
        return np.minimum(priorities, self._largest_error)

    def sample_bytes(self, size: int) -> int:
        """Bytes of the records of `size` transitions."""
        return size * self._window * int(self._rows.shape[1])

    def sample(self, size: int, out: memoryview | None = None) -> Samples:
        """Sample `size` transitions; raises ValueError when the table is empty.

        out: memory of `sample_bytes` for their records; None: new memory.
        """
        if len(self) == 0:
            raise ValueError("cannot sample from an empty table")
        keys, probabilities = self._sampler.sample(self.keys, size)
        places = keys % self._capacity
        return Samples(
            keys=keys,
            probabilities=probabilities,
            table_size=len(self),
            total_priority=self._sampler.total(self.keys),
            actions=self._actions[places],
            rewards=self._rewards[places],
            discounts=self._discounts[places],
            bootstrap_offsets=self._bootstrap_offsets[places],
            weights_versions=self._weights_versions[places],
            records=self._gather(places, out),
        )

    def _window_rows(self, places: Int64Array) -> Int64Array:
        """Rows of the windows of the transitions at these places [B], int64 [B, W]."""
        num_own = self._num_own[places, None].astype(np.int64)
        own = self._start_rows[places, None] + self._in_window
        rest = self._rest_rows[places, None] - num_own + self._in_window
        return np.where(self._in_window < num_own, own, rest)

    def _gather(self, places: Int64Array, out: memoryview | None) -> UInt8Array:
        """Records [B, W, R] of the transitions at these places [B]."""
        rows = self._window_rows(places).reshape(-1)
        record_bytes = self._rows.shape[1]
        flat = None if out is None else np.frombuffer(out, np.uint8).reshape(-1, record_bytes)
        # "clip" writes straight into `out`; every row exists.
        records: UInt8Array = self._rows.take(rows, axis=0, out=flat, mode="clip")
        return records.reshape(len(places), self._window, record_bytes)

    def _set_apart(self, extent: _Extent, tail: UInt8Array) -> int:
        """Keep the chunk's tail until a chunk begins with it; return the tail's first row."""
        row = self._free_tails.pop()
        self._rows[row : row + len(tail)] = tail
        extent.tail_row, extent.tail_hash = row, hash(tail.tobytes())
        self._waiting[extent.tail_hash] = extent
        return row

    def _hand_over(self, chunk: Chunk, first_row: int) -> None:
        """Let the chunk that this one continues, if any, use its rows from first_row on."""
        overlap = self._window - 1
        if len(chunk) < overlap:
            return  # its own tail would hold some of these rows
        head = chunk.records[:overlap]
        before = self._waiting.get(hash(head.tobytes()))
        if before is None or before.tail_row is None:
            return
        if np.array_equal(self._rows[before.tail_row : before.tail_row + overlap], head):
            end = before.first_key + before.num_transitions
            keys = np.arange(max(before.first_key, end - overlap), end)
            self._rest_rows[keys % self._capacity] = first_row
            self._free_tail(before)

    def _free_tail(self, extent: _Extent) -> None:
        if extent.tail_row is not None:
            self._free_tails.append(extent.tail_row)
            extent.tail_row = None
            if self._waiting.get(extent.tail_hash) is extent:
                del self._waiting[extent.tail_hash]

    def _make_room(self, num_rows: int) -> int:
        """Evict until `num_rows` consecutive rows of the ring are free; return the first."""
        first_row = self._next_row
        if first_row + num_rows > self._num_ring_rows:
            # The rows up to the end of the ring stay unused until it wraps again.
            self._evict_rows(first_row, self._num_ring_rows)
            first_row = 0
        self._evict_rows(first_row, first_row + num_rows)
        return first_row

    def _evict_rows(self, start: int, stop: int) -> None:
        # The oldest chunk is the next one ahead in the ring, so evicting in order frees them.
        while self._extents and start <= self._extents[0].first_row < stop:
            self._evict_oldest()

    def _evict_oldest(self) -> None:
        self._free_tail(self._extents.popleft())

    def check_invariants(self) -> None:
        """Raise AssertionError unless the module's invariants hold."""
        key = self.first_key
        overlap = self._window - 1
        taken = np.zeros(len(self._rows), bool)
        for extent in self._extents:
            if extent.first_key != key:
                raise AssertionError(f"key {extent.first_key} where {key} is due")
            key += extent.num_transitions
            spans = [(extent.first_row, extent.num_rows)]
            if extent.tail_row is not None:
                spans.append((extent.tail_row, overlap))
            for first, length in spans:
                if taken[first : first + length].any():
                    raise AssertionError("two chunks lie in the same rows")
                taken[first : first + length] = True
        if key != self._next_key or len(self) > self._capacity:
            raise AssertionError("keys are not the newest inserted, or exceed the capacity")
        places = np.arange(self.first_key, self._next_key) % self._capacity
        if not taken[self._window_rows(places)].all():
            raise AssertionError("a transition's window has rows outside all chunks")
        num_apart = int(taken[self._num_ring_rows :].sum()) // overlap
        all_tails = (len(self._rows) - self._num_ring_rows) // overlap
        if num_apart + len(self._free_tails) != all_tails:
            raise AssertionError("a tail is neither free nor used by a chunk")
        self._sampler.check_invariants(self.keys)
