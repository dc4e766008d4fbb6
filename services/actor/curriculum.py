"""How often an actor plays each number of robots: by a schedule, or by its successes so far.

The greatest number may be played alone at first: with as many targets as robots, somebody is soon
near one, and what is learned from that serves the others.

Invariants: pure; chances sum to 1. A weight is a share of the transitions, because those are what
is learned from: an episode of a number counts as many as its robots have made on average. The
automatic weight is p (1 - p), p the success so far (Tzannetos et al. 2023, "Proximal Curriculum for
Reinforcement Learning Agents", which prefers p (p* - p), here with the best success p* = 1). p is
never quite 0 or 1, so that no number is given up: half a success in one episode is added to those
that were seen (Krichevsky and Trofimov 1981).
"""

import numpy as np

from mrcdrl.common.config import ArenaConfig, CurriculumConfig
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.messages.trajectory import Float64Array, Outcome

_PRIOR_EPISODES = 1.0  # added to those that were seen; half of one is a success


class Curriculum:
    """The numbers of robots of one actor's episodes: `chances` before each, `add` after each."""

    def __init__(self, config: CurriculumConfig, arena: ArenaConfig) -> None:
        self._config = config
        self._places = {number: place for place, number in enumerate(arena.numbers)}
        self._numbers = np.array(arena.numbers, np.float64)
        self._prior_frames = float(arena.f_max)  # of an episode, before the first of any number
        self._episodes, self._successes, self._frames = np.zeros((3, len(arena.numbers)))

    def __repr__(self) -> str:
        rates = dict(zip(self._places, self.success_rates.round(3).tolist(), strict=True))
        return f"Curriculum(kind={self._config.kind!r}, success_rates={rates})"

    @property
    def success_rates(self) -> Float64Array:
        """Success so far of each number, averaged over the last episodes; 0.5 before the first."""
        rates: Float64Array = (self._successes + _PRIOR_EPISODES / 2) / self._counted
        return rates

    @property
    def _counted(self) -> Float64Array:
        """Episodes of each number, with the prior ones."""
        counted: Float64Array = self._episodes + _PRIOR_EPISODES
        return counted

    def add(self, number: int, outcome: Outcome, frames: int) -> None:
        """Count an episode that has ended."""
        place, kept = self._places[number], 1 - 1 / self._config.memory_episodes
        success = float(outcome is Outcome.SUCCESS)
        gained = ((self._episodes, 1.0), (self._successes, success), (self._frames, float(frames)))
        for sums, new in gained:
            sums[place] = kept * sums[place] + new

    def weights(self, learner_step: int) -> Float64Array:
        """Shares of the transitions that each number should have; they sum to 1."""
        if learner_step < self._config.greatest_first_steps:
            return np.array([0.0] * (len(self._numbers) - 1) + [1.0])
        if self._config.kind == "automatic":
            learnable = _normalized(self.success_rates * (1 - self.success_rates))
            floor = self._config.floor
            return (1 - floor) * learnable + floor / len(learnable)
        return _scheduled(self._config, learner_step, len(self._places))

    def chances(self, learner_step: int) -> Float64Array:
        """Probability of each number in the next episode."""
        typical = (self._frames.sum() + self._prior_frames) / (self._episodes.sum() + 1)
        frames = (self._frames + typical * _PRIOR_EPISODES) / self._counted
        return _normalized(self.weights(learner_step) / (self._numbers * frames))


def _scheduled(config: CurriculumConfig, learner_step: int, num: int) -> Float64Array:
    """The schedule's shares [num] at a learner step."""
    if not config.schedule:
        return np.full(num, 1 / num)
    columns = (
        [(point[0], point[place]) for point in config.schedule] for place in range(1, num + 1)
    )
    return _normalized(np.array([value_at(column, learner_step) for column in columns]))


def _normalized(weights: Float64Array) -> Float64Array:
    """The weights over their sum."""
    shares: Float64Array = weights / weights.sum()
    return shares
