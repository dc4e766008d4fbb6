"""Progress is shown as the terminal allows it, and never ends the work."""

import errno
import io
import os
import pty
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

import pytest

from mrcdrl.services.tools import progress as progress_module
from mrcdrl.services.tools.progress import Progress


@contextmanager
def stderr_to(descriptor: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[IO[str]]:
    """Have sys.stderr write to the descriptor, which it closes."""
    with os.fdopen(descriptor, "w", encoding="utf-8") as stream, monkeypatch.context() as patched:
        patched.setattr(sys, "stderr", stream)
        yield stream


def work() -> list[int]:
    with Progress() as progress:
        done = progress.stage("episodes", 4)
        for number in range(1, 5):
            done(number)
        progress.stage("film.mp4")
        return list(progress.over(range(3), "frames", 3))


def test_without_a_terminal_each_stage_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert work() == [0, 1, 2]
    told = capsys.readouterr()
    assert told.err.splitlines() == ["episodes: 0 of 4", "film.mp4 …", "frames: 0 of 3"]
    assert told.out == ""


def test_no_time_is_told_from_the_first_episodes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress_module, "_LINE_PERIOD_S", 0.0)
    done = Progress().stage("episodes", 20)
    done(1)
    done(2)
    lines = capsys.readouterr().err.splitlines()
    assert lines[1] == "episodes: 1 of 20", "the first to end took the compiling, too"
    assert lines[2].startswith("episodes: 2 of 20, about ")


def test_a_long_stage_says_how_far_it_is(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress_module, "_LINE_PERIOD_S", 0.0)
    work()
    lines = capsys.readouterr().err.splitlines()
    assert lines[1] == "episodes: 1 of 4, about 0 s left"
    assert lines[4] == "episodes: 4 of 4"


@pytest.mark.parametrize("terminal", ["xterm-256color", "dumb"])
def test_a_terminal_that_can_draw_gets_a_bar_and_others_get_lines(
    terminal: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", terminal)
    reader, writer = pty.openpty()
    with stderr_to(writer, monkeypatch):
        work()
        sys.stderr.flush()
        shown = os.read(reader, 1 << 16).decode()
    os.close(reader)
    assert "episodes" in shown
    assert ("\x1b" in shown) == (terminal != "dumb")
    assert ("episodes: 0 of 4" in shown) == (terminal == "dumb")


class Hung(io.StringIO):
    """A stream that can be written until it hangs up."""

    encoding = "utf-8"

    def __init__(self, terminal: bool) -> None:
        super().__init__()
        self._terminal, self.hung_up = terminal, False

    def isatty(self) -> bool:
        return self._terminal

    def write(self, text: str) -> int:
        if self.hung_up:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().write(text)


@pytest.mark.parametrize("terminal", [False, True])
def test_a_closed_pipe_or_terminal_ends_nothing(
    terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(progress_module, "_BAR_PERIOD_S", 0.0)
    stream = Hung(terminal)
    monkeypatch.setattr(sys, "stderr", stream)
    with Progress() as progress:
        done = progress.stage("episodes", 4)
        stream.hung_up = True
        done(1)
        assert list(progress.over(range(3), "frames", 3)) == [0, 1, 2]
