"""A real Prometheus scrapes a run and its services, and raises an alert when an actor is gone."""

import json
import shutil
import signal
import subprocess
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from mrcdrl.common.transport import free_endpoint
from tests.patience import eventually
from tests.system.system_processes import (
    PATIENCE_S,
    REPOSITORY,
    SMALL,
    Command,
    end_all,
    run_name,
    smoke_training,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(1200)]
MONITORING = REPOSITORY / "deploy" / "monitoring"
STOP = signal.SIGKILL


def free_port() -> int:
    return int(free_endpoint().rpartition(":")[2])


class Prometheus:
    """Prometheus with the configuration and rules of deploy/monitoring, only quicker."""

    def __init__(self, folder: Path, target: int) -> None:
        program = shutil.which("prometheus")
        if program is None:
            pytest.skip("NO PROMETHEUS: NOBODY SCRAPES A RUN (apt install prometheus)")
        settings = (MONITORING / "prometheus-local.yml").read_text("utf-8")
        rules = (MONITORING / "alerts.yml").read_text("utf-8")
        assert "127.0.0.1:9464" in settings
        for before, after in (
            ("127.0.0.1:9464", f"127.0.0.1:{target}"),
            ("10s", "1s"),
            ("5s", "1s"),
        ):
            settings = settings.replace(before, after)
        (folder / "prometheus.yml").write_text(settings, "utf-8")
        (folder / "alerts.yml").write_text(rules.replace("for: 1m", "for: 2s"), "utf-8")
        self.port = free_port()
        with (folder / "prometheus.log").open("wb") as log:
            self.process = subprocess.Popen(
                [
                    program,
                    f"--config.file={folder / 'prometheus.yml'}",
                    f"--storage.tsdb.path={folder / 'data'}",
                    f"--web.listen-address=127.0.0.1:{self.port}",
                ],
                stdout=log,
                stderr=log,
            )

    def ask(self, query: str) -> list[dict[str, Any]]:
        """The series that the query finds now; none while Prometheus starts."""
        words = urllib.parse.urlencode({"query": query})
        try:
            with urllib.request.urlopen(
                f"http://127.0.0.1:{self.port}/api/v1/query?{words}", timeout=PATIENCE_S
            ) as answer:
                found: list[dict[str, Any]] = json.load(answer)["data"]["result"]
                return found
        except OSError:
            return []

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(PATIENCE_S)


@pytest.fixture
def owned() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def served(port: int) -> str:
    """What a process says of itself; empty while it starts."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S) as told:
            text: str = told.read().decode()
            return text
    except OSError:
        return ""


def test_each_service_tells_of_itself_and_status_of_the_whole(
    tmp_path: Path, owned: ExitStack
) -> None:
    name, endpoint = run_name("told"), free_endpoint()
    owned.callback(end_all, name)
    run = ["--run", name, "--run-dir", tmp_path]
    ends: dict[str, list[str | Path]] = {
        "router": ["--listen", free_endpoint()],
        "replay": [*run, "--config", "smoke", *SMALL, "--listen", endpoint],
        "learner": [*run, "--connect", endpoint],
        "evaluator": [*run, "--connect", endpoint],
        "status": [*run, "--connect", endpoint, "--record"],
    }
    ports = {role: free_port() for role in ends}
    started: list[Command] = []
    for role, flags in ends.items():
        command = Command([role, *flags, "--metrics-port", str(ports[role])], tmp_path)
        started.append(owned.enter_context(command))

    def tells(role: str, text: str) -> bool:
        for command in started:
            assert command.process.poll() is None, command.err
        return text in served(ports[role])

    for role, text in {
        "router": "process_resident_memory_bytes ",
        "replay": f'mrcdrl_replay_transitions{{run="{name}",worker="replay-0"}} 0.0',
        "learner": "mrcdrl_learner_data_wait_ratio{",
        "evaluator": "mrcdrl_evaluator_busy{",
        "status": 'mrcdrl_service_up{role="learner"',
    }.items():
        eventually(lambda role=role, text=text: tells(role, text), f"{role}: {text}")  # type: ignore[misc]


def test_prometheus_scrapes_a_run_and_tells_that_an_actor_is_gone(
    tmp_path: Path, owned: ExitStack
) -> None:
    port, own_port, name = free_port(), free_port(), run_name("scraped")
    prometheus = Prometheus(tmp_path, port)
    owned.callback(end_all, name)
    owned.callback(prometheus.close)
    endless = ("--learner-steps=100000000", "--run.minutes=0", "--metrics-port", str(port))
    train = owned.enter_context(Command([*smoke_training(tmp_path, name), *endless], tmp_path))
    eventually((tmp_path / name / "endpoint").exists, "the run is up")
    join = ["--run", name, "--run-dir", tmp_path]
    gone = owned.enter_context(
        Command(["actor", *join, "--id", "gone", "--metrics-port", str(own_port)], tmp_path)
    )
    crowded = owned.enter_context(
        Command(["actor", *join, "--id", "crowded", "--metrics-port", str(port)], tmp_path)
    )

    def found(query: str) -> list[dict[str, Any]]:
        for command in (train, crowded):
            assert command.process.poll() is None, command.err
        return prometheus.ask(query)

    # An actor that finds its port in use says so once, and collects.
    for actor in ("actor-0", "gone", "crowded"):
        query = f'mrcdrl_actor_env_steps_total{{run="{name}", worker="{actor}"}} > 0'
        eventually(lambda query=query: found(query), f"{query} is scraped")  # type: ignore[misc]
    assert crowded.err.count("transport.metrics_port") == 1
    eventually(lambda: found("mrcdrl_learner_steps_total > 0"), "the learner's steps rise")
    assert found(f'mrcdrl_service_up{{run="{name}"}} == 0') == []
    assert found('up{job="mrcdrl"} == 1')
    assert found(f'mrcdrl_replay_transitions{{run="{name}"}} > 0')

    # What the actor says of itself, without the run.
    own = served(own_port)
    assert f'mrcdrl_actor_env_steps_total{{run="{name}",worker="gone"}}' in own
    assert "process_cpu_seconds_total" in own

    gone.signal(STOP)
    firing = 'ALERTS{alertname="MrcdrlProcessLost", alertstate="firing"}'
    (alert,) = eventually(lambda: found(firing), "the alert fires")
    assert alert["metric"]["worker"] == "gone"
    assert alert["metric"]["role"] == "actor"
    before = found("mrcdrl_run_learner_steps")[0]["value"][1]
    eventually(lambda: found(f"mrcdrl_run_learner_steps > {before}"), "the run goes on")
    train.signal(signal.SIGINT)
    train.wait_without_plots()
