"""A run directory: created, resumed or joined by one process at a time.

    runs/NAME/  config.toml  endpoint (while it runs)  logs/  replay/  checkpoints/
                tensorboard/  metrics.jsonl  episodes.jsonl  evaluations.jsonl
                summary.json  training.png  trajectories.png  evaluation.mp4

Invariants: a directory that exists never becomes a new run; two processes never hold one.
"""

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

from mrcdrl.common.config import Config, load_config, refuse_changes, to_toml
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.runtime.closing import Closing
from mrcdrl.common.runtime.files import RUN_CONFIG, atomic_write, is_locked, lock_directory, reason
from mrcdrl.common.sync.joining import ENDPOINT_FILE


def is_held(path: Path) -> bool:
    """Whether a process holds the run: one that runs, records or removes it, or serves replay."""
    return any(map(is_locked, lockable(path)))


def lockable(path: Path) -> list[Path]:
    """The directories that processes of a run lock."""
    return [path, *sorted(path.glob("replay/[0-9]*"))]


Check = Callable[[Config, Config], None]  # of what a run was made with, and is resumed with


def default_name(config_name: str, num_robots: int) -> str:
    """A name such as quick-2robots-20261122-101500."""
    stem = Path(config_name).stem
    return f"{stem}-{num_robots}robots-{time.strftime('%Y%m%d-%H%M%S')}"


class RunDirectory(Closing):
    """The directory of one run, locked while the object is open.

    Raises RunDirectoryError if it exists (`create`), is missing (`resume`), is in use by another
    process, or cannot be written.
    """

    def __init__(self, path: Path, config: Config, *, resumed: bool) -> None:
        self.path = path
        self.config = config
        self.resumed = resumed
        try:
            self._lock = lock_directory(path)
        except BlockingIOError as error:
            raise RunDirectoryError(f"{path} is in use by another process") from error

    @classmethod
    def create(cls, path: Path, config: Config) -> Self:
        """Create the directory, with the resolved configuration in it."""
        try:
            path.mkdir(parents=True)
        except FileExistsError as error:
            raise RunDirectoryError(
                f"{path} exists; take another --name, or go on with --resume {path.name}"
            ) from error
        except OSError as error:
            raise RunDirectoryError(f"cannot create {path}: {reason(error)}") from error
        try:
            return cls._opened(path, config, resumed=False)
        except RunDirectoryError:
            shutil.rmtree(path, ignore_errors=True)
            raise

    @classmethod
    def create_free(cls, path: Path, config: Config) -> Self:
        """Create it under this name, or the first of name-2, name-3 … that no directory has."""
        free, number = path, 1
        while True:
            try:
                return cls.create(free, config)
            except RunDirectoryError as error:
                if not isinstance(error.__cause__, FileExistsError):
                    raise
            number += 1
            free = path.with_name(f"{path.name}-{number}")

    @classmethod
    def resume(
        cls, path: Path, overrides: dict[str, str], check: Check = lambda _before, _now: None
    ) -> Self:
        """Open an existing run, with its configuration and the changes of environment and flags.

        check: called before anything is written; what it raises leaves the run as it was.
        """
        before, config = cls.resumed_config(path, overrides)
        return cls._opened(path, config, resumed=True, check=lambda: check(before, config))

    @staticmethod
    def resumed_config(path: Path, overrides: dict[str, str]) -> tuple[Config, Config]:
        """What a run was made with, and what it would be resumed with; nothing is written.

        Raises RunDirectoryError if it is not a run, or a setting changes that has to stay.
        """
        file = path / RUN_CONFIG
        if not file.is_file():
            raise RunDirectoryError(f"{path} is not a run ({RUN_CONFIG} is missing)")
        before = load_config(str(file), environ={})
        config = load_config(str(file), overrides)
        refuse_changes(path, before, config)
        return before, config

    @classmethod
    def join(cls, path: Path, config: Config) -> Self:
        """Open the directory of a live run to keep its records; create it if it is missing."""
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunDirectoryError(f"cannot create {path}: {reason(error)}") from error
        return cls._opened(path, config, resumed=True)

    @classmethod
    def _opened(
        cls, path: Path, config: Config, *, resumed: bool, check: Callable[[], None] = lambda: None
    ) -> Self:
        try:
            run = cls(path, config, resumed=resumed)
            try:
                check()
                run.logs.mkdir(exist_ok=True)
                atomic_write(run.config_file, to_toml(config).encode())
            except BaseException:
                os.close(run._lock)
                raise
        except OSError as error:
            raise RunDirectoryError(f"cannot write {path}: {reason(error)}") from error
        return run

    @property
    def config_file(self) -> Path:
        return self.path / RUN_CONFIG

    @property
    def logs(self) -> Path:
        return self.path / "logs"

    def note_endpoint(self, endpoint: str) -> None:
        """Write the endpoint, so that `mrcdrl actor --run NAME` on this machine finds the run."""
        atomic_write(self.path / ENDPOINT_FILE, endpoint.encode())

    def close(self) -> None:
        """Release the directory."""
        (self.path / ENDPOINT_FILE).unlink(missing_ok=True)
        os.close(self._lock)
