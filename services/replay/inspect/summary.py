"""Summarize a log in plain values for JSON; docs/inspect.md explains each name.

Invariant: pure; an unknown number is None.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrcdrl.common.messages.trajectory import NUM_ACTIONS, Chunk, Float32Array
from mrcdrl.services.replay.inspect.contents import Contents, Rebuilt

_BINS = 12


def summarize(contents: Contents) -> dict[str, Any]:
    """All fields of the summary."""
    chunks = contents.chunks
    return {
        "files": asdict(contents.files),
        "chunks": len(chunks),
        "transitions": contents.num_transitions,
        "first_key": contents.keys[0] if chunks else None,
        "last_key": contents.keys[-1] + len(chunks[-1]) - 1 if chunks else None,
        "table": None if contents.rebuilt is None else _table(contents.rebuilt),
        "priorities": _priorities(contents),
        "weights": _weights(chunks),
        "rewards": histogram(_column(chunks, "rewards")),
        "terminations": int((_column(chunks, "discounts") == 0).sum()),
        "actions": np.bincount(_column(chunks, "actions"), minlength=NUM_ACTIONS).tolist(),
        "actors": [_actor(*item) for item in _by_actor(chunks).items()],
    }


def histogram(values: NDArray[Any], *, logarithmic: bool = False) -> dict[str, Any] | None:
    """Range, median, mean and bins of numbers; None if there are none.

    logarithmic: bins of equal ratio over the positive numbers; the first bin also has the others.
    """
    if len(values) == 0:
        return None
    exact = values.astype(np.float64)
    shown = exact
    if logarithmic and exact.max() > 0:
        shown = np.log10(np.maximum(exact, exact[exact > 0].min()))
    low, high, bins = shown.min(), shown.max(), _BINS
    if np.issubdtype(values.dtype, np.integer):  # integers get integer edges
        width = -(-(high - low + 1) // _BINS)
        bins = int(-(-(high - low + 1) // width))
        high = low + bins * width
    counts, edges = np.histogram(shown, bins, (low, high))
    if shown is not exact:
        edges = 10.0**edges
    return {
        "min": float(exact.min()),
        "median": float(np.median(exact)),
        "mean": float(exact.mean()),
        "max": float(exact.max()),
        "edges": [float(edge) for edge in edges],
        "counts": counts.tolist(),
    }


def _table(rebuilt: Rebuilt) -> dict[str, Any]:
    snapshot, table = rebuilt.snapshot, rebuilt.table
    return {
        "size": len(table),
        "capacity": table.capacity,
        "first_key": table.first_key,
        "inserts": table.next_key,
        "samples": None if snapshot is None else snapshot.all_samples,
        "samples_per_insert": rebuilt.limiter.ratio,
    }


def _priorities(contents: Contents) -> dict[str, Any]:
    """The table's priorities, from the snapshot; without a table, the actors' in the log."""
    rebuilt = contents.rebuilt
    if rebuilt is not None and len(rebuilt.priorities):
        source = "actors" if rebuilt.snapshot is None else "snapshot"
        return {"source": source, "spread": histogram(rebuilt.priorities, logarithmic=True)}
    given = _column(contents.chunks, "priorities")
    spread = histogram(given, logarithmic=True)
    return {"source": "actors" if spread else None, "spread": spread}


def _weights(chunks: Sequence[Chunk]) -> dict[str, Any] | None:
    """Versions that acted, and how far each transition's version is behind the newest."""
    if not chunks:
        return None
    versions = np.repeat([c.weights_version for c in chunks], [len(c) for c in chunks])
    return {
        "oldest": int(versions.min()),
        "newest": int(versions.max()),
        "staleness": histogram(versions.max() - versions),
    }


def _by_actor(chunks: Sequence[Chunk]) -> dict[str, list[Chunk]]:
    by_actor: dict[str, list[Chunk]] = {}
    for chunk in chunks:
        by_actor.setdefault(chunk.actor, []).append(chunk)
    return dict(sorted(by_actor.items()))


def _actor(name: str, chunks: Sequence[Chunk]) -> dict[str, Any]:
    """One actor's chunks in numbers."""
    last: dict[int, int] = {}
    gaps = 0
    for chunk in chunks:
        gaps += chunk.sequence - last.get(chunk.incarnation, chunk.sequence - 1) - 1
        last[chunk.incarnation] = chunk.sequence
    return {
        "actor": name,
        "chunks": len(chunks),
        "transitions": sum(map(len, chunks)),
        "incarnations": len(last),
        "gaps": gaps,
        "first_version": chunks[0].weights_version,
        "last_version": chunks[-1].weights_version,
    }


def _column(chunks: Sequence[Chunk], name: str) -> NDArray[Any]:
    """One value per transition, from the chunks that have it."""
    empty: Float32Array = np.empty(0, np.uint8 if name == "actions" else np.float32)
    return np.concatenate([getattr(c, name) for c in chunks] or [empty])
