"""A learner that computes nothing: publishes weights of real size, drops the batches it samples."""

import threading
from collections import Counter
from contextlib import ExitStack
from multiprocessing.connection import Connection
from time import monotonic_ns, time_ns

import numpy as np

from mrcdrl.common.messages.trajectory import Priorities, Weights
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import SENT_AS, weights_to_bytes
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.weights import WeightsWriter
from mrcdrl.common.transport import Session
from mrcdrl.services.replay.client import PriorityWriter, ReplayReader
from mrcdrl.services.tools.simulate.actors import Plan, Tally, answering, follow, tell_joined


def learn(plan: Plan, connection: Connection) -> None:
    """Run a process's simulated learner until the parent sends STOP."""
    with answering(connection), ExitStack() as owned:
        session = owned.enter_context(Session(plan.transport))
        bulk = owned.enter_context(Session(plan.transport))
        learner = SimulatedLearner(plan, session, bulk)
        owned.callback(learner.close)
        tell_joined(connection)(1)
        follow(connection, learner)


class SimulatedLearner:
    """Publishes `plan.rate` times a second; samples as fast as replay's limiter allows, if any."""

    def __init__(self, plan: Plan, session: Session, bulk: Session) -> None:
        config, keys = plan.config, plan.keys
        network = QNetwork(
            config.agent.kind, stack=config.arena.stack, view_px=config.arena.view_px
        )
        self._payload = weights_to_bytes(network, SENT_AS[config.learner.publish_precision])
        self._period_s = 1 / plan.rate if plan.rate else float("inf")
        self._due_s, self._epoch, self._version = 0.0, time_ns(), 0
        self._num_samples = 0
        self._stop = StopSignal()
        session.announce(keys.live("learner", plan.workers[0]))
        self._weights = WeightsWriter(session, keys, config.learner.publish_bytes_per_s)
        self._reader = ReplayReader.from_config(bulk, keys, config, self._stop)
        self._priorities = (
            PriorityWriter.from_config(bulk, keys, config, self._stop)
            if config.replay.prioritized
            else None
        )
        self._samples = config.replay.samples_per_insert > 0
        self._thread = threading.Thread(target=self._sample, name="sample")

    def begin(self, now_s: float) -> None:
        self._due_s = now_s + self._period_s
        if self._samples:
            self._thread.start()

    def work(self, now_s: float) -> None:
        """Publish if it is due; late publications are skipped, as a learner skips them."""
        if now_s >= self._due_s:
            self._due_s += self._period_s
            self._version += 1
            weights = Weights.of(self._epoch, self._version, monotonic_ns(), self._payload)
            self._weights.publish(weights)

    def tally(self, seconds: float) -> Tally:
        published = self._weights.publications
        return Tally(seconds, Counter(published=published, samples=self._num_samples))

    def drained(self) -> bool:
        return True

    def close(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._weights.close()

    def _sample(self) -> None:
        rng = np.random.default_rng(0)
        while (samples := self._reader.sample()) is not None:
            self._num_samples += len(samples)
            if self._priorities is not None:
                errors = rng.lognormal(0, 1, len(samples)).astype(np.float32)
                self._priorities.update(Priorities(samples.keys, errors))
