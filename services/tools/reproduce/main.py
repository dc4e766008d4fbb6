"""`mrcdrl reproduce`: train what the paper's tables and figures need, and report on its claims.

Invariants: killed at any moment, the same command goes on where it was; what is done is never run
again; a report says what is missing.
"""

import dataclasses
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.errors import ConfigError, RunDirectoryError
from mrcdrl.common.runtime.files import atomic_write, reason
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.runs import runs_folder
from mrcdrl.services.monitor.records import to_line
from mrcdrl.services.tools.experiment.asked import named_like, print_states
from mrcdrl.services.tools.experiment.cell import CellFiles
from mrcdrl.services.tools.experiment.main import RESULTS, reporter
from mrcdrl.services.tools.experiment.runner import run_cells
from mrcdrl.services.tools.progress import Progress
from mrcdrl.services.tools.reproduce.drawing import Figures
from mrcdrl.services.tools.reproduce.flags import ALL, REPORT, parser
from mrcdrl.services.tools.reproduce.keeping import keep_weights
from mrcdrl.services.tools.reproduce.protocol import SCALES, SMOKE, plan
from mrcdrl.services.tools.reproduce.report import write_report
from mrcdrl.services.tools.reproduce.runs import Runs, read_runs

_LOG = logging.getLogger("reproduce")


def main(argv: Sequence[str]) -> int:
    """Train and report; return the exit code: 0 if all that was asked for is done."""
    arguments = parser().parse_args(argv)
    scale = SMOKE if arguments.smoke else SCALES[arguments.scale]
    out = arguments.out or runs_folder() / "reproduce" / scale.name
    planned = plan(scale)
    every = [CellFiles(cell, out) for cell in planned.part(ALL)]
    part = ALL if arguments.part == REPORT else arguments.part
    named = {cell.name for cell in planned.part(part)}
    asked = named_like((files for files in every if files.cell.name in named), arguments.only)
    if not asked:
        raise ConfigError(
            f"scale {scale.name} has no runs for {part} named like {arguments.only!r}; "
            f"`mrcdrl reproduce --scale {scale.name} --list` lists all"
        )
    if arguments.list:
        print_states(asked, as_json=arguments.json)
        return 0
    try:
        (out / "cells").mkdir(parents=True, exist_ok=True)
        if arguments.part != REPORT:
            stop = StopSignal().listen()
            command = " ".join(["mrcdrl reproduce", *argv])
            run_cells(asked, arguments.jobs, command, stop, reporter(asked))
            if stop.is_set():
                _LOG.info("the same command goes on; `mrcdrl reproduce report` draws what is there")
                return 1
        runs = read_runs(planned, every)
        _write(runs, every, out, as_json=arguments.json)
    except OSError as error:
        raise RunDirectoryError(f"{out} cannot be written: {reason(error)}") from error
    done = arguments.part == REPORT or all(files.cell.name in runs.results for files in asked)
    return 0 if done else 1


def _write(runs: Runs, every: Sequence[CellFiles], out: Path, *, as_json: bool) -> None:
    """Write results, weights, figures and report; print the verdicts."""
    atomic_write(out / RESULTS, "".join(map(to_line, runs.results.values())).encode())
    with Progress() as progress:
        progress.stage("weights")
        for missing in keep_weights(runs, out):
            _LOG.warning("%s", missing)
        Figures(runs, out, progress).draw()
        claims = write_report(runs, every, out)
    if as_json:
        sys.stdout.writelines(to_line(dataclasses.asdict(claim)) for claim in claims)
        return
    for claim in claims:
        print(f"{claim.verdict:<16} {claim.number:<3} {claim.text}")
    print(f"{out / 'report.html'}: {len(runs.results)} of {len(every)} runs")
