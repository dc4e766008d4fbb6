"""The subject of a command: weights or a controller, and its arena, as named by flags."""

import argparse
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import torch

from mrcdrl.common.arena import looked_up, make_codec, test_starts
from mrcdrl.common.arena.controllers import check_controller, make_controller
from mrcdrl.common.config import DEFAULT_PRESET, Config, load_config
from mrcdrl.common.config.arguments import overrides
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.model.policy import Policy, averaged_symmetries
from mrcdrl.common.model.saved_policy import config_beside, policy_of, read_saved, weights_path
from mrcdrl.common.runtime.runs import find_weights
from mrcdrl.services.evaluator.trial import (
    ControllerPlayer,
    EpisodeResult,
    Player,
    PolicyPlayer,
    play,
)
from mrcdrl.services.tools.progress import Done

_LOG = logging.getLogger("mrcdrl")


@dataclass(frozen=True, slots=True)
class Subject:
    """A policy or a controller, and the arena it plays in."""

    config: Config
    policy: Policy | None
    controller: str | None
    weights: Weights  # for a controller: version 0 without parameters

    def player(self, seed: int, epsilon: float | None = None) -> Player:
        """Make a player that draws its exploration from the seed.

        epsilon: the configuration's if None.
        """
        arena, rng = self.config.arena, np.random.default_rng(seed)
        epsilon = self.config.evaluator.epsilon if epsilon is None else epsilon
        if self.policy is not None:
            return PolicyPlayer(arena, make_codec(arena), self.policy, epsilon, rng)
        name = self.controller or ""
        return ControllerPlayer(lambda: make_controller(name, arena, rng), epsilon, rng)

    def each_number(self) -> list[Self]:
        """The subject with each number of robots alone, in rising order."""
        return [self._playing(config) for config in self.config.each_number()]

    def with_robots(self, number: int) -> Self:
        """The subject with this number of robots; raises ConfigError if the arena is for others."""
        arena = self.config.arena
        if arena.targets_px and len(arena.targets_px) < number:
            raise ConfigError(
                f"arena.targets_px has {len(arena.targets_px)} targets, too few for {number} robots"
            )
        if arena.num_targets < number:
            arena = arena.model_copy(update={"num_targets": 0})  # as many as there are robots
        update = {"arena": arena.with_robots(number)}
        return self._playing(self.config.model_copy(update=update))

    def _playing(self, config: Config) -> Self:
        policy = self.policy and self.policy.averaging(averaged_symmetries(config))
        return replace(self, config=config, policy=policy)

    def episodes(self, num: int, seed: int, report: Done) -> list[EpisodeResult]:
        """Play the paper's test from `num` starts, keeping the robots' paths.

        Where there are several numbers of robots, they take turns, the greatest first. report:
        called with the number of episodes finished. Raises ConfigError for a custom world.
        """
        if self.config.arena.is_custom:
            raise ConfigError(
                "paths are drawn from the poses of the paper's arena: not with a custom world, "
                "arena.env"
            )
        parts = self.each_number()[::-1]
        played: dict[int, EpisodeResult] = {}
        for place, part in enumerate(parts):
            arena, turns = part.config.arena, range(place, num, len(parts))
            starts, player = test_starts(arena, len(turns), seed), part.player(seed)
            going = always(_after(len(played), report))
            results = play(arena, starts, player, keep_paths=True, keep_going=going) or []
            played |= zip(turns, results, strict=True)
        return [played[turn] for turn in range(num)]


def config_without_weights(arguments: argparse.Namespace) -> Config:
    """The configuration by flags, from the preset `quick` by default; raises ConfigError."""
    return load_config(arguments.config or DEFAULT_PRESET, overrides(arguments))


def subject(arguments: argparse.Namespace) -> Subject:
    """The subject that the flags name.

    Raises ConfigError for contradictory flags and unknown controllers, RunDirectoryError for an
    unknown run, CheckpointError for weights that cannot be read, are not ours, or do not fit the
    arena.
    """
    if (arguments.weights is None) == (arguments.controller is None):
        raise ConfigError("give either weights or --controller")
    if arguments.controller is not None:
        return controlled(arguments.controller, config_without_weights(arguments))
    path = weights_path(find_weights(arguments.weights, arguments.run_dir))
    own = config_beside(path)
    config = _known(load_config(arguments.config or own, overrides(arguments)))
    _say_other_robots(path, own, config)
    torch.set_num_threads(config.evaluator.threads)
    weights = read_saved(path)
    return Subject(config, policy_of(path, weights, config), None, weights)


def _known(config: Config) -> Config:
    """The configuration with the numbers of a custom world, which it is asked where they lack."""
    return config if config.arena.num_actions else looked_up(config)


def trained_with(own: str) -> tuple[int, ...]:
    """The numbers of robots that weights were trained with; own: their run's configuration file.

    Empty if they are of no run.
    """
    return () if own == DEFAULT_PRESET else load_config(own, environ={}).arena.numbers


def _say_other_robots(path: Path, own: str, config: Config) -> None:
    """Say so if the weights were trained with another number of robots; own: their run's file."""
    learned, now = trained_with(own), config.arena.numbers
    if learned and not set(now) <= set(learned):
        told = (", ".join(map(str, numbers)) for numbers in (learned, now))
        _LOG.warning("%s: trained with %s robots, plays with %s", path, *told)


def _after(before: int, report: Done) -> Done:
    """Reports as many more."""
    return lambda done: report(before + done)


def always(report: Done) -> Callable[[int], bool]:
    """A `keep_going` of `play` that reports, and goes on."""

    def keep_going(done: int) -> bool:
        report(done)
        return True

    return keep_going


def controlled(name: str, config: Config) -> Subject:
    """The controller of this name as a subject; raises ConfigError for an unknown one."""
    check = check_controller(name)
    if config.arena.is_custom:
        raise ConfigError(
            "--controller sees the true state of the paper's arena: not with a custom world, "
            "arena.env"
        )
    return Subject(config, None, check, Weights.of(0, 0, 0, b""))
