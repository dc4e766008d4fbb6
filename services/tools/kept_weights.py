"""Folders of weights to keep and to hand on, in half precision, each with a card.

    NAME/
        model.safetensors   in half precision
        model.json          its digest, and where it is from
        config.toml         the configuration that it was trained by
        README.md           what it is, how it was trained, how well it does, how it fails

A folder is one that `mrcdrl evaluate`, `render`, `figure`, `export` and `demo` take, runs or no
runs. Invariant: a folder holds the weights that its card describes, or no card.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.model.weights_files import read_weights, write_weights
from mrcdrl.common.model.weights_io import SENT_AS, network_from_bytes, weights_to_bytes
from mrcdrl.common.runtime.files import RUN_CONFIG, WEIGHTS_SUFFIX, atomic_write

MODEL: Final = f"model{WEIGHTS_SUFFIX}"
CARD: Final = "README.md"
PRECISION: Final = "float16"


def rounded(weights: Weights) -> bytes:
    """The weights' parameters in half precision."""
    return weights_to_bytes(network_from_bytes(weights.payload), SENT_AS[PRECISION])


def keep(
    folder: Path, weights: Weights, config: str, manifest: Mapping[str, Any], card: str
) -> None:
    """Write the folder; config: as TOML; manifest: what is to be told of the weights.

    Raises CheckpointError if the weights cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CARD).unlink(missing_ok=True)
    atomic_write(folder / RUN_CONFIG, config.encode())
    told: dict[str, Any] = {
        "weights_epoch": weights.epoch,
        "weights_version": weights.version,
        "learner_step": weights.learner_step,
        "precision": PRECISION,
        **manifest,
    }
    write_weights(folder / MODEL, rounded(weights), told)
    atomic_write(folder / CARD, card.encode())


def manifest_of(folder: Path) -> dict[str, Any] | None:
    """What was told of the weights in the folder; None if it is not whole."""
    try:
        _, manifest = read_weights(folder / MODEL)
    except CheckpointError:
        return None
    return manifest if (folder / CARD).exists() else None


def failures_text(test: Mapping[str, Any]) -> str:
    """How the paper's test ended where it failed; test: as `mrcdrl evaluate --json` tells it."""
    met, wall = (test["navigation"][f"collision_with_{whom}_rate"] for whom in ("robot", "wall"))
    return (
        f"of all starts {100 * met:.1f} % end by a robot that hits a robot, {100 * wall:.1f} %\n"
        f"by one that hits a wall, {100 * test['timeout_rate']:.1f} % by running out of time."
    )


def success_text(test: Mapping[str, Any]) -> str:
    """The success in the paper's test with its interval, in words."""
    low, high = test["success_interval"]
    return (
        f"{100 * test['success_rate']:.1f} % of {test['episodes']} starts of the paper's test"
        " (95 %\n"
        f"interval {100 * low:.1f} to {100 * high:.1f}), ε 0.01, one collision fails."
    )
