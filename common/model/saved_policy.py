"""A policy from saved weights: find the file in a run directory, read it, build its network.

policy = load_policy("runs/four")
actions = policy.select_actions(states, epsilon=0.0, rng=rng).actions
"""

import json
from pathlib import Path

from mrcdrl.common.config import DEFAULT_PRESET, Config, load_config
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.model.policy import Policy, averaged_symmetries
from mrcdrl.common.model.q_network import precision
from mrcdrl.common.model.weights_files import read_weights
from mrcdrl.common.model.weights_io import network_from_bytes
from mrcdrl.common.runtime.files import BEST_WEIGHTS, CHECKPOINT_MANIFEST, RUN_CONFIG, sha256
from mrcdrl.common.runtime.runs import find_weights


def load_policy(source: str | Path, config: Config | None = None) -> Policy:
    """Load the policy of a run or of a .safetensors file, on the CPU.

    source: a file, or a run (its name, its path, or `latest`), which stands for its best weights,
    or else its newest checkpoint's. config: by default the run's own, or else the preset `quick`;
    it sets the precision and the arena, whose images the network must fit.

    The policy acts on states uint8 [N, S, V, V]: the last S images of V x V px of N robots, oldest
    first. Raises RunDirectoryError for an unknown run, CheckpointError if there are no weights, or
    if they are unreadable, damaged or do not fit the arena, ConfigError for a wrong configuration.
    """
    path = weights_path(find_weights(str(source)))
    return policy_of(path, read_saved(path), config or load_config(config_beside(path)))


def weights_path(source: Path) -> Path:
    """The file itself; in a run directory, the best weights, or else the newest checkpoint's.

    Raises CheckpointError if the directory has none.
    """
    if not source.is_dir():
        return source
    checkpoints = sorted(source.glob("checkpoints/step_*"), reverse=True)
    published = ("average.safetensors", "model.safetensors")  # the average, where there is one
    saved = (directory / name for directory in (*checkpoints, source) for name in published)
    for path in (source / BEST_WEIGHTS, *saved):
        if path.is_file():
            return path
    raise CheckpointError(f"{source} holds no weights")


def config_beside(path: Path) -> str:
    """The configuration file of the run that holds these weights; else the preset `quick`."""
    for directory in path.resolve().parents[:3]:
        if (directory / RUN_CONFIG).is_file():
            return str(directory / RUN_CONFIG)
    return DEFAULT_PRESET


def read_saved(path: Path) -> Weights:
    """Read weights, with version and learner step from the manifest beside them, or else 0.

    Raises CheckpointError for weights that cannot be read, or whose digest is not the manifest's.
    """
    payload, manifest = read_weights(path)
    if not manifest and (path.parent / CHECKPOINT_MANIFEST).is_file():
        digest = sha256(payload)
        manifest = json.loads((path.parent / CHECKPOINT_MANIFEST).read_bytes())
        if manifest.get("sha256", {}).get(path.name, digest) != digest:
            raise CheckpointError(f"{path} is damaged: its digest is not the manifest's")
    return Weights.of(
        epoch=int(manifest.get("weights_epoch", 0)),
        version=int(manifest.get("weights_version", 0)),
        learner_step=int(manifest.get("learner_step", 0)),
        payload=payload,
    )


def policy_of(path: Path, weights: Weights, config: Config) -> Policy:
    """Build the policy of weights read from `path`; raises CheckpointError if they do not fit."""
    try:
        network = network_from_bytes(
            weights.payload, compute_dtype=precision(config.learner.precision)
        )
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    arena = config.arena
    if (network.stack, network.view_px) != (arena.stack, arena.view_px):
        raise CheckpointError(
            f"{path} sees {network.stack} images of {network.view_px} px, the arena gives "
            f"{arena.stack} of {arena.view_px} px"
        )
    if network.num_actions != arena.action_count:
        raise CheckpointError(
            f"{path} chooses among {network.num_actions} actions, the arena has "
            f"{arena.action_count}"
        )
    policy = Policy(network, averaged_symmetries(config))
    policy.adopt(weights)
    return policy
