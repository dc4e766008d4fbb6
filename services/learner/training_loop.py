"""The learner's main loop: take batches, step, send TD errors back, publish, save."""

import logging
from functools import partial

from mrcdrl.common.config import Config
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.stats import StatsReporter
from mrcdrl.services.learner.diagnostics import Diagnostics
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.prefetch import Prefetcher
from mrcdrl.services.learner.priorities import PrioritiesSender
from mrcdrl.services.learner.publish_schedule import publish_schedule
from mrcdrl.services.learner.timing import StageTimer
from mrcdrl.services.learner.weights_publisher import WeightsPublisher

_LOG = logging.getLogger("learner")
_POLL_S = 0.2


def run(
    config: Config,
    learner: Learner,
    prefetcher: Prefetcher,
    priorities: PrioritiesSender | None,
    publisher: WeightsPublisher,
    reporter: StatsReporter,
    stop: StopSignal,
) -> None:
    """Learn until stopped or run.learner_steps is reached; leaves a last checkpoint.

    priorities: where TD errors go; None where sampling is uniform. Raises DivergedError instead
    of publishing or saving numbers that are not finite.
    """
    timer = StageTimer(learner, prefetcher, priorities, publisher, Diagnostics(config, learner))
    limit = config.run.learner_steps
    try:
        publisher.publish()
        schedule = publish_schedule(config)
        while not stop.is_set() and (not limit or learner.learner_step < limit):
            most = min(learner.updates_per_launch, _steps_left(learner, schedule.period, limit))
            batches = timer.timed("data_wait", partial(prefetcher.next, _POLL_S, most))
            reporter.worked(None if batches else prefetcher.heard_s)
            if batches:
                updates = timer.timed("step", partial(learner.steps, batches))
                reporter.warmed_up()
                timer.last = (batches[-1], updates[-1])
                if priorities is not None:
                    for batch, update in zip(batches, updates, strict=True):
                        priorities.put(batch.keys, update.td_errors)
                schedule.after(learner.learner_step, publisher, timer)
            reporter.publish_if_due(timer.metrics)
        schedule.at_end(publisher)
    finally:
        reporter.publish(timer.metrics)
    _LOG.info("stopped at learner step %d", learner.learner_step)


def _steps_left(learner: Learner, publish_period: int, limit: int) -> int:
    """Steps until weights are to be published or, with a limit, the run ends."""
    steps = publish_period - learner.learner_step % publish_period
    return min(steps, limit - learner.learner_step) if limit else steps
