"""A run directory is held by one process, and each of its errors is one line."""

import threading
from pathlib import Path

import pytest

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.errors import ConfigError, RunDirectoryError
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.services.monitor.run_directory import RunDirectory, default_name

CONFIG = load_config("smoke", {"arena.num_robots": "3"}, {})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "first"


def test_a_new_directory_holds_the_resolved_configuration(path: Path) -> None:
    with RunDirectory.create(path, CONFIG) as run:
        assert load_config(str(path / RUN_CONFIG), environ={}) == run.config == CONFIG
        assert run.logs.is_dir()
        assert not run.resumed
        run.note_endpoint("tcp/127.0.0.1:7")
        assert (path / "endpoint").read_text() == "tcp/127.0.0.1:7"
    assert not (path / "endpoint").exists()
    assert {entry.name for entry in path.iterdir()} == {RUN_CONFIG, "logs"}


def test_a_directory_that_exists_is_not_a_new_run(path: Path) -> None:
    path.mkdir(parents=True)
    (path / "mine.txt").write_text("mine")
    with pytest.raises(
        RunDirectoryError, match=r"exists; take another --name, or .* --resume first"
    ):
        RunDirectory.create(path, CONFIG)
    assert [entry.name for entry in path.iterdir()] == ["mine.txt"]


def test_a_run_is_resumed_with_what_the_flags_change(path: Path) -> None:
    RunDirectory.create(path, CONFIG).close()
    with RunDirectory.resume(path, {"run.minutes": "7"}) as run:
        assert run.resumed
        assert run.config.run.minutes == 7
        assert run.config.arena.num_robots == 3
    assert load_config(str(path / RUN_CONFIG), environ={}).run.minutes == 7


@pytest.mark.parametrize("made", [False, True])
def test_what_is_not_a_run_is_not_resumed(path: Path, made: bool) -> None:
    if made:
        path.mkdir(parents=True)
    with pytest.raises(RunDirectoryError, match="is not a run"):
        RunDirectory.resume(path, {})


def test_a_run_whose_configuration_is_broken_is_not_resumed(path: Path) -> None:
    RunDirectory.create(path, CONFIG).close()
    (path / RUN_CONFIG).write_text("[learners]\n")
    with pytest.raises(ConfigError, match="did you mean learner"):
        RunDirectory.resume(path, {})


def test_a_run_that_is_up_is_not_resumed(path: Path) -> None:
    with (
        RunDirectory.create(path, CONFIG),
        pytest.raises(RunDirectoryError, match="in use by another process"),
    ):
        RunDirectory.resume(path, {})
    RunDirectory.resume(path, {}).close()


def test_of_many_that_resume_at_once_one_does(path: Path) -> None:
    RunDirectory.create(path, CONFIG).close()
    together, taken, refused = threading.Barrier(4), [], []

    def resume() -> None:
        together.wait(20)
        try:
            taken.append(RunDirectory.resume(path, {}))
        except RunDirectoryError:
            refused.append(1)

    threads = [threading.Thread(target=resume) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(taken), len(refused)) == (1, 3)
    taken[0].close()


def test_a_file_in_place_of_a_directory_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("a file")
    with pytest.raises(RunDirectoryError, match=r"cannot create .*Not a directory") as refused:
        RunDirectory.create(tmp_path / "runs" / "first", CONFIG)
    assert "\n" not in str(refused.value)


def test_a_file_in_place_of_the_logs_is_one_line(path: Path) -> None:
    RunDirectory.create(path, CONFIG).close()
    (path / "logs").rmdir()
    (path / "logs").write_text("a file")
    with pytest.raises(RunDirectoryError, match=r"cannot write .*File exists"):
        RunDirectory.resume(path, {})


@pytest.mark.parametrize("config", ["quick", "some/where/quick.toml"])
def test_the_default_name_is_made_of_preset_robots_and_time(config: str) -> None:
    assert default_name(config, 3).startswith("quick-3robots-2")


@pytest.mark.parametrize("name", ["arena.num_robots", "agent.kind"])
def test_a_resumed_run_keeps_its_arena_and_agent(tmp_path: Path, name: str) -> None:
    RunDirectory.create(tmp_path / "run", Config()).close()
    before = (tmp_path / "run" / "config.toml").read_bytes()
    with pytest.raises(RunDirectoryError, match=f"{name} cannot be changed"):
        RunDirectory.resume(tmp_path / "run", {name: "3"})
    assert (tmp_path / "run" / "config.toml").read_bytes() == before
