"""When a run ends by itself: enough time, steps or success, or the paper's patience.

Invariants: no clock inside; a limit of 0 is off; the limits are checked in a fixed order, so the
same run always ends for the same reason; an evaluation counts once its weights are published.
"""

from collections import deque

from mrcdrl.common.config import RunConfig
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome
from mrcdrl.services.monitor.records import SUCCESS_WINDOW

_STOPPED = "stopped ("


def stopped(cause: str) -> str:
    """Reason of a run that a signal ended; it would have gone on."""
    return f"{_STOPPED}{cause})"


def was_stopped(reason: str) -> bool:
    """Whether a signal ended the run, and not its own rule."""
    return reason.startswith(_STOPPED)


class StoppingRule:
    """Observes episodes and evaluations, and says why the run is over.

    The paper's rule (section 5.2): "the training can be stopped when a certain size is satisfied
    and when no larger value appears in the next 1000 episodes". The value is the number of
    successes in the last 100 episodes, taken after each episode from the 100th on; the certain
    size is `patience_floor`.
    """

    def __init__(self, run: RunConfig) -> None:
        self._run = run
        self._latest: deque[bool] = deque(maxlen=SUCCESS_WINDOW)
        self._episodes = 0
        self._maximum = -1
        self._maximum_at = 0
        self._reached: Evaluation | None = None
        self._goes_on = False  # although the target was reached

    def go_on(self) -> None:
        """What was reached so far ends the run no more: patience counts from here."""
        self._goes_on = self._reached is not None
        if self._patience_is_over:
            self._maximum_at = self._episodes

    def observe_episode(self, episode: EpisodeSummary) -> None:
        self._episodes += 1
        self._latest.append(episode.outcome is Outcome.SUCCESS)
        successes = sum(self._latest)
        if len(self._latest) == SUCCESS_WINDOW and successes > self._maximum:
            self._maximum, self._maximum_at = successes, self._episodes

    def observe_evaluation(self, evaluation: Evaluation) -> None:
        target, known = self._run.target_success_rate, self._reached
        earliest = known is None or _order(evaluation) < _order(known)
        if target and evaluation.success_rate >= target and earliest:
            self._reached = evaluation

    def reason(
        self, learner_steps: int, minutes: float, published: tuple[float, int]
    ) -> str | None:
        """Why the run is over; None while it goes on.

        published: epoch and version of the learner's last publication. An evaluation of later ones
        does not belong to this run, or not yet.
        """
        run = self._run
        reached = None if self._goes_on else self._reached
        if reached is not None and _order(reached) <= published:
            return (
                f"evaluation success {reached.success_rate:.3f} reached "
                f"run.target_success_rate {run.target_success_rate:g}"
            )
        if run.learner_steps and learner_steps >= run.learner_steps:
            return f"learner step limit reached ({run.learner_steps})"
        if run.minutes and minutes >= run.minutes:
            return f"time limit reached ({run.minutes:g} min)"
        if self._patience_is_over:
            return (
                f"no new maximum above {self._maximum} successes of 100 episodes "
                f"in {self._without_maximum} episodes (run.patience_episodes)"
            )
        return None

    @property
    def _without_maximum(self) -> int:
        """Episodes since the last new maximum."""
        return self._episodes - self._maximum_at

    @property
    def _patience_is_over(self) -> bool:
        patience = self._run.patience_episodes
        satisfied = self._maximum >= self._run.patience_floor * SUCCESS_WINDOW
        return bool(patience) and satisfied and self._without_maximum >= patience


def _order(evaluation: Evaluation) -> tuple[float, int]:
    """The evaluated weights' place among all; the epoch as the learner's metrics have it."""
    return float(evaluation.weights_epoch), evaluation.weights_version
