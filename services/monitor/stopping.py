"""When a run ends by itself: enough time, steps or success, or the paper's patience.

Invariants: no clock inside; a rule set to 0 never speaks; the order of the questions is fixed, so
the same run always ends for the same reason.
"""

from collections import deque

from mrcdrl.common.config import RunConfig
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome

HUNDRED = 100


class StoppingRule:
    """Fed with what happens, says why the run is over.

    The paper's rule (section 5.2): "the training can be stopped when a certain size is satisfied
    and when no larger value appears in the next 1000 episodes". The value is the successes of
    the last 100 episodes, taken after each episode from the 100th on; the certain size is
    `patience_floor`.
    """

    def __init__(self, run: RunConfig) -> None:
        self._run = run
        self._latest: deque[bool] = deque(maxlen=HUNDRED)
        self._episodes = 0
        self._maximum = -1
        self._maximum_at = 0
        self._reached: Evaluation | None = None

    def observe_episode(self, episode: EpisodeSummary) -> None:
        self._episodes += 1
        self._latest.append(episode.outcome is Outcome.SUCCESS)
        successes = sum(self._latest)
        if len(self._latest) == HUNDRED and successes > self._maximum:
            self._maximum, self._maximum_at = successes, self._episodes

    def observe_evaluation(self, evaluation: Evaluation) -> None:
        target = self._run.target_success_rate
        if target and self._reached is None and evaluation.success_rate >= target:
            self._reached = evaluation

    def reason(self, learner_steps: int, minutes: float) -> str | None:
        """Why the run is over, in words; None while it goes on."""
        run = self._run
        if self._reached is not None:
            return (
                f"evaluation success {self._reached.success_rate:.3f} reached "
                f"run.target_success_rate {run.target_success_rate:g}"
            )
        if run.learner_steps and learner_steps >= run.learner_steps:
            return f"run.learner_steps {run.learner_steps} done"
        if run.minutes and minutes >= run.minutes:
            return f"run.minutes {run.minutes:g} over"
        since = self._episodes - self._maximum_at
        satisfied = self._maximum >= run.patience_floor * HUNDRED
        if run.patience_episodes and satisfied and since >= run.patience_episodes:
            return (
                f"no new maximum above {self._maximum} successes of 100 episodes "
                f"in {since} episodes (run.patience_episodes)"
            )
        return None
