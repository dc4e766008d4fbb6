"""What watches a run degrades, says so once, and ends nothing."""

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig, load_config
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome, Stats
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.monitor.follower import Follower
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.records import read_episodes, read_last_metrics
from mrcdrl.services.monitor.screen import plain_line
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule
from mrcdrl.services.monitor.watching import Watching

CONFIG = load_config("smoke", environ={})
EPISODE = EpisodeSummary("actor-0", 1, 1, Outcome.SUCCESS, 99, 150.5, 1, 0.1, 5, 2.0, 2)
EVALUATION = Evaluation(
    "e", 1, 1, 50, 2, 100, 0.5, 0.5, 0.0, (0.2, 1.0), 9.0, 9.0, 4.0, 110.0, 150.0, 1, 20.0
)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(28, "No space left on device"), "No space left on device"),
        (RunDirectoryError("a is not of this version"), "a is not of this version"),
        (ValueError("cannot convert float NaN"), "ValueError: cannot convert float NaN"),
    ],
)
def test_a_failure_is_said_once_for_each_part(
    error: Exception, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    watching = Watching()
    for part in ("recording", "recording", "the display"):
        with watching(part):
            raise error
    assert [r.getMessage() for r in caplog.records] == [
        f"recording failed: {said}; the run goes on",
        f"the display failed: {said}; the run goes on",
    ]


def test_what_is_to_pass_is_raised() -> None:
    watching = Watching(passes=(OSError,))
    with pytest.raises(BrokenPipeError), watching("the display"):
        raise BrokenPipeError
    with watching("the display"):
        raise ValueError


@contextmanager
def full_disk(folder: Path) -> Iterator[None]:
    """Have every file below the folder that this process has open take no byte more."""
    links = Path("/proc/self/fd").iterdir()
    there = [int(link.name) for link in links if folder in link.resolve().parents]
    assert there
    kept = {descriptor: os.dup(descriptor) for descriptor in there}
    full = os.open("/dev/full", os.O_WRONLY)
    for descriptor in there:
        os.dup2(full, descriptor)
    os.close(full)
    yield
    for descriptor, copy in kept.items():
        os.dup2(copy, descriptor)
        os.close(copy)


def a_second(recorder: Recorder, state: RunState, now: float) -> None:
    """What a run gives to record in one second; more than any buffer holds."""
    for _ in range(100):
        state.observe_episode(EPISODE)
        recorder.record_episode(EPISODE, state, now)
    recorder.record_evaluation(state.observe_evaluation(EVALUATION, now))
    recorder.record_metrics(state, now)


def test_a_full_disk_ends_no_run_and_recording_goes_on_when_there_is_room(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state = RunState(CONFIG)
    state.observe_stats(Stats("learner", "0", {"learner_steps": 5.0, "loss": 0.5}), 0.0)
    with Recorder(tmp_path, CONFIG) as recorder:
        a_second(recorder, state, 0.0)
        with full_disk(tmp_path):
            for second in range(1, 4):
                a_second(recorder, state, float(second))
        a_second(recorder, state, 9.0)
        recorder.write_summary(state, 10.0, "over")
    assert sorted(r.getMessage() for r in caplog.records) == [
        "recording failed: No space left on device; the run goes on",
        "tensorboard failed: No space left on device; the run goes on",
    ]
    assert (tmp_path / "summary.json").is_file()
    assert read_last_metrics(tmp_path)["time_s"] == 9.0
    assert len(read_episodes(tmp_path)) >= 200
    assert events_of(tmp_path) > 200


class Odd(RunState):
    """Cannot fold in what an actor called odd says."""

    def observe_stats(self, stats: Stats, now: float) -> None:
        if stats.id == "odd":
            raise OverflowError("int too large")
        super().observe_stats(stats, now)


def test_a_message_that_cannot_be_folded_in_is_left_out_and_the_next_are_not(
    caplog: pytest.LogCaptureFixture,
) -> None:
    state, keys = Odd(CONFIG), Keys("odd")
    with Session(TransportConfig(listen=(free_endpoint(),))) as session:
        follower = Follower(session, keys, state, None, StoppingRule(CONFIG.run))
        for actor in ("odd", "even"):
            session.announce(keys.live("actor", actor))
        for actor in ("odd", "odd", "even"):
            stats = Stats("actor", actor, {"robot_steps": 5.0}, {})
            session.publisher(keys.stats("actor", actor)).put(encode(stats))
        while not state.robot_steps:
            follower.listen(0.05)
    assert caplog.messages == [
        "following Stats messages failed: OverflowError: int too large; the run goes on"
    ]


@pytest.mark.parametrize("steps", [1e19, -1.0, float("nan"), float("inf")])
def test_one_odd_count_of_learner_steps_ends_nothing(steps: float, tmp_path: Path) -> None:
    state, keys, rule = RunState(CONFIG), Keys("odd"), StoppingRule(CONFIG.run)
    with (
        Session(TransportConfig(listen=(free_endpoint(),))) as session,
        Recorder(tmp_path, CONFIG) as recorder,
    ):
        follower = Follower(session, keys, state, recorder, rule)
        for learner, count in (("x1", steps), ("0", 7.0)):
            session.announce(keys.live("learner", learner))
            stats = Stats("learner", learner, {"learner_steps": count, "weights_version": count})
            session.publisher(keys.stats("learner", learner)).put(encode(stats))
        while not state.learner_steps:
            follower.listen(0.05)
        assert "learner steps 7 " in plain_line(state, follower.now)
        assert follower.stop_reason(learner_ended=True) is None
        recorder.record_metrics(state, follower.now)
    assert read_last_metrics(tmp_path)["learner_steps"] == 7


def events_of(run_dir: Path) -> int:
    """The number of whole events in the run's file; it has nothing else."""
    (path,) = (run_dir / "tensorboard").iterdir()
    content, count = path.read_bytes(), 0
    while content:
        (length,) = struct.unpack_from("<Q", content)
        assert len(content) >= length + 16
        content, count = content[length + 16 :], count + 1
    return count


def test_a_disk_that_is_full_at_the_end_keeps_what_was_written(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state = RunState(CONFIG)
    recorder = Recorder(tmp_path, CONFIG)
    a_second(recorder, state, 0.0)
    with full_disk(tmp_path):
        a_second(recorder, state, 1.0)
        recorder.close()
    assert len(read_episodes(tmp_path)) == 100
    assert len(caplog.records) == 2


def test_a_step_that_tensorboard_cannot_hold_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state = RunState(CONFIG)
    state.observe_stats(Stats("learner", "x1", {"learner_steps": 1e19, "loss": 0.5}), 0.0)
    with Recorder(tmp_path, CONFIG) as recorder:
        recorder.record_metrics(state, 1.0)
    (said,) = [r.getMessage() for r in caplog.records]
    assert said.startswith("tensorboard failed: ValueError")
    assert read_last_metrics(tmp_path)["time_s"] == 1.0
