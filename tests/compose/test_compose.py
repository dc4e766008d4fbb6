"""`docker compose up` on a real engine: healthy, training, scaled, through faults, stopped.

There are two stacks, one after the other, and the tests of each run in order: a plain one, and a
secured one with two shards. Without an engine the tests are skipped, and say so.
"""

import ast
import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.compose.compose_stack import (
    REPOSITORY,
    SMOKE,
    Container,
    NoEngineError,
    Stack,
    engine,
    wheels_override,
)
from tests.patience import PATIENCE_S

pytestmark = [pytest.mark.system, pytest.mark.timeout(4 * PATIENCE_S)]
SERVICES = ("router", "replay", "learner", "actor", "evaluator", "status", "web")
UP_S = 3 * PATIENCE_S  # 60 on an idle machine
AGAIN_S = PATIENCE_S  # from a fault to recovery
SECURE, SHARDS, GPU, ZENOHD, MONITORING = (
    REPOSITORY / f"compose.{name}.yml"
    for name in ("secure", "shards", "gpu", "zenohd", "monitoring")
)
SECURED = Path(__file__).with_name("secured.yml")
INTRUDER = Path(__file__).with_name("intruder.py")
# A working directory that holds packages named like ours, and a module of the standard library.
CROWDED = """set -e
mkdir /tmp/crowded && cd /tmp/crowded
mkdir common services configs
for file in common/__init__.py services/__init__.py configs/__init__.py mrcdrl.py random.py; do
  echo "raise SystemExit(13)" > $file
done
mrcdrl --help
python -m mrcdrl "$0" --help
python -m mrcdrl.common.runtime.heartbeat --help
python -c "import random, mrcdrl.services.$0.main"
"""
REFUSED = {  # what the router's log says of each of the intruder's attempts
    "without_a_certificate": "refused a connection: peer sent no certificates",
    "with_a_foreign_authority": "refused a connection: invalid peer certificate",
    "in_no_role": "its certificate has no role here",
    "weights_as_an_actor": "refused actor: Put on mrcdrl/stack/weights",
    "samples_as_an_evaluator": "refused evaluator: Query on mrcdrl/stack/replay/1/sample",
}


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """An environment with a Docker engine, started for these tests where none is running."""
    with ExitStack() as cleanup:
        try:
            found = cleanup.enter_context(engine(tmp_path_factory.mktemp("engine")))
        except NoEngineError as error:
            pytest.skip(f"NO DOCKER ENGINE: THE STACK IS NOT TESTED ({error})")
        yield found


@pytest.fixture(scope="module")
def built(environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The same, with the images of both stacks."""
    wheels = wheels_override(environment, tmp_path_factory.mktemp("compose"))
    Stack(environment, SECURE, wheels).compose("build", timeout_s=1500)
    return environment


@pytest.fixture(scope="module")
def stack(built: dict[str, str]) -> Iterator[Stack]:
    """The plain stack, not up yet; removed at the end."""
    stack = Stack(built, SMOKE)
    yield stack
    stack.remove()


@pytest.fixture(scope="module")
def secured(built: dict[str, str]) -> Iterator[Stack]:
    """Another: encrypted, each service in its role, with two shards."""
    secured = Stack(built, SMOKE, SHARDS, SECURE, SECURED)
    yield secured
    secured.remove()


def records(stack: Stack, name: str) -> list[dict[str, Any]]:
    """Complete lines of a file that the status service writes."""
    text = stack.compose("exec", "--no-TTY", "status", "cat", f"/runs/stack/{name}.jsonl")
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def come_up(stack: Stack, services: tuple[str, ...]) -> None:
    """Start the stack, and wait for one healthy container of each service."""
    stack.compose("up", "--detach", "--wait", "--no-build", timeout_s=UP_S)
    for service in services:
        assert len(stack.containers(service)) == 1
        assert healthy(stack, service), service


def healthy(stack: Stack, service: str) -> bool:
    return {container.health for container in stack.containers(service)} == {"healthy"}


def restarted(stack: Stack, before: Container) -> bool:
    now = stack.container(before.id)
    return now.restarts > before.restarts and now.health == "healthy"


@pytest.mark.timeout(3000)  # an engine and images may have to be made first
def test_it_comes_up_healthy(stack: Stack) -> None:
    come_up(stack, SERVICES)


@pytest.mark.parametrize("service", ["replay", "actor"])
def test_it_imports_nothing_from_the_working_directory(stack: Stack, service: str) -> None:
    stack.compose(
        *("run", "--rm", "--no-deps", "--no-TTY", "--entrypoint", "sh", service),
        *("-c", CROWDED, service),
    )


@pytest.mark.parametrize("service", SERVICES)
def test_an_image_lists_what_is_in_it(stack: Stack, service: str) -> None:
    (container,) = stack.containers(service)
    bill = json.loads(stack.docker("exec", container.id, "cat", "/opt/mrcdrl/sbom.cdx.json"))
    assert bill["bomFormat"] == "CycloneDX"
    listed = {part["name"]: part["version"] for part in bill["components"]}
    show = "import importlib.metadata as m; print({d.name: d.version for d in m.distributions()})"
    installed = ast.literal_eval(stack.docker("exec", container.id, "python", "-c", show))
    assert listed == installed
    assert {"mrcdrl", "eclipse-zenoh"} <= set(listed)


@pytest.mark.parametrize("service", SERVICES)
def test_it_may_do_no_more_than_it_must(stack: Stack, service: str) -> None:
    (container,) = stack.containers(service)
    found = json.loads(stack.docker("inspect", container.id))[0]
    host = found["HostConfig"]
    assert host["ReadonlyRootfs"]
    assert host["CapDrop"] == ["ALL"]
    assert host["SecurityOpt"] == ["no-new-privileges:true"]
    bound = [each["HostIp"] for ports in host["PortBindings"].values() for each in ports]
    assert bound == (["127.0.0.1"] if service == "web" else [])  # the page, on this host alone
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


def test_containers_of_a_host_share_the_weights_that_one_has_fetched(stack: Stack) -> None:
    def lock(service: str) -> str:
        path = "/tmp/mrcdrl-10001/weights-stack.lock"
        return stack.compose("exec", "-T", service, "stat", "-c", "%i %u %a", path)

    assert lock("actor") == lock("evaluator")
    assert lock("actor").split()[1:] == ["10001", "600"]


def test_more_actors_join(stack: Stack) -> None:
    def at_work() -> set[str]:
        said = stack.status()
        actors = [s["id"] for s in said["services"] if s["role"] == "actor" and s["alive"]]
        return {a for a in actors if said.get(f"actor/{a}/inserts_acknowledged", 0) > 0}

    stack.compose(
        "up", "--detach", "--no-build", "--no-recreate", "--scale", "actor=3", timeout_s=UP_S
    )
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


@pytest.mark.timeout(3000)  # as above, where it is asked for alone
def test_it_comes_up_secured_and_sharded(secured: Stack) -> None:
    come_up(secured, (*SERVICES, "replay-1", "actor-1"))


def test_it_learns_from_both_shards_and_refuses_none_of_its_own(secured: Stack) -> None:
    counted = [
        f"replay/replay-{shard}/{what}" for shard in (0, 1) for what in ("inserts", "samples")
    ]
    first = secured.status()

    def advances() -> bool:
        now = secured.status()
        return all(now.get(name, 0) > first.get(name, 0) for name in (*counted, "learner_steps"))

    secured.eventually(advances, "steps, and inserts and samples of both shards", AGAIN_S)
    assert "refused" not in secured.log("router")


@pytest.mark.parametrize("attempt", REFUSED)
def test_who_may_not_is_refused(secured: Stack, attempt: str) -> None:
    secured.compose(
        *("run", "--rm", "--no-deps", "--no-TTY", "intruder"), "-c", INTRUDER.read_text(), attempt
    )
    said = REFUSED[attempt]
    secured.eventually(lambda: said in secured.log("router"), f"the log says {said!r}", AGAIN_S)


def test_it_learns_on_and_leaves_nothing(secured: Stack) -> None:
    steps = secured.status()["learner_steps"]
    secured.eventually(
        lambda: secured.status()["learner_steps"] > steps, "steps after all that", AGAIN_S
    )
    secured.remove()
    assert secured.left() == []


def test_the_learner_reserves_a_gpu(environment: dict[str, str]) -> None:
    """Check the configuration only: there is no GPU to run it on."""
    plain, changed = Stack(environment).config(), Stack(environment, GPU).config()
    device = {"driver": "nvidia", "count": 1, "capabilities": ["gpu"]}
    learner = changed.pop("learner")
    assert learner["deploy"]["resources"]["reservations"].pop("devices") == [device]
    assert learner["image"] != plain["learner"]["image"]
    assert learner["build"].pop("args")["TORCH_INDEX"] == ""
    assert "TORCH_INDEX" not in (plain["learner"]["build"].pop("args", None) or {})
    other = {"deploy": None, "image": None}
    assert learner | other == plain.pop("learner") | other
    assert changed == plain


def test_monitoring_adds_prometheus_and_grafana_and_ports_for_them(
    environment: dict[str, str],
) -> None:
    """Check the configuration only: their images are not run."""
    plain, changed = Stack(environment).config(), Stack(environment, MONITORING).config()
    for name in ("prometheus", "grafana"):
        added = changed.pop(name)
        assert added["read_only"]
        assert added["cap_drop"] == ["ALL"]
        assert [port["host_ip"] for port in added["ports"]] == ["127.0.0.1"]
        for mount in added["volumes"]:
            assert mount["type"] == "volume" or Path(mount["source"]).exists()
    metrics = {
        "MRCDRL_TRANSPORT__METRICS_PORT": "9464",
        "MRCDRL_TRANSPORT__METRICS_ADDRESS": "0.0.0.0",
    }
    for name in ("router", "replay", "learner", "actor", "evaluator", "status"):
        given = plain[name].get("environment") or {}
        assert changed[name].pop("environment") == given | metrics
        plain[name].pop("environment", None)
    assert changed == plain


def test_zenohd_is_the_router_by_the_same_file(environment: dict[str, str]) -> None:
    """Check the configuration only: its image is not run."""
    plain, changed = Stack(environment).config(), Stack(environment, ZENOHD).config()
    router = changed.pop("router")
    (version,) = (
        line.removeprefix("eclipse-zenoh==")
        for line in (REPOSITORY / "constraints.txt").read_text("utf-8").splitlines()
        if line.startswith("eclipse-zenoh==")
    )
    assert router["image"] == f"eclipse/zenoh:{version}"
    assert "build" not in router
    assert router["command"][:4] == ["--config", "/router.json5", "--listen", "tcp/0.0.0.0:7447"]
    (mount,) = router["volumes"]
    assert mount["source"] == str(REPOSITORY / "configs" / "router.json5")
    assert mount["target"] == "/router.json5"
    assert mount["read_only"]
    assert "7447" in router["healthcheck"]["test"][-1]
    kept = ("read_only", "cap_drop", "security_opt", "init", "restart")
    assert {k: router[k] for k in kept} == {k: plain["router"][k] for k in kept}
    del plain["router"]
    assert changed == plain
