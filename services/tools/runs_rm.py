"""`mrcdrl runs rm RUN…`: remove runs for good, after asking.

Invariants: all runs are checked before the first is removed; a run that a process holds stays.
"""

import contextlib
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from mrcdrl.common.config.arguments import Parser
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.runtime.completion import completed_by
from mrcdrl.common.runtime.files import lock_directory, reason
from mrcdrl.common.runtime.runs import add_run_dir, find_run, run_names
from mrcdrl.services.monitor.run_directory import lockable
from mrcdrl.services.monitor.run_info import RunInfo, config_of, run_info
from mrcdrl.services.tools.runs import size_text, state_text


def main(argv: Sequence[str]) -> int:
    """Remove the runs; return the exit code: 1 if the answer was no."""
    arguments = parser().parse_args(argv)
    paths = list(dict.fromkeys(find_run(run, arguments.run_dir) for run in arguments.runs))
    with ExitStack() as held:
        for path in paths:
            _check(path)
            held.enter_context(_held(path))
        found = [run_info(path, held=False) for path in paths]
        for run in found:
            sys.stderr.write(f"{_described(run)}\n")
        total = size_text(sum(run.disk_bytes for run in found))
        if not arguments.yes and not _agreed(f"remove {len(paths)} runs, {total}? [y/N] "):
            sys.stderr.write("nothing was removed\n")
            return 1
        for path in paths:
            _remove(path)
    print(f"removed {', '.join(run.name for run in found)}: {total} are free again")
    return 0


def _check(path: Path) -> None:
    """Raise RunDirectoryError for what is not a run, or not one that stands alone."""
    if path.is_symlink():
        raise RunDirectoryError(f"{path} is a link; remove it and the run by their own paths")
    if path.with_name(f"{path.name}.toml").exists():
        raise RunDirectoryError(f"{path} belongs to an experiment; remove that by hand, as a whole")
    if config_of(path) is None:
        raise RunDirectoryError(f"{path} has no configuration of a run; remove it by hand")


@contextlib.contextmanager
def _held(path: Path) -> Iterator[None]:
    """Keep the run from being started in this block; raises RunDirectoryError if it is up."""
    with ExitStack() as locks:
        for directory in lockable(path):
            try:
                locks.callback(os.close, lock_directory(directory))
            except BlockingIOError as error:
                raise RunDirectoryError(f"{path} is up; stop it first") from error
        yield


def _described(run: RunInfo) -> str:
    best = "" if run.best_success is None else f", best success {run.best_success:.1%}"
    return f"{run.path}: {run.robots} robots, {state_text(run)}{best}, {size_text(run.disk_bytes)}"


def _agreed(question: str) -> bool:
    """Ask; raises RunDirectoryError where nobody can answer."""
    if not sys.stdin.isatty():
        raise RunDirectoryError("nobody can be asked here: give --yes to remove the runs")
    sys.stderr.write(question)
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _remove(path: Path) -> None:
    try:
        shutil.rmtree(path)
    except OSError as error:
        raise RunDirectoryError(f"{path} cannot be removed: {reason(error)}") from error


def parser() -> Parser:
    """The command's flags."""
    made = Parser(prog="mrcdrl runs rm", description="Remove runs, with all their files.")
    runs = made.add_argument("runs", nargs="+", metavar="RUN", help="its name, its path, or latest")
    completed_by(runs, run_names)
    made.add_argument("--yes", action="store_true", help="do not ask")
    add_run_dir(made)
    return made
