"""Where the learner's time goes, and what its last step said."""

import time
from collections.abc import Callable
from typing import TypeVar

from mrcdrl.common.messages.metrics import LearnerMetrics
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.diagnostics import Diagnostics
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.prefetch import Prefetcher
from mrcdrl.services.learner.priorities import PrioritiesSender
from mrcdrl.services.learner.step import Update
from mrcdrl.services.learner.weights_publisher import WeightsPublisher

T = TypeVar("T")


class StageTimer:
    """Times the stages of the learner's loop."""

    def __init__(
        self,
        learner: Learner,
        prefetcher: Prefetcher,
        priorities: PrioritiesSender | None,
        publisher: WeightsPublisher,
        diagnostics: Diagnostics,
    ) -> None:
        self._learner = learner
        self._prefetcher = prefetcher
        self._priorities = priorities
        self._publisher = publisher
        self._diagnostics = diagnostics
        self._seconds = dict.fromkeys(("data_wait", "step", "publish", "checkpoint"), 0.0)
        self._started_s = time.perf_counter()
        self.last: tuple[Batch, Update] | None = None

    def timed(self, stage: str, work: Callable[[], T]) -> T:
        """Do the work; its time counts for the stage."""
        started = time.perf_counter()
        result = work()
        self._seconds[stage] += time.perf_counter() - started
        return result

    def metrics(self) -> LearnerMetrics:
        """Shares are of the time since the start; decoding runs beside the other stages."""
        lived_s = max(time.perf_counter() - self._started_s, 1e-9)
        return LearnerMetrics(
            learner_steps=self._learner.learner_step,
            weights_version=self._publisher.version,
            weights_epoch=self._publisher.epoch,
            batches_ready=self._prefetcher.ready,
            batches_refused=self._prefetcher.refused,
            priorities_dropped=self._priorities.dropped if self._priorities else 0,
            decode_share=self._prefetcher.decode_s / lived_s,
            data_wait_share=self._seconds["data_wait"] / lived_s,
            step_share=self._seconds["step"] / lived_s,
            publish_share=self._seconds["publish"] / lived_s,
            checkpoint_share=self._seconds["checkpoint"] / lived_s,
            diagnostics=None if self.last is None else self._diagnostics.look(*self.last),
        )
