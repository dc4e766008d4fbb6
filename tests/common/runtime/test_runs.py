"""A word means one run, wherever it is given; a word that means none is answered with the nearest.

Every command that takes a run takes it so: by name, path, or `latest`.
"""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from mrcdrl.common.config.arguments import Parser
from mrcdrl.common.errors import ConfigError, RunDirectoryError, UnreachableError
from mrcdrl.common.runtime.runs import (
    active_s,
    add_run,
    find_run,
    find_weights,
    new_run_path,
    run_path,
    run_paths,
    runs_folder,
)
from mrcdrl.common.sync.joining import Joining


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two runs, of which `two` was active last; the current directory is another one."""
    runs = tmp_path / "runs"
    for at_s, name in ((300, "four"), (500, "two")):
        (runs / name).mkdir(parents=True)
        (runs / name / "config.toml").touch()
        os.utime(runs / name / "config.toml", (at_s, at_s))
    (runs / "experiments").mkdir()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.setenv("MRCDRL_RUN_DIR", str(runs))
    return runs


def test_runs_are_in_the_folder_of_the_flag_then_of_the_variable_then_here(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert runs_folder(Path("given")) == Path("given")
    assert runs_folder() == folder
    monkeypatch.delenv("MRCDRL_RUN_DIR")
    assert runs_folder() == Path("runs")


def test_only_runs_are_listed(folder: Path) -> None:
    assert [path.name for path in run_paths(folder)] == ["four", "two"]
    assert run_paths(folder / "none") == []


@pytest.mark.parametrize("find", [run_path, find_run, find_weights])
def test_a_name_a_path_and_latest_mean_a_run(
    folder: Path, find: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert find("four") == folder / "four"
    assert find(f"{folder}/four/") == folder / "four"
    assert find("../runs/four").resolve() == folder / "four"
    assert find("latest") == folder / "two"
    monkeypatch.chdir(folder)
    monkeypatch.delenv("MRCDRL_RUN_DIR")
    assert find("four").resolve() == folder / "four"  # beside a folder of runs
    monkeypatch.chdir("four")
    assert find(".").resolve() == folder / "four"


def test_the_run_whose_records_or_transitions_are_newest_was_active_last(folder: Path) -> None:
    for file in ("metrics.jsonl", "replay/0/000000000000000.segment"):
        newest = active_s(folder / "two") + 100
        for run in ("four", "two"):
            path = folder / run / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            os.utime(path, (newest - 50 * (run == "two"),) * 2)
        assert find_run("latest") == folder / "four"
        os.utime(folder / "two" / file, (newest + 1,) * 2)
        assert find_run("latest") == folder / "two"


@pytest.mark.parametrize(
    ("word", "nearest"),
    [("fuor", "four"), ("tow", "two"), ("nowhere/at/all", None), ("xyz", None)],
)
def test_an_unknown_run_is_answered_with_the_nearest_and_the_folder(
    folder: Path, word: str, nearest: str | None
) -> None:
    with pytest.raises(RunDirectoryError) as refused:
        find_run(word)
    said = str(refused.value)
    assert "\n" not in said
    assert (f"did you mean {nearest}?" in said) == (nearest is not None)
    assert str(folder if "/" not in word else Path("nowhere/at").resolve()) in said


def test_part_of_a_long_name_finds_it(folder: Path) -> None:
    (folder / "quick-2robots-20261122-101500" / "checkpoints").mkdir(parents=True)
    with pytest.raises(RunDirectoryError, match="did you mean quick-2robots-20261122-101500"):
        find_run("quick")


def test_without_runs_it_is_said_how_to_name_their_folder(tmp_path: Path) -> None:
    for word in ("latest", "four"):
        with pytest.raises(
            RunDirectoryError, match=r"no runs in .*; give --run-dir or set MRCDRL_"
        ):
            find_run(word, tmp_path)


def test_weights_may_also_be_a_file_or_a_checkpoint(folder: Path) -> None:
    step = folder / "four" / "checkpoints" / "step_000000000010"
    step.mkdir(parents=True)
    assert find_weights(str(step)) == step
    assert find_weights("missing.safetensors") == Path("missing.safetensors")  # its reader says so
    with pytest.raises(RunDirectoryError, match="did you mean four"):
        find_weights("fourr")


def test_no_run_is_named_latest_or_what_no_key_takes(folder: Path) -> None:
    assert new_run_path("six") == folder / "six"
    assert new_run_path("mine/six") == Path("mine/six")
    for name in ("latest", "a b", "mine/.."):
        with pytest.raises(ConfigError):
            new_run_path(name)
    with pytest.raises(ConfigError, match="give a run"):
        run_path(None)


@pytest.mark.parametrize("argv", [["four"], ["--run", "four"], ["--id", "a", "four"]])
def test_the_run_is_a_position_or_a_flag(argv: list[str]) -> None:
    parser = Parser()
    add_run(parser)
    parser.add_argument("--id")
    assert parser.parse_args(argv).run == "four"
    assert parser.parse_args([]).run is None


def test_who_joins_a_run_finds_its_endpoint_and_its_name(folder: Path) -> None:
    (folder / "two" / "endpoint").write_text("tcp/127.0.0.1:1234")
    for word in ("two", "latest", str(folder / "two")):
        joining = Joining.from_argv("actor", [word])
        assert (joining.run, joining.run_dir) == ("two", folder / "two")
        assert joining.transport.connect == ("tcp/127.0.0.1:1234",)
    elsewhere = Joining.from_argv("actor", ["six", "--connect", "tcp/host:7447"])
    assert (elsewhere.run, elsewhere.run_dir) == ("six", folder / "six")


def test_who_joins_an_unknown_run_is_told_the_nearest(folder: Path) -> None:
    with pytest.raises(UnreachableError, match=r"did you mean four\?; give --connect"):
        Joining.from_argv("actor", ["fuor"])
    with pytest.raises(UnreachableError, match=r"no run is up in .*four; give --connect"):
        Joining.from_argv("actor", ["four"])
