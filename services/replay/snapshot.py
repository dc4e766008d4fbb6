"""Snapshots of what the log does not keep: priorities, counters and the sampler's random state.

    <directory>/snapshot
    magic, CRC-32 of all that follows uint32, length of the header uint32 (little-endian),
    header (JSON), scaled priorities float64 (named "shares"), rewards float32

Invariants: the file is replaced as a whole; one that is torn, damaged, foreign or from another
table is logged and ignored; the present configuration overrides the one it was made with.
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
_ARRAYS: dict[str, tuple[str, np.dtype[Any]]] = {  # by field: name and type in the file
    "scaled_priorities": ("shares", np.dtype("<f8")),
    "rewards": ("rewards", np.dtype("<f4")),
}


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings that a snapshot's numbers depend on."""

    capacity: int
    samples_per_insert: float
    min_size: int
    sampler: str
    priority_exponent: float

    @classmethod
    def from_config(cls, config: Config) -> Self:
        return cls(**{f.name: getattr(config.replay, f.name) for f in fields(cls)})


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Priorities of the N transitions from `first_key` on, and the counters at that time."""

    settings: Settings
    first_key: int
    inserts: int  # of the rate limiter
    samples: int  # of the rate limiter
    all_samples: int  # since the run began
    largest: float  # priority so far
    rng_state: dict[str, Any] = field(repr=False)  # of the sampler, as JSON
    scaled_priorities: Float64Array = field(repr=False)  # [N], or [0] where uniform
    rewards: Float32Array = field(repr=False)  # [N], which identify the transitions

    @classmethod
    def take(cls, config: Config, table: Table, limiter: RateLimiter, all_samples: int) -> Self:
        """Snapshot a table that does not change meanwhile; only copies the arrays."""
        return cls(
            settings=Settings.from_config(config),
            first_key=table.first_key,
            inserts=limiter.inserts,
            samples=limiter.samples,
            all_samples=all_samples,
            largest=table.sampler.largest,
            rng_state=dict(table.sampler.rng.bit_generator.state),
            scaled_priorities=table.sampler.scaled_priorities(table.keys),
            rewards=table.rewards(table.keys),
        )

    @property
    def keys(self) -> range:
        """Keys of its transitions."""
        return range(self.first_key, self.first_key + len(self.rewards))

    def restore(self, config: Config, table: Table, limiter: RateLimiter) -> bool:
        """Restore a table read back from its log; return False if the snapshot is of another.

        Transitions newer than the snapshot keep their initial priorities; evicted ones are
        skipped. Logs each setting that differs from the snapshot's.
        """
        if not self.keys:
            return False
        common = range(max(self.first_key, table.first_key), min(self.keys.stop, table.keys.stop))
        mine = slice(common.start - self.first_key, common.stop - self.first_key)
        if not common or not np.array_equal(self.rewards[mine], table.rewards(common)):
            _LOG.warning("ignoring the snapshot: it does not match the log's transitions")
            return False
        self._report(Settings.from_config(config))
        if self.rng_state:
            table.sampler.rng.bit_generator.state = self.rng_state
        if len(self.scaled_priorities):
            table.sampler.raise_largest(self.largest)
            exponent = self.settings.priority_exponent
            known = priorities_of(self.scaled_priorities[mine], exponent)
            table.update_priorities(np.arange(common.start, common.stop)[: len(known)], known)
        if len(table) >= limiter.min_size:
            inserts = self.inserts + table.next_key - self.keys.stop
            limiter.restore(max(inserts, len(table)), self.samples)
        return True

    def _report(self, present: Settings) -> None:
        was, now = asdict(self.settings), asdict(present)
        changed = [f"replay.{n} is {now[n]}, was {was[n]}" for n in now if now[n] != was[n]]
        if changed:
            _LOG.info("the configuration overrides the snapshot: %s", "; ".join(changed))

    def to_bytes(self) -> bytes:
        header = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS}
        header["settings"] = asdict(self.settings)
        header["lengths"] = {name: len(getattr(self, f)) for f, (name, _) in _ARRAYS.items()}
        text = json.dumps(header).encode()
        arrays = [getattr(self, f).astype(dtype).tobytes() for f, (_, dtype) in _ARRAYS.items()]
        body = b"".join([text, *arrays])
        crc = zlib.crc32(body, zlib.crc32(_LENGTHS.pack(0, len(text))))
        return b"".join([_MAGIC, _LENGTHS.pack(crc, len(text)), body])

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Parse what `to_bytes` wrote; raises CheckpointError with the reason for anything else."""
        if not data.startswith(_MAGIC):
            raise CheckpointError("is not a snapshot of this version")
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
            raise CheckpointError(f"has an unknown format: {error}") from error

    @classmethod
    def _parsed(cls, header: dict[str, Any], data: bytes) -> Self:
        lengths, offset = header.pop("lengths"), 0
        header["settings"] = Settings(**header["settings"])
        header.setdefault("rng_state", {})  # absent from older files
        for name, (name_in_file, dtype) in _ARRAYS.items():
            header[name] = np.frombuffer(data, dtype, lengths[name_in_file], offset)
            offset += header[name].nbytes
        return cls(**header)


def read_snapshot(directory: Path) -> Snapshot | None:
    """The snapshot beside a log; None if there is none or, with a warning, it is unusable."""
    path = directory / _NAME
    try:
        return Snapshot.from_bytes(path.read_bytes())
    except FileNotFoundError:
        return None
    except OSError as error:
        _LOG.warning("ignoring %s, which cannot be read: %s", path, reason(error))
    except CheckpointError as error:
        _LOG.warning("ignoring %s, which %s", path, error)
    return None


class SnapshotWriter:
    """Writes a snapshot every `period_s` from its own thread, and a last one at `stop`.

    take: makes the snapshot; called from that thread.
    """

    def __init__(self, directory: Path, take: Callable[[], Snapshot], period_s: float) -> None:
        self._directory = directory
        self._take = take
        self._period_s = period_s
        self._failing = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="snapshot")

    def start(self) -> None:
        for left in self._directory.glob(f".{_NAME}.*{TEMPORARY_SUFFIX}"):  # by a killed process
            left.unlink(missing_ok=True)
        self._thread.start()

    def stop(self) -> None:
        """Write once more, then end the thread."""
        self._stopping.set()
        self._thread.join()

    @property
    def healthy(self) -> bool:
        """Whether the thread lives; one that died from a bug ends the service."""
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
                _LOG.warning("cannot write a snapshot of the priorities: %s", reason(error))
            self._failing = True
