"""`mrcdrl evaluate`: the paper's test (section 5.3, Table 2) for weights or a controller."""

import dataclasses
import json
import sys
import time
from collections.abc import Callable, Sequence

from rich.console import Console
from rich.progress import Progress

from mrcdrl.common.arena import test_starts
from mrcdrl.common.messages.trajectory import Evaluation
from mrcdrl.services.evaluator.navigation import Navigation, navigation, navigation_table
from mrcdrl.services.evaluator.score import evaluation
from mrcdrl.services.evaluator.trial import play
from mrcdrl.services.tools.subject import Subject, parse_with_episodes, subject, subject_parser


def main(argv: Sequence[str]) -> int:
    """Evaluate and print; return the exit code."""
    parser = subject_parser("evaluate", "The paper's test: one collision fails, epsilon 0.01.")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parse_with_episodes(parser, argv, 1100)
    evaluated = subject(arguments)
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("episodes", total=arguments.episodes)
        result, measures = evaluate(
            evaluated,
            arguments.episodes,
            arguments.seed,
            lambda done: progress.update(task, completed=done),
        )
    if arguments.json:
        measured = {"navigation": dataclasses.asdict(measures)}
        print(json.dumps(dataclasses.asdict(result) | measured))
    else:
        sys.stdout.write(table(result, evaluated) + navigation_table(measures))
    return 0


def evaluate(
    evaluated: Subject, episodes: int, seed: int, report: Callable[[int], None]
) -> tuple[Evaluation, Navigation]:
    """The paper's measures and those of navigation; report: called with the episodes finished."""
    began_s = time.monotonic()
    starts = test_starts(evaluated.config.arena, episodes, seed)

    def keep_going(done: int) -> bool:
        report(done)
        return True

    player = evaluated.player(seed)
    results = play(evaluated.config.arena, starts, player, keep_going=keep_going) or []
    result = evaluation(
        results,
        worker=evaluated.controller or "evaluate",
        weights=evaluated.weights,
        num_robots=evaluated.config.arena.num_robots,
        seed=seed,
        wall_s=time.monotonic() - began_s,
    )
    outcomes, frames = [r.outcome for r in results], [r.frames for r in results]
    return result, navigation(outcomes, frames, [r.journey for r in results])


def table(result: Evaluation, evaluated: Subject) -> str:
    """Format the result for a terminal."""
    low, high = result.success_interval
    epsilon = evaluated.config.evaluator.epsilon
    who = (
        f"controller {evaluated.controller}, which sees the true state"
        if evaluated.controller
        else f"weights of learner step {result.learner_step}, from images alone"
    )
    return f"""{who}
{result.num_robots} robots, {result.episodes} episodes, epsilon {epsilon:g}
  success    {result.success_rate:7.2%}   (95 % interval {low:.2%} to {high:.2%})
  collision  {result.collision_rate:7.2%}
  time-out   {result.timeout_rate:7.2%}
  successes per 100: max {result.max_per_100:.0f}, average {result.mean_per_100:.2f}, \
variance {result.variance_per_100:.2f}
"""
