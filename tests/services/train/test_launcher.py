"""A run that no service could serve is refused before anything is written; others start."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from mrcdrl.common.config import Config, TransportConfig, load_config
from mrcdrl.common.errors import ConfigError, EndpointError
from mrcdrl.common.runtime.files import FILM, MOVING_PICTURE
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.joining import Joining
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.services.monitor.run_directory import RunDirectory
from mrcdrl.services.replay.serving import Serving
from mrcdrl.services.train import launcher
from mrcdrl.services.train.fleet import Fleet
from mrcdrl.services.train.launcher import (
    check_possible,
    start_replay,
    start_workers,
    write_plots,
)


def smoke(**overrides: str) -> Config:
    named = {name.replace("__", "."): value for name, value in overrides.items()}
    return load_config("smoke", named, environ={})


def test_initial_weights_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    config = smoke(learner__initial_weights=str(path))
    with pytest.raises(ConfigError, match=r"learner\.initial_weights .*weights\.safetensors: no"):
        check_possible(config)
    path.touch()
    check_possible(config)


def test_a_port_that_nobody_would_know_is_refused() -> None:
    with pytest.raises(EndpointError, match=r"tcp/127\.0\.0\.1:0: port 0 is any free one"):
        check_possible(smoke(transport__listen='["tcp/127.0.0.1:0"]'))


def test_an_endpoint_that_would_not_be_used_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"transport\.connect tcp/a:1: mrcdrl train connects"):
        check_possible(smoke(transport__connect='["tcp/a:1"]'))


class Started(Fleet):
    """Notes flags by worker, and starts nothing."""

    def __init__(self, logs: Path) -> None:
        super().__init__(logs)
        self.flags: dict[str, list[str]] = {}

    def start(self, role: str, worker: str, arguments: list[str]) -> None:
        self.flags[worker] = arguments


@pytest.mark.parametrize("shards", ["1", "2"])
def test_children_take_the_transport_of_the_runs_file(shards: str, tmp_path: Path) -> None:
    files = {name: str(tmp_path / f"Of {name}.PEM") for name in ("ca", "certificate", "key")}
    settings = {f"transport__{name}": path for name, path in files.items()}
    config = smoke(transport__timeout_s="7.5", replay__shards=shards, **settings)
    endpoints = ["tls/127.0.0.1:1", "tls/localhost:2"]
    with RunDirectory.create(tmp_path / "run", config) as run:
        fleet = Started(run.logs)
        start_replay(run, fleet, endpoints)
        start_workers(run, fleet, endpoints[0])
    listening = fleet.flags.pop("router-0", fleet.flags["replay-0"])
    assert [flag for flag in listening if flag.startswith("tls/")] == endpoints
    for worker, flags in fleet.flags.items():
        role = worker.partition("-")[0]
        joined = Serving.from_argv(flags) if role == "replay" else Joining.from_argv(role, flags)
        ends = {"listen": joined.transport.listen, "connect": joined.transport.connect}
        assert joined.transport == config.transport.model_copy(update=ends)
        assert joined.run_dir == run.path
        assert role == "replay" or joined.transport.connect == (endpoints[0],)


def test_a_port_in_use_is_refused() -> None:
    endpoint = free_endpoint()
    with (
        Session(TransportConfig(listen=(endpoint,))),
        pytest.raises(EndpointError, match=endpoint),
    ):
        check_possible(smoke(transport__listen=f'["{endpoint}"]'))


class When(StopSignal):
    """Set by Ctrl-C as soon as something is so."""

    def __init__(self, so: Callable[[], bool]) -> None:
        super().__init__()
        self.cause, self._so = "Ctrl-C", so

    def is_set(self) -> bool:
        return self._so()


REPORTS = """
import pathlib, sys, time
run = pathlib.Path(sys.argv[-1])
(run / "training.png").write_bytes(b"whole")
(run / "evaluation.gif").write_bytes(b"whole or not")
if (run / "films").exists():
    (run / "evaluation.mp4").write_bytes(b"cut off")
(run / "ready").touch()
time.sleep(600)
"""


@pytest.mark.parametrize("films", [True, False])
def test_a_signal_skips_the_plots_and_leaves_whole_files_only(
    films: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(launcher, "COMMAND", (sys.executable, "-c", REPORTS))
    (tmp_path / FILM).write_bytes(b"of an earlier start")
    if films:
        (tmp_path / "films").touch()
    write_plots(tmp_path, When((tmp_path / "ready").exists))
    assert caplog.messages == [
        f"plots and video skipped (Ctrl-C); `mrcdrl report {tmp_path}` writes them"
    ]
    assert (tmp_path / "training.png").exists()
    assert (tmp_path / FILM).exists() == (not films)
    assert (tmp_path / MOVING_PICTURE).exists() == films  # nobody knows whether the last is whole


def test_the_progress_of_plots_is_logged_as_it_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    reports = "import sys; print('training.png …', 'episodes: 0 of 12', sep='\\n', file=sys.stderr)"
    monkeypatch.setattr(launcher, "COMMAND", (sys.executable, "-c", reports))
    write_plots(tmp_path, StopSignal())
    assert caplog.messages == ["training.png …", "episodes: 0 of 12"]


def test_the_reason_why_plots_are_missing_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fails = "import sys; sys.exit('mrcdrl: the run has no weights')"
    monkeypatch.setattr(launcher, "COMMAND", (sys.executable, "-c", fails))
    write_plots(tmp_path, StopSignal())
    assert caplog.messages == ["plots or video are missing: mrcdrl: the run has no weights"]
