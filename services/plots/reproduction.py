"""The paper's Figs. 5, 6, 7 and 9 for many runs, from numbers alone.

Invariants: plotted with matplotlib's Figure on Agg, without global state; a panel without runs says
so; a seed is a thin line, the run with the median success of its kind a thick one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from mrcdrl.common.messages.trajectory import Float64Array
from mrcdrl.services.plots.figures import DARK_BLUE, LIGHT_BLUE, blank, dress, means, save, say

HUNDRED = 100
_COLOURS = {"DQN": "#2a7f3f", "DDQN": "#c4500a", "Duel": "#123c73"}
_WEIGHTS = "viridis"  # colours of p
_PER_THOUSAND = 10  # hundreds


@dataclass(frozen=True, slots=True)
class Training:
    """One run's training by whole hundreds of episodes."""

    successes: Float64Array  # [H] of each hundred
    score: Float64Array  # [H], means
    mean_q: Float64Array  # [H], means, in the arena's rewards


@dataclass(frozen=True, slots=True)
class Group:
    """The runs of one kind; the first one has the median success."""

    name: str
    runs: Sequence[Training]


def weights(groups: Mapping[float, Sequence[Training]], *outs: Path) -> None:
    """Plot successes in training for each weight p (Fig. 5): over episodes, and at the end."""
    figure = blank(9, 4.2)
    curves, ends = figure.subplots(1, 2, width_ratios=(3, 2))
    dress(curves, "(a) successes per 100 episodes", "episodes", "successes")
    dress(ends, "(b) over the last 1 000 episodes", "weight p", "successes per 100")
    ends.xaxis.set_major_formatter("{x:g}")
    colours = _shades(len(groups))
    for colour, (p, runs) in zip(colours, groups.items(), strict=True):
        for number, run in enumerate(runs):
            x, y = _episodes(run.successes), run.successes
            curves.plot(x, y, color=colour, lw=1.0, label="" if number else f"p = {p:g}")
        last = [float(run.successes[-_PER_THOUSAND:].mean()) for run in runs if len(run.successes)]
        ends.plot([p] * len(last), last, "o", color=colour, ms=6, alpha=0.8)
        if last:
            ends.plot(p, np.mean(last), "_", color="black", ms=22, mew=2)
    ends.set_xticks(list(groups) or [0.5])
    ends.set_xlim(0, 1)
    for axes in (curves, ends):
        axes.set_ylim(-2, 102)
        _explain(axes)
    save(figure, *outs)


def training(run: Training | None, name: str, *outs: Path) -> None:
    """Plot one run's scores, and successes with their running maxima (Fig. 6)."""
    figure = blank(9, 7.5)
    scores, successes = figure.subplots(2, 1)
    dress(scores, "(a) score of an episode, mean over its robots", "episodes", "score")
    dress(successes, "(b) successes per 100 episodes", "episodes", "successes")
    if run is not None and len(run.successes):
        for axes, values in ((scores, run.score), (successes, run.successes)):
            x = _episodes(values)
            axes.plot(x, values, color=LIGHT_BLUE, lw=1.2, label="each 100 episodes")
            middles, averages = means(values, _PER_THOUSAND)
            at = HUNDRED * middles
            axes.plot(at, averages, color=DARK_BLUE, lw=2, label="mean of 1 000 episodes")
        before = np.concatenate(([-1.0], np.maximum.accumulate(run.successes)[:-1]))
        rises = run.successes > before
        successes.scatter(
            _episodes(run.successes)[rises], run.successes[rises], s=26,
            c=np.flatnonzero(rises), cmap="plasma", edgecolor="black", lw=0.5, zorder=3,
            label="new maximum",
        )  # fmt: skip
        best = int(np.argmax(run.successes))
        successes.annotate(
            f"{run.successes[best]:.0f}", (HUNDRED * (best + 1), run.successes[best]), (0, 6),
            textcoords="offset points", ha="center", fontweight="bold",
        )  # fmt: skip
    successes.set_ylim(-2, 112)
    for axes in (scores, successes):
        _explain(axes)
    figure.suptitle(name, fontsize=11)
    save(figure, *outs)


def kinds(panels: Mapping[int, Sequence[Group]], *outs: Path) -> None:
    """Plot action values, scores and successes of all kinds by number of robots (Fig. 7 a to i)."""
    figure = blank(4.2 * max(1, len(panels)), 9.5)
    grid = figure.subplots(3, max(1, len(panels)), squeeze=False)
    rows: tuple[tuple[str, Callable[[Training], Float64Array]], ...] = (
        ("average action value", lambda run: run.mean_q),
        ("score", lambda run: run.score),
        ("successes per 100", lambda run: run.successes),
    )
    letters = iter("abcdefghi")
    for axes_row, (label, values) in zip(grid, rows, strict=True):
        for axes, (robots, groups) in zip(axes_row, panels.items(), strict=False):
            dress(axes, f"({next(letters)}) {robots} robots", "episodes", label)
            axes.xaxis.get_major_locator().set_params(nbins=4)
            for group in groups:
                for number, run in reversed(list(enumerate(group.runs))):
                    y = values(run)
                    first = not number
                    axes.plot(
                        _episodes(y), y, color=_COLOURS[group.name], lw=1.8 if first else 0.6,
                        alpha=1.0 if first else 0.45, label=group.name if first else "",
                        zorder=3 if first else 2,
                    )  # fmt: skip
            _explain(axes)
    save(figure, *outs)


def test(outcomes: Mapping[str, Sequence[bool]], *outs: Path) -> None:
    """Plot successes of the test (Fig. 9): each hundred, and any hundred in a row, by kind."""
    figure = blank(9, 4.5)
    axes = figure.subplots()
    dress(axes, "successes per 100 starts of the test, 4 robots", "episodes", "successes")
    for name, won in outcomes.items():
        counted = np.array(won, np.float64)
        if len(counted) < HUNDRED:
            continue
        sliding = np.convolve(counted, np.ones(HUNDRED), "valid")
        at = np.arange(len(sliding)) + HUNDRED
        axes.plot(at, sliding, color=_COLOURS[name], lw=1.0, alpha=0.35)
        x, y = means(HUNDRED * counted, HUNDRED)
        axes.plot(x + HUNDRED / 2, y, color=_COLOURS[name], lw=2, marker="o", ms=4, label=name)
    axes.set_xlim(left=0)
    _explain(axes)
    save(figure, *outs)


def overestimation(panels: Mapping[int, Mapping[str, Sequence[float]]], *outs: Path) -> None:
    """Plot values of first states minus discounted returns: a dot a seed, by robots and kind.

    panels: per cent of a success's reward, by number of robots and kind.
    """
    figure = blank(3.2 * max(1, len(panels)), 3.6)
    row = figure.subplots(1, max(1, len(panels)), squeeze=False, sharey=True)[0]
    for axes, (robots, by_kind) in zip(row, panels.items(), strict=False):
        dress(axes, f"{robots} robots", "", "Q(s0) − return, % of 200" if axes is row[0] else "")
        axes.axhline(0, color="#777777", lw=1)
        for place, (name, values) in enumerate(by_kind.items()):
            axes.plot([place] * len(values), values, "o", color=_COLOURS[name], ms=6, alpha=0.8)
            if values:
                axes.plot(place, np.mean(values), "_", color="black", ms=22, mew=2)
        axes.set_xticks(range(len(by_kind)), list(by_kind))
        axes.set_xlim(-0.6, len(by_kind) - 0.4)
        if not any(by_kind.values()):
            say(axes, "no runs yet")
    save(figure, *outs)


def _episodes(values: Float64Array) -> Float64Array:
    """The last episode of each hundred."""
    return HUNDRED * (np.arange(len(values), dtype=np.float64) + 1)


def _shades(count: int) -> list[tuple[float, float, float, float]]:
    colours = matplotlib.colormaps[_WEIGHTS](np.linspace(0, 0.9, max(1, count)))
    return [tuple(colour) for colour in colours][:count]


def _explain(axes: Axes) -> None:
    """Add the legend; say so where nothing is plotted; show lines of one point."""
    if not any(np.size(line.get_xdata()) for line in axes.get_lines()):
        say(axes, "no runs yet, or fewer than 100 episodes")
        axes.set(xticks=[], yticks=[])
        return
    for line in axes.get_lines():
        if np.size(line.get_xdata()) == 1 and line.get_marker() == "None":
            line.set_marker("o")
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="lower right", fontsize=8, framealpha=0.8)
