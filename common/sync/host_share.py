"""Weights that one process of a host has fetched, for all that follow the run on this host.

They lie in a file; a lock beside it decides who fetches the next ones. Containers of a host share
both if the directory is a volume of theirs (docker-compose.yml). Invariants: who holds the lock and
is killed holds nobody up; a file is whole, or not there; without a directory that is this user's
alone, nothing is shared and everybody fetches.
"""

import contextlib
import fcntl
import os
import stat
import tempfile
import time
from pathlib import Path

from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.runtime.files import sha256

_DIGEST = 64  # bytes, at the file's start
_OLD_S = 86_400.0  # files of runs that have ended are removed when they are older


class HostShare:
    """Takes weights of a run from other processes of this host, and hands on what was fetched."""

    def __init__(self, run: str, *, enabled: bool) -> None:
        """enabled: where this is off, `take` finds nothing and every process may `lead`."""
        directory = _private_directory() if enabled else None
        self._file = None if directory is None else directory / f"weights-{run}"
        self._lock: int | None = None  # descriptor, while this process fetches

    def take(self, digest: str, num_bytes: int) -> bytes | None:
        """The payload with this digest, if another process has fetched it."""
        if self._file is None:
            return None
        try:
            with self._file.open("rb") as file:
                if file.read(_DIGEST) != digest.encode():
                    return None
                payload = file.read(num_bytes + 1)
        except OSError:
            return None
        return payload if sha256(payload) == digest else None

    def lead(self) -> bool:
        """Whether this process is to fetch; if so, until `release`."""
        if self._file is None or self._lock is not None:
            return True
        try:
            lock = os.open(f"{self._file}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError:
            return True
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            return False
        self._lock = lock
        return True

    def offer(self, weights: Weights) -> None:
        """Hand on what was fetched."""
        if self._file is None:
            return
        with contextlib.suppress(OSError):  # then the others fetch, too
            descriptor, fresh = tempfile.mkstemp(prefix=".", dir=self._file.parent)
            with os.fdopen(descriptor, "wb") as file:
                file.write(weights.digest.encode() + weights.payload)
            Path(fresh).replace(self._file)
            _remove_old(self._file.parent)

    def release(self) -> None:
        """Let another process fetch; harmless if repeated."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def _private_directory() -> Path | None:
    """A directory that only this user can change; None if there is none."""
    path = Path(tempfile.gettempdir(), f"mrcdrl-{os.getuid()}")
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
    except OSError:
        return None
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
    return path if ours and not found.st_mode & 0o022 else None


def _remove_old(directory: Path) -> None:
    """Remove what runs that have ended, or writers that were killed, have left."""
    for path in directory.iterdir():
        with contextlib.suppress(OSError):
            if path.suffix != ".lock" and time.time() - path.stat().st_mtime > _OLD_S:
                path.unlink()
