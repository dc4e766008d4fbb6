"""Replays of failed episodes: without exploration, and by a safe controller from their frames.

Invariant: the same subject, episodes and seed give the same failures. In an arena with random
failures, noise or dropped images a replay draws others than its episode did.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from mrcdrl.common.arena import Start
from mrcdrl.common.arena.controllers import make_controller
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Outcome
from mrcdrl.services.evaluator.trial import ControllerPlayer, EpisodeResult, Player, play
from mrcdrl.services.tools.failures import Failure, failure, last_savable_frames
from mrcdrl.services.tools.subject import Subject

RESCUER = "safe_circle"


def failures_of(
    evaluated: Subject, results: Sequence[EpisodeResult], seed: int, report: Callable[[], None]
) -> list[Failure]:
    """Describe all failures among the results, whose paths were kept; replay them for it.

    report: called once a replay, at most `num_replays` times.
    """
    config = evaluated.config.arena
    failed = _failed(results)
    episodes = [results[number] for number in failed]
    unexplored = _successes(
        config, [_start(e, 0) for e in episodes], evaluated.player(seed, epsilon=0.0), report
    )
    rescues = _rescues(config)
    until: list[int | None] = [None] * len(failed)
    if rescues:
        until = last_savable_frames(
            [e.frames for e in episodes],
            lambda asked: _saved(config, [(episodes[i], frame) for i, frame in asked], report),
        )
    return [
        failure(
            config,
            number,
            episode,
            succeeds_without_exploration=success is not None,
            savable=last is not None if rescues else None,
            savable_until_frame=last,
        )
        for number, episode, success, last in zip(failed, episodes, unexplored, until, strict=True)
    ]


def num_replays(results: Sequence[EpisodeResult]) -> int:
    """The greatest number of episodes that `failures_of` plays."""
    return sum(1 + math.ceil(math.log2(results[i].frames + 1)) for i in _failed(results))


def _failed(results: Sequence[EpisodeResult]) -> list[int]:
    return [i for i, result in enumerate(results) if result.outcome is not Outcome.SUCCESS]


def _rescues(config: ArenaConfig) -> bool:
    """Whether the safe controller supports this arena."""
    try:
        make_controller(RESCUER, config, np.random.default_rng(0))
    except ConfigError:
        return False
    return True


def _saved(
    config: ArenaConfig, asked: Sequence[tuple[EpisodeResult, int]], report: Callable[[], None]
) -> list[bool]:
    """Whether the safe controller succeeds from these frames in the time that is left."""
    rng = np.random.default_rng(0)  # draws nothing that counts
    player = ControllerPlayer(lambda: make_controller(RESCUER, config, rng), 0.0, rng)
    starts = [_start(episode, frame) for episode, frame in asked]
    won = _successes(config, starts, player, report)
    return [
        frames is not None and frame + frames <= config.max_frames
        for frames, (_, frame) in zip(won, asked, strict=True)
    ]


def _successes(
    config: ArenaConfig, starts: Sequence[Start], player: Player, report: Callable[[], None]
) -> list[int | None]:
    """The frames to success from each start; None for a failure."""
    told = 0

    def keep_going(done: int) -> bool:
        nonlocal told
        for _ in range(done - told):
            report()
        told = done
        return True

    results = play(config, starts, player, keep_going=keep_going) or []
    return [r.frames if r.outcome is Outcome.SUCCESS else None for r in results]


def _start(episode: EpisodeResult, frame: int) -> Start:
    """The scene of a frame as a start."""
    return Start(episode.robots[frame], episode.targets, episode.obstacles)
