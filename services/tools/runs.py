"""`mrcdrl runs`: a table of the runs in a folder, those active last at the end."""

import dataclasses
import json
import sys
import time
from collections.abc import Iterable, Sequence

from rich.console import Console, JustifyMethod
from rich.table import Table
from rich.text import Text

from mrcdrl.common.config.arguments import Parser
from mrcdrl.common.runtime.runs import add_run_dir, run_paths, runs_folder
from mrcdrl.services.monitor.run_info import RunInfo, State, run_info
from mrcdrl.services.monitor.stopping import rule_of

_UNKNOWN = "–"
_WIDE = 200  # columns: names stay whole, and a narrow terminal wraps lines
_COLUMNS: dict[str, JustifyMethod] = {
    "name": "left",
    "state": "left",
    "robots": "right",
    "kind": "left",
    "preset": "left",
    "best": "right",
    "steps": "right",
    "minutes": "right",
    "disk": "right",
    "active": "right",
}
_STYLES = {
    State.RUNNING: "green",
    State.ENDED: "",
    State.STOPPED: "yellow",
    State.FAILED: "bold red",
    State.KILLED: "red",
}


def main(argv: Sequence[str]) -> int:
    """Print the runs; return the exit code."""
    arguments = parser().parse_args(argv)
    folder = runs_folder(arguments.run_dir)
    found = sorted(map(run_info, run_paths(folder)), key=lambda run: run.active_s)
    if arguments.json:
        sys.stdout.writelines(f"{json.dumps(dataclasses.asdict(run))}\n" for run in found)
    elif found:
        Console(width=_WIDE).print(table(found, time.time()))
    else:
        sys.stderr.write(f"there are no runs in {folder.resolve()}\n")
    return 0


def table(runs: Iterable[RunInfo], now_s: float) -> Table:
    """A row for each run; now_s: since the epoch."""
    made = Table(box=None, pad_edge=False, header_style="bold")
    for name, justify in _COLUMNS.items():
        made.add_column(name, justify=justify, no_wrap=True)
    for run in runs:
        made.add_row(
            run.name,
            Text(state_text(run), _STYLES[run.state]),
            _UNKNOWN if run.robots is None else str(run.robots),
            run.kind or _UNKNOWN,
            _UNKNOWN if run.preset is None else run.preset + f" +{run.changed}" * bool(run.changed),
            _UNKNOWN if run.best_success is None else f"{run.best_success:.1%}",
            _UNKNOWN if run.learner_steps is None else f"{run.learner_steps:,}".replace(",", " "),
            _UNKNOWN if run.minutes is None else f"{run.minutes:.1f}",
            size_text(run.disk_bytes),
            age_text(now_s - run.active_s),
        )
    return made


def state_text(run: RunInfo) -> str:
    """The state, and the rule that ended the run."""
    rule = rule_of(run.stop_reason or "")
    return f"{run.state} ({rule})" if rule else str(run.state)


def age_text(seconds: float) -> str:
    """A time that has passed, such as 3 h ago."""
    for unit, length_s in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= length_s:
            return f"{seconds // length_s:.0f} {unit} ago"
    return "now"


def size_text(num_bytes: float) -> str:
    """Bytes in the unit that fits, such as 1.2 GB."""
    for unit in ("B", "kB", "MB"):
        if num_bytes < 1000:
            return f"{num_bytes:.0f} {unit}"
        num_bytes /= 1000
    return f"{num_bytes:.1f} GB"


def parser() -> Parser:
    """The command's flags."""
    made = Parser(prog="mrcdrl runs", description="Show the runs in a folder.")
    add_run_dir(made)
    made.add_argument("--json", action="store_true", help="print JSON, one object a line")
    return made
