"""`mrcdrl evaluator`: join a run, judge its live weights again and again, keep the best."""

import dataclasses
import logging
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from common.arena import Start, make_codec, test_starts
from common.config import Config
from common.errors import CheckpointError
from common.files import read_weights, write_weights
from common.policy import make_policy
from common.process import (
    StatsReporter,
    StopSignal,
    fetch_config,
    joining_arguments,
    run_main,
)
from common.trajectory import Evaluation, Weights
from common.transport import Session
from common.weights import WeightsReader
from common.wire import encode
from services.evaluator.score import evaluation
from services.evaluator.trial import PolicyPlayer, play

_LOG = logging.getLogger("evaluator")
_POLL_S = 0.2
_NICE = 10  # judging gives way to learning where they share cores
BEST = Path("checkpoints") / "best.safetensors"


def main(argv: Sequence[str]) -> int:
    """Judge for a run; the exit code."""
    joining = joining_arguments("evaluator", argv)
    keys, worker = joining.keys, joining.worker
    stop = StopSignal().listen()
    os.nice(_NICE)
    with Session(joining.transport) as session:
        config = fetch_config(session, joining, stop)
        torch.set_num_threads(config.evaluator.threads)
        reporter = StatsReporter(
            session.publisher(keys.stats("evaluator", worker)), "evaluator", worker
        )
        publisher = session.publisher(keys.evaluation(worker))
        reader = WeightsReader(session, keys)
        judge = Judge(config, worker)
        best = Best(joining.run_dir / BEST)
        session.announce(keys.live("evaluator", worker))
        weights = reader.wait(stop)
        count, busy = 0, False

        def metrics() -> dict[str, float]:
            version = -1 if weights is None else weights.version
            return {"evaluations": count, "weights_version": version, "busy": busy}

        def go_on() -> bool:
            reporter.maybe(metrics)
            return not stop.is_set()

        while weights is not None and not stop.is_set():
            began_s, busy = time.monotonic(), True
            result = judge.judge(weights, go_on)
            busy = False
            if result is None:
                break
            count += 1
            publisher.put(encode(result))
            best.offer(weights, result)
            newer = None
            share = config.evaluator.max_share
            rest_until_s = began_s + max(config.evaluator.period_s, result.wall_s / share)
            while go_on() and (newer is None or time.monotonic() < rest_until_s):
                newer = reader.latest(_POLL_S) or newer
            weights = newer
    return 0


class Judge:
    """Runs the test on weights; the same starts each time."""

    def __init__(self, config: Config, worker: str) -> None:
        self._config = config
        self._worker = worker
        self._policy = make_policy(config)
        self._starts: tuple[Start, ...] = test_starts(
            config.arena, config.evaluator.episodes, config.evaluator.seed
        )

    def judge(self, weights: Weights, go_on: Callable[[], bool]) -> Evaluation | None:
        """The evaluation; None where `go_on` said no."""
        config, began_s = self._config, time.monotonic()
        self._policy.adopt(weights)
        player = PolicyPlayer(
            config.arena,
            make_codec(config.arena),
            self._policy,
            config.evaluator.epsilon,
            np.random.default_rng(config.evaluator.seed),
        )
        results = play(config.arena, self._starts, player, go_on=lambda _done: go_on())
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


class Best:
    """The weights judged best so far, kept beside the checkpoints."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            _, manifest = read_weights(path)
        except CheckpointError:
            manifest = {}
        rate, frames = manifest.get("success_rate", -1), manifest.get("mean_frames", np.inf)
        self._rank = (float(rate), -float(frames))

    def offer(self, weights: Weights, result: Evaluation) -> None:
        """Keep the weights if they did better: more successes, or as many in less time."""
        rank = (result.success_rate, -result.mean_frames)
        if rank > self._rank:
            write_weights(self._path, weights.payload, dataclasses.asdict(result))
            self._rank = rank


if __name__ == "__main__":
    sys.exit(run_main(lambda: main(sys.argv[1:])))
