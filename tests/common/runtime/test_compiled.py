"""Compiled functions work also where numba has no directory for machine code; it is said once."""

import logging

import numba
import pytest
from numba.core import caching

from mrcdrl.common.runtime import compiled as module
from mrcdrl.common.runtime.compiled import compiled, inlined
from mrcdrl.common.runtime.compiling import compiling, tell_compiling


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


class Listener:
    def __init__(self) -> None:
        self.heard: list[bool] = []

    def hear(self) -> None:
        self.heard.append(compiling())


@pytest.mark.usefixtures("nowhere")
def test_a_compilation_is_told_when_it_begins(caplog: pytest.LogCaptureFixture) -> None:
    def doubled(number: int) -> int:
        return 2 * number

    doubled.__module__ = "mrcdrl.somewhere"
    fast, listener, gone = compiled(doubled), Listener(), Listener()
    tell_compiling(listener.hear)
    tell_compiling(gone.hear)
    heard = gone.heard
    del gone
    module._say_once.cache_clear()
    with caplog.at_level(logging.INFO):
        assert fast(4) == 8
        assert listener.heard == [True]
        assert not compiling()
        assert fast(5) == 10
        assert listener.heard == [True]
        assert fast(2.5) == 5.0
    assert listener.heard == [True, True]
    assert heard == []
    assert [line for line in caplog.messages if "done once" in line] == [
        "compiling functions, which takes a minute and is done once …"
    ]


@pytest.mark.usefixtures("nowhere")
def test_a_function_that_does_not_compile_is_told_as_ended() -> None:
    def broken() -> int:
        return len(3)  # type: ignore[arg-type]

    broken.__module__ = "mrcdrl.somewhere"
    listener = Listener()
    tell_compiling(listener.hear)
    with pytest.raises(numba.TypingError):
        compiled(broken)()
    assert listener.heard == [True]
    assert not compiling()
