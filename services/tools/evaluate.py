"""`mrcdrl evaluate`: the paper's test (section 5.3, Table 2) for weights or a controller.

With --failures, failed episodes are replayed after the test, whose own numbers stay the same. Where
episodes differ in their number of robots, each number is tested apart, from as many starts.
"""

import argparse
import dataclasses
import itertools
import json
import sys
import time
from collections.abc import Sequence

from mrcdrl.common.arena import test_starts
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Evaluation
from mrcdrl.services.evaluator.navigation import Navigation, navigation, navigation_table
from mrcdrl.services.evaluator.score import evaluation
from mrcdrl.services.evaluator.trial import EpisodeResult, play
from mrcdrl.services.evaluator.values import StartValues, start_values
from mrcdrl.services.tools import flags
from mrcdrl.services.tools.failure_summary import as_json, failure_table, summarize
from mrcdrl.services.tools.failures import Failure
from mrcdrl.services.tools.progress import Done, Progress
from mrcdrl.services.tools.replays import failures_of, num_replays
from mrcdrl.services.tools.subject import Subject, always, subject


def main(argv: Sequence[str]) -> int:
    """Evaluate and print; return the exit code."""
    arguments = flags.evaluate().parse_args(argv)
    for evaluated in subject(arguments).each_number():
        sys.stdout.write(told(evaluated, arguments))
        sys.stdout.flush()
    return 0


def told(evaluated: Subject, arguments: argparse.Namespace) -> str:
    """Evaluate the subject; the result as text, or as a line of JSON.

    Raises ConfigError for a controller whose values are asked for: it has none.
    """
    if arguments.values and evaluated.policy is None:
        raise ConfigError("--values compares a network's values: give weights, not --controller")
    arena = evaluated.config.arena
    if arena.is_custom and arguments.failures is not None:
        raise ConfigError("--failures tells robots and walls apart: not with a custom world")
    with Progress() as progress:
        result, measures, episodes = evaluate(
            evaluated,
            arguments.episodes,
            arguments.seed,
            progress.stage("episodes", arguments.episodes),
            keep_failed_paths=arguments.failures is not None,
        )
        failures: list[Failure] = []
        if arguments.failures is not None:
            done = progress.stage("replays of failures", num_replays(episodes))
            replayed = itertools.count(1)
            failures = failures_of(
                evaluated, episodes, arguments.seed, lambda: done(next(replayed))
            )
        compared: StartValues | None = None
        if arguments.values and evaluated.policy is not None:
            starts = test_starts(arena, arguments.episodes, arguments.seed)
            done = progress.stage("episodes by training's rules", len(starts))
            compared = start_values(evaluated.config, evaluated.policy, starts, done)
    values = dataclasses.asdict(result) | {
        "outcomes": "".join(episode.outcome[0] for episode in episodes),
    }
    text = table(result, evaluated)
    if measures is not None:
        values["navigation"] = dataclasses.asdict(measures)
        text += navigation_table(measures)
    if compared is not None:
        values["values"] = dataclasses.asdict(compared)
        text += values_table(compared)
    if arguments.failures is not None:
        summary = summarize(failures, arguments.episodes)
        values["failures"] = as_json(failures, summary, arguments.failures)
        text += failure_table(failures, summary, arguments.failures)
    return json.dumps(values) + "\n" if arguments.json else text


def evaluate(
    evaluated: Subject,
    episodes: int,
    seed: int,
    report: Done,
    *,
    keep_failed_paths: bool = False,
) -> tuple[Evaluation, Navigation | None, list[EpisodeResult]]:
    """The paper's measures, those of navigation except in a custom world, and the episodes.

    report: called with the number of episodes finished.
    """
    began_s = time.monotonic()
    starts = test_starts(evaluated.config.arena, episodes, seed)

    player = evaluated.player(seed)
    results = (
        play(
            evaluated.config.arena,
            starts,
            player,
            keep_failed_paths=keep_failed_paths,
            keep_going=always(report),
        )
        or []
    )
    result = evaluation(
        results,
        worker=evaluated.controller or "evaluate",
        weights=evaluated.weights,
        num_robots=evaluated.config.arena.num_robots,
        seed=seed,
        wall_s=time.monotonic() - began_s,
    )
    if evaluated.config.arena.is_custom:
        return result, None, results
    outcomes, frames = [r.outcome for r in results], [r.frames for r in results]
    return result, navigation(outcomes, frames, [r.journey for r in results]), results


def values_table(compared: StartValues) -> str:
    """Format the comparison of values with returns for a terminal."""
    low, high = compared.interval
    return f"""at the start, by training's rules and without exploration, in rewards
  value           {compared.expected:8.2f}
  return          {compared.realised:8.2f}   (discounted)
  overestimation  {compared.overestimation:8.2f}   (95 % interval {low:.2f} to {high:.2f})
"""


def table(result: Evaluation, evaluated: Subject) -> str:
    """Format the result for a terminal."""
    low, high = result.success_interval
    epsilon = evaluated.config.evaluator.epsilon
    custom = evaluated.config.arena.is_custom
    players = "agents" if custom else "robots"
    failure = "failure  " if custom else "collision"
    score = f"  return     {result.mean_score:7.2f}   (a sum, mean over agents)\n" if custom else ""
    who = (
        f"controller {evaluated.controller}, which sees the true state"
        if evaluated.controller
        else f"weights of learner step {result.learner_step}, from images alone"
    )
    return f"""{who}
{result.num_robots} {players}, {result.episodes} episodes, epsilon {epsilon:g}
  success    {result.success_rate:7.2%}   (95 % interval {low:.2%} to {high:.2%})
  {failure}  {result.collision_rate:7.2%}
  time-out   {result.timeout_rate:7.2%}
{score}\
  successes per 100: max {result.max_per_100:.0f}, average {result.mean_per_100:.2f}, \
variance {result.variance_per_100:.2f}
"""
