"""The live screen of a run, and its state as one plain line.

Invariants: pure, built from RunState and `now` alone; fills the console's rows and columns, down to
80 x 24; nothing scrolls. Curves are in braille: two points a column, four levels a row.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from mrcdrl.services.monitor.bottleneck import bottleneck, bottleneck_line, thousands, waiting_for
from mrcdrl.services.monitor.service_table import ROLE_STYLES, services
from mrcdrl.services.monitor.state import RunState

FIXED_ROWS = 9  # header, ring, fill, epsilon and the headings
BAR = "━"
# Bits of the dots of U+2800, [column 0 or 1][row 0 (top) ... 3].
_DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))
_BLANK = 0x2800


@dataclass(frozen=True, slots=True)
class Screen:
    """The whole screen at `now`, laid out for its console."""

    state: RunState
    now: float
    name: str  # of the run

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        rows = Rows.of(options.height or console.size.height, len(self.state.services))
        width = options.max_width
        lines: list[RenderableType] = [
            header(self.state, self.now, self.name, width),
            *ring(self.state, self.now),
            heading("processes"),
            services(self.state, self.now, rows.services),
            fill(self.state, width),
            exploration(self.state),
            curves(self.state, width, rows.curve),
            heading("evaluations", "newest first, with the 95 % interval"),
            evaluations(self.state, rows.evaluations),
            limit(self.state),
            log(self.state, rows.log),
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
    def of(cls, height: int, num_services: int) -> "Rows":
        """Divide the console's height: services first, then curves, then the rest."""
        free = max(8, height - FIXED_ROWS)
        services = min(max(num_services, 1), max(4, free * 2 // 5))
        rest = free - services
        curve = min(8, max(2, rest * 2 // 5))
        log = max(1, (rest - curve) * 2 // 5)
        return cls(services, curve, max(1, rest - curve - log), log)


def clock(seconds: float | None) -> str:
    """Time as 0:12:34; a dash for None."""
    if seconds is None:
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
    robots = f"{config.arena.num_robots} robot{'s' * (config.arena.num_robots != 1)}"
    left = f" mrcdrl  {name}  {robots} · {config.agent.kind}"
    left += f" · {config.arena.target_layout} targets"
    remaining = state.time_left_s(now)
    right = told(state, now) + (f"  {clock(remaining)} left " if remaining is not None else " ")
    room = max(0, width - len(right) - 1)
    return Text(f"{left[:room]:<{room}} {right}", style="bold white on grey23", no_wrap=True)


def ring(state: RunState, now: float) -> list[Text]:
    """The ring with the rate on each arrow, and the counters below."""
    rate = {n: state.per_second(n, now) for n in ("robot_steps", "samples", "learner_steps")}
    line = Text(no_wrap=True, overflow="ellipsis").append("↻ ", style="grey62")
    _stage(line, state, "actor", "actors")
    line.append(f" ─{thousands(rate['robot_steps'])}/s→ ", style="white")
    _stage(line, state, "replay", "replay")
    line.append(f" ─{thousands(rate['samples'])}/s→ ", style="white")
    _stage(line, state, "learner", "learner")
    line.append(f" ─{rate['learner_steps']:.0f}/s→ ", style="white")
    line.append(f"weights v{state.weights_version}", style="bold yellow")
    line.append(" → ", style="white")
    _stage(line, state, "evaluator", "evaluator")
    counters = (
        f"{thousands(state.env_steps)} env steps · {thousands(state.robot_steps)} robot steps · "
        f"{thousands(state.learner_steps)} learner steps · "
        f"{thousands(state.per_second('env_steps', now))} env steps/s"
    )
    return [line, Text(counters, style="grey62", no_wrap=True, overflow="ellipsis")]


def _stage(line: Text, state: RunState, role: str, name: str) -> None:
    count = len(state.alive(role))
    style = f"bold {ROLE_STYLES[role]}" if count else "bold red"
    line.append(f"{count} {name}" if role == "actor" else name, style=style)


def fill(state: RunState, width: int) -> Text:
    """The fill level of replay."""
    size, capacity = state.replay_size, max(1, state.replay_capacity)
    numbers = f" {thousands(size)} of {thousands(capacity)}"
    ratio = state.samples_per_insert
    if ratio is not None:
        numbers += f" · {ratio:.2f} samples per insert"
    length = max(4, width - len("replay  ") - len(numbers) - 1)
    done = round(length * min(1.0, size / capacity))
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


def curves(state: RunState, width: int, height: int) -> Table:
    """Successes per 100 episodes and evaluation success, side by side."""
    table = Table.grid(expand=True, padding=(0, 1, 0, 0))
    table.add_column(ratio=1)
    table.add_column(ratio=1)
    inner = max(8, width // 2 - 6)
    tests = [100 * record.evaluation.success_rate for record in state.evaluations]
    now_and_best = state.successes_per_100 is not None
    training = f"{state.successes_per_100}, best {state.max_successes}" if now_and_best else "–"
    testing = f"{tests[-1]:.1f} %, best {max(tests):.1f} %" if tests else "–"
    table.add_row(
        heading("successes per 100", training, "cyan"),
        heading("evaluation", testing, "green"),
    )
    table.add_row(
        _curve(state.success_history, inner, height, "cyan"),
        _curve(tests, inner, height, "green"),
    )
    return table


def _curve(values: Sequence[float], width: int, height: int, style: str) -> Text:
    text = Text(no_wrap=True)
    for row, line in enumerate(braille_curve(values, width, height, 0, 100)):
        label = "100" if row == 0 else "  0" if row == height - 1 else "   "
        edge = "┤" if label.strip() else "│"
        text.append(f"{label}{edge}", style="grey50").append(line, style=style)
        text.append("\n" if row < height - 1 else "")
    return text


def resample(values: Sequence[float], num_points: int) -> list[float]:
    """Means over equal groups of many values, linear interpolation between few."""
    count = len(values)
    if count == 0:
        return []
    if count < num_points:
        return [_between(values, i * (count - 1) / (num_points - 1)) for i in range(num_points)]
    bounds = [i * count // num_points for i in range(num_points + 1)]
    return [sum(values[a:b]) / (b - a) for a, b in itertools.pairwise(bounds)]


def _between(values: Sequence[float], position: float) -> float:
    """The value at a position between two indices."""
    index = min(int(position), len(values) - 1)
    after = min(index + 1, len(values) - 1)
    return values[index] + (position - index) * (values[after] - values[index])


def braille_curve(
    values: Sequence[float], width: int, height: int, low: float, high: float
) -> list[str]:
    """The curve of `values` between low and high, in `height` lines of `width` characters.

    Neighbouring points are joined by vertical strokes; values outside are drawn at the edge.
    """
    cells = [[_BLANK] * width for _ in range(height)]
    top = 4 * height - 1
    before: int | None = None
    for x, value in enumerate(resample(values, 2 * width)):
        fraction = min(1.0, max(0.0, (value - low) / (high - low)))
        level = top - round(fraction * top)
        start = level if before is None else before + (level > before) - (level < before)
        for y in range(min(start, level), max(start, level) + 1):
            cells[y // 4][x // 2] |= _DOTS[x % 2][y % 4]
        before = level
    return ["".join(map(chr, row)) for row in cells]


def evaluations(state: RunState, num_rows: int) -> Text:
    """The latest evaluations, newest first, the best one marked."""
    text = Text(no_wrap=True, overflow="ellipsis")
    best = state.best_evaluation
    for record in reversed(state.evaluations[-num_rows:]):
        e = record.evaluation
        low, high = e.success_interval
        text.append("\n" if text else "").append("★" if record is best else " ", style="yellow")
        text.append(f" {clock(record.time_s):>7}  v{e.weights_version:<6}")
        text.append(f"{e.success_rate:6.1%} success", style="bold green")
        text.append(f" ({100 * low:.0f}–{100 * high:.0f})".ljust(9), style="grey62")
        text.append(f"{e.collision_rate:6.1%} collision{e.timeout_rate:6.1%} time-out")
        text.append(f"  of {e.episodes}", style="grey62")
    return text if text else Text(f"  none {state.since or 'yet'}", style="grey62")


def limit(state: RunState) -> Rule:
    """The bottleneck, or what the run waits for; heads the log."""
    waiting = waiting_for(state)
    return heading(waiting or "bottleneck", "" if waiting else bottleneck(state), "yellow")


def log(state: RunState, num_rows: int) -> Text:
    """The latest warnings, newest at the bottom."""
    lines = list(state.log)[-num_rows:]
    return Text("\n".join(lines), style="yellow", no_wrap=True, overflow="ellipsis")


def plain_line(state: RunState, now: float) -> str:
    """The state as one line for a log, without colours."""
    successes, of = state.recent_successes
    last = state.last_evaluation
    test = f"{last.evaluation.success_rate:.1%}" if last else "–"
    fields = [
        told(state, now),
        f"{len(state.alive('actor'))} actors",
        f"robot steps {state.robot_steps} ({state.per_second('robot_steps', now):.0f}/s)",
        f"replay {state.replay_size}/{state.replay_capacity}",
        f"learner steps {state.learner_steps} ({state.per_second('learner_steps', now):.0f}/s)",
        f"weights v{state.weights_version}",
        f"successes {successes}/{of}",
        f"evaluation {test}",
        bottleneck_line(state),
    ]
    remaining = state.time_left_s(now)
    if remaining is not None:
        fields.insert(1, f"{clock(remaining)} left")
    return "  ".join(fields).replace("\N{NO-BREAK SPACE}", " ")
