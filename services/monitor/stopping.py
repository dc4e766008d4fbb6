"""When a run ends by itself: enough time, steps or success, or the paper's patience.

Invariants: no clock inside; a limit of 0 is off; the limits are checked in a fixed order, so the
same run always ends for the same reason; an evaluation counts once its weights are published.
"""

from collections import deque
from collections.abc import Sequence

from mrcdrl.common.config import RunConfig
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome
from mrcdrl.services.monitor.records import SUCCESS_WINDOW
from mrcdrl.services.monitor.weakest import Weakest

_STOPPED = "stopped ("
_FAILED = "failed ("
_RULES = {  # by how the reason begins
    "evaluation success": "target",
    "learner step limit": "steps",
    "the learner has finished": "steps",
    "time limit": "time",
    "no new maximum": "patience",
}
_EPOCHS = 16  # of evaluations that are kept; a run has one, and a peer may claim any


def stopped(cause: str) -> str:
    """Reason of a run that a signal ended; it would have gone on."""
    return f"{_STOPPED}{cause})"


def failed(cause: str) -> str:
    """Reason of a run that an error ended; it would have gone on."""
    return f"{_FAILED}{cause})"


def was_stopped(reason: str) -> bool:
    """Whether a signal ended the run."""
    return reason.startswith(_STOPPED)


def has_failed(reason: str) -> bool:
    """Whether an error ended the run."""
    return reason.startswith(_FAILED)


def rule_of(reason: str) -> str:
    """The rule by which a run ended itself: target, steps, time or patience; "" without one."""
    return next((rule for begin, rule in _RULES.items() if reason.startswith(begin)), "")


class StoppingRule:
    """Observes episodes and evaluations, and says why the run is over.

    The paper's rule (section 5.2): "the training can be stopped when a certain size is satisfied
    and when no larger value appears in the next 1000 episodes". The value is the number of
    successes in the last 100 episodes, taken after each episode from the 100th on; the certain
    size is `patience_floor`. Where there are several numbers of robots, each of them has to reach
    the target.
    """

    def __init__(self, run: RunConfig, numbers: Sequence[int] = (1,)) -> None:
        """numbers: of robots, each of which is evaluated apart."""
        self._run = run
        self._weakest = Weakest(numbers)
        self._latest: deque[bool] = deque(maxlen=SUCCESS_WINDOW)
        self._episodes = 0
        self._maximum = -1
        self._maximum_at = 0
        self._reached: dict[int, Evaluation] = {}  # the target, by epoch: the earliest of each
        self._goes_on = False  # although the target was reached

    def go_on(self) -> None:
        """What was reached so far ends the run no more: patience counts from here."""
        self._goes_on = bool(self._reached)
        if self._patience_is_over:
            self._maximum_at = self._episodes

    def observe_episode(self, episode: EpisodeSummary) -> None:
        self._episodes += 1
        self._latest.append(episode.outcome is Outcome.SUCCESS)
        successes = sum(self._latest)
        if len(self._latest) == SUCCESS_WINDOW and successes > self._maximum:
            self._maximum, self._maximum_at = successes, self._episodes

    def observe_evaluation(self, evaluation: Evaluation) -> None:
        target, epoch = self._run.target_success_rate, evaluation.weights_epoch
        weakest, known = self._weakest.add(evaluation), self._reached.get(epoch)
        earliest = known is None or evaluation.weights_version < known.weights_version
        if weakest is not None and target and weakest.success_rate >= target and earliest:
            self._reached[epoch] = weakest
            if len(self._reached) > _EPOCHS:
                del self._reached[next(iter(self._reached))]

    def reason(
        self, learner_steps: int, minutes: float, published: tuple[float, int] | None
    ) -> str | None:
        """Why the run is over; None while it goes on.

        published: epoch and version of the learner's last publication; None for all that have been
        evaluated. An evaluation of later ones, or of another epoch, does not belong to this run.
        """
        run = self._run
        each = () if self._goes_on else self._reached.values()
        reached = next((e for e in each if _belongs(e, published)), None)
        if reached is not None:
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


def _belongs(evaluation: Evaluation, published: tuple[float, int] | None) -> bool:
    """Whether these weights are among those that the learner has published."""
    if published is None:
        return True
    epoch, version = published
    return float(evaluation.weights_epoch) == epoch and evaluation.weights_version <= version
