"""`mrcdrl experiment`: train every cell of a grid, and say in one table what each variant reached.

Invariants: killed at any moment, the same command goes on where it was; what is done is never run
again.
"""

import logging
import sys
import time
from collections.abc import Callable, Sequence
from datetime import timedelta
from pathlib import Path

from mrcdrl.common.config.arguments import Parser
from mrcdrl.common.errors import ConfigError, RunDirectoryError
from mrcdrl.common.runtime.files import atomic_write, reason
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.runs import runs_folder
from mrcdrl.services.monitor.records import to_line
from mrcdrl.services.tools.experiment.asked import named_like, print_states
from mrcdrl.services.tools.experiment.cell import CellFiles
from mrcdrl.services.tools.experiment.flags import add_cell_flags
from mrcdrl.services.tools.experiment.grid import read_grid
from mrcdrl.services.tools.experiment.runner import run_cells
from mrcdrl.services.tools.experiment.table import table

_LOG = logging.getLogger("experiment")
RESULTS = "results.jsonl"
_REPORT_S = 30.0


def main(argv: Sequence[str]) -> int:
    """Run the cells; return the exit code: 0 if all that were asked for are done."""
    arguments = parser().parse_args(argv)
    out = arguments.out or runs_folder() / "experiments" / arguments.grid.stem
    every = [CellFiles(cell, out) for cell in read_grid(arguments.grid)]
    asked = named_like(every, arguments.only)
    if not asked:
        names = ", ".join(files.cell.name for files in every)
        raise ConfigError(f"no cell is named like {arguments.only!r}; the cells are {names}")
    if arguments.list:
        print_states(asked, as_json=arguments.json)
        return 0
    stop = StopSignal().listen()
    command = " ".join(["mrcdrl experiment", *argv])
    try:
        (out / "cells").mkdir(parents=True, exist_ok=True)
        run_cells(asked, arguments.jobs, command, stop, reporter(asked))
        results = [result for result in (files.result() for files in every) if result]
        atomic_write(out / RESULTS, "".join(map(to_line, results)).encode())
    except OSError as error:
        raise RunDirectoryError(f"{out} cannot be written: {reason(error)}") from error
    if arguments.json:
        sys.stdout.writelines(map(to_line, results))
    else:
        sys.stdout.write(table(every))
        print(f"{out / RESULTS}: {len(results)} of {len(every)} results")
    return 0 if all(files.result() for files in asked) else 1


def parser() -> Parser:
    """The command's flags."""
    made = Parser(prog="mrcdrl experiment", description="Train a grid: settings and seeds.")
    made.add_argument("grid", type=Path, metavar="GRID", help="TOML file: see docs/experiments.md")
    add_cell_flags(made, "cell", out="runs/experiments/GRID", example="x-*", printed="results")
    return made


def reporter(cells: Sequence[CellFiles]) -> Callable[[int], None]:
    """Make what says how far the cells are, and how long the rest takes.

    It says so every half minute, and as cells end.
    """
    began_s = time.monotonic()
    before = sum(map(_fraction, cells))
    shown = {"s": -_REPORT_S, "done": -1}

    def report(at_work: int) -> None:
        done = sum(files.result() is not None for files in cells)
        elapsed_s = time.monotonic() - began_s
        if done == shown["done"] and elapsed_s - shown["s"] < _REPORT_S:
            return
        shown.update(s=elapsed_s, done=done)
        now = sum(map(_fraction, cells))
        left = time_left(elapsed_s, now - before, len(cells) - now)
        _LOG.info("%d of %d cells done, %d at work; %s left", done, len(cells), at_work, left)

    return report


def _fraction(files: CellFiles) -> float:
    return files.fraction() if files.result() is None else 1.0


def time_left(elapsed_s: float, made: float, rest: float) -> str:
    """Time for the rest of the cells at the pace so far; "unknown time" before there is any."""
    if made <= 0:
        return "unknown time"
    return str(timedelta(seconds=round(elapsed_s * rest / made)))
