"""The table: a ring of observation records in stream order, and the transitions over them.

Invariants (`check_invariants`): transition keys are consecutive, the newest `size` of all ever
inserted; each touches `window` consecutive rows of one chunk that is whole in the ring; chunks
share rows only where one goes on with the records that the one before it ends with. Pure: no
clock, lock or transport.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from common.errors import ConfigError, WireError
from common.trajectory import Chunk, Float32Array, Int64Array, Samples, UInt8Array
from services.replay.sampler import Sampler

_COLUMNS_BYTES = 8 + 1 + 4 + 4 + 1 + 8  # of one transition


@dataclass(frozen=True, slots=True)
class _Extent:
    """Where a chunk lies."""

    first_key: int
    num_transitions: int
    first_row: int
    num_rows: int


def bytes_per_transition(window: int, chunk_length: int, record_bytes: int) -> float:
    """Memory of records and columns, by the transition; the sampler's comes on top."""
    return record_bytes * (1 + (window - 1) / chunk_length) + _COLUMNS_BYTES


class Table:
    """First in, first out; a sampler says which transitions are drawn.

    capacity: transitions. stack: records of a state. n_step: longest return; a transition
    touches a window of stack + n_step records. chunk_length: transitions of most chunks; many
    shorter ones leave less than the capacity. record_bytes: length of one record. sampler: of the
    same capacity, for this table alone. All memory is taken, and touched, at once.
    """

    def __init__(
        self,
        capacity: int,
        stack: int,
        n_step: int,
        chunk_length: int,
        record_bytes: int,
        sampler: Sampler,
    ) -> None:
        window = stack + n_step
        num_rows = int(capacity * (1 + (window - 1) / chunk_length)) + 2 * window
        try:
            self._rows: UInt8Array = np.full((num_rows, record_bytes), 0, np.uint8)
        except MemoryError as error:
            raise ConfigError(
                f"replay.capacity {capacity} needs {num_rows * record_bytes >> 20} MiB for its "
                "records, more than this machine gives; lower it"
            ) from error
        self._capacity = capacity
        self._window = window
        self._n_step = n_step
        self._in_window = np.arange(window)
        self._start_rows = np.zeros(capacity, np.int64)
        self._actions = np.zeros(capacity, np.uint8)
        self._rewards = np.zeros(capacity, np.float32)
        self._discounts = np.zeros(capacity, np.float32)
        self._bootstrap_offsets = np.zeros(capacity, np.uint8)
        self._weights_versions = np.zeros(capacity, np.int64)
        self._extents: deque[_Extent] = deque()
        self._next_key = 0
        self._next_row = 0
        self._sampler = sampler

    def __len__(self) -> int:
        return self._next_key - self.first_key

    @property
    def first_key(self) -> int:
        """Key of the oldest transition; of the next one in an empty table."""
        return self._extents[0].first_key if self._extents else self._next_key

    @property
    def next_key(self) -> int:
        """Key of the next transition; transitions ever inserted."""
        return self._next_key

    def number_from(self, key: int) -> None:
        """Give the next transition this key; ValueError unless the table is empty."""
        if len(self):
            raise ValueError("only an empty table can be numbered anew")
        self._next_key = key

    @property
    def keys(self) -> range:
        """Of the transitions there are now."""
        return range(self.first_key, self._next_key)

    @property
    def sampler(self) -> Sampler:
        """Which says what is drawn."""
        return self._sampler

    def rewards(self, keys: range) -> Float32Array:
        """A copy of these transitions' n-step returns [len(keys)]."""
        return self._rewards[np.arange(keys.start, keys.stop) % self._capacity]

    @property
    def capacity(self) -> int:
        return self._capacity

    @property
    def nbytes(self) -> int:
        """Memory of the records and of what is kept a transition."""
        columns = (
            self._rows,
            self._start_rows,
            self._actions,
            self._rewards,
            self._discounts,
            self._bootstrap_offsets,
            self._weights_versions,
        )
        return sum(column.nbytes for column in columns) + self._sampler.nbytes

    def check(self, chunk: Chunk) -> None:
        """Raise WireError where the chunk does not fit this table."""
        num_rows, record_bytes = chunk.records.shape
        tail = num_rows - len(chunk)
        if record_bytes != self._rows.shape[1] or tail != self._window - 1:
            raise WireError(
                f"records of {record_bytes} bytes, {tail} more than transitions, where "
                f"{self._rows.shape[1]} and {self._window - 1} are due: another arena or agent?"
            )
        if int(chunk.bootstrap_offsets.max()) > self._n_step:
            raise WireError(f"a bootstrap offset exceeds agent.n_step, {self._n_step}")
        if len(chunk) > self._capacity:
            raise WireError(f"{len(chunk)} transitions exceed the capacity {self._capacity}")

    def insert(self, chunk: Chunk) -> None:
        """Append the chunk's transitions; the oldest chunks make room."""
        self.check(chunk)
        length, num_rows = len(chunk), len(chunk.records)
        oldest = self.first_key
        shared = self._window - 1 if self._goes_on(chunk) else 0
        first_row = self._make_room(length, num_rows - shared) - shared
        if self.first_key > oldest:
            self._sampler.evict(range(oldest, self.first_key))
        self._rows[first_row + shared : first_row + num_rows] = chunk.records[shared:]
        slots = (self._next_key + np.arange(length)) % self._capacity
        self._start_rows[slots] = first_row + np.arange(length)
        self._actions[slots] = chunk.actions
        self._rewards[slots] = chunk.rewards
        self._discounts[slots] = chunk.discounts
        self._bootstrap_offsets[slots] = chunk.bootstrap_offsets
        self._weights_versions[slots] = chunk.weights_version
        self._extents.append(_Extent(self._next_key, length, first_row, num_rows))
        self._next_key += length
        self._next_row = first_row + num_rows
        self._sampler.insert(range(self._next_key - length, self._next_key), chunk.priorities)

    def update_priorities(self, keys: Int64Array, priorities: Float32Array) -> int:
        """Give transitions new absolute TD errors, both [N]; how many of them were taken.

        Those that were evicted meanwhile are ignored; so are all where sampling is uniform.
        """
        there = (keys >= self.first_key) & (keys < self._next_key)
        return self._sampler.update(keys[there], priorities[there])

    def sample_bytes(self, size: int) -> int:
        """Length of the records of `size` transitions."""
        return size * self._window * int(self._rows.shape[1])

    def sample(self, size: int, out: memoryview | None = None) -> Samples:
        """`size` transitions as the sampler draws them; ValueError when the table is empty.

        out: memory of `sample_bytes` for their records.
        """
        if len(self) == 0:
            raise ValueError("cannot sample from an empty table")
        keys, probabilities = self._sampler.sample(self.keys, size)
        slots = keys % self._capacity
        return Samples(
            keys=keys,
            probabilities=probabilities,
            table_size=len(self),
            total_priority=self._sampler.total(self.keys),
            actions=self._actions[slots],
            rewards=self._rewards[slots],
            discounts=self._discounts[slots],
            bootstrap_offsets=self._bootstrap_offsets[slots],
            weights_versions=self._weights_versions[slots],
            records=self._gather(self._start_rows[slots], out),
        )

    def _gather(self, start_rows: Int64Array, out: memoryview | None) -> UInt8Array:
        """The records [B, W, R] of the windows that begin at rows [B]."""
        rows = (start_rows[:, None] + self._in_window).reshape(-1)
        record_bytes = self._rows.shape[1]
        flat = None if out is None else np.frombuffer(out, np.uint8).reshape(-1, record_bytes)
        # "clip" writes straight into `out`; the rows are all there.
        records: UInt8Array = self._rows.take(rows, axis=0, out=flat, mode="clip")
        return records.reshape(len(start_rows), self._window, record_bytes)

    def _goes_on(self, chunk: Chunk) -> bool:
        """Whether the chunk begins with the records that the newest one ends with.

        So do two chunks of one robot when no other came between.
        """
        overlap, end = self._window - 1, self._next_row
        if not self._extents or end + len(chunk.records) - overlap > len(self._rows):
            return False
        return np.array_equal(self._rows[end - overlap : end], chunk.records[:overlap])

    def _make_room(self, num_transitions: int, num_rows: int) -> int:
        """Evict until both fit; the first of `num_rows` free consecutive rows."""
        while len(self) + num_transitions > self._capacity:
            self._extents.popleft()
        first_row = self._next_row
        if first_row + num_rows > len(self._rows):
            # The rows up to the end stay unused this time round.
            self._evict_rows(first_row, len(self._rows))
            first_row = 0
        self._evict_rows(first_row, first_row + num_rows)
        return first_row

    def _evict_rows(self, start: int, stop: int) -> None:
        # The oldest chunk is the next one ahead in the ring, so evicting in order frees them.
        while self._extents and start <= self._extents[0].first_row < stop:
            self._extents.popleft()

    def check_invariants(self) -> None:
        """Raise AssertionError where one of the module's invariants does not hold."""
        key = self.first_key
        taken = np.zeros(len(self._rows), bool)
        end = -1
        for extent in self._extents:
            if extent.first_key != key:
                raise AssertionError(f"key {extent.first_key} follows where {key} is due")
            key += extent.num_transitions
            first, stop = extent.first_row, extent.first_row + extent.num_rows
            if first == end - (self._window - 1):
                first = end
            if taken[first:stop].any():
                raise AssertionError("two chunks share rows, and neither goes on with the other")
            taken[first:stop] = True
            end = stop
        if key != self._next_key or len(self) > self._capacity:
            raise AssertionError("keys are not the newest of all inserted, or exceed the capacity")
        self._sampler.check_invariants(self.keys)
