"""`mrcdrl evaluator`: evaluate a run's live weights again and again, and keep the best."""

import dataclasses
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from mrcdrl.common.arena import Start, make_codec, test_starts
from mrcdrl.common.config import Config
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.metrics import EvaluatorMetrics
from mrcdrl.common.messages.trajectory import Evaluation, Outcome, Weights
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.model.policy import make_policy
from mrcdrl.common.model.weights_files import read_weights, write_weights
from mrcdrl.common.runtime.files import BEST_WEIGHTS
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.repeats import is_logged
from mrcdrl.common.sync.broadcast import Broadcast
from mrcdrl.common.sync.joining import Joining
from mrcdrl.common.sync.stats import StatsReporter
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport import Session
from mrcdrl.services.evaluator.score import evaluation
from mrcdrl.services.evaluator.trial import EpisodeResult, PolicyPlayer, Show, play

_LOG = logging.getLogger("evaluator")
_POLL_S = 0.2
_BY_ROBOTS = "success_by_robots"  # in the manifest of the best weights
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
        broadcast: Broadcast | None = None,
    ) -> None:
        """after_first: called once the first evaluation is published.

        broadcast: is shown one of the arenas, while anybody watches.
        """
        keys, worker = joining.keys, joining.worker
        self._settings = config.evaluator
        self._stop = stop
        self._after_first = after_first
        self.reporter = StatsReporter(
            session.publisher(keys.stats("evaluator", worker)), "evaluator", worker, warms_up=True
        )
        self._evaluate_all = AllNumbers(config, worker, self._before_frame, broadcast)
        self._reader = WeightsReader(
            session, keys, self._evaluate_all.adopt, averages=config.learner.average_apart
        )
        self._best = BestWeights(
            joining.run_dir / BEST_WEIGHTS,
            AllNumbers(confirming(config), worker, self._before_frame),
            by_return=config.arena.is_custom,
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
        """Evaluate one version, publish the results, keep the weights if they are the best.

        Each number of robots is evaluated apart.
        """
        self._version, self._busy = weights.version, True
        first = self._evaluations == 0
        results = self._evaluate_all(weights, self._publish)
        if results:
            self._keep(weights, results)
            if first:
                self._after_first()
        self._busy = False

    def _keep(self, weights: Weights, results: Sequence[Evaluation]) -> None:
        """Keep the weights if they are the best; a full disk does not end the evaluator."""
        try:
            self._best.offer(weights, results)
        except CheckpointError as error:
            self._failures += 1
            if is_logged(self._failures):
                _LOG.warning("%s (%d times so far)", error, self._failures)

    def _publish(self, result: Evaluation) -> None:
        self._evaluations += 1
        self._publisher.put(encode(result))

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
            self.reporter.warmed_up()
        self._frames += 1
        return self._keep_going()

    def _keep_going(self) -> bool:
        self._report()
        return not self._stop.is_set()

    def _report(self) -> None:
        self.reporter.worked()
        self.reporter.publish_if_due(self._metrics)

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

    def __init__(self, config: Config, worker: str, broadcast: Broadcast | None = None) -> None:
        """broadcast: is shown one of the arenas, while anybody watches."""
        self._config = config
        self._worker = worker
        self._broadcast = broadcast
        self._policy = make_policy(config)
        self._starts: tuple[Start, ...] = test_starts(
            config.arena, config.evaluator.episodes, config.evaluator.seed
        )

    def adopt(self, weights: Weights) -> None:
        """Take the weights to evaluate; raises CheckpointError for another network's."""
        self._policy.adopt(weights)

    def _parts(self) -> list[tuple[Start, ...]]:
        """The first starts, and those that are played only if one of the first succeeds.

        Of a custom world all are played: its return counts, whether it knows success or not.
        """
        probe = 0 if self._config.arena.is_custom else self._config.evaluator.probe_episodes
        first = probe or len(self._starts)
        return [part for part in (self._starts[:first], self._starts[first:]) if part]

    def evaluate(self, weights: Weights, keep_going: Callable[[], bool]) -> Evaluation | None:
        """Evaluate the weights; None without starts, and as soon as `keep_going` returns False.

        Ends after the probe episodes if none of them succeeds; the result then counts those alone.
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
        broadcast = self._broadcast
        show = None if broadcast is None else Show(broadcast, player, weights.version)
        results: list[EpisodeResult] = []
        for starts in self._parts():
            if results and not any(result.outcome is Outcome.SUCCESS for result in results):
                break
            part = play(
                config.arena, starts, player, keep_going=lambda _done: keep_going(), show=show
            )
            if part is None:
                return None
            results += part
        return evaluation(
            results,
            worker=self._worker,
            weights=weights,
            num_robots=config.arena.num_robots,
            seed=config.evaluator.seed,
            wall_s=time.monotonic() - began_s,
        )


class AllNumbers:
    """Evaluates weights with each number of robots that an episode may have."""

    def __init__(
        self,
        config: Config,
        worker: str,
        keep_going: Callable[[], bool],
        broadcast: Broadcast | None = None,
    ) -> None:
        """keep_going: called again and again; an evaluation ends as soon as it returns False.

        broadcast: is shown one of the arenas, while anybody watches.
        """
        self._evaluators = [
            WeightsEvaluator(one, worker, broadcast) for one in config.each_number()
        ]
        self._keep_going = keep_going

    def adopt(self, weights: Weights) -> None:
        """Take the weights to evaluate; raises CheckpointError for another network's."""
        for evaluator in self._evaluators:
            evaluator.adopt(weights)

    def __call__(
        self, weights: Weights, report: Callable[[Evaluation], None] = lambda _result: None
    ) -> list[Evaluation]:
        """Evaluate the weights with each number; none without starts, or if it was ended.

        report: called with each result as it is there.
        """
        results = []
        for evaluator in self._evaluators:
            result = evaluator.evaluate(weights, self._keep_going)
            if result is None:
                return []
            report(result)
            results.append(result)
        return results


class BestWeights:
    """The file of the weights that scored best so far, beside the checkpoints.

    The best of many evaluations owes some of its score to luck. So weights that score well are
    evaluated again, from more and other starts, and ranked by that.
    """

    def __init__(
        self,
        path: Path,
        confirm: Callable[[Weights], Sequence[Evaluation]] = lambda _weights: (),
        *,
        by_return: bool = False,
    ) -> None:
        """confirm: evaluates weights again; nothing where it does not, or was stopped.

        by_return: of equal success the greater return ranks higher, not the fewer frames.
        """
        self._path = path
        self._confirm = confirm
        self._by_return = by_return

    def offer(self, weights: Weights, results: Sequence[Evaluation]) -> None:
        """Keep the weights if they scored better: more successes, or as many in fewer frames.

        results: one for each number of robots. The number that succeeds least counts most, and
        then the mean over all of them. Of weights without a success the newest are kept.
        """
        if not self._is_better(results):
            return
        if self._rank(results)[0] >= _WORTH_CONFIRMING:
            results = self._confirm(weights) or results
        if self._is_better(results):
            write_weights(self._path, weights.payload, _manifest(results))

    def _is_better(self, results: Sequence[Evaluation]) -> bool:
        rank, kept = self._rank(results), self._kept_rank()
        return rank > kept or (rank == kept and not any(each.success_rate for each in results))

    def _rank(self, results: Sequence[Evaluation]) -> tuple[float, float, float]:
        weakest = _weakest(results)
        mean = fmean(result.success_rate for result in results)
        last = weakest.mean_score if self._by_return else -weakest.mean_frames
        return (weakest.success_rate, mean, last)

    def _kept_rank(self) -> tuple[float, float, float]:
        """Rank the kept weights, read again because another evaluator may have replaced them."""
        try:
            _, manifest = read_weights(self._path)
        except CheckpointError:
            manifest = {}
        rate = float(manifest.get("success_rate", -1))
        by_robots = manifest.get(_BY_ROBOTS) or {"": rate}
        if self._by_return:
            last = float(manifest.get("mean_score", -np.inf))
        else:
            last = -float(manifest.get("mean_frames", np.inf))
        return (rate, fmean(map(float, by_robots.values())), last)


def _weakest(results: Sequence[Evaluation]) -> Evaluation:
    return min(results, key=lambda result: result.success_rate)


def _manifest(results: Sequence[Evaluation]) -> dict[str, Any]:
    """What is said of the weights: the weakest result, and the success with each number."""
    manifest = dataclasses.asdict(_weakest(results))
    if len(results) > 1:
        manifest[_BY_ROBOTS] = {str(r.num_robots): r.success_rate for r in results}
    return manifest
