"""Help that fits a screen, with the values that hold; or every setting."""

from pathlib import Path

import pytest

from mrcdrl.common.config import load_config, preset_names, to_toml
from mrcdrl.common.config.arguments import Parser, add_config_flag, add_config_flags
from mrcdrl.common.config.settings import all_settings, find_setting

ROBOTS = find_setting("arena.num_robots").meaning.rstrip(".")


@pytest.fixture(autouse=True)
def _narrow_and_clean(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)


def make_parser() -> Parser:
    parser = Parser(prog="mrcdrl test", description="Test.")
    parser.add_argument("weights", nargs="?")
    parser.add_argument("--out", required=True, metavar="FILE")
    parser.add_argument("--run-dir", type=Path)
    add_config_flag(parser, of_run=True)
    add_config_flags(parser, ("arena.num_robots", "agent.n_step", "agent.optimizer"))
    return parser


def shown(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The help, its lines joined."""
    with pytest.raises(SystemExit) as ended:
        make_parser().parse_args(words)
    assert ended.value.code == 0
    return " ".join(capsys.readouterr().out.split())


def test_the_short_help_has_what_people_use(capsys: pytest.CaptureFixture[str]) -> None:
    text = shown(capsys, "--help")
    assert text.startswith("usage: mrcdrl test [WEIGHTS] --out FILE [flags] Test.")
    assert f"--robots N {ROBOTS} (between 1 and 10; default: 2)" in text
    assert "(adam or rmsprop; default: adam)" in text
    assert "--help-all" in text
    assert "--agent.gamma" not in text
    assert ", ".join(preset_names()[:-1]) in text


@pytest.mark.parametrize("words", [["--help", "--config", "paper"], ["--config=paper", "-h"]])
def test_defaults_are_those_that_hold(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert "default: 5" in shown(capsys, "--help")
    text = shown(capsys, *words)
    assert "settings (defaults of preset paper)" in text
    assert "Rewards summed before the bootstrap (between 1 and 32; default: 1)" in text


def test_a_run_and_the_environment_set_defaults_too(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "runs" / "mine"
    run.mkdir(parents=True)
    config = load_config("quick", {"agent.n_step": "7"}, environ={})
    (run / "config.toml").write_text(to_toml(config), "utf-8")
    for words in (["mine"], ["--out", "x.mp4", str(run)], ["mine", "--run-dir", "runs"]):
        assert "default: 7" in shown(capsys, *words, "--help")
    monkeypatch.setenv("MRCDRL_AGENT__N_STEP", "5")
    assert "default: 5" in shown(capsys, "mine", "--help")


def test_help_is_shown_whatever_else_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    text = shown(capsys, "--config", "nosuch", "--treads", "3", "--help")
    assert f"--robots N {ROBOTS} (between 1 and 10)" in text
    assert "settings (defaults of preset quick)" in shown(capsys, "--config", "--help")


def test_the_long_help_has_every_setting(capsys: pytest.CaptureFixture[str]) -> None:
    text = shown(capsys, "--help-all", "--config", "hard")
    for setting in all_settings():
        assert f"--{setting.key} {setting.metavar} " in text
        assert " ".join(setting.meaning.rstrip(".").split())[:50] in text
    assert "[arena] settings (defaults of preset hard)" in text
    assert "--robots, --arena.num_robots N" in text
