"""Shares of failures, with their intervals, for a terminal and as JSON.

Invariant: a share counts the failures to which its question applies. Pure.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrcdrl.common.messages.trajectory import Outcome
from mrcdrl.services.evaluator.score import wilson_interval
from mrcdrl.services.tools.failures import RECENT_FRAMES, Failure

_PERCENTILES = (10, 50, 90)

QUESTIONS: dict[str, tuple[str, Callable[[Failure], bool | None]]] = {
    "hit_robot": ("a robot hit a robot", lambda f: f.hit("robot")),
    "hit_wall": ("a robot hit a wall", lambda f: f.hit("wall")),
    "hit_obstacle": ("a robot hit an obstacle", lambda f: f.hit("obstacle")),
    "timeout": ("time-out", lambda f: f.outcome is Outcome.TIMEOUT),
    "explored_before": ("collision soon after exploring", lambda f: f.explored_before),
    "succeeds_without_exploration": (
        "succeeds with epsilon 0",
        lambda f: f.succeeds_without_exploration,
    ),
    "savable": ("safe_circle could save it", lambda f: f.savable),
    "savable_late": (
        f"  even {RECENT_FRAMES} frames before the end",
        lambda f: None if f.savable is None else _frames_before_end(f) <= RECENT_FRAMES,
    ),
    "same_target": ("two robots wanted one target", lambda f: f.same_target),
    "unseen": ("collision with a robot unseen", lambda f: f.unseen),
    "late_robot": ("time-out with a robot off target", lambda f: _of_timeout(f, f.late_robots)),
    "circled": (
        "time-out with one that circled there",
        lambda f: _of_timeout(f, [robot for robot in f.late_robots if robot.circled]),
    ),
}
"""Key, words and answer of each share; the answer None does not count."""


@dataclass(frozen=True, slots=True)
class Share:
    """The share of the failures of which something is true."""

    count: int
    of: int  # failures to which the question applies
    share: float | None  # None of none
    interval: tuple[float, float]  # 95 %, Wilson


@dataclass(frozen=True, slots=True)
class Summary:
    """All failures of the evaluated starts."""

    episodes: int
    failures: int
    shares: dict[str, Share]  # by key of QUESTIONS
    savable_frames_before_end: dict[str, float | None]
    """Percentiles of the frames between the last savable one and the end, of the savable."""


def summarize(failures: Sequence[Failure], episodes: int) -> Summary:
    """Count the failures of this many episodes."""
    before = [_frames_before_end(f) for f in failures if f.savable]
    return Summary(
        episodes=episodes,
        failures=len(failures),
        shares={key: _share([ask(f) for f in failures]) for key, (_, ask) in QUESTIONS.items()},
        savable_frames_before_end={
            f"p{percent}": float(np.percentile(before, percent)) if before else None
            for percent in _PERCENTILES
        },
    )


def as_json(failures: Sequence[Failure], summary: Summary, num_listed: int) -> dict[str, Any]:
    """The summary, and the first failures under `listed`."""
    listed = [dataclasses.asdict(failure) for failure in failures[:num_listed]]
    return dataclasses.asdict(summary) | {"listed": listed}


def failure_table(failures: Sequence[Failure], summary: Summary, num_listed: int) -> str:
    """Format the first failures and the summary for a terminal."""
    lines = [_line(failure) for failure in failures[:num_listed]]
    lines.append(f"{summary.failures} failures of {summary.episodes} episodes")
    for key, (words, _) in QUESTIONS.items():
        share = summary.shares[key]
        if share.share is None:
            lines.append(f"  {words:36} {'-':>7}")
            continue
        low, high = share.interval
        lines.append(
            f"  {words:36} {share.share:7.2%}   "
            f"({share.count} of {share.of}; 95 % interval {low:.2%} to {high:.2%})"
        )
    percentiles = ", ".join(
        f"{name} {'-' if value is None else f'{value:.0f}'}"
        for name, value in summary.savable_frames_before_end.items()
    )
    lines.append(f"  last savable frame, frames before the end: {percentiles}")
    return "\n".join(lines) + "\n"


def _line(failure: Failure) -> str:
    """A failure in one line."""
    told = [
        f"robot{'s' if len(c.robots) > 1 else ''} {' and '.join(map(str, c.robots))}"
        + (f" and {'an' if c.what == 'obstacle' else 'a'} {c.what}" if c.what != "robot" else "")
        + f" at ({c.place_px[0]:.0f}, {c.place_px[1]:.0f})"
        for c in failure.contacts
    ]
    told += [
        f"robot {late.robot} {late.distance_px:.0f} px off target {late.target}"
        + (", circling" if late.circled else "")
        for late in failure.late_robots
    ]
    if failure.outcome is Outcome.TIMEOUT:
        told.insert(0, "time-out")
    notes = {
        "exploring before": failure.explored_before,
        "succeeds with epsilon 0": failure.succeeds_without_exploration,
        f"savable until frame {failure.savable_until_frame}": failure.savable,
        "one target wanted by two": failure.same_target,
        "unseen": failure.unseen,
    }
    told += [words for words, answer in notes.items() if answer]
    return f"start {failure.start}, frame {failure.frames}: " + "; ".join(told)


def _share(answers: Sequence[bool | None]) -> Share:
    known = [answer for answer in answers if answer is not None]
    share = sum(known) / len(known) if known else None
    return Share(sum(known), len(known), share, wilson_interval(sum(known), len(known)))


def _frames_before_end(failure: Failure) -> float:
    """Frames between the last savable one and the end; infinite if none is."""
    until = failure.savable_until_frame
    return np.inf if until is None else failure.frames - until


def _of_timeout(failure: Failure, robots: Sequence[object]) -> bool | None:
    return bool(robots) if failure.outcome is Outcome.TIMEOUT else None
