"""Atomic file writes, and the file names in a run directory that several rooms share.

Invariants: a file gets its name only when its bytes are on the disk; a write that fails or is
killed leaves nothing under the final name.
"""

import errno
import fcntl
import hashlib
import os
import tempfile
from pathlib import Path

from mrcdrl.common.errors import ConfigError

TEMPORARY_SUFFIX = ".part"
WEIGHTS_SUFFIX = ".safetensors"
RUN_CONFIG = "config.toml"  # in a run directory, as all below
METRICS = "metrics.jsonl"
PICTURES = ("training.png", "trajectories.png")
MOVING_PICTURE = "evaluation.gif"
FILM = "evaluation.mp4"
BEST_WEIGHTS = Path("checkpoints") / f"best{WEIGHTS_SUFFIX}"
CHECKPOINT_MANIFEST = "manifest.json"


def write_synced(path: Path, content: bytes, mode: int = 0o644) -> None:
    """Write a new file and wait until it is on the disk; raises OSError.

    mode: the file's permissions, from its first byte on.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
    try:
        remaining = memoryview(content)
        while remaining:
            remaining = remaining[os.write(descriptor, remaining) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_directory(path: Path) -> None:
    """Wait until the names in a directory are on the disk; raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def atomic_write(path: Path, content: bytes, mode: int = 0o644) -> None:
    """Write or replace a file in one step; an OSError leaves the old one unchanged.

    mode: as in `write_synced`. Two writers at once are safe: the last one wins.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY_SUFFIX}")
    try:
        write_synced(temporary, content, mode)
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    sync_directory(path.parent)


def lock_directory(path: Path) -> int:
    """Lock a directory against other processes; return the descriptor that holds the lock.

    Raises BlockingIOError if another one has it, another OSError where it cannot be locked.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def is_locked(path: Path) -> bool:
    """Whether another process has locked a directory; raises OSError where it cannot be opened."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def prepare_output(path: Path) -> None:
    """Make the folder of a file that a command is to write, before its work begins.

    Raises ConfigError if the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {reason(error)}") from error


def sha256(content: bytes) -> str:
    """SHA-256 digest, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def reason(error: OSError) -> str:
    """The reason in a few words, such as "No space left on device"."""
    return error.strerror or type(error).__name__
