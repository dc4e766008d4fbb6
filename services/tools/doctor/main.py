"""`mrcdrl doctor`: check this machine, and a run, and say how to fix what is wrong."""

import argparse
import dataclasses
import json
from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mrcdrl.common.config import DEFAULT_PRESET, Config, load_config
from mrcdrl.common.config.arguments import Parser, add_config_flag, add_config_flags, overrides
from mrcdrl.common.errors import EndpointError
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.runs import add_run, runs_folder
from mrcdrl.common.sync.joining import Joining
from mrcdrl.services.tools.doctor.finding import Finding, failed
from mrcdrl.services.tools.doctor.machine import of_this_machine
from mrcdrl.services.tools.doctor.run import look

_STYLES = {"ok": "green", "warning": "yellow", "failed": "bold red"}


def main(argv: Sequence[str]) -> int:
    """Check and show the findings; return 1 if a check failed."""
    arguments = parser().parse_args(argv)
    config: Config | None = None
    found: list[Finding] = []
    if arguments.run:
        found, config = look_at_run(arguments)
    own = config or load_config(arguments.config or DEFAULT_PRESET, overrides(arguments))
    found += of_this_machine(own, runs_folder(arguments.run_dir), running=config is not None)
    if arguments.json:
        lines = [dataclasses.asdict(finding) for finding in found]
        Console(soft_wrap=True).out(json.dumps(lines), highlight=False)
    else:
        show(found, Console())
    return int(any(finding.verdict == "failed" for finding in found))


def parser() -> Parser:
    """Make the command's parser."""
    made = Parser(prog="mrcdrl doctor", description="Check this machine and a run.")
    add_run(made, "also check this live run")
    made.add_argument("--connect", action="append", help="its endpoint, such as tcp/HOST:7447")
    add_config_flag(made, of_run=True)
    made.add_argument("--json", action="store_true", help="print the findings as JSON")
    made.set_defaults(id="doctor", transport=None)
    add_config_flags(made)
    return made


def look_at_run(arguments: argparse.Namespace) -> tuple[list[Finding], Config | None]:
    """Check the run that the flags name; also return its configuration."""
    try:
        joining = Joining.from_arguments(arguments)
    except EndpointError as error:
        fix = "start it, or go on with it by `mrcdrl train --resume`; its logs/ say why it ended"
        return [failed("endpoint", str(error), fix)], None
    return look(joining, StopSignal())


def show(found: Iterable[Finding], console: Console) -> None:
    """Print a line for each finding, and below it how to fix it."""
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in found:
        text = Text(finding.said)
        if finding.fix:
            text.append(f"\n→ {finding.fix}", style="bold")
        table.add_row(Text(finding.verdict, _STYLES[finding.verdict]), finding.check, text)
    console.print(table)
