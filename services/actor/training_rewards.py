"""Rewards as a run learns from them: the arena's, changed by settings of `agent`.

A collision costs what the schedule says at the time. A target that another robot is nearer to pays
nothing where `occupied_targets_pay` is off: the paper's reward pays more for waiting beside it than
for leaving. Potential-based shaping (Ng, Harada & Russell
1999) adds, for each robot and frame,

    F = gamma Phi(s', t') - Phi(s, t),   Phi(s, t) = -c(t) d(s),

where d is the distance to the robot's target, assigned anew in each state, and c the potential
lost with each px, at the learner step of the weights that act. Over an episode the discounted sum
of F is -Phi of its first state, whatever the robots do. So the best policies stay the best, and
with several robots and a Phi that changes the equilibria stay (Devlin & Kudenko 2012).

Invariants: a state's potential is computed once, on arrival, and left with the same number: else a
change of c would pay. It is 0 where the episode terminated; a truncated one bootstraps, and keeps
it. Nothing but the learner's transitions knows of these rewards.
"""

from collections.abc import Sequence

import numpy as np

from mrcdrl.common.arena import Arenas
from mrcdrl.common.config import Config
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.messages.trajectory import (
    BoolArray,
    Float64Array,
    Int64Array,
    Outcome,
    TimeSteps,
)


class TrainingRewards:
    """The rewards of all robots of an actor: `start` at each episode, `after` at each step."""

    def __init__(self, config: Config, arenas: Arenas) -> None:
        self._agent = config.agent
        self._off_target = config.arena.step_reward
        self._arenas = arenas
        self._every = np.arange(len(arenas))
        # of the states that the robots are in
        self._potentials: Float64Array = np.zeros((len(arenas), config.arena.num_robots))

    def start(self, arenas: Sequence[int], learner_step: int) -> None:
        """Begin an episode in these arenas. learner_step: that of the weights that act."""
        if self._agent.shaping_per_px and arenas:
            indices = np.array(arenas)
            self._potentials[indices] = self._potentials_of(indices, learner_step)

    def after(self, time_steps: TimeSteps, learner_step: int) -> Float64Array:
        """Rewards [A, K] of a step of all arenas, before an ended one starts anew."""
        agent, rewards = self._agent, time_steps.rewards.astype(np.float64)
        if not agent.occupied_targets_pay:
            rewards[self._paid_for_occupied(time_steps)] = self._off_target
        # a robot that collided has the price of it as its whole reward
        rewards[time_steps.collided] *= value_at(agent.collision_schedule, learner_step)
        if not agent.shaping_per_px:
            return rewards
        before, after = self._potentials, self._potentials_of(self._every, learner_step)
        after[time_steps.terminated] = 0.0
        self._potentials = after
        shaped: Float64Array = rewards + agent.gamma * after - before
        return shaped

    def _paid_for_occupied(self, time_steps: TimeSteps) -> BoolArray:
        """The robots [A, K] whose reward can be for a target that another one is nearer to."""
        occupied = self._arenas.drawn_to_occupied(self._every) & ~time_steps.collided
        succeeded = [outcome is Outcome.SUCCESS for outcome in time_steps.outcomes]
        occupied[succeeded] = False
        return occupied

    def _potentials_of(self, arenas: Int64Array, learner_step: int) -> Float64Array:
        """Phi [N, K] of the robots' states in these arenas."""
        agent = self._agent
        per_px = agent.shaping_per_px * value_at(agent.shaping_schedule, learner_step)
        return -per_px * self._arenas.assigned_distances_px(arenas)
