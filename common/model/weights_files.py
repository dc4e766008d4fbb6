"""Weight files, each with a manifest beside it; no torch here.

Invariant: a manifest also holds the one that it replaced. So weights whose digest is in neither are
damaged, whenever a writer was killed.
"""

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.runtime.files import atomic_write, reason, sha256

_REPLACED = "replaced"


def write_weights(path: Path, payload: bytes, manifest: Mapping[str, Any]) -> None:
    """Write the manifest beside `path` as `.json`, then published weights to `path`.

    Raises CheckpointError if the disk is full or the directory cannot be written.
    """
    described = {**manifest, "sha256": sha256(payload)}
    with contextlib.suppress(CheckpointError):  # nothing to replace, or damaged
        described[_REPLACED] = {k: v for k, v in read_weights(path)[1].items() if k != _REPLACED}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(described, indent=2, allow_nan=False)
        atomic_write(path.with_suffix(".json"), text.encode())
        atomic_write(path, payload)
    except OSError as error:
        raise CheckpointError(f"weights {path} not written: {reason(error)}") from error


def read_weights(path: Path) -> tuple[bytes, dict[str, Any]]:
    """Read a payload and its manifest, or {} if it has none.

    Raises CheckpointError if the payload cannot be read, or is not the one that the manifest is of.
    """
    try:
        payload = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"weights {path}: {reason(error)}") from error
    beside = path.with_suffix(".json")
    try:
        manifest = json.loads(beside.read_bytes())
    except (OSError, ValueError):
        return payload, {}
    if not isinstance(manifest, dict) or "sha256" not in manifest:
        return payload, {}  # of another program
    for described in (manifest, manifest.get(_REPLACED) or {}):
        if described.get("sha256") == sha256(payload):
            return payload, described
    raise CheckpointError(
        f"weights {path} are damaged: their digest is not that of {beside.name}; "
        "to use them nevertheless, remove that file"
    )
