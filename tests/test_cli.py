"""The command line as a whole: its commands, their help, completion, exit codes."""

import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import argcomplete
import pytest

import mrcdrl
from mrcdrl import cli
from mrcdrl.common.config import preset_names
from mrcdrl.common.config.arguments import Parser
from mrcdrl.common.errors import MrcdrlError

ROOT = Path(__file__).resolve().parents[1]
LINES = 40  # of a screen
SHORT = ("--robots", "--minutes", "--learner-steps", "--actors", "--seed")


def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str) -> str:
    """What `mrcdrl WORDS` prints on success."""
    monkeypatch.setattr(sys, "argv", ["mrcdrl", *words])
    assert cli.main() == 0
    return capsys.readouterr().out


def parsers() -> dict[str, Parser]:
    return {name: command.parser() for name, command in cli.COMMANDS.items()}


# -- the command itself ------------------------------------------------------------------


@pytest.mark.parametrize("command", [["mrcdrl"], [sys.executable, "-m", "mrcdrl"]], ids=len)
def test_the_version_is_told(command: list[str]) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    told = subprocess.run(
        [*command, "--version"], capture_output=True, text=True, env={**os.environ, "PATH": path}
    )
    assert (told.returncode, told.stdout) == (0, f"mrcdrl {mrcdrl.__version__}\n")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["tain"], "no command 'tain'; did you mean train?"),
        (["evalute", "x"], "no command 'evalute'; did you mean evaluate?"),
        (["xyzzy"], "no command 'xyzzy'; the commands are train, "),
        (["--robots", "4", "train"], "unknown argument --robots; flags follow the command"),
        (["train", "--minuts", "4"], "unknown argument --minuts; did you mean --minutes?"),
    ],
)
def test_a_wrong_word_is_told_in_one_line(
    words: list[str],
    told: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["mrcdrl", *words])
    try:
        code = cli.main()
    except SystemExit as ended:
        code = int(str(ended.code))
    captured = capsys.readouterr()
    assert (code, captured.out, captured.err.count("\n")) == (2, "", 1)
    assert told in captured.err


def test_its_help_fits_a_screen_and_has_every_command_and_exit_code(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = run(capsys, monkeypatch, "--help").splitlines()
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= 80
    for name in cli.COMMANDS:
        assert any(line.startswith(f"  {name}  ") for line in lines)
    for code in cli.EXIT_CODES:
        assert any(line.startswith(f"  {code}  ") for line in lines)


def test_errors_end_with_exit_codes_that_are_documented() -> None:
    raised = {MrcdrlError.exit_code, *(kind.exit_code for kind in MrcdrlError.__subclasses__())}
    assert raised < set(cli.EXIT_CODES)
    page = (ROOT / "docs" / "command-line.md").read_text("utf-8")
    for code, meaning in cli.EXIT_CODES.items():
        assert f"| {code} | {meaning} |" in page


# -- the commands' help ------------------------------------------------------------------


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_the_help_of_a_command_fits_a_screen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = cli.COMMANDS[name].parser().format_help().splitlines()
    assert lines[0].startswith(f"usage: mrcdrl {name} ")
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_flag_of_a_command_says_what_it_does(name: str) -> None:
    parser = cli.COMMANDS[name].parser()
    assert [action.dest for action in parser._actions if not action.help] == []
    assert set(parser.shown) <= {setting.key for setting in parser.settings.values()}


def test_a_short_flag_means_the_same_in_every_command() -> None:
    own = {"simulate": {"--actors", "--minutes"}}
    for name, parser in parsers().items():
        flags = {word: a for a in parser._actions for word in a.option_strings}
        if "--arena.num_robots" in flags:
            for flag in SHORT:
                assert flag in flags, f"{name} {flag}"
        for flag in set(SHORT[:-1]) & set(flags) - own.get(name, set()):
            assert "." in flags[flag].option_strings[1], f"{name} {flag}"


def test_what_a_program_would_want_comes_as_json() -> None:
    """Services have no result, pictures are one, and `simulate` always prints JSON."""
    without = {"replay", "router", "actor", "learner", "evaluator", "completion", "simulate"}
    without |= {"web", "demo"}
    without |= {"render", "figure", "report", "runs rm"}
    for name, parser in parsers().items():
        flags = {word for action in parser._actions for word in action.option_strings}
        assert ("--json" in flags) == (name not in without), name


def test_help_and_wrong_flags_need_no_heavy_import() -> None:
    """Of any command; a fresh interpreter makes all parsers."""
    code = """
import sys
from mrcdrl import cli
for command in cli.COMMANDS.values():
    command.parser()
heavy = {"torch", "numba", "cv2", "scipy", "matplotlib", "av", "pymunk", "safetensors"}
print(*sorted(heavy & set(sys.modules)))
"""
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert made.stdout.split() == []


def test_flags_name_all_controllers_figures_and_formats() -> None:
    from mrcdrl.common.arena.controllers import CONTROLLERS
    from mrcdrl.services.plots import film, paper
    from mrcdrl.services.tools import export, figure, flags, rerun_recording

    assert flags.CONTROLLERS == CONTROLLERS
    assert tuple(figure._FIGURES) == flags.FIGURES
    for parser, suffixes in (
        (flags.render(), (*film.SUFFIXES, rerun_recording.SUFFIX)),
        (flags.figure(), paper.SUFFIXES),
        (flags.export(), tuple(export.FORMATS)),
    ):
        (out,) = (action for action in parser._actions if action.dest == "out")
        assert all(suffix in (out.help or "") for suffix in suffixes)


# -- config ------------------------------------------------------------------------------


def test_config_prints_json(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = json.loads(run(capsys, monkeypatch, "config", "--json", "--robots", "4", "--seed", "9"))
    assert told["arena"]["num_robots"] == 4
    assert {told[section]["seed"] for section in ("run", "learner", "replay")} == {9}
    words = ("config", "--explain", "agent.n_step", "--config", "apex")
    told = json.loads(run(capsys, monkeypatch, *words, "--json"))
    assert (told["value"], told["from"]) == (3, "preset apex")
    assert "3, from preset apex" in run(capsys, monkeypatch, *words)


# -- completion --------------------------------------------------------------------------


class Finder(argcomplete.CompletionFinder):
    """A finder that leaves the descriptor alone on which a shell takes messages for debugging."""

    def _init_debug_stream(self) -> None:
        pass


@pytest.fixture
def completed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], list[str]]:
    """Words that a shell is offered where a line ends."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("_ARGCOMPLETE_IFS", "\n")

    def words(line: str) -> list[str]:
        offered = io.StringIO()
        find = partial(Finder(), output_stream=offered, exit_method=sys.exit)
        monkeypatch.setattr(argcomplete, "autocomplete", find)
        monkeypatch.setenv("_ARGCOMPLETE", "1")
        monkeypatch.setenv("COMP_LINE", line)
        monkeypatch.setenv("COMP_POINT", str(len(line)))
        with pytest.raises(SystemExit, match="0"):
            cli.main()
        return [word.strip() for word in offered.getvalue().split("\n")]

    return words


def test_commands_flags_presets_and_choices_are_completed(
    completed: Callable[[str], list[str]], tmp_path: Path
) -> None:
    (tmp_path / "mine.toml").touch()
    (tmp_path / "not-mine.txt").touch()
    words = [name for name in cli.COMMANDS if " " not in name]
    assert set(completed("mrcdrl ")) >= set(words)
    assert completed("mrcdrl ev") == ["evaluate", "evaluator"]
    assert "inspect" in completed("mrcdrl replay ")
    assert "--json" in completed("mrcdrl replay inspect --")
    flags = completed("mrcdrl train --")
    assert {"--robots", "--resume", "--agent.kind"} <= set(flags)
    assert "--agent.gamma" not in flags
    assert completed("mrcdrl train --agent.ga") == ["--agent.gamma"]
    assert completed("mrcdrl train --agent.kind ") == ["duel", "ddqn", "dqn"]
    sources = completed("mrcdrl train --config ")
    assert sorted(sources) == sorted([*preset_names(), "mine.toml"])
    assert "potential_field" in completed("mrcdrl evaluate --controller p")
    assert "views" in completed("mrcdrl figure ")
    assert "learner.batch_size" in completed("mrcdrl config --explain learner.b")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_takes_what_completes_it(
    shell: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """The shell itself reads the script, where it is installed."""
    (tmp_path / "script").write_text(run(capsys, monkeypatch, "completion", shell), "utf-8")
    assert "mrcdrl" in (tmp_path / "script").read_text("utf-8")
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    subprocess.run([shell, "-n", str(tmp_path / "script")], check=True)


def test_bash_completes_a_command(tmp_path: Path) -> None:
    """Bash's own machinery calls the function that the script defines."""
    script = """
eval "$(mrcdrl completion bash)"
COMP_LINE="mrcdrl train --config sm" COMP_POINT=24 COMP_TYPE=9
_python_argcomplete mrcdrl sm --config
echo "${COMPREPLY[@]}"
"""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    ended = subprocess.run(
        ["bash", "-c", script],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
    )
    assert ended.stdout.split() == ["smoke"], ended.stderr
