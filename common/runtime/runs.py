"""Runs by name: the folder that they are kept in, and the run that a word means.

A word is a run's name in that folder, a path, or `latest`: the run that was active last. Where
weights are asked for, it may also name pretrained ones. Nothing is written.
"""

import argparse
import difflib
import os
from pathlib import Path

from mrcdrl.common.errors import ConfigError, RunDirectoryError
from mrcdrl.common.runtime.completion import completed_by
from mrcdrl.common.runtime.files import METRICS, RUN_CONFIG, WEIGHTS_SUFFIX
from mrcdrl.common.runtime.names import check_name
from mrcdrl.common.runtime.pretrained import PREFIX, pretrained_names, pretrained_path

RUN_DIR_VARIABLE = "MRCDRL_RUN_DIR"
LATEST = "latest"
_DEFAULT = Path("runs")
_MARKS = (RUN_CONFIG, METRICS, "checkpoints", "replay/[0-9]*")  # a run has one of these


def add_run(parser: argparse.ArgumentParser, text: str = "the run") -> None:
    """Add the argument that names a run, also as --run, and --run-dir."""
    named = f"{text}: its name, its path, or {LATEST}"
    run = parser.add_argument(
        "run", nargs="?", default=argparse.SUPPRESS, metavar="RUN", help=named
    )
    flag = parser.add_argument("--run", default=None, metavar="RUN", help="the same as RUN")
    for action in (run, flag):
        completed_by(action, run_names)
    add_run_dir(parser)


def add_run_dir(parser: argparse.ArgumentParser) -> None:
    """Add the flag that says where runs are kept."""
    parser.add_argument(
        "--run-dir",
        type=Path,
        metavar="DIR",
        help=f"where runs are kept; default: {RUN_DIR_VARIABLE}, or else {_DEFAULT}",
    )


def runs_folder(given: Path | None = None) -> Path:
    """Where runs are kept: as given, or else as MRCDRL_RUN_DIR says, or else `runs` here."""
    return given or Path(os.environ.get(RUN_DIR_VARIABLE) or _DEFAULT)


def run_path(word: str | None, given: Path | None = None) -> Path:
    """The directory that the run has or would have; its last part is the run's name.

    given: the folder of runs, if a flag names one. Raises ConfigError without a word and for a name
    that no run can have, RunDirectoryError for `latest` where there is no run.
    """
    if not word:
        raise ConfigError(f"give a run: its name, its path, or {LATEST}")
    folder = runs_folder(given)
    if word == LATEST:
        return _latest(folder)
    path = folder / word
    if _is_path(word) or (not path.exists() and is_run(Path(word))):
        path = Path(word)
    if not path.name or path.name == "..":
        path = path.resolve()
    check_name(path.name, "run name")
    return path


def new_run_path(name: str, given: Path | None = None) -> Path:
    """The directory of a new run; raises ConfigError for a name that no run can have."""
    path = Path(name) if _is_path(name) else runs_folder(given) / name
    if path.name == LATEST:
        raise ConfigError(f"no run can be named {LATEST}, which means the one that was active last")
    check_name(path.name, "run name")
    return path


def find_run(word: str | None, given: Path | None = None) -> Path:
    """The directory of a run that exists.

    Arguments and errors are those of `run_path`; RunDirectoryError also for a run that does not
    exist, with the nearest name and where was looked.
    """
    path = run_path(word, given)
    if not is_run(path):
        raise RunDirectoryError(unknown_run(path))
    return path


def find_weights(word: str, given: Path | None = None) -> Path:
    """The directory of a run, another directory, or a file of weights, which may be missing.

    `pretrained:NAME` means weights that come with the package; so does NAME alone where no run and
    no file is called so. Arguments and errors are those of `find_run`.
    """
    if word.startswith(PREFIX):
        return pretrained_path(word.removeprefix(PREFIX))
    named = runs_folder(given) / word
    if word == LATEST or (not _is_path(word) and is_run(named)):
        return run_path(word, given)
    path = Path(word)
    if not (path.exists() or path.suffix == WEIGHTS_SUFFIX):
        if word in pretrained_names():
            return pretrained_path(word)
        raise RunDirectoryError(unknown_run(path if _is_path(word) else named))
    return path


def unknown_run(path: Path) -> str:
    """Say that there is no run of this name, where was looked, and which name is nearest."""
    names = [run.name for run in run_paths(path.parent)]
    if not names:
        return f"no run {path.name!r}: {_empty(path.parent)}"
    near = difflib.get_close_matches(path.name, names, n=1, cutoff=0.5)
    near = near or [name for name in names if path.name in name][-1:]
    hint = f"did you mean {near[0]}?" if near else "`mrcdrl runs` lists all"
    return f"no run {path.name!r} in {path.parent.resolve()}; {hint}"


def is_run(path: Path) -> bool:
    """Whether a directory is that of a run."""
    return any(any(path.glob(mark)) for mark in _MARKS)


def run_paths(folder: Path) -> list[Path]:
    """The directories of all runs in a folder, by name."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.is_dir() and is_run(path))


def run_names(_typed: str = "") -> list[str]:
    """Words that name a run here, as a shell completes them."""
    names = [run.name for run in run_paths(runs_folder())]
    return [*names, LATEST] if names else []


def weights_names(typed: str = "") -> list[str]:
    """Words that name weights here, as a shell completes them."""
    return [*run_names(typed), *(PREFIX + name for name in pretrained_names())]


def active_s(run: Path) -> float:
    """When the run was active last, in seconds since the epoch, as its files tell."""
    files = [run / RUN_CONFIG, run / METRICS, run / "checkpoints", *run.glob("replay/*/*")]
    return max(map(_written_s, files))


def _written_s(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:
        return 0.0


def _is_path(word: str) -> bool:
    return os.sep in word or word in (os.curdir, os.pardir)


def _latest(folder: Path) -> Path:
    paths = run_paths(folder)
    if not paths:
        raise RunDirectoryError(_empty(folder))
    return max(paths, key=active_s)


def _empty(folder: Path) -> str:
    return f"there are no runs in {folder.resolve()}; give --run-dir or set {RUN_DIR_VARIABLE}"
