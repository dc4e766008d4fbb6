"""Export a log's transitions as numpy arrays in one file; docs/inspect.md describes them."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.runtime.files import TEMPORARY_SUFFIX, reason
from mrcdrl.services.replay.inspect.contents import Contents


def arrays(contents: Contents) -> dict[str, np.ndarray[Any, Any]]:
    """The arrays by name, from a log read with its records.

    Raises RunDirectoryError if there is no transition, or if records or windows differ in size.
    """
    chunks = contents.chunks
    if not chunks:
        raise RunDirectoryError("the log has no transitions to export")
    shapes = {(len(c.records) - len(c) + 1, c.records.shape[1]) for c in chunks}
    if len(shapes) > 1:
        raise RunDirectoryError(
            "the log has chunks of several arenas or agents; give the run's --config to leave out "
            "the others"
        )
    lengths = np.array([len(c) for c in chunks])
    rows = np.array([len(c.records) for c in chunks])
    offsets = np.concatenate([np.arange(n) for n in lengths])
    names, numbers = np.unique([c.actor for c in chunks], return_inverse=True)
    return {
        "keys": np.repeat(np.array(contents.keys, np.int64), lengths) + offsets,
        "actors": np.repeat(numbers.astype(np.int32), lengths),
        "actor_names": names,
        "incarnations": np.repeat(np.array([c.incarnation for c in chunks], np.int64), lengths),
        "sequences": np.repeat(np.array([c.sequence for c in chunks], np.int64), lengths),
        "weights_versions": np.repeat([c.weights_version for c in chunks], lengths),
        "actions": np.concatenate([c.actions for c in chunks]),
        "rewards": np.concatenate([c.rewards for c in chunks]),
        "discounts": np.concatenate([c.discounts for c in chunks]),
        "bootstrap_offsets": np.concatenate([c.bootstrap_offsets for c in chunks]),
        "priorities": np.concatenate(
            [c.priorities if len(c.priorities) else np.full(len(c), np.nan, "f4") for c in chunks]
        ),
        "records": np.concatenate([c.records for c in chunks]),
        "start_rows": np.repeat(np.cumsum(rows) - rows, lengths) + offsets,
        "window": np.array(next(iter(shapes))[0]),
    }


def write_export(path: Path, contents: Contents) -> int:
    """Write the arrays as .npz, completely or not at all; return the number of transitions."""
    by_name = arrays(contents)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY_SUFFIX}")
    try:
        with temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **by_name)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise RunDirectoryError(f"cannot write {path}: {reason(error)}") from error
    return len(by_name["keys"])
