"""`mrcdrl learner`: join a run, learn from its replay, publish weights, keep checkpoints."""

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import torch

from mrcdrl.common.config import Config
from mrcdrl.common.runtime.cores import available_cores
from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal
from mrcdrl.common.sync.claim import claim_learner
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.sync.lockstep import Lockstep
from mrcdrl.common.sync.stats import StatsReporter, serve_statistics
from mrcdrl.common.sync.weights import WeightsWriter
from mrcdrl.common.transport import Session
from mrcdrl.services.learner.accelerate.thread_tuner import ThreadTuner, thread_counts
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.prefetch import Prefetcher, make_collate
from mrcdrl.services.learner.priorities import PrioritiesSender
from mrcdrl.services.learner.training_loop import run
from mrcdrl.services.learner.weights_publisher import WeightsPublisher
from mrcdrl.services.replay.client import PriorityWriter, ReplayReader

_LOG = logging.getLogger("learner")
_WAITING_BATCHES = 64  # whose priorities are not sent yet: some 40 ms of the fastest learner


def main(argv: Sequence[str]) -> int:
    """Learn for a run; the exit code."""
    joining = Joining.from_argv("learner", argv)
    keys, worker = joining.keys, joining.worker
    stop = StopSignal().listen(STOP_DEADLINE_S)
    with ExitStack() as owned:
        session = owned.enter_context(Session(joining.transport))
        bulk = owned.enter_context(Session(joining.transport))
        config = fetch_config(session, joining, stop)
        claim_learner(session, keys, stop)
        reporter = StatsReporter(
            session.publisher(keys.stats("learner", worker)), "learner", worker, warms_up=True
        )
        owned.enter_context(serve_statistics(joining.transport, "learner", joining.run, reporter))
        settings, lockstep = config.learner, Lockstep.from_config(config)
        torch.set_num_threads(1)  # threads share batches, not operations
        learner = make_learner(config)
        torch.backends.cudnn.benchmark = True  # batches are of one size
        exact = lockstep is not None and learner.device.type == "cpu"
        torch.use_deterministic_algorithms(exact)
        writer = WeightsWriter(session, keys, 0.0 if lockstep else settings.publish_bytes_per_s)
        owned.callback(writer.close)
        publisher = WeightsPublisher(config, learner, writer, joining.run_dir / "checkpoints")
        reader = ReplayReader.from_config(bulk, keys, config, stop, learner.learner_step)
        priorities = None
        if config.replay.prioritized:
            errors = PriorityWriter.from_config(bulk, keys, config, stop)
            priorities = PrioritiesSender(errors, _WAITING_BATCHES)
            owned.callback(priorities.close)
        rendering_threads = owned.enter_context(
            ThreadPoolExecutor(settings.drawing_threads or available_cores(), "rendering")
        )
        collate = make_collate(config, learner, rendering_threads)
        # in lockstep no number may follow from which thread was the faster
        ahead = learner.ahead if learner.device.type == "cpu" and lockstep is None else None
        prefetcher = Prefetcher(reader, collate, settings.prefetch_batches, stop, ahead)
        owned.callback(prefetcher.close)
        owned.callback(stop.set)  # called first: the threads above end by it
        session.announce(keys.live("learner", worker))
        _LOG.info("%s", learner)
        run(config, learner, prefetcher, priorities, publisher, reporter, stop)
    return 0


def make_learner(config: Config) -> Learner:
    """The learner of a run, with as many threads as it says, or as prove fastest.

    In lockstep the same number of threads gives the same numbers, so it is not left to a measure.
    """
    cores = available_cores()
    if config.learner.threads or config.run.turn_size or cores == 1:
        return Learner.from_config(config, config.learner.threads or max(1, cores // 2))
    return Learner.from_config(config, cores, ThreadTuner(thread_counts(cores)))
