"""A run that has ended is resumed with another limit, or refused in one line and left as it is."""

from pathlib import Path

import pytest

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome, Stats
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.run_directory import RunDirectory
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule
from mrcdrl.services.train.launcher import open_run
from mrcdrl.services.train.resuming import check_unfinished

TARGET = {"run.target_success_rate": "0.9"}
STEPS = {"run.learner_steps": "60"}
PATIENCE = {"run.patience_episodes": "50"}


def ended(folder: Path, limits: dict[str, str]) -> Path:
    """A run that has reached each kind of limit, and was made with these."""
    config = load_config("smoke", {**limits, "run.minutes": "0"} | limits, environ={})
    with RunDirectory.create(folder / "two", config) as run:
        state = RunState(config)
        with Recorder(run.path, config) as recorder:
            for number in range(200):
                outcome = Outcome.SUCCESS if number < 100 else Outcome.TIMEOUT
                episode = EpisodeSummary("actor-0", 1, number, outcome, 9, 1.0, 0, 0.1, 0, 1.0, 2)
                state.observe_episode(episode)
                recorder.record_episode(episode, state, 5.0)
            judged = Evaluation(
                "0",
                1,
                3,
                50,
                2,
                100,
                0.95,
                0.05,
                0.0,
                (0.9, 1.0),
                95.0,
                95.0,
                0.0,
                9.0,
                1.0,
                1,
                2.0,
            )
            recorder.record_evaluation(state.observe_evaluation(judged, 6.0))
            counted = {"learner_steps": 60.0, "weights_version": 7.0}
            state.observe_stats(Stats("learner", "0", counted), 7.0)
            state.observe_stats(Stats("replay", "0", {"inserts": 500.0, "samples": 900.0}), 7.0)
            recorder.record_metrics(state, 7.0)
            recorder.write_summary(state, 7.0, "its rule")
    return run.path


def content(path: Path) -> dict[str, bytes]:
    return {str(file): file.read_bytes() for file in path.rglob("*") if file.is_file()}


@pytest.mark.parametrize(
    ("limits", "flags", "reason"),
    [
        (TARGET, [], "evaluation success 0.950 reached run.target_success_rate 0.9"),
        (PATIENCE, [], "no new maximum above 100 successes"),
        (STEPS, [], "learner step limit reached .60."),
        (
            STEPS,
            ["--minutes", "30"],
            "learner step limit reached .60.; .*--minutes 30 --learner-steps 0",
        ),
        (STEPS, ["--learner-steps", "50"], "learner step limit reached .50."),
        ({}, ["--learner-steps", "60"], "learner step limit reached .60."),
        (TARGET, ["--agent.learning_rate", "1e-5"], "evaluation success"),
    ],
)
def test_a_run_with_nothing_left_to_do_is_refused_and_left_as_it_is(
    limits: dict[str, str], flags: list[str], reason: str, tmp_path: Path
) -> None:
    path = ended(tmp_path, limits)
    before = content(path)
    with pytest.raises(RunDirectoryError, match=f"two has ended: {reason}"):
        open_run(["--resume", str(path), *flags])
    assert content(path) == before


@pytest.mark.parametrize(
    ("limits", "flags"),
    [
        (TARGET, ["--minutes", "30"]),
        (TARGET, ["--run.target_success_rate", "0.98"]),
        (PATIENCE, ["--minutes", "30"]),
        (PATIENCE, ["--run.patience_episodes", "0"]),
        (STEPS, ["--learner-steps", "90"]),
        (STEPS, ["--minutes", "30", "--learner-steps", "0"]),
        ({"run.minutes": "1"}, []),  # counts from this start
        ({"run.minutes": "1"}, ["--minutes", "1"]),
    ],
)
def test_a_run_with_another_limit_goes_on(
    limits: dict[str, str], flags: list[str], tmp_path: Path
) -> None:
    path = ended(tmp_path, limits)
    with open_run(["--resume", str(path), *flags]) as run:
        assert run.resumed


def test_a_limit_of_the_environment_counts_if_it_is_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = ended(tmp_path, TARGET)
    monkeypatch.setenv("MRCDRL_RUN__MINUTES", "0")
    with pytest.raises(RunDirectoryError, match="has ended"):
        open_run(["--resume", str(path)])
    monkeypatch.setenv("MRCDRL_RUN__MINUTES", "30")
    open_run(["--resume", str(path)]).close()


def test_a_run_without_records_is_unfinished(tmp_path: Path) -> None:
    check_unfinished(tmp_path, Config(), Config(), {})


def test_counters_continue_until_their_services_report_again(tmp_path: Path) -> None:
    path = ended(tmp_path, {})
    config = load_config(str(path / "config.toml"), environ={})
    state = RunState(config)
    with Recorder(path, config) as recorder:
        recorder.restore(state, StoppingRule(config.run))
    counters = (state.learner_steps, state.weights_version, state.inserts, state.samples)
    assert counters == (60, 7, 500, 900)
