"""The live screen of a run, and its state as one plain line.

Invariants: pure, built from RunState and `now` alone; fills the console's rows and columns, down to
80 x 24; nothing scrolls. Curves are in braille: two points a column, four levels a row.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from mrcdrl.common.runtime.names import printable
from mrcdrl.services.monitor.bottleneck import bottleneck
from mrcdrl.services.monitor.phase import Phase, counted, progress, thousands
from mrcdrl.services.monitor.records import SUCCESS_WINDOW
from mrcdrl.services.monitor.service_table import ROLE_STYLES, services
from mrcdrl.services.monitor.state import HISTORY_PERIOD, RunState

FIXED_ROWS = 12  # header, phase, ring, fill, epsilon, axes, footer and the headings
Point = tuple[float, float]
BAR = "━"
# Bits of the dots of U+2800, [column 0 or 1][row 0 (top) ... 3].
_DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))
_BLANK = 0x2800  # shown as a space, which every font has


@dataclass(frozen=True, slots=True)
class Screen:
    """The whole screen at `now`, laid out for its console."""

    state: RunState
    now: float
    run_dir: Path
    keys: str = ""  # what Ctrl-C does

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        state, now, width = self.state, self.now, options.max_width
        rows = Rows.of(options.height or console.size.height, state)
        lines: list[RenderableType] = [
            header(state, now, self.run_dir.name, width),
            phase(state),
            *ring(state, now),
            heading("processes"),
            services(state, now, rows.services),
            fill(state, width),
            exploration(state),
            curves(state, now, width, rows.curve),
            heading("evaluations", "newest first, with the 95 % interval"),
            evaluations(state, rows.evaluations),
            limit(state),
            log(state, rows.log),
            footer(self.run_dir, "" if state.ending else self.keys, width),
        ]
        yield Group(*lines)


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows for each part of variable height."""

    services: int
    curve: int
    evaluations: int
    log: int

    @classmethod
    def of(cls, height: int, state: RunState) -> "Rows":
        """Divide the console's height: what each list needs, within bounds; the curves get the
        rest."""
        free = max(8, height - FIXED_ROWS)
        services = min(max(len(state.services), 1), max(4, free * 2 // 5))
        rest = free - services
        log = min(max(len(state.log), 1), max(1, rest // 5))
        evaluations = min(max(len(state.evaluations), 1), max(1, (rest - log) * 2 // 5))
        return cls(services, rest - log - evaluations, evaluations, log)


def clock(seconds: float | None) -> str:
    """Time as 0:12:34; a dash for None, and for no end in sight."""
    if seconds is None or seconds == math.inf:
        return "–"
    whole = int(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"


def told(state: RunState, now: float) -> str:
    """The time, and since when if that is not the run's start."""
    return f"{clock(now)} {state.since}".rstrip()


def heading(title: str, more: str = "", style: str = "grey62") -> Rule:
    text = Text(title, style="bold").append(f"  {more}" if more else "", style=f"not bold {style}")
    return Rule(text, align="left", style="grey37")


def header(state: RunState, now: float, name: str, width: int) -> Text:
    """One bar with the run's name, arena and agent, its time and the time left."""
    config = state.config
    numbers = ", ".join(map(str, config.arena.numbers))
    robots = f"{numbers} robot{'s' * (config.arena.num_robots != 1)}"
    left = f" mrcdrl  {printable(name)}  {robots} · {config.agent.kind}"
    left += f" · {config.arena.target_layout} targets"
    remaining = state.time_left_s(now)
    right = f" {told(state, now)}" + (
        f"  {clock(remaining)} left " if remaining is not None else " "
    )
    return at_both_ends(left, right, width, "bold white on grey23")


def footer(run_dir: Path, keys: str, width: int) -> Text:
    """One line with the run's folder, and what Ctrl-C does."""
    return at_both_ends(f"folder {printable(str(run_dir))}", f" {keys}", width, "grey62")


def at_both_ends(left: str, right: str, width: int, style: str) -> Text:
    """One line of `width` cells; where both do not fit, the left text is cut."""
    line = Text(left, style=style, no_wrap=True, overflow="ellipsis")
    line.truncate(max(0, width - cell_len(right)), overflow="ellipsis", pad=True)
    return line.append(right)


def phase(state: RunState) -> Text:
    """What the run is doing, or what it waits for."""
    now = progress(state)
    style = "bold green" if now.phase is Phase.LEARNING else "bold yellow"
    words, rest = str(now.phase), str(now).removeprefix(now.phase)
    return Text(no_wrap=True, overflow="ellipsis").append(words, style=style).append(rest)


def ring(state: RunState, now: float) -> list[Text]:
    """The ring with the rate on each arrow, and the counters below."""
    rate = {n: state.per_second(n, now) for n in ("robot_steps", "samples", "learner_steps")}
    line = Text(no_wrap=True, overflow="ellipsis").append("↻ ", style="grey62")
    _stage(line, state, "actor")
    line.append(f" ─{thousands(rate['robot_steps'])}/s→ ", style="white")
    _stage(line, state, "replay")
    line.append(f" ─{thousands(rate['samples'])}/s→ ", style="white")
    _stage(line, state, "learner")
    line.append(f" ─{rate['learner_steps']:.0f}/s→ ", style="white")
    line.append(f"weights v{state.weights_version}", style="bold yellow")
    line.append(" → ", style="white")
    _stage(line, state, "evaluator")
    counters = (
        f"{thousands(state.env_steps)} env steps · {thousands(state.robot_steps)} robot steps · "
        f"{thousands(state.learner_steps)} learner steps · "
        f"{thousands(state.per_second('env_steps', now))} env steps/s"
    )
    return [line, Text(counters, style="grey62", no_wrap=True, overflow="ellipsis")]


def _stage(line: Text, state: RunState, role: str) -> None:
    count = len(state.alive(role))
    name = f"{count} actor{'s' * (count != 1)}" if role == "actor" else role
    style = f"bold {ROLE_STYLES[role]}" if count else "bold red"
    line.append(name if count else f"no {role}", style=style)


def fill(state: RunState, width: int) -> Text:
    """The fill level of replay."""
    size, capacity = state.replay_size, max(1, state.replay_capacity)
    numbers = f" {thousands(size)} of {thousands(capacity)}"
    ratio = state.samples_per_insert
    if ratio is not None:
        numbers += f" · {ratio:.2f} samples per insert"
    length = max(4, width - len("replay  ") - len(numbers) - 1)
    done = round(length * min(1.0, max(0.0, size / capacity)))
    line = Text(no_wrap=True).append("replay  ", style=ROLE_STYLES["replay"])
    line.append(BAR * done, style="blue").append(BAR * (length - done), style="grey23")
    return line.append(numbers)


def exploration(state: RunState) -> Text:
    """Epsilon, and the latest training episodes."""
    line = Text(no_wrap=True, overflow="ellipsis").append("ε  ", style="cyan")
    epsilons = state.epsilons
    if epsilons is None:
        line.append("–")
    else:
        low, high = (f"{epsilon:.3g}" for epsilon in epsilons)
        line.append(low if low == high else f"{low} … {high}")
    successes, of = state.recent_successes
    line.append(f"   {thousands(state.episodes)} episodes · ")
    return line.append(f"{successes} successes in the last {of}", style="bold")


def curves(state: RunState, now: float, width: int, height: int) -> Table:
    """Successes per 100 episodes over episodes, and evaluation success over minutes."""
    table = Table.grid(expand=True, padding=(0, 1, 0, 0))
    table.add_column(ratio=1)
    table.add_column(ratio=1)
    inner = max(8, width // 2 - 6)
    training = [
        (SUCCESS_WINDOW + HISTORY_PERIOD * i, float(successes))
        for i, successes in enumerate(state.success_history)
    ]
    tests = [(r.time_s / 60, 100 * r.evaluation.success_rate) for r in state.weakest]
    rates = [rate for _, rate in tests]
    now_and_best = state.successes_per_100 is not None
    trained = f"{state.successes_per_100}, best {state.max_successes}" if now_and_best else "–"
    tested = f"{rates[-1]:.1f} %, best {max(rates):.1f} %" if tests else "–"
    if state.config.arena.mixes_numbers:
        tested = f"of the weakest number: {tested}"
    table.add_row(
        heading("successes per 100", trained, "cyan"),
        heading("test success", tested, "green"),
    )
    table.add_row(
        _plot(training, max(state.episodes, SUCCESS_WINDOW), "episodes", inner, height, "cyan"),
        _plot(tests, max(now / 60, 1.0), "min", inner, height, "green"),
    )
    return table


def _plot(
    points: Sequence[Point], right: float, unit: str, width: int, height: int, style: str
) -> Text:
    """A curve with its axes: 0 ... 100 upwards, 0 ... right across."""
    labels = {_row(value, height): str(value) for value in _ticks(height)}
    text = Text(no_wrap=True)
    for row, line in enumerate(braille_curve(points, right, width, height)):
        label = labels.get(row, "")
        text.append(f"{label:>3}{'┤' if label else '│'}", style="grey50")
        text.append(f"{line}\n", style=style)
    return text.append(f"   └{_x_axis(right, unit, width)}", style="grey50")


def _ticks(height: int) -> tuple[int, ...]:
    """The values that the axis upwards names."""
    if height >= 9:
        return (0, 25, 50, 75, 100)
    return (0, 50, 100) if height >= 3 else (0, 100)


def _row(value: float, height: int) -> int:
    """The row of a value of 0 ... 100, from the top."""
    top = 4 * height - 1
    return (top - round(value / 100 * top)) // 4


def _x_axis(right: float, unit: str, width: int) -> str:
    """The axis across, named at its left end, at a round number near its middle, at its right."""
    end = f" {thousands(right)} {unit}"
    line = "0 ".ljust(max(0, width - len(end)), "─")
    digits = -math.floor(math.log10(right / 2))
    middle = round(right / 2, digits)
    label = f" {thousands(middle)} "
    begin = round(middle / right * (width - 1)) - len(label) // 2
    if digits <= 0 and begin > 2 and begin + len(label) < len(line):
        line = line[:begin] + label + line[begin + len(label) :]
    return line + end


def resample(points: Sequence[Point], right: float, num: int) -> list[float | None]:
    """The values at `num` places spread evenly over 0 ... right.

    Means where several points fall on one place, linear between points, None outside them.
    """
    finite = [point for point in points if np.isfinite(point).all()]
    if not finite:
        return [None] * num
    xs, ys = np.array(finite).T
    places = np.clip(xs / right * (num - 1), 0, num - 1)
    nearest = np.rint(places).astype(int)
    counts = np.bincount(nearest, minlength=num)
    sums = np.bincount(nearest, ys, num)
    known = np.flatnonzero(counts)
    values = np.interp(np.arange(num), known, sums[known] / counts[known])
    return [float(v) if known[0] <= x <= known[-1] else None for x, v in enumerate(values)]


def braille_curve(points: Sequence[Point], right: float, width: int, height: int) -> list[str]:
    """The curve of `points`, x in 0 ... right and y in 0 ... 100, in `height` lines.

    Neighbouring points are joined by vertical strokes; values outside are drawn at the edge.
    """
    cells = [[_BLANK] * width for _ in range(height)]
    top = 4 * height - 1
    before: int | None = None
    for x, value in enumerate(resample(points, right, 2 * width)):
        if value is None:
            continue
        level = top - round(min(100.0, max(0.0, value)) / 100 * top)
        start = level if before is None else before + (level > before) - (level < before)
        for y in range(min(start, level), max(start, level) + 1):
            cells[y // 4][x // 2] |= _DOTS[x % 2][y % 4]
        before = level
    return ["".join(map(chr, row)).replace(chr(_BLANK), " ") for row in cells]


def evaluations(state: RunState, num_rows: int) -> Text:
    """The latest evaluations, newest first, the best one marked."""
    text = Text(no_wrap=True, overflow="ellipsis")
    best = state.best_evaluation
    for record in reversed(state.evaluations[-num_rows:]):
        e = record.evaluation
        low, high = e.success_interval
        starred = best is not None and e is best.evaluation
        text.append("\n" if text else "").append("★" if starred else " ", style="yellow")
        text.append(f" {clock(record.time_s):>7}  v{e.weights_version:<6}")
        if state.config.arena.mixes_numbers:
            text.append(f"{e.num_robots:>2} robots ")
        text.append(f"{e.success_rate:6.1%} success", style="bold green")
        text.append(f" ({100 * low:.0f}–{100 * high:.0f})".ljust(9), style="grey62")
        text.append(f"{e.collision_rate:6.1%} collision {e.timeout_rate:6.1%} time-out")
        text.append(f"  of {e.episodes}", style="grey62")
    return text if text else Text(f"  none {state.since or 'yet'}", style="grey62")


def limit(state: RunState) -> Rule:
    """The bottleneck, once the ring turns; heads the log."""
    return heading(
        "bottleneck", "–" if progress(state).waiting_for else bottleneck(state), "yellow"
    )


def log(state: RunState, num_rows: int) -> Text:
    """The latest warnings, newest at the bottom."""
    lines = list(state.log)[-num_rows:]
    return Text("\n".join(lines), style="yellow", no_wrap=True, overflow="ellipsis")


def tests_line(state: RunState) -> str:
    """The latest success in the test: "93.0%", or of each number of robots "1: 99.0% 4: 93.0%"."""
    rates = {n: record.evaluation.success_rate for n, record in state.last_by_robots.items()}
    if state.config.arena.mixes_numbers:
        return " ".join(f"{number}: {rates[number]:.1%}" for number in sorted(rates)) or "–"
    last = state.last_evaluation
    return f"{last.evaluation.success_rate:.1%}" if last else "–"


def plain_line(state: RunState, now: float) -> str:
    """The state as one line for a log, without colours."""
    successes, of = state.recent_successes
    test = tests_line(state)
    doing = progress(state)
    fields = [
        told(state, now),
        str(doing),
        counted(len(state.alive("actor")), "actor"),
        f"robot steps {state.robot_steps} ({state.per_second('robot_steps', now):.0f}/s)",
        f"replay {state.replay_size}/{state.replay_capacity}",
        f"learner steps {state.learner_steps} ({state.per_second('learner_steps', now):.0f}/s)",
        f"weights v{state.weights_version}",
        f"successes {successes}/{of}",
        f"evaluation {test}",
    ]
    if not doing.waiting_for:
        fields.append(f"bottleneck: {bottleneck(state)}")
    remaining = state.time_left_s(now)
    if remaining is not None:
        fields.insert(2, f"{clock(remaining)} left")
    return "  ".join(fields).replace("\N{NO-BREAK SPACE}", " ")
