"""Checkpoints of the learner: directories that are whole or do not exist.

    checkpoints/step_000001234/
        model.safetensors  target.safetensors  optimizer.safetensors  manifest.json
        average.safetensors, where learner.average_decay asks for it

Invariants: a directory gets its name once all of its files are on the disk; the manifest holds the
digest of every file; a reader takes the newest directory whose digests are right and says which
ones it skipped; nothing is unpickled. One process writes, any may read.
"""

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.runtime.files import (
    CHECKPOINT_MANIFEST,
    TEMPORARY_SUFFIX,
    reason,
    sha256,
    sync_directory,
    write_synced,
)
from mrcdrl.services.learner.learner import LearnerState

FORMAT_VERSION = 1
_PREFIX = "step_"
_FILES = ("model", "target", "optimizer")
_AVERAGE = "average"


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A learner's state, and the last weights it had published."""

    state: LearnerState
    weights_epoch: int
    weights_version: int  # of the last publication; the next one is larger
    config_digest: str  # of the configuration it was learned with
    unix_time_s: float  # when it was taken


@dataclass(frozen=True, slots=True)
class Loaded:
    """The newest whole checkpoint, and why newer ones were skipped."""

    checkpoint: Checkpoint
    path: Path
    skipped: tuple[str, ...]  # one line each, newest first


def save(directory: Path, checkpoint: Checkpoint, *, keep: int) -> Path:
    """Write a checkpoint below `directory`, then delete all but the newest `keep`.

    Raises CheckpointError if the disk is full or the directory cannot be written. Nothing
    half-written is left then, and the older checkpoints are as they were.
    """
    if keep < 1:
        raise ValueError(f"keep = {keep} would delete the checkpoint just written")
    path = directory / f"{_PREFIX}{checkpoint.state.learner_step:09d}"
    temporary = directory / f".{path.name}.{os.getpid()}{TEMPORARY_SUFFIX}"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(directory)
        _write(temporary, checkpoint)
        if path.exists():  # the same step again; rename cannot replace a directory that holds files
            path.rename(temporary.with_suffix(f".old{TEMPORARY_SUFFIX}"))
        temporary.rename(path)
        sync_directory(directory)
        _remove_leftovers(directory)
        for old in _newest_first(directory)[keep:]:
            shutil.rmtree(old)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise CheckpointError(f"checkpoint {path} not written: {reason(error)}") from error
    return path


def latest(directory: Path) -> Path | None:
    """The newest checkpoint by its manifest; its other files are not checked."""
    found = _newest_first(directory)
    return found[0] if found else None


def load(path: Path) -> Checkpoint:
    """One checkpoint, every digest verified; raises CheckpointError saying what is wrong."""
    manifest = _read_manifest(path)
    averaged = [_AVERAGE] if f"{_AVERAGE}.safetensors" in manifest["sha256"] else []
    names = (*_FILES, *averaged)
    contents = {name: _read_file(path / f"{name}.safetensors", manifest) for name in names}
    try:
        return Checkpoint(
            state=LearnerState(
                learner_step=int(manifest["learner_step"]),
                model=contents["model"],
                target=contents["target"],
                optimizer=contents["optimizer"],
                rng_state=dict(manifest["rng_state"]),
                average=contents.get(_AVERAGE, b""),
            ),
            weights_epoch=int(manifest["weights_epoch"]),
            weights_version=int(manifest["weights_version"]),
            config_digest=str(manifest["config_digest"]),
            unix_time_s=float(manifest["unix_time_s"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {path}: its manifest lacks {error}, or holds a wrong value"
        ) from error


def load_latest(directory: Path) -> Loaded | None:
    """The newest whole checkpoint; None if there is none at all.

    Raises CheckpointError if there are some and none is whole: a resumed run must not start anew
    in silence.
    """
    found = _newest_first(directory)
    skipped: list[str] = []
    for path in found:
        try:
            return Loaded(load(path), path, tuple(skipped))
        except CheckpointError as error:
            skipped.append(str(error))
    if found:
        raise CheckpointError(
            f"none of {len(found)} checkpoints is whole; the newest: {skipped[0]}"
        )
    return None


def _write(folder: Path, checkpoint: Checkpoint) -> None:
    state = checkpoint.state
    contents = {"model": state.model, "target": state.target, "optimizer": state.optimizer}
    if state.average:
        contents[_AVERAGE] = state.average
    manifest = {
        "format_version": FORMAT_VERSION,
        "learner_step": state.learner_step,
        "weights_epoch": checkpoint.weights_epoch,
        "weights_version": checkpoint.weights_version,
        "config_digest": checkpoint.config_digest,
        "unix_time_s": checkpoint.unix_time_s,
        "rng_state": state.rng_state,
        "sha256": {f"{name}.safetensors": sha256(data) for name, data in contents.items()},
    }
    folder.mkdir()
    for name, data in contents.items():
        write_synced(folder / f"{name}.safetensors", data)
    write_synced(folder / CHECKPOINT_MANIFEST, json.dumps(manifest, indent=2).encode())
    sync_directory(folder)


def _remove_leftovers(directory: Path) -> None:
    """Delete what killed saves left behind."""
    for leftover in directory.glob(f".{_PREFIX}*{TEMPORARY_SUFFIX}"):
        shutil.rmtree(leftover)


def _newest_first(directory: Path) -> list[Path]:
    """Checkpoints by (epoch, version, step); those without a readable manifest come last."""

    def age(path: Path) -> tuple[int, int, int]:
        try:
            manifest = _read_manifest(path)
            return (
                int(manifest["weights_epoch"]),
                int(manifest["weights_version"]),
                int(manifest["learner_step"]),
            )
        except (CheckpointError, KeyError, TypeError, ValueError):
            return (-1, -1, -1)

    return sorted(directory.glob(f"{_PREFIX}*"), key=lambda path: (age(path), path), reverse=True)


def _read_manifest(path: Path) -> Mapping[str, Any]:
    try:
        manifest = json.loads((path / CHECKPOINT_MANIFEST).read_bytes())
    except OSError as error:
        raise CheckpointError(
            f"checkpoint {path}: {CHECKPOINT_MANIFEST}: {reason(error)}"
        ) from error
    except ValueError as error:
        raise CheckpointError(f"checkpoint {path}: {CHECKPOINT_MANIFEST} is damaged") from error
    if not isinstance(manifest, dict) or not isinstance(manifest.get("sha256"), dict):
        raise CheckpointError(f"checkpoint {path}: {CHECKPOINT_MANIFEST} is damaged")
    if manifest.get("format_version") != FORMAT_VERSION:
        version = manifest.get("format_version")
        raise CheckpointError(f"checkpoint {path} has format {version!r}, not {FORMAT_VERSION}")
    return manifest


def _read_file(path: Path, manifest: Mapping[str, Any]) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"checkpoint {path}: {reason(error)}") from error
    if sha256(content) != manifest["sha256"].get(path.name):
        raise CheckpointError(f"checkpoint {path} is damaged: its digest is not the manifest's")
    return content
