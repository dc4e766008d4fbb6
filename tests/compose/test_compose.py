"""`docker compose up` on a real engine: healthy, training, scaled, through faults, stopped.

One stack for all tests, in their order; without an engine they are skipped, and say so.
"""

import json
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.compose.compose_stack import Container, NoEngineError, Stack, engine

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
SERVICES = ("router", "replay", "learner", "actor", "evaluator", "status")
UP_S = 180.0  # 60 on a machine that does nothing else
AGAIN_S = 120.0  # from a fault to the next


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """The stack with its images built, not up yet; removed at the end."""
    folder = tmp_path_factory.mktemp("compose")
    with ExitStack() as cleanup:
        try:
            environment = cleanup.enter_context(engine(folder))
        except NoEngineError as error:
            pytest.skip(f"NO DOCKER ENGINE: THE STACK IS NOT TESTED ({error})")
        stack = Stack(environment, folder)
        stack.compose("build", timeout_s=1500)
        cleanup.callback(stack.remove)
        yield stack


def records(stack: Stack, name: str) -> list[dict[str, Any]]:
    """Lines of a file that the status service keeps."""
    text = stack.compose("exec", "--no-TTY", "status", "cat", f"/runs/stack/{name}.jsonl")
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def healthy(stack: Stack, service: str) -> bool:
    return {container.health for container in stack.containers(service)} == {"healthy"}


def restarted(stack: Stack, before: Container) -> bool:
    now = stack.container(before.id)
    return now.restarts > before.restarts and now.health == "healthy"


@pytest.mark.timeout(3000)  # an engine and images may have to be made first
def test_it_comes_up_healthy(stack: Stack) -> None:
    stack.compose("up", "--detach", "--wait", timeout_s=UP_S)
    for service in SERVICES:
        assert len(stack.containers(service)) == 1
        assert healthy(stack, service), service


@pytest.mark.parametrize("service", SERVICES)
def test_it_may_do_no_more_than_it_must(stack: Stack, service: str) -> None:
    (container,) = stack.containers(service)
    found = json.loads(stack.docker("inspect", container.id))[0]
    host = found["HostConfig"]
    assert host["ReadonlyRootfs"]
    assert host["CapDrop"] == ["ALL"]
    assert host["SecurityOpt"] == ["no-new-privileges:true"]
    assert not host["PortBindings"]
    assert stack.docker("exec", container.id, "id", "--user").strip() == "10001"


def test_it_learns(stack: Stack) -> None:
    def steps() -> int:
        return int(stack.status()["learner_steps"])

    stack.eventually(steps, "the first steps", AGAIN_S)
    first = steps()
    stack.eventually(lambda: steps() > first, "more steps", AGAIN_S)


def test_live_weights_are_judged(stack: Stack) -> None:
    def versions() -> set[int]:
        return {record["weights_version"] for record in records(stack, "evaluations")}

    stack.eventually(lambda: len(versions()) > 1, "weights judged twice", AGAIN_S)
    assert all(0 <= record["success_rate"] <= 1 for record in records(stack, "evaluations"))


def test_more_actors_join(stack: Stack) -> None:
    def at_work() -> set[str]:
        said = stack.status()
        actors = [s["id"] for s in said["services"] if s["role"] == "actor" and s["alive"]]
        return {a for a in actors if said.get(f"actor/{a}/inserts_acknowledged", 0) > 0}

    stack.compose("up", "--detach", "--no-recreate", "--scale", "actor=3", timeout_s=UP_S)
    assert len(stack.containers("actor")) == 3
    stack.eventually(lambda: len(at_work()) == 3, "three actors' transitions in replay", AGAIN_S)
    for service in SERVICES:
        stack.eventually(lambda s=service: healthy(stack, s), f"{service} is healthy", AGAIN_S)


@pytest.mark.parametrize("service", SERVICES)
def test_what_is_killed_comes_back(stack: Stack, service: str) -> None:
    before = stack.containers(service)[0]
    steps = records(stack, "metrics")[-1]["learner_steps"]
    stack.signal(before, "KILL")
    stack.eventually(lambda: restarted(stack, before), f"{service} is back", AGAIN_S)
    stack.eventually(
        lambda: records(stack, "metrics")[-1]["learner_steps"] > steps, "it goes on", AGAIN_S
    )


def test_what_hangs_is_unhealthy_and_started_again(stack: Stack) -> None:
    (before,) = stack.containers("evaluator")
    stack.signal(before, "STOP")
    stack.eventually(
        lambda: stack.container(before.id).health == "unhealthy", "it is unhealthy", AGAIN_S
    )
    stack.eventually(lambda: restarted(stack, before), "it is back", AGAIN_S)


def test_it_stops_in_order_and_leaves_nothing(stack: Stack) -> None:
    stack.compose("stop", timeout_s=AGAIN_S)
    codes = {s: [c.exit_code for c in stack.containers(s)] for s in SERVICES}
    assert codes == {service: [0] * (3 if service == "actor" else 1) for service in SERVICES}
    stack.remove()
    assert stack.left() == []
