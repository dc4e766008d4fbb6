"""Lockstep: actor and learner take turns, so that a run's numbers do not depend on their speed.

In turn t the one actor collects with the weights of learner step t x `steps`, in new episodes that
end with the turn; then the learner makes `steps` steps. Invariant: everything that a process does
follows from the configuration, the turn, and the learner's checkpoint at its beginning, so that a
process that is killed repeats itself exactly. Pure.
"""

from dataclasses import dataclass
from typing import Self

from mrcdrl.common.config import Config


@dataclass(frozen=True, slots=True)
class Lockstep:
    """The sizes of a turn."""

    first: int  # transitions that turn 0 has beyond `size`
    size: int  # transitions of a turn
    steps: int  # learner steps of a turn

    @classmethod
    def from_config(cls, config: Config) -> Self | None:
        """Lockstep as configured; None if actors and learner run freely."""
        size = config.run.turn_size
        if not size:
            return None
        robots = config.actor.num_arenas * config.arena.num_robots
        first = -(-config.replay.min_size // robots) * robots
        samples = round(size * config.replay.samples_per_insert)
        return cls(first, size, samples // config.learner.batch_size)

    def turn(self, learner_step: int) -> int:
        """The turn in which the learner makes the step after `learner_step` others."""
        return learner_step // self.steps

    def transitions(self, turn: int) -> int:
        """Transitions that the actor collects in a turn."""
        return self.size + (0 if turn else self.first)

    def inserts(self, learner_step: int) -> int:
        """Transitions inserted in all before the learner makes the step after `learner_step`."""
        return self.first + (self.turn(learner_step) + 1) * self.size
