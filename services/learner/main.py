"""`mrcdrl learner`: join a run, learn from its replay, publish weights, keep checkpoints."""

import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial

import torch

from mrcdrl.common.arena import layout_symmetries
from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import Samples
from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal, available_cores
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.sync.lockstep import Lockstep
from mrcdrl.common.sync.stats import StatsReporter
from mrcdrl.common.sync.weights import WeightsWriter
from mrcdrl.common.transport import Session
from mrcdrl.services.learner.accelerate.side_stream import beside_the_step
from mrcdrl.services.learner.batch import Batch, collate, importance_exponent_at
from mrcdrl.services.learner.diagnostics import Diagnostics
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.prefetch import Prefetcher
from mrcdrl.services.learner.priorities import PrioritiesSender
from mrcdrl.services.learner.rendering import make_renderer
from mrcdrl.services.learner.timing import StageTimer
from mrcdrl.services.learner.weights_publisher import Keeper
from mrcdrl.services.replay.client import PriorityWriter, ReplayReader

_LOG = logging.getLogger("learner")
_POLL_S = 0.2
_WAITING_BATCHES = 64  # whose priorities are not sent yet: some 40 ms of the fastest learner


def main(argv: Sequence[str]) -> int:
    """Learn for a run; the exit code."""
    joining = Joining.from_argv("learner", argv)
    keys, worker = joining.keys, joining.worker
    stop = StopSignal().listen(STOP_DEADLINE_S)
    with Session(joining.transport) as session, Session(joining.transport) as bulk:
        config = fetch_config(session, joining, stop)
        settings = config.learner
        torch.set_num_threads(1)  # threads share batches, not operations
        threads = settings.threads or max(1, available_cores() // 2)
        lockstep = Lockstep.from_config(config)
        learner = Learner(
            config.agent,
            settings,
            stack=config.arena.stack,
            view_px=config.arena.view_px,
            threads=threads,
        )
        torch.backends.cudnn.benchmark = True  # batches are of one size
        on_cpu = learner.device.type == "cpu"
        torch.use_deterministic_algorithms(lockstep is not None and on_cpu)
        keeper = Keeper(config, learner, joining.run_dir / "checkpoints")
        reader = ReplayReader(
            bulk,
            keys,
            settings.batch_size,
            settings.sample_size // settings.batch_size,
            settings.requests_in_flight,
            settings.warn_s,
            stop,
            num_shards=config.replay.shards,
            seed=settings.seed,
            learner_step=None if lockstep is None else learner.learner_step,
        )
        drawing_threads = ThreadPoolExecutor(
            settings.drawing_threads or available_cores(), "drawing"
        )
        prefetcher = Prefetcher(
            reader,
            make_collate(config, learner, drawing_threads),
            settings.prefetch_batches,
            stop,
        )
        priorities = None
        if config.replay.prioritized:
            priorities = PrioritiesSender(
                PriorityWriter(bulk, keys, stop, num_shards=config.replay.shards),
                _WAITING_BATCHES,
            )
        writer = WeightsWriter(session, keys)
        reporter = StatsReporter(
            session.publisher(keys.stats("learner", worker)), "learner", worker
        )
        session.announce(keys.live("learner", worker))
        _LOG.info("%s", learner)
        try:
            run(config, learner, prefetcher, priorities, writer, keeper, reporter, stop)
        finally:
            stop.set()
            prefetcher.close()
            drawing_threads.shutdown()
            if priorities is not None:
                priorities.close()
            writer.close()
    return 0


def run(
    config: Config,
    learner: Learner,
    prefetcher: Prefetcher,
    priorities: PrioritiesSender | None,
    writer: WeightsWriter,
    keeper: Keeper,
    reporter: StatsReporter,
    stop: StopSignal,
) -> None:
    """Learn until stopped or run.learner_steps is reached; leaves a last checkpoint.

    priorities: where TD errors go; None where sampling is uniform. Raises DivergedError instead
    of publishing or saving numbers that are not finite.
    """
    timer = StageTimer(learner, prefetcher, priorities, keeper, Diagnostics(config, learner))
    limit, lockstep = config.run.learner_steps, Lockstep.from_config(config)
    publish_period = config.learner.publish_period if lockstep is None else lockstep.steps
    interval_s = config.learner.publish_interval_s if lockstep is None else 0.0
    try:
        writer.publish(keeper.next_weights())
        published_s = time.monotonic()
        while not stop.is_set() and (not limit or learner.learner_step < limit):
            most = min(learner.updates_per_launch, _steps_left(learner, publish_period, limit))
            batches = timer.timed("data_wait", partial(prefetcher.next, _POLL_S, most))
            reporter.worked(None if batches else prefetcher.heard_s)
            if batches:
                updates = timer.timed("step", partial(learner.steps, batches))
                timer.last = (batches[-1], updates[-1])
                if priorities is not None:
                    for batch, update in zip(batches, updates, strict=True):
                        priorities.put(batch.keys, update.td_errors)
                due = learner.learner_step % publish_period == 0
                if due and time.monotonic() - published_s >= interval_s:
                    if lockstep is not None:  # on the disk before anyone acts by it
                        timer.timed("checkpoint", keeper.save)
                    timer.timed("publish", lambda: writer.publish(keeper.next_weights()))
                    published_s = time.monotonic()
                if lockstep is None:
                    timer.timed("checkpoint", keeper.maybe_save)
            reporter.maybe(timer.metrics)
        if lockstep is None:
            writer.publish(keeper.next_weights())
            keeper.save()
    finally:
        reporter.now(timer.metrics)
    _LOG.info("stopped at learner step %d", learner.learner_step)


def _steps_left(learner: Learner, publish_period: int, limit: int) -> int:
    """Until weights are to be published or, with a limit, the run ends."""
    steps = publish_period - learner.learner_step % publish_period
    return min(steps, limit - learner.learner_step) if limit else steps


def make_collate(
    config: Config, learner: Learner, drawing_threads: Executor | None = None
) -> Callable[[Samples], Batch]:
    """From samples to the batch of one step, images drawn; by these threads if given."""
    symmetries = layout_symmetries(config.arena) if config.learner.symmetries else ()
    drawing = make_renderer(config.arena, learner.device, drawing_threads)

    def collated(samples: Samples) -> Batch:
        return collate(
            samples,
            drawing,
            config.arena.stack,
            symmetries=symmetries,
            rng=learner.rng,
            beta=importance_exponent_at(config.replay, learner.learner_step),
        )

    return beside_the_step(collated, learner.device)
