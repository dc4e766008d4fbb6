"""What the log does not keep: priorities, the limiter's counters, the draws; now and then.

    <directory>/snapshot
    magic, CRC-32 of all that follows uint32, length of the header uint32 (little-endian),
    header (JSON), shares float64, rewards float32

Invariants: the file is replaced as a whole; one that is torn, damaged, foreign or not about the
table at hand is reported and ignored; the configuration at hand beats the one it was made with.
"""

import json
import logging
import struct
import threading
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Self

import numpy as np

from mrcdrl.common.config import Config
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.trajectory import Float32Array, Float64Array
from mrcdrl.common.runtime.files import TEMPORARY_SUFFIX, atomic_write, reason
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.sampler import priorities_of
from mrcdrl.services.replay.table import Table

_LOG = logging.getLogger("replay")
_NAME = "snapshot"
_MAGIC = b"mrcdrl replay snapshot 1\n"
_LENGTHS = struct.Struct("<II")
_ARRAYS: dict[str, np.dtype[Any]] = {"shares": np.dtype("<f8"), "rewards": np.dtype("<f4")}


@dataclass(frozen=True, slots=True)
class Settings:
    """What of the configuration the numbers of a snapshot depend on."""

    capacity: int
    samples_per_insert: float
    min_size: int
    sampler: str
    priority_exponent: float

    @classmethod
    def of(cls, config: Config) -> Self:
        return cls(**{f.name: getattr(config.replay, f.name) for f in fields(cls)})


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Priorities of the N transitions from `first_key` on, and what was counted by then."""

    settings: Settings
    first_key: int
    inserts: int  # of the rate limiter
    samples: int  # of the rate limiter
    all_samples: int  # since the run began
    largest: float  # priority so far
    rng_state: dict[str, Any] = field(repr=False)  # of the draws, as JSON takes it
    shares: Float64Array = field(repr=False)  # [N], priorities to the power; or [0]
    rewards: Float32Array = field(repr=False)  # [N], by which the transitions are known again

    @classmethod
    def take(cls, config: Config, table: Table, limiter: RateLimiter, all_samples: int) -> Self:
        """Of a table that does not change meanwhile; copies the arrays, and no more."""
        return cls(
            settings=Settings.of(config),
            first_key=table.first_key,
            inserts=limiter.inserts,
            samples=limiter.samples,
            all_samples=all_samples,
            largest=table.sampler.largest,
            rng_state=dict(table.sampler.rng.bit_generator.state),
            shares=table.sampler.shares(table.keys),
            rewards=table.rewards(table.keys),
        )

    @property
    def keys(self) -> range:
        """Of its transitions."""
        return range(self.first_key, self.first_key + len(self.rewards))

    def restore(self, config: Config, table: Table, limiter: RateLimiter) -> bool:
        """Give a table read back from its log what it had; False where this is not about it.

        Transitions that came after the snapshot keep their initial priorities, those that are
        gone are passed over. Logs each setting that differs from the snapshot's.
        """
        if not self.keys:
            return False
        common = range(max(self.first_key, table.first_key), min(self.keys.stop, table.keys.stop))
        mine = slice(common.start - self.first_key, common.stop - self.first_key)
        if not common or not np.array_equal(self.rewards[mine], table.rewards(common)):
            _LOG.warning("the snapshot is not about the log's transitions and is ignored")
            return False
        self._report(Settings.of(config))
        if self.rng_state:
            table.sampler.rng.bit_generator.state = self.rng_state
        if len(self.shares):
            table.sampler.raise_largest(self.largest)
            exponent = self.settings.priority_exponent
            known = priorities_of(self.shares[mine], exponent)
            table.update_priorities(np.arange(common.start, common.stop)[: len(known)], known)
        if len(table) >= limiter.min_size:
            inserts = self.inserts + table.next_key - self.keys.stop
            limiter.restore(max(inserts, len(table)), self.samples)
        return True

    def _report(self, present: Settings) -> None:
        was, now = asdict(self.settings), asdict(present)
        changed = [f"replay.{n} is {now[n]}, was {was[n]}" for n in now if now[n] != was[n]]
        if changed:
            _LOG.info("the configuration beats the snapshot: %s", "; ".join(changed))

    def to_bytes(self) -> bytes:
        header = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS}
        header["settings"] = asdict(self.settings)
        header["lengths"] = {name: len(getattr(self, name)) for name in _ARRAYS}
        text = json.dumps(header).encode()
        arrays = [getattr(self, name).astype(dtype).tobytes() for name, dtype in _ARRAYS.items()]
        body = b"".join([text, *arrays])
        crc = zlib.crc32(body, zlib.crc32(_LENGTHS.pack(0, len(text))))
        return b"".join([_MAGIC, _LENGTHS.pack(crc, len(text)), body])

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Raises CheckpointError with the reason for what `to_bytes` would not have written."""
        if not data.startswith(_MAGIC):
            raise CheckpointError("is no snapshot, or one of another version")
        body_at = len(_MAGIC) + _LENGTHS.size
        if len(data) < body_at:
            raise CheckpointError("is torn")
        crc, length = _LENGTHS.unpack_from(data, len(_MAGIC))
        body = data[body_at:]
        if zlib.crc32(body, zlib.crc32(_LENGTHS.pack(0, length))) != crc:
            raise CheckpointError("is torn or damaged")
        try:
            return cls._parsed(json.loads(body[:length]), body[length:])
        except (ValueError, TypeError, KeyError) as error:
            raise CheckpointError(f"is of no known form: {error}") from error

    @classmethod
    def _parsed(cls, header: dict[str, Any], data: bytes) -> Self:
        lengths, offset = header.pop("lengths"), 0
        header["settings"] = Settings(**header["settings"])
        header.setdefault("rng_state", {})  # of a file written before there was one
        for name, dtype in _ARRAYS.items():
            header[name] = np.frombuffer(data, dtype, lengths[name], offset)
            offset += header[name].nbytes
        return cls(**header)


def read_snapshot(directory: Path) -> Snapshot | None:
    """The snapshot beside a log; None where there is none, or, with a warning, no whole one."""
    path = directory / _NAME
    try:
        return Snapshot.from_bytes(path.read_bytes())
    except FileNotFoundError:
        return None
    except OSError as error:
        _LOG.warning("%s cannot be read and is ignored: %s", path, reason(error))
    except CheckpointError as error:
        _LOG.warning("%s %s and is ignored", path, error)
    return None


class SnapshotWriter:
    """Writes a snapshot every `period_s` from a thread of its own, and the last one at `stop`.

    take: copies what is to be written; asked from that thread.
    """

    def __init__(self, directory: Path, take: Callable[[], Snapshot], period_s: float) -> None:
        self._directory = directory
        self._take = take
        self._period_s = period_s
        self._failing = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="snapshot")

    def start(self) -> None:
        for left in self._directory.glob(f".{_NAME}.*{TEMPORARY_SUFFIX}"):  # of one that was killed
            left.unlink(missing_ok=True)
        self._thread.start()

    def stop(self) -> None:
        """Write once more, then end the thread."""
        self._stopping.set()
        self._thread.join()

    @property
    def healthy(self) -> bool:
        """The thread lives; one that died of a bug of ours ends the service."""
        return self._thread.is_alive()

    def _run(self) -> None:
        while not self._stopping.wait(self._period_s):
            self._write()
        self._write()

    def _write(self) -> None:
        try:
            atomic_write(self._directory / _NAME, self._take().to_bytes())
            self._failing = False
        except OSError as error:
            if not self._failing:
                _LOG.warning("no snapshot of the priorities was written: %s", reason(error))
            self._failing = True
