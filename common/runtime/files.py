"""Atomic file writes, and the file names in a run directory that several rooms share.

Invariants: a file gets its name only when its bytes are on the disk; a write that fails or is
killed leaves nothing under the final name.
"""

import fcntl
import hashlib
import os
from pathlib import Path

TEMPORARY_SUFFIX = ".part"
WEIGHTS_SUFFIX = ".safetensors"
RUN_CONFIG = "config.toml"  # in a run directory, as all below
METRICS = "metrics.jsonl"
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


def sha256(content: bytes) -> str:
    """SHA-256 digest, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def reason(error: OSError) -> str:
    """The reason in a few words, such as "No space left on device"."""
    return error.strerror or type(error).__name__
