"""Each check of a run, and the command, against real sessions."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig, load_config, to_toml
from mrcdrl.common.errors import EndpointError
from mrcdrl.common.messages.metrics import EvaluatorMetrics
from mrcdrl.common.runtime.versions import versions
from mrcdrl.common.sync.stats import StatsReporter
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.tools.doctor.main import main
from mrcdrl.services.tools.doctor.run import (
    clocks,
    endpoints,
    listen,
    same_versions,
    services,
    weights,
)

RUN = "looked-at"
IDLE = EvaluatorMetrics(evaluations=0, weights_version=0, weights_refused=0, busy=0)


class Run:
    """What the doctor sees of a run: its configuration, and services with statistics."""

    def __init__(self) -> None:
        self.endpoint, self.keys = free_endpoint(), Keys(RUN)
        self._session = Session(TransportConfig(listen=(self.endpoint,)))
        self._server = self._session.server(self.keys.config)
        self._stopping = threading.Event()
        self._text = to_toml(load_config("smoke", {}, environ={})).encode()
        self._reporters: list[StatsReporter] = []
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def add(self, role: str) -> None:
        """Add a service that is up."""
        self._session.announce(self.keys.live(role, role))
        publisher = self._session.publisher(self.keys.stats(role, role))
        self._reporters.append(StatsReporter(publisher, role, role))

    def _serve(self) -> None:
        while not self._stopping.is_set():
            request = self._server.take(0.1)
            if request is not None:
                request.reply(self._text)
            for reporter in list(self._reporters):
                reporter.publish(lambda: IDLE)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        self._session.close()


@pytest.fixture
def run() -> Iterator[Run]:
    up = Run()
    yield up
    up.close()


def doctor(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, str]]:
    """Exit code, and the verdict of each check."""
    code = main(["--json", *arguments])
    found = json.loads(capsys.readouterr().out)
    return code, {line["check"]: line["verdict"] for line in found}


def test_a_run_that_is_up(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    join = ["--run", RUN, "--connect", run.endpoint, "--run-dir", str(tmp_path)]
    for role in ("replay", "actor"):
        run.add(role)
    code, found = doctor(capsys, *join)
    assert found["services"] == "warning", "there is no learner"
    assert code == 0
    run.add("learner")
    code, found = doctor(capsys, *join)
    assert code == 0
    for check in ("endpoint", "session", "services", "weights", "clocks", "versions of the run"):
        assert found[check] == "ok", check


def test_another_name_than_the_runs(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mrcdrl.services.tools.doctor.run._REACH_S", 0.5)
    code, found = doctor(
        capsys, "--run", "other", "--connect", run.endpoint, "--run-dir", str(tmp_path)
    )
    assert code == 1
    assert (found["endpoint"], found["session"]) == ("ok", "failed")


def test_nobody_listens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mrcdrl.services.tools.doctor.run._REACH_S", 0.5)
    where = ["--connect", free_endpoint(), "--run-dir", str(tmp_path)]
    code, found = doctor(capsys, "--run", "nobody", *where)
    assert code == 1
    assert (found["endpoint"], found["session"]) == ("failed", "failed")


def test_a_run_that_is_not_up_here(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = doctor(capsys, "--run", "nobody", "--run-dir", str(tmp_path))
    assert (code, found["endpoint"]) == (1, "failed")


def test_for_a_reader(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--run-dir", str(tmp_path), "--config", "smoke"]
    assert main(arguments) == 0
    assert "shared memory" in capsys.readouterr().out
    assert main([*arguments, "--replay.capacity", str(10**12)]) == 1
    out = capsys.readouterr().out
    assert "failed" in out
    assert "→ lower replay.capacity" in out


def test_an_endpoint_that_is_not_tcp_is_left_to_the_session() -> None:
    found = list(endpoints(TransportConfig(connect=("unixsock-stream//tmp/x",))))
    assert [finding.verdict for finding in found] == ["ok"]
    found = list(endpoints(TransportConfig(connect=("tcp/127.0.0.1:99999",))))
    assert [finding.verdict for finding in found] == ["failed"]
    with pytest.raises(EndpointError):
        Session(TransportConfig(connect=("odd",)), open_timeout_s=0.1)


def test_services() -> None:
    assert services(["replay", "actor", "learner"], []).verdict == "ok"
    assert services(["replay", "actor", "learner", "status"], ["status"]).verdict == "ok"
    assert services(["actor", "learner"], []).verdict == "warning"


def test_weights_that_a_service_refuses() -> None:
    assert weights({}).verdict == weights({"a": 0.0}).verdict == "ok"
    found = weights({"a": 1.0, "evaluator-0": 12.0, "b": 0.0})
    assert (found.verdict, found.said) == ("warning", "evaluator-0 has refused 12")


@pytest.mark.parametrize(
    ("ahead_s", "verdict"),
    [({"replay-0": 0.01, "a": -0.5}, "ok"), ({"replay-0": 0.0, "a": -3.0}, "warning"),
     ({"replay-0": 3600.0}, "failed"), ({}, "warning")],
)  # fmt: skip
def test_clocks(ahead_s: dict[str, float], verdict: str) -> None:
    assert clocks(ahead_s).verdict == verdict


def test_versions_of_a_run() -> None:
    ours = versions()
    assert same_versions({"a": ours, "of another time": {}}, ours).verdict == "ok"
    found = same_versions({"a": {**ours, "zenoh": "1.0.0"}}, ours)
    assert found.verdict == "warning"
    assert "a has zenoh 1.0.0" in found.said


def test_statistics_on_the_key_of_another_are_not_heard(run: Run) -> None:
    with Session(TransportConfig(connect=(run.endpoint,))) as session:
        heard = session.queue_subscriber(run.keys.every_stats)
        publisher = session.publisher(run.keys.stats("actor", "a"))
        for name in ("b", "a"):
            StatsReporter(publisher, "actor", name).publish(lambda: IDLE)
        assert list(listen(heard, 3.0)) == ["a"]
