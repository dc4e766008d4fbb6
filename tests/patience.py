"""How long a test waits for what should happen at once: the one bound, for tests of all kinds.

It only ends a test that would wait forever, and is never the verdict. Every core may have ten
others to serve.
"""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
PATIENCE_S = 300.0


def eventually(
    look: Callable[[], T | None],
    what: str = "what it waits for",
    timeout_s: float = PATIENCE_S,
    pause_s: float = 0.05,
) -> T:
    """The first true result of `look`; fails after timeout_s."""
    pause = threading.Event()
    deadline = time.monotonic() + timeout_s
    while not (found := look()):
        if time.monotonic() > deadline:
            raise AssertionError(f"in {timeout_s:g} s not: {what}")
        pause.wait(pause_s)
    return found
