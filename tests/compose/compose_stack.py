"""A Docker engine for the tests, and the stack on it.

Invariants: an engine that was running is left as it was, and one started here is stopped; all that
the stack creates, except its images, has its project's name and is removed at the end; every wait
has a deadline and says what it waited for.
"""

import json
import os
import subprocess
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from tests.patience import PATIENCE_S

REPOSITORY = Path(__file__).resolve().parents[2]
BASE = REPOSITORY / "docker-compose.yml"
SMOKE = Path(__file__).with_name("smoke.yml")
ENGINE_VARIABLE = "MRCDRL_DOCKER_ENGINE"  # a script that brings an engine up and down
WHEELS_VARIABLE = "PIP_FIND_LINKS"
LEARNING = ("actor", "learner", "evaluator")  # their images hold PyTorch
T = TypeVar("T")


class NoEngineError(Exception):
    """No engine is running and none can be started; the message says why."""


def works(environment: Mapping[str, str]) -> bool:
    """Whether an engine is running, with Compose."""
    try:
        for command in (["docker", "compose", "version"], ["docker", "info"]):
            subprocess.run(
                command, env=dict(environment), capture_output=True, check=True, timeout=PATIENCE_S
            )
    except (OSError, subprocess.SubprocessError):
        return False
    return True


@contextmanager
def engine(folder: Path) -> Iterator[dict[str, str]]:
    """The environment in which `docker compose` works; raises NoEngineError."""
    script = os.environ.get(ENGINE_VARIABLE)
    if works(os.environ):
        yield dict(os.environ)
    elif not script:
        raise NoEngineError(f"{ENGINE_VARIABLE} names none")
    elif os.geteuid() != 0:
        raise NoEngineError(f"only root may bring up {script}")
    else:
        home = Path(os.environ.get("ENGINE_HOME", folder / "engine"))
        environment = {**os.environ, "ENGINE_HOME": str(home)}
        try:
            subprocess.run([script, "up"], env=environment, check=True, timeout=900)
        except (OSError, subprocess.SubprocessError) as error:
            raise NoEngineError(str(error)) from error
        try:
            shown = subprocess.run(
                ["bash", "-c", '. "$ENGINE_HOME/env.sh" && env -0'],
                env=environment,
                capture_output=True,
                text=True,
                check=True,
                timeout=PATIENCE_S,
            )
            yield dict(line.split("=", 1) for line in shown.stdout.split("\0") if line)
        finally:
            subprocess.run([script, "down"], env=environment, check=True, timeout=PATIENCE_S)


@dataclass(frozen=True, slots=True)
class Container:
    """One container as the engine sees it."""

    id: str
    running: bool
    health: str
    restarts: int
    exit_code: int


class Stack:
    """`docker compose …` with these overrides, under its own project name."""

    def __init__(self, environment: Mapping[str, str], *overrides: Path) -> None:
        self.project = f"mrcdrl-test-{uuid.uuid4().hex[:8]}"
        # The page at any free port: others may have one here.
        self._environment = {**environment, "WEB_PORT": "0"}
        self._head = ["docker", "compose", "--project-name", self.project]
        self._head += [word for file in (BASE, *overrides) for word in ("--file", str(file))]

    def compose(self, *arguments: str, timeout_s: float = PATIENCE_S) -> str:
        """Output of the command; a failure shows all of it."""
        return self._run([*self._head, *arguments], timeout_s)

    def docker(self, *arguments: str) -> str:
        return self._run(["docker", *arguments], PATIENCE_S)

    def containers(self, service: str) -> list[Container]:
        """Containers of a service, stopped ones included, sorted by id."""
        ids = self.compose("ps", "--all", "--quiet", service).split()
        return sorted(map(self.container, ids), key=lambda c: c.id) if ids else []

    def container(self, container_id: str) -> Container:
        found: dict[str, Any] = json.loads(self.docker("inspect", container_id))[0]
        state = found["State"]
        return Container(
            container_id,
            state["Running"],
            state.get("Health", {}).get("Status", ""),
            found["RestartCount"],
            state["ExitCode"],
        )

    def signal(self, container: Container, name: str) -> None:
        """Signal the service's process, not the container: `docker kill` would count as a stop."""
        command = f"kill -{name} $(cut -d' ' -f1 /tmp/heartbeat)"
        self.docker("exec", container.id, "sh", "-c", command)

    def log(self, service: str) -> str:
        return self.compose("logs", "--no-color", service)

    def config(self) -> dict[str, Any]:
        """The services as Compose reads the files; no engine is needed."""
        said = json.loads(self.compose("config", "--format", "json"))
        services: dict[str, Any] = said["services"]
        return services

    def status(self) -> dict[str, Any]:
        """Output of `mrcdrl status --json`, once the run is up."""
        asking = "until mrcdrl status --run stack --json; do sleep 1; done"
        said = self.compose("exec", "--no-TTY", "status", "sh", "-c", asking)
        told: dict[str, Any] = json.loads(said)
        return told

    def eventually(self, look: Callable[[], T | None], what: str, timeout_s: float) -> T:
        """The first true result of `look`; fails with the logs after timeout_s."""
        deadline, pause = time.monotonic() + timeout_s, threading.Event()
        while not (found := look()):
            if time.monotonic() > deadline:
                logs = self.compose("logs", "--no-color", "--tail", "20")
                raise AssertionError(f"in {timeout_s:g} s not: {what}\n{logs}")
            pause.wait(0.5)
        return found

    def remove(self) -> None:
        self.compose("down", "--volumes", "--timeout", "5", timeout_s=PATIENCE_S)

    def left(self) -> list[str]:
        """Containers, volumes and networks with the project's name."""
        label = f"label=com.docker.compose.project={self.project}"
        return [
            line
            for kind in (["ps", "--all"], ["volume", "ls"], ["network", "ls"])
            for line in self.docker(*kind, "--quiet", "--filter", label).split()
        ]

    def _run(self, command: list[str], timeout_s: float) -> str:
        result = subprocess.run(
            command,
            cwd=REPOSITORY,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )
        assert result.returncode == 0, f"{' '.join(command)}\n{result.stdout}\n{result.stderr}"
        return result.stdout


def wheels_override(environment: Mapping[str, str], folder: Path) -> Path:
    """Write a compose file that gives the builds the local wheels that pip uses on this machine."""
    links = [Path(word) for word in environment.get(WHEELS_VARIABLE, "").split()]
    folders = [str(link) for link in links if link.is_dir()]
    build = {"build": {"additional_contexts": {"wheels": folders[0]}}} if folders else {}
    path = folder / "wheels.json"  # JSON is YAML
    path.write_text(json.dumps({"services": dict.fromkeys(LEARNING, build)}), "utf-8")
    return path
