"""The compilations under way in this process, for services to report.

Invariants: who asks to be told hears of each when it begins, in its own thread; numba is not
imported, so that a process that compiles nothing need not have it.
"""

import threading
from collections.abc import Callable
from weakref import WeakMethod

_lock = threading.Lock()
_listeners: list[WeakMethod[Callable[[], None]]] = []
_under_way = 0


def compiling() -> bool:
    """Whether a function is being compiled now; not one that is read from disk."""
    return _under_way > 0


def tell_compiling(method: Callable[[], None]) -> None:
    """Call this method of an object whenever a compilation begins, as long as the object lives."""
    with _lock:
        _listeners.append(WeakMethod(method))


def began() -> None:
    """Note that a compilation begins; they nest."""
    global _under_way
    with _lock:
        _under_way += 1
        _listeners[:] = [listener for listener in _listeners if listener() is not None]
        told = list(_listeners)
    for listener in told:
        if method := listener():
            method()


def ended() -> None:
    """Note that one has ended, or failed."""
    global _under_way
    with _lock:
        _under_way -= 1
