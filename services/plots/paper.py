"""The paper's figures for any arena and run: Figs. 1, 3, 7 and 10 (Figs. 6 and 8: `figures`).

Invariants: plotted with matplotlib's Figure on Agg, without global state.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Evaluation, Float64Array, Outcome, UInt8Array
from mrcdrl.services.monitor.records import SUCCESS_WINDOW, read_episodes, read_evaluations
from mrcdrl.services.plots.figures import (
    Path2D,
    blank,
    by_robots,
    draw_paths,
    dress,
    explain_arena,
    explain_paths,
    means,
    save,
    say,
)

SUFFIXES = (".png", ".svg")
_ROW_NAME = 32  # characters in a line, beside a panel of 3 inches
_STYLES = ("-", "--", ":", "-.")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")  # for numbers of robots of one run
_COLOURS = ("#123c73", "#c4500a", "#2a7f3f", "#6a3d9a", "#b01050", "#0a7a80", "#8a7400", "#444444")


@dataclass(frozen=True, slots=True)
class Sight:
    """What one robot sees of an arena, and where it lies there."""

    arena: UInt8Array  # [S, S], intensities of the whole arena
    pose: Float64Array  # [3], x px, y px, heading rad, of the robot
    view: UInt8Array  # [V, V], its image
    states: UInt8Array  # [K, S, V, V], of all robots, oldest image first


@dataclass(frozen=True, slots=True)
class Contender:
    """One row of a comparison."""

    name: str
    episodes: Sequence[Path2D]  # from the same starts in every row


def arenas(
    images: Sequence[UInt8Array], titles: Sequence[str], *outs: Path, obstacles: bool
) -> None:
    """Plot arenas side by side (Fig. 1); images: BGR [S, S, 3]; obstacles: whether any has some."""
    figure, panels = _panels(1, len(images), 3.6)
    for axes, image, title in zip(panels[0], images, titles, strict=True):
        axes.imshow(image[..., ::-1])
        axes.set_title(title, fontsize=10)
    explain_arena(figure, obstacles=obstacles)
    save(figure, *outs)


def sight(seen: Sight, config: ArenaConfig, *outs: Path) -> None:
    """Plot how a robot's image is made, and what each robot sees (Fig. 3).

    (a) the arena's intensities with the rectangle around one robot, zeros beyond the border; (b)
    that rectangle resized; (c) the state of every robot, one row each, oldest image first.
    """
    num, stack = seen.states.shape[:2]
    figure = blank(8.6 + 0.9 * stack, 4.4)
    widths = (4.3, 4.3, max(2, 0.9 * stack))
    left, middle, right = figure.subfigures(1, 3, squeeze=False, width_ratios=widths)[0]
    _show_window(left.subplots(), seen, config)
    axes = middle.subplots()
    axes.imshow(seen.view, cmap="gray", vmin=0, vmax=255)
    axes.set_title(f"(b) resized to {config.view_px} x {config.view_px}", fontsize=10)
    axes.set_axis_off()
    right.suptitle("(c) states", fontsize=10)
    for robot, row in enumerate(right.subplots(num, stack, squeeze=False)):
        for axes, image in zip(row, seen.states[robot], strict=True):
            axes.imshow(image, cmap="gray", vmin=0, vmax=255)
            axes.set(xticks=[], yticks=[])
        row[0].set_ylabel(f"robot {robot + 1}", fontsize=8)
    save(figure, *outs)


def comparison(rows: Sequence[Contender], config: ArenaConfig, *outs: Path) -> None:
    """Plot several policies from the same starts (Fig. 10): a row each, a column for each start.

    A row may have fewer episodes than others; its last panels stay empty.
    """
    figure, panels = _panels(len(rows), max(len(row.episodes) for row in rows), 3.1)
    for row, contender in zip(panels, rows, strict=True):
        for axes, episode in zip(row, contender.episodes, strict=False):
            draw_paths(axes, episode, config)
        row[0].set_axis_on()  # for its label alone
        row[0].set(xticks=[], yticks=[])
        row[0].spines[:].set_visible(False)
        row[0].set_ylabel(fill(contender.name, _ROW_NAME), fontsize=9, fontweight="bold")
    explain_paths(figure, [episode for row in rows for episode in row.episodes])
    save(figure, *outs)


def curves(run_dirs: Sequence[Path], out: Path) -> None:
    """Plot the successes of several runs over episodes (Figs. 7 g to i) and over learner steps.

    Raises RunDirectoryError for records of another version.
    """
    figure = blank(9, 7.5)
    training, test = figure.subplots(2, 1)
    dress(training, "(a) successes per 100 episodes of training", "episodes", "successes")
    dress(test, "(b) success in the paper's test", "learner steps", "success, %")
    for number, run_dir in enumerate(run_dirs):
        colour = _COLOURS[number % len(_COLOURS)]
        style = _STYLES[number // len(_COLOURS) % len(_STYLES)]
        line = {"color": colour, "ls": style, "label": run_dir.name}
        won = [record.episode.outcome is Outcome.SUCCESS for record in read_episodes(run_dir)]
        training.plot(*means(SUCCESS_WINDOW * np.array(won, float), SUCCESS_WINDOW), **line)
        each = by_robots(read_evaluations(run_dir)) or {0: []}  # named all the same
        for (robots, records), marker in zip(each.items(), cycle(_MARKERS)):
            tests = sorted((e.evaluation for e in records), key=_learner_step)
            steps = [e.learner_step for e in tests]
            if len(each) > 1:
                line |= {"label": f"{run_dir.name}, {robots} robots", "marker": marker}
            test.plot(steps, [100 * e.success_rate for e in tests], **line)
            bounds = 100 * np.array([e.success_interval for e in tests], float).reshape(-1, 2)
            test.fill_between(steps, *bounds.T, color=colour, alpha=0.15, lw=0)
    for axes in (training, test):
        axes.set_ylim(-2, 102)
        axes.set_xlim(0, max(SUCCESS_WINDOW, axes.get_xlim()[1]))
        if not any(len(line.get_xdata()) for line in axes.get_lines()):
            say(axes, "no records")
        for line in axes.get_lines():
            if len(line.get_xdata()) == 1 and line.get_marker() == "None":
                line.set_marker("o")  # a line of one point is not seen
        axes.legend(loc="lower right", fontsize=8, framealpha=0.8)
    save(figure, out)


def _learner_step(test: Evaluation) -> int:
    return test.learner_step


def _show_window(axes: Axes, seen: Sight, config: ArenaConfig) -> None:
    """Plot the arena on black, and the rectangle, which may reach beyond it."""
    size, crop = config.size_px, config.crop_px
    x, y, heading = seen.pose
    turn_deg = np.degrees(heading) + 90 if config.orientation == "heading_up" else 0.0
    axes.imshow(seen.arena, cmap="gray", vmin=0, vmax=255, extent=(0, size, size, 0))
    corner = (x - crop / 2, y - crop / 2)
    window = Rectangle(
        corner, crop, crop, angle=turn_deg, rotation_point="center",
        fill=False, ec="#ff9020", lw=1.6, clip_on=False,
    )  # fmt: skip
    axes.add_patch(window)
    axes.add_patch(Rectangle((0, 0), size, size, fill=False, ec="#777777", lw=0.8, ls=":"))
    places = np.concatenate([window.get_corners(), [(0, 0), (size, size)]])
    (left, top), (right, bottom) = places.min(axis=0) - 4, places.max(axis=0) + 4
    axes.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[], facecolor="black")
    axes.set_title("(a) intensity, zeros beyond the border", fontsize=10)


def _panels(rows: int, columns: int, side: float) -> tuple[Figure, np.ndarray]:
    """A figure and its axes [rows, columns] without frames; side: a panel's, in inches."""
    figure = blank(side * columns, (side + 0.25) * rows)
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    return figure, panels
