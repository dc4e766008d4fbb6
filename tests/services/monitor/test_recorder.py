"""The records of a run, and how they are resumed."""

import json
import math
import os
import struct
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.proto.plugin_hparams_pb2 import HParamsPluginData

from mrcdrl.common.config import load_config
from mrcdrl.common.config.returns import largest_return
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome, Stats
from mrcdrl.common.runtime.files import atomic_write
from mrcdrl.services.monitor import records
from mrcdrl.services.monitor.recorder import RESULTS, Recorder
from mrcdrl.services.monitor.records import (
    read_episodes,
    read_evaluations,
    read_last_metrics,
    read_latest_metrics,
)
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule

CONFIG = load_config("quick", environ={})
PICTURE = Path(__file__).parents[3] / "docs" / "images" / "renderers.png"


def episode(number: int, mean_q: float = 2.0) -> EpisodeSummary:
    outcome = Outcome.SUCCESS if number % 4 else Outcome.TIMEOUT
    return EpisodeSummary("actor-0", 1, number, outcome, 99, 150.5, 1, 0.1, 5, mean_q, 2)


def evaluation(rate: float, step: int) -> Evaluation:
    return Evaluation(
        "0", 1, step // 50, step, 2, 100, rate, 1 - rate, 0.0, (rate / 2, 1.0),
        math.nan, 90.0, 4.0, 110.0, 150.0, 1, 20.0,
    )  # fmt: skip


def record(run_dir: Path, episodes: range, rates: list[float], start_s: float = 0.0) -> RunState:
    """Record part of a run as the launcher does."""
    state = RunState(CONFIG)
    with Recorder(run_dir, CONFIG) as recorder:
        recorder.restore(state, StoppingRule(CONFIG.run))
        for second in range(3):
            now = start_s + second
            counted = {"env_steps": 10.0 * second, "robot_steps": 20.0 * second}
            state.observe_stats(Stats("actor", "0", counted), now)
            state.observe_stats(Stats("learner", "0", {"learner_steps": 5, "loss": 0.5}), now)
            recorder.record_metrics(state, now)
        for number in episodes:
            state.observe_episode(episode(number))
            recorder.record_episode(episode(number), state, start_s + 3)
        for k, rate in enumerate(rates):
            judged = evaluation(rate, 1_000 * (k + 1))
            recorder.record_evaluation(state.observe_evaluation(judged, start_s + 10 * k))
        recorder.write_summary(state, start_s + 60, "time limit reached (1 min)")
    return state


def test_lines_read_back_to_what_was_recorded(tmp_path: Path) -> None:
    record(tmp_path, range(120), [0.4])
    episodes, (test,) = read_episodes(tmp_path), read_evaluations(tmp_path)
    assert [r.episode for r in episodes] == [episode(number) for number in range(120)]
    assert (episodes[0].time_s, episodes[0].learner_steps) == (3.0, 5)
    assert (test.env_steps, test.robot_steps) == (20, 40)
    assert math.isnan(test.evaluation.max_per_100)
    assert test.evaluation.success_interval == (0.2, 1.0)
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    last = json.loads(lines[-1])
    assert len(lines) == 3
    assert (last["time_s"], last["env_steps"], last["learner/0/loss"]) == (2.0, 20, 0.5)
    assert last["robot_steps_per_s"] == pytest.approx(20)


def test_tensorboard_events_are_written(tmp_path: Path) -> None:
    record(tmp_path, range(120), [0.4])
    (events,) = (tmp_path / "tensorboard").iterdir()
    content = events.read_bytes()
    for tag in ("training/score", "training/successes_per_100", "training/mean_q",
                "evaluation/success_rate", "rates/robot_steps_per_s", "learner/loss"):  # fmt: skip
        assert tag.encode() in content


def summaries(run_dir: Path) -> list[tuple[int, Any]]:
    """Step and value of every event, as TensorBoard reads them."""
    found = []
    for path in sorted((run_dir / "tensorboard").iterdir()):
        data, at = path.read_bytes(), 0
        while at < len(data):
            (length,) = struct.unpack_from("<Q", data, at)
            event = Event.FromString(data[at + 12 : at + 12 + length])
            found += [(event.step, value) for value in event.summary.value]
            at += 16 + length
    return found


def test_tensorboard_is_given_histograms_and_no_bins(tmp_path: Path) -> None:
    state, scale = RunState(CONFIG), largest_return(CONFIG)
    bins = {f"q_bin_{i}": 0.1 for i in range(10)} | {f"td_error_bin_{i}": 0.1 for i in range(10)}
    metrics = {"learner_steps": 7.0, "q_min": -3 * scale, "q_max": 2.0} | bins
    with Recorder(tmp_path, CONFIG) as recorder:
        for second in range(3):  # the same bins thrice: they are sent now and then
            state.observe_stats(Stats("learner", "0", metrics), second)
            recorder.record_metrics(state, second)
        for odd in ({"q_bin_0": 1e300}, {"q_bin_0": 0.2, "q_max": math.nan}):
            state.observe_stats(Stats("learner", "0", metrics | odd), 3)
            recorder.record_metrics(state, 3)
    found = [(step, v) for step, v in summaries(tmp_path) if v.HasField("histo")]
    (step, q), (_, errors) = found
    assert (step, q.tag, errors.tag) == (7, "learner/q", "learner/td_error")
    assert (q.histo.min, q.histo.max) == (-3 * scale, scale)
    assert list(q.histo.bucket_limit) == pytest.approx(
        [i / 4 * scale for i in range(-4, 5)] + [scale]
    )
    assert list(q.histo.bucket) == [0.1] * 10
    assert errors.histo.bucket_limit[0] == pytest.approx(scale / 1e4)
    assert not [v.tag for _, v in summaries(tmp_path) if "_bin" in v.tag]


def test_tensorboard_is_given_settings_the_result_and_pictures(tmp_path: Path) -> None:
    gif = b"GIF89a" + struct.pack("<HH", 300, 200) + b"the rest"
    with Recorder(tmp_path, CONFIG) as recorder:
        state = RunState(CONFIG)
        for rate in (0.9, 0.4):
            recorder.record_evaluation(state.observe_evaluation(evaluation(rate, 10), 1.0))
        recorder.record_metrics(state, 1.0)
        recorder.write_summary(state, 60, "time limit reached (1 min)")
        (tmp_path / "training.png").write_bytes(PICTURE.read_bytes())
        (tmp_path / "trajectories.png").write_bytes(b"cut off")
        (tmp_path / "evaluation.gif").write_bytes(gif)
        recorder.record_pictures()
    found = {value.tag: value for _, value in summaries(tmp_path)}
    text = found["configuration/text_summary"].tensor.string_val[0].decode()
    assert "    gamma = 0.99" in text.splitlines()
    start = HParamsPluginData.FromString(
        found["_hparams_/session_start_info"].metadata.plugin_data.content
    )
    given = start.session_start_info.hparams
    assert given["agent.gamma"].number_value == 0.99
    assert given["agent.kind"].string_value == "duel"
    assert not [name for name in given if name.startswith("transport")]
    compared = HParamsPluginData.FromString(
        found["_hparams_/experiment"].metadata.plugin_data.content
    ).experiment.metric_infos
    assert [info.name.tag for info in compared] == list(RESULTS)
    assert found["result/best_success_rate"].simple_value == pytest.approx(0.9)
    assert found["result/last_success_rate"].simple_value == pytest.approx(0.4)
    assert found["run/training"].image.encoded_image_string == PICTURE.read_bytes()
    film = found["run/evaluation"].image
    assert (film.width, film.height, film.encoded_image_string) == (300, 200, gif)
    assert "run/trajectories" not in found


def test_a_resumed_run_appends_and_knows_its_past(tmp_path: Path) -> None:
    record(tmp_path, range(150), [0.4, 0.6])
    state = record(tmp_path, range(150, 200), [0.9], start_s=13.0)
    assert state.episodes == 200
    assert state.hundreds == [75, 75]
    assert [r.evaluation.success_rate for r in state.evaluations] == [0.4, 0.6, 0.9]
    assert (state.env_steps, state.robot_steps) == (40, 80)
    assert len(read_episodes(tmp_path)) == 200
    recorder = Recorder(tmp_path, CONFIG)
    assert recorder.restore(RunState(CONFIG), StoppingRule(CONFIG.run)) == 16.0
    recorder.close()
    recorder.close()


@pytest.mark.parametrize("torn", ['{"time_s": 9.0, "learner', "\x00\x00", "7"])
def test_a_torn_last_line_is_cut_off(tmp_path: Path, torn: str) -> None:
    record(tmp_path, range(10), [0.4])
    for name in ("episodes.jsonl", "evaluations.jsonl", "metrics.jsonl"):
        with (tmp_path / name).open("a") as file:
            file.write(torn)
    assert len(read_episodes(tmp_path)) == 10
    assert read_last_metrics(tmp_path)["time_s"] == 2.0
    assert record(tmp_path, range(10, 12), [0.5], 20.0).episodes == 12
    assert [r.episode.episode for r in read_episodes(tmp_path)] == list(range(12))
    for name in ("episodes.jsonl", "evaluations.jsonl", "metrics.jsonl"):
        assert all(json.loads(line) for line in (tmp_path / name).read_text().splitlines())


def test_the_stopping_rule_is_fed_with_the_past(tmp_path: Path) -> None:
    record(tmp_path, range(10), [0.95])
    run = CONFIG.run.model_copy(update={"target_success_rate": 0.9})
    rule = StoppingRule(run)
    with Recorder(tmp_path, CONFIG) as recorder:
        recorder.restore(RunState(CONFIG), rule)
    assert rule.reason(0, 0.0, (1.0, 20)) is not None


def test_a_value_that_is_not_finite_is_strict_json(tmp_path: Path) -> None:
    state = RunState(CONFIG)
    with Recorder(tmp_path, CONFIG) as recorder:
        state.observe_episode(episode(1, math.nan))
        recorder.record_episode(episode(1, math.nan), state, 1.0)
    assert "NaN" not in (tmp_path / "episodes.jsonl").read_text()
    assert math.isnan(read_episodes(tmp_path)[0].episode.mean_q)


def test_what_several_learners_claim_makes_neither_long_lines_nor_odd_events(
    tmp_path: Path,
) -> None:
    """A run has one learner; what its metrics are is in a schema."""
    state = RunState(CONFIG)
    state.observe_stats(Stats("learner", "0", {"learner_steps": 5.0, "loss": 1e308}), 0.0)
    for number in range(200):
        many = {f"odd{metric}": 1.0 for metric in range(256)}
        claim = Stats("learner", f"x{number}", many | {"learner_steps": 1e15})
        state.observe_stats(claim, 0.0)
    with Recorder(tmp_path, CONFIG) as recorder:
        recorder.record_metrics(state, 1.0)
    assert read_last_metrics(tmp_path)["learner_steps"] == 5
    assert (tmp_path / "metrics.jsonl").stat().st_size < 1 << 16
    (events,) = (tmp_path / "tensorboard").iterdir()
    assert b"learner/learner_steps" in events.read_bytes()
    assert b"learner/loss" not in events.read_bytes()  # no float32
    assert b"odd" not in events.read_bytes()


def test_the_last_line_of_metrics_is_found_however_long_it_is(tmp_path: Path) -> None:
    long = json.dumps({"time_s": 2.0, "note": "x" * (3 << 20)})
    (tmp_path / "metrics.jsonl").write_text(f'{{"time_s": 1.0}}\n{long}\n')
    assert read_last_metrics(tmp_path)["time_s"] == 2.0


def test_a_foreign_line_and_a_directory_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    (tmp_path / "episodes.jsonl").write_text('{"time_s": 1.0}\n')
    with pytest.raises(RunDirectoryError, match="not of this version"):
        read_episodes(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunDirectoryError, match="cannot be written"):
        Recorder(tmp_path / "file" / "run", CONFIG)


def test_summary(tmp_path: Path) -> None:
    record(tmp_path, range(250), [0.4, 0.85, 0.95, 0.91])
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["stop_reason"] == "time limit reached (1 min)"
    assert summary["wall_s"] == 60
    assert (summary["env_steps"], summary["robot_steps"], summary["learner_steps"]) == (20, 40, 5)
    assert {"inserts", "samples", "weights_version"} <= summary.keys()
    table = summary["training_success_per_100"]
    assert table == {"last": 75, "max": 75, "average": 75.0, "variance": 0.0, "hundreds": 2}
    assert summary["evaluation"]["last"]["success_rate"] == 0.91
    assert summary["evaluation"]["best"]["success_rate"] == 0.95
    assert summary["evaluation"]["best"]["max_per_100"] is None
    assert summary["reached"]["0.5"] == {
        "seconds": 10.0, "learner_steps": 2_000, "robot_steps": 40
    }  # fmt: skip
    assert summary["reached"]["0.9"] == summary["reached"]["0.94"]
    assert summary["versions"].keys() == {"python", "mrcdrl", "zenoh", "numpy", "torch"}
    assert summary["machine"]["cores"] == os.cpu_count()


def test_summary_of_a_run_in_which_nothing_happened(tmp_path: Path) -> None:
    record(tmp_path, range(0), [])
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["training_success_per_100"]["max"] is None
    assert summary["evaluation"] == {"count": 0, "last": None, "best": None}
    assert set(summary["reached"].values()) == {None}


def test_atomic_write_leaves_the_new_content_and_nothing_beside_it(tmp_path: Path) -> None:
    for data in (b"old", b"new"):
        atomic_write(tmp_path / "file", data)
    assert (tmp_path / "file").read_bytes() == b"new"
    with pytest.raises(OSError, match="directory"):
        atomic_write(tmp_path, b"data")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_episodes_of_a_version_that_recorded_no_number_of_robots_are_read(tmp_path: Path) -> None:
    line = {"time_s": 1.0, "learner_steps": 5} | asdict(episode(1))
    del line["num_robots"]
    (tmp_path / "episodes.jsonl").write_text(json.dumps(line) + "\n")
    (read,) = read_episodes(tmp_path)
    assert read.episode == replace(episode(1), num_robots=0)


def test_the_latest_metrics_are_read_without_those_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = [f'{{"time_s": {second}}}\n' for second in range(500)]
    (tmp_path / "metrics.jsonl").write_text("".join([*lines, "\0\0\n", '{"time_s": 5']))
    parsed: list[bytes] = []
    loads = records.json.loads
    monkeypatch.setattr(records.json, "loads", lambda line: parsed.append(line) or loads(line))
    assert read_latest_metrics(tmp_path, 2) == [{"time_s": 498}, {"time_s": 499}]
    assert len(parsed) == 3
