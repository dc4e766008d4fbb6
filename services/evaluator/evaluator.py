"""`mrcdrl evaluator`: evaluate a run's live weights again and again, and keep the best."""

import dataclasses
import logging
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mrcdrl.common.arena import Start, make_codec, test_starts
from mrcdrl.common.config import Config
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.metrics import EvaluatorMetrics
from mrcdrl.common.messages.trajectory import Evaluation, Weights
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.model.policy import make_policy
from mrcdrl.common.model.weights_files import read_weights, write_weights
from mrcdrl.common.runtime.files import BEST_WEIGHTS
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.joining import Joining
from mrcdrl.common.sync.stats import StatsReporter
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport import Session
from mrcdrl.services.evaluator.score import evaluation
from mrcdrl.services.evaluator.trial import PolicyPlayer, play

_LOG = logging.getLogger("evaluator")
_POLL_S = 0.2
_WORTH_CONFIRMING = 0.9  # success; below it, learning outruns luck
_CONFIRMING_SEED = 500_000  # added to evaluator.seed: no test that is quoted has these starts


class Evaluator:
    """The service: follows the weights, evaluates them, publishes the results."""

    def __init__(
        self,
        config: Config,
        joining: Joining,
        session: Session,
        stop: StopSignal,
        after_first: Callable[[], None] = lambda: None,
    ) -> None:
        """after_first: called once the first evaluation is published."""
        keys, worker = joining.keys, joining.worker
        self._settings = config.evaluator
        self._stop = stop
        self._after_first = after_first
        self._reporter = StatsReporter(
            session.publisher(keys.stats("evaluator", worker)), "evaluator", worker, warms_up=True
        )
        self._evaluator = WeightsEvaluator(config, worker)
        self._reader = WeightsReader(session, keys, self._evaluator.adopt)
        confirmer = WeightsEvaluator(confirming(config), worker)
        self._best = BestWeights(
            joining.run_dir / BEST_WEIGHTS,
            lambda weights: confirmer.evaluate(weights, self._before_frame),
        )
        self._publisher = session.publisher(keys.evaluation(worker))
        self._frames = 0  # each of many arenas
        self._evaluations = 0
        self._failures = 0  # to keep the best weights
        self._version = -1
        self._busy = False

    def run(self) -> None:
        """Evaluate, rest, take the newest weights, until stopped."""
        weights = self._reader.wait(self._stop, meanwhile=self._report)
        while weights is not None:
            began_s = time.monotonic()
            self._evaluate(weights)
            spent_s = time.monotonic() - began_s
            rest_s = max(self._settings.period_s, spent_s / self._settings.max_share)
            weights = self._newest_after(began_s + rest_s)

    def _evaluate(self, weights: Weights) -> None:
        """Evaluate one version, publish the result, keep the weights if they are the best."""
        self._version, self._busy = weights.version, True
        result = self._evaluator.evaluate(weights, self._before_frame)
        if result is not None:
            self._evaluations += 1
            self._publisher.put(encode(result))
            self._keep(weights, result)
            if self._evaluations == 1:
                self._after_first()
        self._busy = False

    def _keep(self, weights: Weights, result: Evaluation) -> None:
        """Keep the weights if they are the best; a full disk does not end the evaluator."""
        try:
            self._best.offer(weights, result)
        except CheckpointError as error:
            self._failures += 1
            if self._failures.bit_count() == 1:  # the 1st, 2nd, 4th …
                _LOG.warning("%s (%d times so far)", error, self._failures)

    def _newest_after(self, until_s: float) -> Weights | None:
        """Wait until this time and for newer weights; return them, or None once stopped."""
        newest: Weights | None = None
        while newest is None and self._keep_going():
            if time.monotonic() < until_s:
                self._stop.wait(_POLL_S)
            else:
                newest = self._reader.latest(_POLL_S)
        return newest

    def _before_frame(self) -> bool:
        """Report, as each frame is work done; whether to play it."""
        if self._frames:
            self._reporter.warmed_up()
        self._frames += 1
        return self._keep_going()

    def _keep_going(self) -> bool:
        self._report()
        return not self._stop.is_set()

    def _report(self) -> None:
        self._reporter.worked()
        self._reporter.publish_if_due(self._metrics)

    def _metrics(self) -> EvaluatorMetrics:
        return EvaluatorMetrics(
            evaluations=self._evaluations,
            weights_version=self._version,
            weights_refused=self._reader.refused,
            busy=self._busy,
        )


def confirming(config: Config) -> Config:
    """The configuration by which weights that may be the best are evaluated again."""
    settings = config.evaluator
    changed = {
        "episodes": settings.confirm_episodes,
        "seed": settings.seed + _CONFIRMING_SEED,
    }
    return config.model_copy(update={"evaluator": settings.model_copy(update=changed)})


class WeightsEvaluator:
    """Evaluates weights by the paper's test, from the same starts each time."""

    def __init__(self, config: Config, worker: str) -> None:
        self._config = config
        self._worker = worker
        self._policy = make_policy(config)
        self._starts: tuple[Start, ...] = test_starts(
            config.arena, config.evaluator.episodes, config.evaluator.seed
        )

    def adopt(self, weights: Weights) -> None:
        """Take the weights to evaluate; raises CheckpointError for another network's."""
        self._policy.adopt(weights)

    def evaluate(self, weights: Weights, keep_going: Callable[[], bool]) -> Evaluation | None:
        """Evaluate the weights; None without starts, and as soon as `keep_going` returns False.

        Raises CheckpointError for weights of another network.
        """
        if not self._starts:
            return None
        config, began_s = self._config, time.monotonic()
        self.adopt(weights)
        player = PolicyPlayer(
            config.arena,
            make_codec(config.arena),
            self._policy,
            config.evaluator.epsilon,
            np.random.default_rng(config.evaluator.seed),
        )
        results = play(config.arena, self._starts, player, keep_going=lambda _done: keep_going())
        if results is None:
            return None
        return evaluation(
            results,
            worker=self._worker,
            weights=weights,
            num_robots=config.arena.num_robots,
            seed=config.evaluator.seed,
            wall_s=time.monotonic() - began_s,
        )


class BestWeights:
    """The file of the weights that scored best so far, beside the checkpoints.

    The best of many evaluations owes some of its score to luck. So weights that score well are
    evaluated again, from more and other starts, and ranked by that.
    """

    def __init__(
        self,
        path: Path,
        confirm: Callable[[Weights], Evaluation | None] = lambda _weights: None,
    ) -> None:
        """confirm: evaluates weights again; None where it does not, or was stopped."""
        self._path = path
        self._confirm = confirm

    def offer(self, weights: Weights, result: Evaluation) -> None:
        """Keep the weights if they scored better: more successes, or as many in fewer frames."""
        if _rank(result) <= self._rank():
            return
        if result.success_rate >= _WORTH_CONFIRMING:
            result = self._confirm(weights) or result
        if _rank(result) > self._rank():
            write_weights(self._path, weights.payload, dataclasses.asdict(result))

    def _rank(self) -> tuple[float, float]:
        """Rank the kept weights, read again because another evaluator may have replaced them."""
        try:
            _, manifest = read_weights(self._path)
        except CheckpointError:
            manifest = {}
        rate, frames = manifest.get("success_rate", -1), manifest.get("mean_frames", np.inf)
        return (float(rate), -float(frames))


def _rank(result: Evaluation) -> tuple[float, float]:
    return (result.success_rate, -result.mean_frames)
