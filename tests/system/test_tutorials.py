"""The tutorials, done as a reader would: every block of shell, Python and files, in one directory.

A comment above a block says what else becomes of it: `file: NAME` is written to that file,
`background` runs until the page ends, `not run: REASON` is left out. Settings in the environment
make every run tiny; they beat the files that the tutorials name.
"""

import os
import re
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest

from mrcdrl.common.config import load_config, to_toml
from mrcdrl.common.config.toml import toml_value
from mrcdrl.common.transport import free_endpoint
from tests.patience import PATIENCE_S, eventually
from tests.system.system_processes import REPOSITORY, SMALL, environment

pytestmark = [pytest.mark.system, pytest.mark.timeout(1800)]

TUTORIALS = REPOSITORY / "docs" / "tutorials"
PAGES = sorted(path.name for path in TUTORIALS.glob("*.md") if path.name != "index.md")
ENDPOINT = "tcp/127.0.0.1:7447"  # as the tutorials write it
LANGUAGES = {"sh": ("bash", "-ec"), "python": (sys.executable, "-c")}
BLOCK = re.compile(r"(?:^<!-- (.*?) -->\n)?^```(\w+)\n(.*?)^```$", re.M | re.S)


class Block(NamedTuple):
    """A block of code, and what the comment above it says."""

    comment: str
    language: str
    text: str


def blocks(page: str) -> list[Block]:
    return [Block(*found) for found in BLOCK.findall((TUTORIALS / page).read_text("utf-8"))]


def tiny() -> dict[str, str]:
    """The environment in which every run is the preset smoke at its smallest."""
    changes = dict(flag.removeprefix("--").split("=") for flag in SMALL)
    quick, smoke = (
        tomllib.loads(to_toml(config))
        for config in (load_config("quick", environ={}), load_config("smoke", changes, environ={}))
    )
    return {
        f"MRCDRL_{section}__{name}".upper(): toml_value(value)
        for section, settings in smoke.items()
        for name, value in settings.items()
        if value != quick[section][name]
    }


class Reader:
    """Does what a page says, in a directory."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        self._variables = environment(PATH=path, **tiny())

    def read(self, page: str) -> list[str]:
        """Do everything on a page; the output of each block that ended."""
        endpoint, outputs = free_endpoint(), []
        started: list[subprocess.Popen[bytes]] = []
        try:
            for block in blocks(page):
                text = block.text.replace(ENDPOINT, endpoint)
                if block.comment.startswith("file: "):
                    (self._folder / block.comment.removeprefix("file: ")).write_text(text, "utf-8")
                elif block.comment == "background":
                    started.append(self._start(text))
                elif block.language in LANGUAGES and not block.comment:
                    outputs.append(self._result(block.language, text, wait=bool(started)))
            assert [process.poll() for process in started] == [None] * len(started)
        finally:
            for process in reversed(started):
                process.send_signal(signal.SIGTERM)
            codes = [process.wait(PATIENCE_S) for process in started]
        # One that was still being imported ends by the signal itself.
        assert set(codes) <= {0, -signal.SIGTERM}
        return outputs

    def _start(self, text: str) -> "subprocess.Popen[bytes]":
        """Start one command, which no number of learner steps ends."""
        with (self._folder / "background.log").open("ab") as log:
            return subprocess.Popen(
                ["bash", "-c", f"exec {text}"],
                cwd=self._folder,
                env={**self._variables, "MRCDRL_RUN__LEARNER_STEPS": "0"},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def _result(self, language: str, text: str, *, wait: bool) -> str:
        """Output of a block that must succeed; wait: once what runs in the background is ready."""
        failed = ""

        def succeeds() -> subprocess.CompletedProcess[str] | None:
            nonlocal failed
            result = subprocess.run(
                [*LANGUAGES[language], text],
                cwd=self._folder,
                env=self._variables,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                check=False,
            )
            failed = f"{text}\n{result.stdout}\n{result.stderr}"
            return None if result.returncode else result

        if not wait:
            result = succeeds()
            assert result, failed
            return result.stdout
        try:
            return eventually(succeeds, text, pause_s=1.0).stdout
        except AssertionError as error:
            raise AssertionError(failed) from error


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Reader:
    return Reader(tmp_path_factory.mktemp("tutorials"))


@pytest.fixture(scope="module")
def first_run(reader: Reader) -> list[str]:
    """The output of the first tutorial, whose run the others need."""
    return reader.read("first-run.md")


def test_first_run(first_run: list[str]) -> None:
    assert "learner step limit reached" in first_run[1]
    assert "200 episodes" in first_run[3]


def test_page_and_curves(reader: Reader, first_run: list[str]) -> None:
    _, figures, runs = reader.read("page-and-curves.md")
    assert re.match(r"\d+ learner steps in [\d.]+ minutes\nstep \d+: 0%", figures)
    assert "first" in runs


def test_first_experiment(reader: Reader) -> None:
    listed, table = reader.read("first-experiment.md")
    assert [line.split()[0] for line in listed.splitlines()] == ["missing"] * 4
    assert "| batch-32 " in table
    assert "| batch-64 " in table


def test_four_from_two(reader: Reader, first_run: list[str]) -> None:
    before, trained, _, after, forecast = reader.read("four-from-two.md")
    assert "4 robots, 200 episodes" in before
    assert "learner step limit reached" in trained
    assert "4 robots, 200 episodes" in after
    assert "nothing was written" in forecast


def test_own_robot(reader: Reader, first_run: list[str]) -> None:
    driven, _, saved = reader.read("own-robot.md")
    assert (
        len(re.findall(r"^robot [01]: (?:left|straight|right), by version \d+$", driven, re.M))
        == 20
    )
    assert saved


def test_own_arena(reader: Reader) -> None:
    meaning, _, tested, played, _, trained = reader.read("own-arena.md")
    assert "Inner walls" in meaning
    assert "3 robots, 100 episodes" in tested
    assert re.fullmatch(r"\(4, \d+, \d+\) (collision|timeout)\n", played)
    assert "learner step limit reached" in trained


def test_cluster(reader: Reader) -> None:
    (status,) = reader.read("cluster.md")
    assert "replay" in status


def test_every_tutorial_is_done() -> None:
    done = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    assert {page.removesuffix(".md").replace("-", "_") for page in PAGES} <= done


@pytest.mark.parametrize("page", PAGES)
def test_comments_say_what_becomes_of_a_block(page: str) -> None:
    found = blocks(page)
    assert found
    for block in found:
        assert block.comment == "" or re.match(r"file: \S+$|background$|not run: .", block.comment)
