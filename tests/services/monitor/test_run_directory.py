"""A run directory is held by one process, and each of its errors is one line."""

import re
import threading
from pathlib import Path

import pytest

from mrcdrl.common.config import Config, load_config, variable
from mrcdrl.common.errors import ConfigError, RunDirectoryError
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.services.monitor.run_directory import RunDirectory, default_name
from tests.patience import PATIENCE_S

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
        together.wait(PATIENCE_S)
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


CHANGES = {
    "arena.num_robots": ("2", "3"),
    "arena.step_reward": ("0.03", "0.0"),
    "agent.kind": ("duel", "dqn"),
    "agent.gamma": ("0.99", "0.5"),
    "agent.n_step": ("1", "3"),
    "agent.reward_scale": ("1.0", "0.1"),
    "agent.shaping_per_px": ("0.0", "0.01"),
    "agent.optimizer": ("adam", "rmsprop"),
    "replay.shards": ("1", "2"),
    "learner.initial_weights": ("", "other.safetensors"),
    "run.turn_size": ("0", "64"),
}
TURNS = {
    "run.turn_size": ("64", "128"),
    "actor.num_arenas": ("8", "4"),
    "replay.min_size": ("50000", "40000"),
    "replay.samples_per_insert": ("8.0", "4.0"),
    "learner.batch_size": ("32", "64"),
}


@pytest.mark.parametrize("source", ["flag", "environment"])
@pytest.mark.parametrize(
    ("lockstep", "name"), [(False, n) for n in CHANGES] + [(True, n) for n in TURNS]
)
def test_a_resumed_run_keeps_what_its_records_depend_on(
    tmp_path: Path, lockstep: bool, name: str, source: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new = (TURNS if lockstep else CHANGES)[name]
    made_with = load_config(None, {"run.turn_size": "64"} if lockstep else {}, environ={})
    RunDirectory.create(tmp_path / "run", made_with).close()
    file = tmp_path / "run" / "config.toml"
    before = file.read_bytes()
    given = {name: new} if source == "flag" else {}
    if source == "environment":
        monkeypatch.setenv(variable(*name.split(".")), new)
    with pytest.raises(RunDirectoryError) as refused:
        RunDirectory.resume(tmp_path / "run", given)
    line = str(refused.value)
    assert re.search(rf"{name} is {new} here and {old} in .*run, whose", line)
    assert variable(*name.split(".")) in line
    assert "\n" not in line
    assert file.read_bytes() == before


def test_settings_that_nothing_depends_on_may_change(path: Path) -> None:
    RunDirectory.create(path, CONFIG).close()
    given = {"agent.learning_rate": "1e-5", "learner.batch_size": "16", "replay.capacity": "90_000"}
    with RunDirectory.resume(path, {**given, "arena.num_robots": "3"}) as run:  # 3 as before
        assert run.config.learner.batch_size == 16


def test_a_run_that_a_check_refuses_stays_as_it_was(path: Path) -> None:
    RunDirectory.create(path, CONFIG).close()
    before = (path / RUN_CONFIG).read_bytes()

    def refuse(was: Config, now: Config) -> None:
        assert (was.run.minutes, now.run.minutes) == (CONFIG.run.minutes, 7)
        raise RunDirectoryError("nothing left to do")

    with pytest.raises(RunDirectoryError, match="nothing left"):
        RunDirectory.resume(path, {"run.minutes": "7"}, refuse)
    assert (path / RUN_CONFIG).read_bytes() == before
    RunDirectory.resume(path, {}).close()  # it is held no more


def test_default_names_of_runs_that_start_at_once_are_made_unique(path: Path) -> None:
    made: list[RunDirectory] = []
    together = threading.Barrier(4)

    def create() -> None:
        together.wait()
        made.append(RunDirectory.create_free(path, CONFIG))

    threads = [threading.Thread(target=create) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(run.path.name for run in made) == ["first", "first-2", "first-3", "first-4"]
    for run in made:
        run.close()


def test_a_name_that_cannot_be_created_is_not_tried_again(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunDirectoryError, match="cannot create"):
        RunDirectory.create_free(tmp_path / "file" / "run", CONFIG)
