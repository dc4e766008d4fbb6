"""What is closed when its `with` block is left."""

from types import TracebackType
from typing import Self


class Closing:
    """Enters as itself; leaving closes it, whatever happened."""

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
        """Give back what it holds."""
        raise NotImplementedError
