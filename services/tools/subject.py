"""What is to be judged, from a command line: weights or a controller, in which arena."""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mrcdrl.common.arena import make_codec
from mrcdrl.common.arena.controllers import CONTROLLERS, check_controller, controller
from mrcdrl.common.config import Config, load_config
from mrcdrl.common.config.arguments import Parser, add_config_flags, overrides
from mrcdrl.common.errors import CheckpointError, ConfigError
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.model.policy import Policy
from mrcdrl.common.model.q_network import precision
from mrcdrl.common.model.weights_files import read_weights
from mrcdrl.common.model.weights_io import network_from_bytes
from mrcdrl.common.runtime.files import BEST_WEIGHTS, RUN_CONFIG
from mrcdrl.services.evaluator.trial import ControllerPlayer, Player, PolicyPlayer

_MANIFEST = "manifest.json"


@dataclass(frozen=True, slots=True)
class Subject:
    """A policy or a controller, and the arena to judge it in."""

    config: Config
    policy: Policy | None
    controller: str | None
    weights: Weights  # of a controller: version 0 without parameters

    def player(self, seed: int) -> Player:
        """A fresh player, its exploration drawn from the seed."""
        arena, rng = self.config.arena, np.random.default_rng(seed)
        epsilon = self.config.evaluator.epsilon
        if self.policy is not None:
            return PolicyPlayer(arena, make_codec(arena), self.policy, epsilon, rng)
        name = self.controller or ""
        return ControllerPlayer(lambda: controller(name, arena, rng), epsilon, rng)


def subject_parser(command: str, description: str) -> Parser:
    """The flags that name a subject."""
    parser = Parser(prog=f"mrcdrl {command}", description=description)
    parser.add_argument("weights", nargs="?", type=Path, help="a .safetensors file, or a run")
    parser.add_argument("--controller", help=f"instead of weights: {', '.join(CONTROLLERS)}")
    add_arena_flags(parser)
    return parser


def add_arena_flags(parser: Parser) -> None:
    """The flags that say in which arena a subject is shown."""
    parser.add_argument("--config", help="a preset or a TOML file; by default the run's")
    add_config_flags(parser, {"arena.num_robots": "--robots"})


def config_without_weights(arguments: argparse.Namespace) -> Config:
    """What the flags give; the preset `quick` where none is named. Raises ConfigError."""
    return load_config(arguments.config or "quick", overrides(arguments))


def subject(arguments: argparse.Namespace) -> Subject:
    """What the flags name.

    Raises ConfigError for flags that contradict each other and for an unknown controller,
    CheckpointError for weights that cannot be read, are foreign, or do not fit the arena.
    """
    if (arguments.weights is None) == (arguments.controller is None):
        raise ConfigError("give either weights or --controller")
    if arguments.controller is not None:
        return controlled(arguments.controller, config_without_weights(arguments))
    path = weights_path(arguments.weights)
    config = load_config(arguments.config or _config_beside(path), overrides(arguments))
    payload, manifest = _read(path)
    torch.set_num_threads(config.evaluator.threads)
    network = network_from_bytes(payload, compute_dtype=precision(config.learner.precision))
    if (network.stack, network.view_px) != (config.arena.stack, config.arena.view_px):
        raise CheckpointError(
            f"{path} sees {network.stack} images of {network.view_px} px, the arena gives "
            f"{config.arena.stack} of {config.arena.view_px} px"
        )
    weights = Weights.of(
        epoch=int(manifest.get("weights_epoch", 0)),
        version=int(manifest.get("weights_version", 0)),
        learner_step=int(manifest.get("learner_step", 0)),
        payload=payload,
    )
    return Subject(config, Policy(network), None, weights)


def controlled(name: str, config: Config) -> Subject:
    """A controller in the arena of the configuration; raises ConfigError for an unknown one."""
    return Subject(config, None, check_controller(name), Weights.of(0, 0, 0, b""))


def weights_path(path: Path) -> Path:
    """The file itself, or of a run's folder the best weights, else the newest checkpoint's.

    Raises CheckpointError where there is none.
    """
    if not path.is_dir():
        return path
    found = [path / BEST_WEIGHTS, *sorted(path.glob("checkpoints/step_*/model.safetensors"))[::-1]]
    for candidate in (*found, path / "model.safetensors"):
        if candidate.is_file():
            return candidate
    raise CheckpointError(f"{path} holds no weights")


def _read(path: Path) -> tuple[bytes, dict[str, Any]]:
    """Weights and what is known of them, kept alone or as part of a checkpoint."""
    payload, manifest = read_weights(path)
    if not manifest and (path.parent / _MANIFEST).is_file():
        manifest = json.loads((path.parent / _MANIFEST).read_bytes())
    return payload, manifest


def _config_beside(path: Path) -> str:
    """The configuration of the run that the weights lie in; else the preset `quick`."""
    for folder in path.resolve().parents[:3]:
        if (folder / RUN_CONFIG).is_file():
            return str(folder / RUN_CONFIG)
    return "quick"
