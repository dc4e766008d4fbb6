"""Experiment trackers: what they are told, and that no fault of theirs reaches the run.

Trackers of all kinds stand in for the packages, on Python's path; the packages themselves are tried
where they are installed.
"""

import importlib.util
import json
import logging
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from mrcdrl.common.config import load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.tracker import Tracker
from mrcdrl.services.train.launcher import check_possible
from tests.patience import PATIENCE_S

INIT = {"project": "p", "name": "n", "config": {"agent": {"gamma": 0.9}}}
NOTING = """
import json, pathlib
OUT = pathlib.Path(__file__).with_name("told.jsonl")
def note(*told):
    with OUT.open("a") as file:
        file.write(json.dumps(told) + "\\n")
def init(**given): note("init", given)
def log(values, step): note("log", values, step)
def finish(): note("finish")
class Image(str): pass
class Video(str): pass
print("talkative")
"""
SLEEPS = "import time\ntime.sleep(600)\n"


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """Writes a module that stands for a tracker; its name."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def write(code: str) -> str:
        (tmp_path / "tracks.py").write_text(code, "utf-8")
        return "tracks"

    return write


def told(folder: Path) -> list[list[object]]:
    return [json.loads(line) for line in (folder / "told.jsonl").read_text().splitlines()]


def given_up(tracker: Tracker, caplog: pytest.LogCaptureFixture) -> str:
    """The one warning, once the tracker is given up; a run goes on telling meanwhile."""
    deadline, second = time.monotonic() + PATIENCE_S, 0
    pause = threading.Event()
    while tracker.up:
        assert time.monotonic() < deadline
        tracker.add("learner/loss", second)
        tracker.tell(10.0 * second)
        second += 1
        pause.wait(0.05)
    tracker.add("learner/loss", 0.0)
    tracker.tell(1e6)
    tracker.tell_files([])
    tracker.close()
    (record,) = (r for r in caplog.records if r.levelno == logging.WARNING)
    return record.getMessage()


def test_a_tracker_is_told_settings_figures_pictures_and_the_end(
    stand_in: Callable[[str], str], tmp_path: Path
) -> None:
    with Tracker(stand_in(NOTING), INIT, tmp_path / "logs" / "t.log") as tracker:
        for second in range(25):
            tracker.add("learner/loss", 1.0 * second)
            tracker.add("odd", float("nan"))
            tracker.tell(float(second))
        tracker.tell_files([tmp_path / "training.png", tmp_path / "evaluation.mp4"])
    first, *logs, files, rest, finish = told(tmp_path)
    assert first == ["init", INIT]
    assert logs == [
        ["log", {"learner/loss": float(second), "time_s": float(second)}, second]
        for second in (0, 10, 20)
    ]
    names = {"run/training": "training.png", "run/evaluation": "evaluation.mp4"}
    assert files == ["log", {tag: str(tmp_path / name) for tag, name in names.items()}, 20]
    assert rest == ["log", {"learner/loss": 24.0}, 20]
    assert finish == ["finish"]
    assert "talkative" in (tmp_path / "logs" / "t.log").read_text()


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("raise SystemError('of no use')", "of no use"),
        (NOTING + "def init(**given): raise OSError('not logged in')", "not logged in"),
        (NOTING + "def log(values, step): raise OSError('refused')", "refused"),
        (NOTING + "import os\ndef log(values, step): os._exit(9)", "is given up"),
        (SLEEPS, "no answer for 0.5 s"),
        (NOTING + "import time\ndef init(**given): time.sleep(600)", "no answer for 0.5 s"),
        (NOTING + "import time\ndef log(values, step): time.sleep(600)", "no answer for 0.5 s"),
    ],
)
def test_a_tracker_that_fails_or_hangs_is_given_up_with_one_warning(
    code: str,
    why: str,
    stand_in: Callable[[str], str],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    patience_s = 0.5 if "no answer" in why else PATIENCE_S
    tracker = Tracker(stand_in(code), INIT, tmp_path / "t.log", patience_s=patience_s)
    said = given_up(tracker, caplog)
    assert said.startswith("tracks is given up: ")
    assert said.endswith("; the run goes on")
    assert why in said


def test_a_tracker_that_reads_nothing_is_given_up_before_much_waits_for_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    program = (sys.executable, "-c", SLEEPS)
    tracker = Tracker("slow", INIT, tmp_path / "t.log", program=program)
    for second in range(100):
        for number in range(1000):
            tracker.add(f"a/long/name/of/a/metric/{number}", 1.0)
        tracker.tell(10.0 * second)
    assert not tracker.up
    assert caplog.messages == ["slow is given up: it does not keep up; the run goes on"]


def test_a_tracker_that_does_not_end_is_ended(
    stand_in: Callable[[str], str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    code = NOTING + "import time\ndef finish():\n    note('ending')\n    time.sleep(600)"
    tracker = Tracker(stand_in(code), INIT, tmp_path / "t.log", patience_s=3.0)
    process = tracker._process
    assert process is not None
    tracker.close()
    tracker.close()
    assert process.poll() is not None
    assert caplog.messages == ["tracks is given up: it did not end within 3 s; the run goes on"]


@pytest.mark.parametrize("package", ["trackio", "wandb"])
def test_a_package_that_is_missing_is_named_before_the_run(
    package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == package else object()
    )
    config = load_config("smoke", {"run.tracker": package}, environ={})
    with pytest.raises(ConfigError, match=rf"needs {package}.*mrcdrl\[{package}\]"):
        check_possible(config)


@pytest.mark.parametrize("package", ["trackio", "wandb"])
def test_the_package_itself_takes_a_recorded_run(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"NO {package.upper()}: IT IS NOT TESTED (pip install 'mrcdrl[{package}]')")
    kept = tmp_path / "kept"
    for name, value in {
        "WANDB_MODE": "offline",
        "WANDB_DIR": str(kept),
        "TRACKIO_DIR": str(kept),
    }.items():
        monkeypatch.setenv(name, value)
    kept.mkdir()
    config = load_config("smoke", {"run.tracker": package}, environ={})
    picture = Path(__file__).parents[3] / "docs" / "images" / "renderers.png"
    run_dir = tmp_path / "run"
    with Recorder(run_dir, config) as recorder:
        state = RunState(config)
        state.observe_stats(Stats("learner", "l", {"learner_steps": 5.0, "loss": 0.5}), 0.0)
        for second in (0.0, 10.0, 20.0):
            recorder.record_metrics(state, second)
        (run_dir / "training.png").write_bytes(picture.read_bytes())
        recorder.record_pictures()
    log = (run_dir / "logs" / "tracker.log").read_text()
    assert [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING] == [], log
    assert "Traceback" not in log
    written = b"".join(p.read_bytes() for p in kept.rglob("*") if p.is_file())
    assert b"learner/loss" in written
