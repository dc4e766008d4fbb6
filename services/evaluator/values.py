"""Action values against returns: what a policy expects where an episode starts, and what it gets.

Episodes are played as in training, where several collisions may happen, and without exploration:
the values were learned for these rules and for this policy.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mrcdrl.common.arena import ArenaBatch, Start, make_codec
from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import Float64Array
from mrcdrl.common.model.policy import FrameStack, Policy
from mrcdrl.services.evaluator.score import Z95
from mrcdrl.services.evaluator.trial import MAX_ARENAS


@dataclass(frozen=True, slots=True)
class StartValues:
    """Values of first states, and the discounted returns that followed, in the arena's rewards.

    Both are means over robots and episodes. What comes after a time-out is left out of the return.
    """

    episodes: int
    expected: float  # greedy action's value
    realised: float  # sum of gamma^t times the reward
    overestimation: float  # expected - realised
    interval: tuple[float, float]  # 95 %, of the overestimation's mean over episodes


def start_values(
    config: Config,
    policy: Policy,
    starts: Sequence[Start],
    report: Callable[[int], None] = lambda _done: None,
) -> StartValues:
    """Play an episode from each start, greedily; report: called with the number of those ended."""
    expected: list[float] = []
    realised: list[float] = []
    for first in range(0, len(starts), MAX_ARENAS):
        values, returns = _play(config, policy, starts[first : first + MAX_ARENAS])
        expected += (values / config.agent.reward_scale).tolist()
        realised += returns.tolist()
        report(len(realised))
    excess = np.array(expected) - np.array(realised)
    mean = float(excess.mean())
    half = Z95 * float(excess.std()) / math.sqrt(max(1, len(excess) - 1))
    return StartValues(
        episodes=len(excess),
        expected=float(np.mean(expected)),
        realised=float(np.mean(realised)),
        overestimation=mean,
        interval=(mean - half, mean + half),
    )


def _play(
    config: Config, policy: Policy, starts: Sequence[Start]
) -> tuple[Float64Array, Float64Array]:
    """The first states' values, scaled as learned, and the discounted returns; float64 [A] each."""
    arena, codec = config.arena, make_codec(config.arena)
    num_arenas, num_robots = len(starts), arena.num_robots
    arenas = ArenaBatch(arena, [np.random.default_rng(i) for i in range(num_arenas)])
    frames = FrameStack(num_arenas * num_robots, arena.stack, arena.view_px)
    for index, start in enumerate(starts):
        robots = slice(index * num_robots, (index + 1) * num_robots)
        frames.reset(robots, codec.decode(arenas.reset(index, start).records))
    values = policy.q_values(frames.stacks)
    expected = values.max(axis=1).reshape(num_arenas, num_robots).mean(axis=1, dtype=np.float64)
    returns = np.zeros(num_arenas, np.float64)
    running, discount = np.arange(num_arenas), 1.0
    while len(running):
        acting = (running[:, np.newaxis] * num_robots + np.arange(num_robots)).reshape(-1)
        greedy = policy.q_values(frames.stacks[acting]).argmax(axis=1).astype(np.uint8)
        steps = arenas.step(greedy.reshape(-1, num_robots), running)
        returns[running] += discount * steps.rewards.mean(axis=1, dtype=np.float64)
        discount *= config.agent.gamma
        images = codec.decode(steps.records.reshape(-1, steps.records.shape[-1]))
        frames.push(images, acting)
        running = running[[outcome is None for outcome in steps.outcomes]]
    return expected, returns
