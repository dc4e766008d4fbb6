"""The folder of runs that a server shows: found by name, and nothing outside it.

Invariants: nothing is written and no lock is taken, so that no run can notice; a name that is not
one of a run in this folder is refused, and so is a link that leads out of it.
"""

import os
import threading
import time
from pathlib import Path

from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.runtime.files import FILM, METRICS, PICTURES, RUN_CONFIG
from mrcdrl.common.runtime.names import is_name
from mrcdrl.common.runtime.runs import is_run
from mrcdrl.services.monitor.recall import is_recorded_now
from mrcdrl.services.monitor.recorder import SUMMARY
from mrcdrl.services.monitor.records import EVALUATIONS
from mrcdrl.services.monitor.run_directory import lockable
from mrcdrl.services.monitor.run_info import RunInfo, run_info

MAX_RUNS = 500  # in the list: those that were active last
_FRESH_S = 2.0  # the list is made anew after this
_LOCKS = Path("/proc/locks")
# What a run leaves to look at, by name, and as what it is sent.
FILES = {
    **dict.fromkeys(PICTURES, "image/png"),
    **{str(Path(name).with_suffix(".svg")): "image/svg+xml" for name in PICTURES},
    FILM: "video/mp4",
    RUN_CONFIG: "text/plain; charset=utf-8",
    SUMMARY: "application/json",
}


class RunFolder:
    """The runs in one folder; may be used by several threads."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._root = path.resolve()
        self._lock = threading.Lock()
        self._known: dict[Path, tuple[tuple[float, ...], RunInfo]] = {}
        self._listed: list[RunInfo] = []
        self._due_s = 0.0

    def __repr__(self) -> str:
        return f"RunFolder({str(self.path)!r})"

    def find(self, name: str) -> Path:
        """The directory of a run; raises RunDirectoryError if there is none of that name."""
        path = self._root / name
        if not (is_name(name) and path.is_dir() and self._holds(path) and is_run(path)):
            raise RunDirectoryError("there is no run of that name here")
        return path

    def file(self, name: str, file: str) -> Path:
        """A file that a run has left; raises RunDirectoryError if it is not one to be shown."""
        path = self.find(name) / file
        if file not in FILES or not path.is_file() or path.resolve().parent != path.parent:
            raise RunDirectoryError("the run has no such file")
        return path

    def infos(self) -> list[RunInfo]:
        """What is known of the runs, those active last first; at most 2 s old."""
        with self._lock:
            if time.monotonic() >= self._due_s:
                self._listed = sorted(self._read(), key=lambda run: -run.active_s)[:MAX_RUNS]
                self._due_s = time.monotonic() + _FRESH_S
            return self._listed

    def info(self, name: str) -> RunInfo:
        """What is known of a run; raises RunDirectoryError as `find` does."""
        path = self.find(name)
        with self._lock:
            return self._info(path)

    def _read(self) -> list[RunInfo]:
        try:
            paths = [p for p in self._root.iterdir() if is_name(p.name) and self._holds(p)]
        except OSError:
            return []
        latest = sorted(filter(_may_be_run, paths), key=_changed_s)[-MAX_RUNS:]
        self._known = {path: self._known[path] for path in latest if path in self._known}
        return [self._info(path) for path in latest]

    def _info(self, path: Path) -> RunInfo:
        up = is_up(path)
        signature = (*_signature(path), up)
        known = self._known.get(path)
        if known is None or known[0] != signature:
            known = self._known[path] = (signature, run_info(path, held=up))
        return known[1]

    def _holds(self, path: Path) -> bool:
        """Whether a directory is in this folder, not only a link to one elsewhere."""
        return path.resolve().parent == self._root


def is_up(path: Path) -> bool:
    """Whether a run is up: its records are written, or the kernel lists a lock on its directory.

    To try the lock itself would keep a process that starts meanwhile from having it.
    """
    return is_recorded_now(path) or any(map(_lock_is_listed, lockable(path)))


def _lock_is_listed(path: Path) -> bool:
    try:
        status = path.stat()
        major, minor = os.major(status.st_dev), os.minor(status.st_dev)
        place = f" {major:02x}:{minor:02x}:{status.st_ino} "
        return any(" FLOCK " in line and place in line for line in _locks())
    except OSError:
        return False


def _locks() -> list[str]:
    return _LOCKS.read_text("ascii").splitlines()


def _may_be_run(path: Path) -> bool:
    try:
        return path.is_dir() and is_run(path)
    except OSError:
        return False


def _changed_s(path: Path) -> float:
    return max(_signature(path))


def _signature(path: Path) -> tuple[float, ...]:
    """When the files that `run_info` reads were written."""
    names = (RUN_CONFIG, METRICS, SUMMARY, EVALUATIONS, "checkpoints")
    times = []
    for name in names:
        try:
            times.append((path / name).stat().st_mtime)
        except OSError:
            times.append(0.0)
    return tuple(times)
