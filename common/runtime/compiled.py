"""Functions that numba compiles: with one set of options, and kept on disk where possible."""

import logging
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit

_LOG = logging.getLogger("numba")


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call, to run without the interpreter's lock.

    Machine code is kept for the next start: in NUMBA_CACHE_DIR, beside the file, or in the user's
    home. Where none of them can be written, every start compiles anew, and a warning says so.
    """
    return _compile(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile as `compiled` does, and into each caller."""
    return _compile(function, inline="always")


def _compile(function: Callable[..., Any], **options: Any) -> Any:
    options |= {"nogil": True, "error_model": "numpy"}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # numba's, if it finds no directory
        _warn_once()
        return njit(**options)(function)


@cache
def _warn_once() -> None:
    _LOG.warning(
        "no directory for compiled functions can be written: each start compiles them anew, which "
        "takes a minute; set NUMBA_CACHE_DIR to one that can"
    )
