"""The cells that a command is asked for, and how far they are."""

import fnmatch
import sys
from collections.abc import Iterable, Sequence

from mrcdrl.services.monitor.records import to_line
from mrcdrl.services.tools.experiment.cell import CellFiles


def named_like(cells: Iterable[CellFiles], pattern: str) -> list[CellFiles]:
    """The cells whose names match."""
    return [files for files in cells if fnmatch.fnmatchcase(files.cell.name, pattern)]


def print_states(cells: Sequence[CellFiles], *, as_json: bool) -> None:
    """Print how far each cell is."""
    states = {files.cell.name: files.state for files in cells}
    lines = "".join(f"{state:<8} {name}\n" for name, state in states.items())
    sys.stdout.write(to_line(states) if as_json else lines)
