"""The base of objects that close at the end of a `with` block."""

from types import TracebackType
from typing import Self


class Closing:
    """A context manager that returns itself and calls `close` on exit, even after an error."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release what it holds."""
        raise NotImplementedError
