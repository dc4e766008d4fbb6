"""Weight files, each with a manifest beside it; no torch here."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.runtime.files import atomic_write, reason, sha256


def write_weights(path: Path, payload: bytes, manifest: Mapping[str, Any]) -> None:
    """Write published weights to `path`, and the manifest beside it as `.json`.

    Raises CheckpointError if the disk is full or the directory cannot be written.
    """
    described = {**manifest, "sha256": sha256(payload)}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, payload)
        text = json.dumps(described, indent=2, allow_nan=False)
        atomic_write(path.with_suffix(".json"), text.encode())
    except OSError as error:
        raise CheckpointError(f"weights {path} not written: {reason(error)}") from error


def read_weights(path: Path) -> tuple[bytes, dict[str, Any]]:
    """Read a payload and its manifest, or {} if the manifest is missing or about another payload.

    Raises CheckpointError if the payload cannot be read; its reader checks that it is whole.
    """
    try:
        payload = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"weights {path}: {reason(error)}") from error
    try:
        manifest = json.loads(path.with_suffix(".json").read_bytes())
    except (OSError, ValueError):
        return payload, {}
    if not isinstance(manifest, dict) or manifest.get("sha256") != sha256(payload):
        return payload, {}
    return payload, manifest
