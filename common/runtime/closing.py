"""The base of objects that close at the end of a `with` block."""

from typing import Self


class Closing:
    """A context manager that returns itself and calls `close` on exit, even after an error."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release what it holds."""
        raise NotImplementedError
