"""`mrcdrl doctor`: does this machine, and a run, have what is needed; and how to mend it."""

import argparse
import dataclasses
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.config.arguments import Parser, add_config_flags, overrides
from mrcdrl.common.errors import EndpointError
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.joining import Joining
from mrcdrl.services.tools.doctor.finding import Finding, failed
from mrcdrl.services.tools.doctor.machine import of_this_machine
from mrcdrl.services.tools.doctor.run import look

_STYLES = {"ok": "green", "warning": "yellow", "failed": "bold red"}


def main(argv: Sequence[str]) -> int:
    """Check and show; 1 where something failed."""
    arguments = parser().parse_args(argv)
    config: Config | None = None
    found: list[Finding] = []
    if arguments.run:
        found, config = look_at_run(arguments)
    own = config or load_config(arguments.config, overrides(arguments))
    found += of_this_machine(own, arguments.run_dir, running=config is not None)
    if arguments.json:
        lines = [dataclasses.asdict(finding) for finding in found]
        Console(soft_wrap=True).out(json.dumps(lines), highlight=False)
    else:
        show(found, Console())
    return int(any(finding.verdict == "failed" for finding in found))


def parser() -> Parser:
    """The command's flags."""
    made = Parser(prog="mrcdrl doctor", description="What a run needs, and how to mend it.")
    made.add_argument("--run", help="the name of a run that is up, to look at it too")
    made.add_argument("--connect", action="append", help="its endpoint, such as tcp/HOST:7447")
    made.add_argument("--run-dir", type=Path, default=Path("runs"), help="where runs are kept")
    made.add_argument("--config", help="a preset or a TOML file; by default the run's")
    made.add_argument("--json", action="store_true", help="as JSON, a list of what was found")
    made.set_defaults(id="doctor")
    add_config_flags(made)
    return made


def look_at_run(arguments: argparse.Namespace) -> tuple[list[Finding], Config | None]:
    """What was found of the run that the flags name, and its configuration."""
    try:
        joining = Joining.from_arguments(arguments)
    except EndpointError as error:
        return [failed("endpoint", str(error), "start the run, or give --connect")], None
    return look(joining, StopSignal())


def show(found: Iterable[Finding], console: Console) -> None:
    """A line each, and below it how to mend it."""
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in found:
        text = Text(finding.said)
        if finding.mend:
            text.append(f"\n→ {finding.mend}", style="bold")
        table.add_row(Text(finding.verdict, _STYLES[finding.verdict]), finding.check, text)
    console.print(table)
