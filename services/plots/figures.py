"""Figures of a finished or running run: its training curve, and robots' paths in the arena.

Invariants: plotted with matplotlib's Figure on Agg, without global state; an empty run gives an
empty but labelled figure; no label reaches beyond its figure.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import MaxNLocator

from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.messages.trajectory import Float64Array, Outcome
from mrcdrl.common.runtime.files import reason
from mrcdrl.services.monitor.records import (
    SUCCESS_WINDOW,
    EpisodeRecord,
    EvaluationRecord,
    read_episodes,
    read_evaluations,
)

DPI = 200  # of a .png; an .svg has none
START, WALL, TARGET, OBSTACLE, ROBOT = "red", "#d03030", "#2050d0", "#30a030", "#123c73"
LIGHT_BLUE, DARK_BLUE, GREEN = "#a9cbe8", "#123c73", "#2a7f3f"
# One hue for each robot: light at the start, dark at the end.
ROBOT_HUES = (
    ("#cfe3f5", "#0b3c73"),
    ("#fbdcc0", "#9c3d04"),
    ("#d3ecd0", "#0d5a24"),
    ("#e2d8ee", "#4a1a82"),
    ("#f7d0dc", "#8c1044"),
    ("#d2eeee", "#075a5f"),
    ("#f3e8bd", "#756003"),
    ("#dddddd", "#222222"),
    ("#e9d8cc", "#5b3218"),
    ("#dcecb5", "#4a6408"),
)


@dataclass(frozen=True, slots=True)
class Path2D:
    """One episode's paths, as `trajectories` plots them."""

    robots: Float64Array  # [T, K, 3], x_px, y_px, heading_rad
    targets: Float64Array  # [M, 2], centres in px
    obstacles: Float64Array  # [O, 3], centres and radius in px
    outcome: Outcome


def training_curve(run_dir: Path, *outs: Path) -> None:
    """Plot the training curve of a run to `outs` (paper Fig. 6, and its evaluations).

    (a) mean score of episodes; (b) successes per 100 episodes with their running maxima; (c)
    evaluation success with its 95 % interval.

    Raises RunDirectoryError for records of another version.
    """
    episodes, tests = read_episodes(run_dir), read_evaluations(run_dir)
    figure = blank(9, 11)
    score, successes, evaluation = figure.subplots(3, 1)
    group = SUCCESS_WINDOW * (10 if len(episodes) >= 40 * SUCCESS_WINDOW else 1)
    _draw_scores(score, episodes, group)
    _draw_successes(successes, episodes, group)
    _draw_evaluations(evaluation, tests)
    figure.suptitle(run_dir.name, fontsize=12, fontweight="bold")
    save(figure, *outs)


def blank(width: float, height: float) -> Figure:
    """An empty figure; sizes in inches."""
    figure = Figure(
        figsize=(width, height), dpi=DPI, layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08)
    )
    FigureCanvasAgg(figure)
    return figure


def _draw_scores(axes: Axes, episodes: Sequence[EpisodeRecord], group: int) -> None:
    scores = np.array([record.episode.score for record in episodes])
    dress(axes, "(a) score of an episode, mean over its robots", "episodes", "score")
    if not episodes:
        say(axes, "no episodes")
    else:
        each = max(1, min(SUCCESS_WINDOW, len(scores) // 20))
        label = f"mean of {each} episodes" if each > 1 else "each episode"
        axes.plot(*means(scores, each), color=LIGHT_BLUE, lw=1.2, label=label)
        if len(scores) >= 2 * group:
            label = f"mean of {group} episodes"
            axes.plot(*means(scores, group), color=DARK_BLUE, lw=2, label=label)
        axes.legend(loc="lower right", frameon=False)
    _over_episodes(axes, episodes)


def _draw_successes(axes: Axes, episodes: Sequence[EpisodeRecord], group: int) -> None:
    won = np.array([record.episode.outcome is Outcome.SUCCESS for record in episodes], float)
    dress(axes, "(b) successes per 100 episodes", "episodes", "successes")
    axes.set_ylim(-2, 112)
    if len(won) < SUCCESS_WINDOW:
        say(axes, f"{int(won.sum())} successes in {len(won)} episodes, fewer than 100")
    else:
        counted, values = means(SUCCESS_WINDOW * won, SUCCESS_WINDOW)
        if group > SUCCESS_WINDOW:
            axes.plot(counted, values, color=LIGHT_BLUE, lw=1.2, label="each 100 episodes")
            label = f"mean of {group} episodes"
            axes.plot(*means(SUCCESS_WINDOW * won, group), color=DARK_BLUE, lw=2, label=label)
        else:
            sliding = np.convolve(won, np.ones(SUCCESS_WINDOW), "valid")
            middles = np.arange(len(sliding)) + (SUCCESS_WINDOW + 1) / 2
            axes.plot(middles, sliding, color=LIGHT_BLUE, lw=1.2, label="any 100 in a row")
            axes.plot(counted, values, color=DARK_BLUE, lw=2, label="each 100 episodes")
        before = np.concatenate(([-1.0], np.maximum.accumulate(values)[:-1]))
        rises = values > before
        axes.scatter(
            counted[rises], values[rises], s=26, c=np.flatnonzero(rises), cmap="plasma",
            edgecolor="black", lw=0.5, zorder=3, label="new maximum",
        )  # fmt: skip
        best = int(np.argmax(values))
        axes.annotate(
            f"{values[best]:.0f}", (counted[best], values[best]), (0, 6),
            textcoords="offset points", ha="center", fontweight="bold",
        )  # fmt: skip
        axes.legend(loc="lower right", frameon=False)
    _over_episodes(axes, episodes)


def _over_episodes(axes: Axes, episodes: Sequence[EpisodeRecord]) -> None:
    axes.set_xlim(0, 1.04 * max(10, len(episodes)))
    _minutes(axes, np.arange(1, len(episodes) + 1), [record.time_s for record in episodes])


def _draw_evaluations(axes: Axes, tests: Sequence[EvaluationRecord]) -> None:
    title = "(c) success in the paper's test: one collision fails"
    dress(axes, title, "learner steps", "success, %")
    axes.set_ylim(-2, 112)
    tests = sorted(tests, key=lambda record: record.evaluation.learner_step)
    steps = np.array([record.evaluation.learner_step for record in tests], float)
    each = by_robots(tests)
    if len(each) == 1:
        _draw_tests(axes, tests, GREEN, "")
    for number, (robots, own) in enumerate(each.items() if len(each) > 1 else ()):
        dark = ROBOT_HUES[number % len(ROBOT_HUES)][1]
        _draw_tests(axes, own, dark, f"{robots} robot{'s' * (robots != 1)}, ")
    if tests:
        axes.legend(loc="lower right", frameon=False)
    else:
        say(axes, "no evaluations")
    last = max(10.0, steps.max(initial=0))
    axes.set_xlim(-0.02 * last, 1.04 * last)
    _minutes(axes, steps, [record.time_s for record in tests])


def by_robots(tests: Sequence[EvaluationRecord]) -> dict[int, list[EvaluationRecord]]:
    """The evaluations with each number of robots, in rising order."""
    numbers = sorted({record.evaluation.num_robots for record in tests})
    return {n: [r for r in tests if r.evaluation.num_robots == n] for n in numbers}


def _draw_tests(axes: Axes, tests: Sequence[EvaluationRecord], colour: str, who: str) -> None:
    """Plot the success over learner steps, with its interval, and mark the best."""
    steps = np.array([record.evaluation.learner_step for record in tests], float)
    rates = 100 * np.array([record.evaluation.success_rate for record in tests])
    bounds = 100 * np.array([record.evaluation.success_interval for record in tests])
    low, high = bounds.T
    interval = "" if who else "95 % interval"
    axes.fill_between(steps, low, high, color=colour, alpha=0.18, lw=0, label=interval)
    axes.vlines(steps, low, high, color=colour, alpha=0.4, lw=0.8)
    label = f"{who}{tests[-1].evaluation.episodes} starts each"
    axes.plot(steps, rates, color=colour, lw=1.8, marker="o", ms=4, label=label)
    best = int(np.argmax(rates))
    axes.annotate(
        f"{rates[best]:.1f} %", (steps[best], rates[best]), (0, 7),
        textcoords="offset points", ha="center" if best else "left", fontweight="bold",
        color=colour if who else None,
    )  # fmt: skip


def means(values: Float64Array, group: int) -> tuple[Float64Array, Float64Array]:
    """Middle episode and mean of each whole group."""
    whole = len(values) // group
    middles: Float64Array = group * (np.arange(whole, dtype=np.float64) + 0.5) + 0.5
    return middles, values[: whole * group].reshape(whole, group).mean(axis=1)


def say(axes: Axes, words: str) -> None:
    """Write words in the middle of empty axes."""
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", color="#777777")


def dress(axes: Axes, title: str, x: str, y: str) -> None:
    """Set title, labels, grid and number format."""
    axes.set_title(title, loc="left", fontsize=11)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color="#e4e4e4", lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}".replace(",", " "))
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))


def _minutes(axes: Axes, positions: Any, times_s: Sequence[float]) -> None:
    """Add a second axis at the top: the minutes at which the positions were reached."""
    if len(times_s) < 2 or times_s[-1] <= times_s[0] or positions[-1] <= positions[0]:
        return
    minutes = np.maximum.accumulate(np.asarray(times_s)) / 60
    slope = np.linspace(0, 1e-6, len(minutes))  # inverted below, so it must increase
    to_minutes = _interpolation(np.asarray(positions, float) + slope, minutes + slope)
    to_position = _interpolation(minutes + slope, np.asarray(positions, float) + slope)
    top = axes.secondary_xaxis("top", functions=(to_minutes, to_position))
    top.set_xlabel("minutes", fontsize=9)
    top.tick_params(labelsize=8)
    top.xaxis.set_major_locator(MaxNLocator(8))


def _interpolation(x: Float64Array, y: Float64Array) -> Callable[[Any], Any]:
    """Linear between the points, and beyond them with the mean slope."""
    slope = (y[-1] - y[0]) / (x[-1] - x[0])

    def at(value: Any) -> Any:
        value = np.asarray(value, float)
        inside = np.interp(value, x, y)
        return inside + slope * (np.minimum(0, value - x[0]) + np.maximum(0, value - x[-1]))

    return at


def trajectories(episodes: Sequence[Path2D], config: ArenaConfig, *outs: Path) -> None:
    """Plot a grid of episodes to `outs` (paper Fig. 8).

    Each robot's path is shaded from light (start) to dark (end) in its own hue.
    """
    columns = min(4, max(1, len(episodes)))
    rows = max(1, -(-len(episodes) // columns))
    figure = blank(3.1 * columns, 3.35 * rows)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, episode in zip(grid.flat, episodes, strict=False):
        draw_paths(axes, episode, config)
    explain_paths(figure, episodes)
    save(figure, *outs)


def explain_paths(figure: Figure, episodes: Sequence[Path2D]) -> None:
    """Add a legend of all that `draw_paths` draws."""
    if not episodes:
        return
    handles = [
        _disc("start", "none", START),
        Line2D([], [], color=ROBOT, lw=3, label="path"),
        _disc("end", ROBOT, ROBOT, alpha=0.35),
        _square("target", TARGET),
        Line2D([], [], color=WALL, lw=1.3, label="wall"),
    ]
    if any(len(episode.obstacles) for episode in episodes):
        handles.append(_disc("obstacle", OBSTACLE, OBSTACLE))
    explain(figure, handles)


def explain_arena(figure: Figure, *, obstacles: bool) -> None:
    """Add a legend of what the arena's own image shows."""
    handles = [
        _disc("robot", "white", "black"),
        _square("target", "blue"),
        Line2D([], [], color="red", lw=1.3, label="wall"),
    ]
    explain(figure, [*handles, *([_disc("obstacle", "lime", "lime")] if obstacles else [])])


def explain(figure: Figure, handles: Sequence[Line2D]) -> None:
    """Add a legend below the panels, in as many columns as the figure is wide."""
    columns = min(len(handles), max(1, int(figure.get_figwidth() / 0.9)))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=9,
        columnspacing=1.2,
        handletextpad=0.5,
    )


def _disc(label: str, face: str, edge: str, alpha: float = 1.0) -> Line2D:
    return Line2D(
        [], [], ls="", marker="o", ms=9, mfc=face, mec=edge, mew=1.4, alpha=alpha, label=label
    )


def _square(label: str, face: str) -> Line2D:
    return Line2D([], [], ls="", marker="s", ms=8, mfc=face, mec=face, label=label)


def save(figure: Figure, *outs: Path) -> None:
    """Write the figure to each path in the format of its suffix; MrcdrlError if that fails."""
    for out in outs:
        try:
            figure.savefig(out)
        except OSError as error:
            raise MrcdrlError(f"figure {out} cannot be written: {reason(error)}") from error


def check_suffix(path: Path, suffixes: Sequence[str]) -> None:
    """Raise MrcdrlError unless the path has one of these suffixes."""
    if path.suffix not in suffixes:
        *others, last = suffixes
        allowed = f"{', '.join(others)} or {last}"
        raise MrcdrlError(f"{path}: unsupported extension {path.suffix!r}; use {allowed}")


def draw_paths(axes: Axes, episode: Path2D, config: ArenaConfig) -> None:
    """Plot the arena and one episode's paths in it."""
    _draw_arena(axes, episode, config)
    radius = config.robot_radius_px
    for k in range(episode.robots.shape[1]):
        path = episode.robots[:, k, :2]
        light, dark = ROBOT_HUES[k % len(ROBOT_HUES)]
        shades = LinearSegmentedColormap.from_list(f"robot {k}", [light, dark])
        pieces = np.stack([path[:-1], path[1:]], axis=1)
        lines = LineCollection(list(pieces), cmap=shades, lw=3, capstyle="round", zorder=2)
        lines.set_array(np.arange(len(pieces)))
        axes.add_collection(lines)
        axes.add_patch(Circle(path[0], radius, fill=False, ec=START, lw=1.6, zorder=3))
        axes.add_patch(Circle(path[-1], radius, fc=dark, ec=dark, alpha=0.35, lw=1.6, zorder=3))
        heading = episode.robots[-1, k, 2]
        tip = path[-1] + radius * np.array([np.cos(heading), np.sin(heading)])
        axes.plot(*np.stack([path[-1], tip]).T, color=dark, lw=1.6, zorder=4)
    axes.set_title(f"{episode.outcome.value}, {len(episode.robots) - 1} frames", fontsize=9)


def _draw_arena(axes: Axes, episode: Path2D, config: ArenaConfig) -> None:
    size, side = config.size_px, config.target_size_px
    middle = config.wall_offset_px + config.wall_thickness_px / 2
    inside = size - 2 * middle
    axes.add_patch(Rectangle((0, 0), size, size, fc="#fafafa", ec="#888888", lw=0.8))
    axes.add_patch(Rectangle((middle, middle), inside, inside, fill=False, ec=WALL, lw=1.3))
    for x0, y0, x1, y1 in config.inner_walls_px:
        axes.plot([x0, x1], [y0, y1], color=WALL, lw=1.3)
    for x, y, radius in episode.obstacles:
        axes.add_patch(Circle((x, y), radius, fc=OBSTACLE, zorder=1))
    for x, y in episode.targets:
        axes.add_patch(Rectangle((x - side / 2, y - side / 2), side, side, fc=TARGET, zorder=1))
    axes.set_xlim(-5, size + 5)
    axes.set_ylim(size + 5, -5)  # y points down, as in the arena's image
    axes.set_aspect("equal")
