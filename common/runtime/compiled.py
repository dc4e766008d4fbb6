"""Functions that numba compiles: with one set of options, kept on disk where possible."""

import logging
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit
from numba.core import event

from mrcdrl.common.runtime.compiling import began, ended

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


@cache
def _say_once() -> None:
    _LOG.info("compiling functions, which takes a minute and is done once …")


class _Reporter(event.Listener):
    """Notes each compilation of a function of ours; those of numba's own belong to one."""

    def on_start(self, event: Any) -> None:
        if _is_ours(event):
            _say_once()
            began()

    def on_end(self, event: Any) -> None:
        if _is_ours(event):
            ended()


def _is_ours(event: Any) -> bool:
    module: str = event.data["dispatcher"].py_func.__module__
    return module.startswith("mrcdrl.")


event.register("numba:compile", _Reporter())  # type: ignore[no-untyped-call]
