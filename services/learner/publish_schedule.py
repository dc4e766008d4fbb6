"""When a learner publishes and saves: at its own pace, or once a turn of lockstep."""

import time
from typing import Protocol

from mrcdrl.common.config import Config
from mrcdrl.common.sync.lockstep import Lockstep
from mrcdrl.services.learner.timing import StageTimer
from mrcdrl.services.learner.weights_publisher import WeightsPublisher


class PublishSchedule(Protocol):
    """Decides after every launch of steps."""

    period: int
    """Learner steps between publications; no launch passes over a multiple of it."""

    def after(self, learner_step: int, publisher: WeightsPublisher, timer: StageTimer) -> None:
        """Publish and save what is due when so many steps are made."""
        ...

    def at_end(self, publisher: WeightsPublisher) -> None:
        """Publish and save what is due when the learner stops."""
        ...


class AtOwnPace:
    """Publishes at most once in `interval_s`, and saves by the clock."""

    def __init__(self, period: int, interval_s: float) -> None:
        self.period = period
        self._interval_s = interval_s
        self._published_s = time.monotonic()

    def after(self, learner_step: int, publisher: WeightsPublisher, timer: StageTimer) -> None:
        waited_s = time.monotonic() - self._published_s
        if learner_step % self.period == 0 and waited_s >= self._interval_s:
            timer.timed("publish", publisher.publish)
            self._published_s = time.monotonic()
        timer.timed("checkpoint", publisher.maybe_save)

    def at_end(self, publisher: WeightsPublisher) -> None:
        publisher.publish()
        publisher.save()


class OncePerTurn:
    """Saves, then publishes, at a turn's end: nobody acts by weights that a kill would lose."""

    def __init__(self, period: int) -> None:
        self.period = period

    def after(self, learner_step: int, publisher: WeightsPublisher, timer: StageTimer) -> None:
        if learner_step % self.period == 0:
            timer.timed("checkpoint", publisher.save)
            timer.timed("publish", publisher.publish)

    def at_end(self, publisher: WeightsPublisher) -> None:
        """Nothing: a turn that did not end is made again."""


def publish_schedule(config: Config) -> PublishSchedule:
    """The schedule that the configuration asks for; its clock starts now."""
    lockstep, learner = Lockstep.from_config(config), config.learner
    if lockstep is not None:
        return OncePerTurn(lockstep.steps)
    return AtOwnPace(learner.publish_period, learner.publish_interval_s)
