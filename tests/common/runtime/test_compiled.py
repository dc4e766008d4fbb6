"""Compiled functions work also where numba has no directory for machine code; it is said once."""

import logging

import numba
import pytest
from numba.core import caching

from mrcdrl.common.runtime import compiled as module
from mrcdrl.common.runtime.compiled import compiled, inlined


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """A read-only installation and no home: no place for a cache."""
    monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])
    module._warn_once.cache_clear()


@pytest.mark.usefixtures("nowhere")
def test_without_a_directory_functions_are_compiled_anew(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):

        @inlined
        def twice(number: int) -> int:
            return 2 * number

        @compiled
        def next_of(number: int) -> int:
            return int(twice(number)) + 1

    assert next_of(3) == 7
    assert len(caplog.messages) == 1
    assert "set NUMBA_CACHE_DIR" in caplog.text
    with pytest.raises(RuntimeError, match="cannot cache"):
        numba.njit(cache=True)(lambda: 1)


def test_with_one_they_are_kept(caplog: pytest.LogCaptureFixture) -> None:
    module._warn_once.cache_clear()

    @compiled
    def half(number: float) -> float:
        return number / 2

    assert half._cache.cache_path
    assert caplog.messages == []
