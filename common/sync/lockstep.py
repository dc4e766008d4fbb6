"""Actor and learner in turns, so that the numbers of a run do not depend on who is how fast.

In turn t the one actor collects with the weights of learner step t x `steps`, in new episodes that
end with the turn; then the learner makes `steps` steps. Invariant: whatever a process does follows
from the configuration, the turn and the learner's checkpoint of its beginning, so that a process
that is killed does the same again. Pure.
"""

from dataclasses import dataclass
from typing import Self

from mrcdrl.common.config import Config


@dataclass(frozen=True, slots=True)
class Lockstep:
    """first: transitions that turn 0 has more; size: of a turn; steps: of the learner in one."""

    first: int
    size: int
    steps: int

    @classmethod
    def of(cls, config: Config) -> Self | None:
        """As configured; None where all go at their own pace."""
        size = config.run.turn_size
        if not size:
            return None
        robots = config.actor.num_arenas * config.arena.num_robots
        first = -(-config.replay.min_size // robots) * robots
        samples = round(size * config.replay.samples_per_insert)
        return cls(first, size, samples // config.learner.batch_size)

    def turn(self, learner_step: int) -> int:
        """In which the learner, having made so many steps, makes the next one."""
        return learner_step // self.steps

    def transitions(self, turn: int) -> int:
        """That the actor collects in this turn."""
        return self.size + (0 if turn else self.first)

    def inserts(self, learner_step: int) -> int:
        """Transitions ever inserted when the learner makes the step after so many."""
        return self.first + (self.turn(learner_step) + 1) * self.size
