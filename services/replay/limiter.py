"""The rate limiter: only counters and limits, as in Reverb, so that the table's owner may ask it.

Invariant: once `min_size` is reached, samples stay within `error_buffer` of
`samples_per_insert` x (inserts - min_size) if both sides ask before they act.
"""

import math
from dataclasses import dataclass
from typing import Self

from mrcdrl.common.config import Config
from mrcdrl.common.errors import ConfigError


@dataclass(slots=True)
class RateLimiter:
    """Keeps samples and inserts at a ratio.

    samples_per_insert: transitions sampled per inserted one; 0: no limit. min_size: inserts
    before the first sample. error_buffer: samples by which either side may run ahead.
    largest_insert, largest_sample: transitions of one request, for the deadlock check.

    Raises ConfigError for settings that would deadlock.
    """

    samples_per_insert: float
    min_size: int
    error_buffer: float
    largest_insert: int
    largest_sample: int
    inserts: int = 0
    samples: int = 0

    def __post_init__(self) -> None:
        if self.samples_per_insert < 0 or self.min_size < 1:
            raise ConfigError("the rate limiter needs samples_per_insert >= 0 and min_size >= 1")
        needed = max(self.samples_per_insert * self.largest_insert, self.largest_sample)
        if self.samples_per_insert and self.error_buffer < needed:
            raise ConfigError(
                f"replay.tolerance allows a lead of {self.error_buffer:.0f} samples, one request "
                f"moves {needed:.0f}: actors and learner would wait for each other forever"
            )

    @classmethod
    def from_config(cls, config: Config) -> Self:
        """The limiter of one shard; in lockstep the turns set the pace, and only min_size holds."""
        return cls.with_tolerance(
            0.0 if config.run.turn_size else config.replay.samples_per_insert,
            config.replay.shard_min_size,
            config.replay.tolerance,
            largest_insert=config.actor.chunk_length,
            largest_sample=config.learner.sample_size,
        )

    @classmethod
    def with_tolerance(
        cls,
        samples_per_insert: float,
        min_size: int,
        tolerance: float,
        largest_insert: int,
        largest_sample: int,
    ) -> Self:
        """A limiter whose buffer is `tolerance` x min_size x ratio, but at least two requests."""
        one_request = max(samples_per_insert * largest_insert, largest_sample)
        buffer = max(tolerance * min_size * samples_per_insert, 2.0 * one_request)
        return cls(samples_per_insert, min_size, buffer, largest_insert, largest_sample)

    @property
    def _lead(self) -> float:
        """Samples still due for what was inserted; negative when the learner is ahead."""
        return (self.inserts - self.min_size) * self.samples_per_insert - self.samples

    def can_insert(self, count: int) -> bool:
        if not self.samples_per_insert or self.inserts + count <= self.min_size:
            return True
        return self._lead + count * self.samples_per_insert <= self.error_buffer

    def can_sample(self, count: int) -> bool:
        if self.inserts < self.min_size:
            return False
        return not self.samples_per_insert or self._lead - count >= -self.error_buffer

    def resume(self, size: int) -> None:
        """Continue with a table that holds `size` transitions of earlier processes.

        They count as just inserted, and neither side as ahead.
        """
        self.inserts = size
        self.samples = round(max(size - self.min_size, 0) * self.samples_per_insert)

    def restore(self, inserts: int, samples: int) -> None:
        """Continue an earlier process's counters, given a whole table of at least `min_size`.

        Samples lost since the counters were saved, or changed settings, may have put the lead
        outside the error buffer; it is then moved back to the edge.
        """
        self.inserts, self.samples = inserts, samples
        if self.samples_per_insert:
            due = (inserts - self.min_size) * self.samples_per_insert
            least, most = math.ceil(due - self.error_buffer), math.floor(due + self.error_buffer)
            self.samples = max(min(max(samples, least), most), 0)

    @property
    def ratio(self) -> float:
        """Samples per insert so far, counted from the first insert that could be sampled."""
        return self.samples / max(self.inserts - self.min_size, 1)
