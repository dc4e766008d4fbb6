"""The boundary between a run and what only watches it: screen, records, log reading, messages.

Invariants: what fails here is said once and ends nothing; it is tried again, since a full disk may
have room later.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.runtime.files import reason

_LOG = logging.getLogger("train")


class Watching:
    """Guards parts of a watcher; each part that fails is named once.

    passes: errors that are raised nevertheless.
    """

    def __init__(self, passes: tuple[type[Exception], ...] = ()) -> None:
        self._passes = passes
        self._failed: set[str] = set()

    def __repr__(self) -> str:
        return f"Watching(failed={sorted(self._failed)})"

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        """Do what only watches in this block; the block ends where something in it fails."""
        try:
            yield
        except self._passes:
            raise
        except Exception as error:  # noqa: BLE001
            if part not in self._failed:
                self._failed.add(part)
                _LOG.warning("%s failed: %s; the run goes on", part, _why(error))


def _why(error: Exception) -> str:
    """The error in a few words; a bug of ours with its type."""
    if isinstance(error, OSError):
        return reason(error)
    return str(error) if isinstance(error, MrcdrlError) else f"{type(error).__name__}: {error}"
