"""The Kubernetes manifests fit Kubernetes' schema, the Dockerfile, Compose and our commands.

No cluster is needed. Each object is checked strictly against the schema that the API server
publishes, for an older and the newest version; then names that one object takes from another, which
no schema checks.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from mrcdrl.common.config import load_config
from mrcdrl.common.runtime.names import check_name

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
VERSIONS = ("1.28.0", kubernetes_validate.latest_version())  # pod-index came with 1.28
Object = dict[str, Any]

KUSTOMIZATION: Object = yaml.safe_load((DEPLOY / "kustomization.yaml").read_text("utf-8"))
OBJECTS: list[Object] = [
    document
    for name in KUSTOMIZATION["resources"]
    for document in yaml.safe_load_all((DEPLOY / name).read_text("utf-8"))
]
COMPOSE: Object = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))
WORKLOADS = {
    o["metadata"]["name"]: o for o in OBJECTS if o["kind"] in ("Deployment", "StatefulSet")
}
PODS: dict[str, Object] = {n: o["spec"]["template"] for n, o in WORKLOADS.items()}
HEARTBEAT = "mrcdrl.common.runtime.heartbeat"
workloads = pytest.mark.parametrize("name", WORKLOADS)


def of_kind(kind: str) -> list[Object]:
    return [o for o in OBJECTS if o["kind"] == kind]


def container(name: str) -> Object:
    (only,) = PODS[name]["spec"]["containers"]
    found: Object = only
    return found


def selected(labels: dict[str, str]) -> set[str]:
    """Workloads whose pods have all of these labels."""
    return {n for n, pod in PODS.items() if labels.items() <= pod["metadata"]["labels"].items()}


def title(manifest: Object) -> str:
    return f"{manifest['kind']}-{manifest['metadata']['name']}"


# -- schema ------------------------------------------------------------------------------


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("manifest", OBJECTS, ids=title)
def test_fits_the_schema(manifest: Object, version: str) -> None:
    kubernetes_validate.validate(manifest, version, strict=True)


def test_the_schema_refuses_what_is_misspelt() -> None:
    wrong = {**WORKLOADS["router"], "spec": {**WORKLOADS["router"]["spec"], "replica": 1}}
    with pytest.raises(kubernetes_validate.ValidationError, match="replica"):
        kubernetes_validate.validate(wrong, VERSIONS[-1], strict=True)


def test_every_file_is_a_resource_and_none_twice() -> None:
    files = {path.name for path in DEPLOY.glob("*.yaml")} - {"kustomization.yaml"}
    assert files == set(KUSTOMIZATION["resources"])
    names = [title(manifest) for manifest in OBJECTS]
    assert len(names) == len(set(names))
    assert all("namespace" not in o["metadata"] for o in OBJECTS), "kustomization.yaml names it"


# -- what runs in them -------------------------------------------------------------------


def test_the_services_are_those_of_compose() -> None:
    assert set(WORKLOADS) == set(COMPOSE["services"])


@workloads
def test_the_command_is_that_of_compose(name: str) -> None:
    arguments, composed = container(name)["args"], COMPOSE["services"][name]["command"]
    if name == "replay":
        assert arguments[-2:] == ["--shard", "$(SHARD)"]
        assert {e["name"] for e in container(name)["env"]} >= {"SHARD"}
        arguments = arguments[:-2]
    assert arguments == composed
    environment = {e["name"]: e.get("value") for e in container(name).get("env", [])}
    assert environment.items() >= COMPOSE["services"][name].get("environment", {}).items()


@workloads
def test_the_image_is_a_target_of_the_dockerfile(name: str) -> None:
    image = container(name)["image"]
    assert image == COMPOSE["services"][name]["image"]
    assert image in {entry["name"] for entry in KUSTOMIZATION["images"]}
    targets = re.findall(r"^FROM \S+ AS (\S+)$", (ROOT / "Dockerfile").read_text("utf-8"), re.M)
    assert image.removeprefix("mrcdrl/") in targets


@workloads
def test_it_may_do_no_more_than_in_compose(name: str) -> None:
    pod, inside = PODS[name]["spec"], container(name)["securityContext"]
    user = re.search(r"useradd --uid (\d+)", (ROOT / "Dockerfile").read_text("utf-8"))
    assert user is not None
    context = pod["securityContext"]
    assert context["runAsNonRoot"] is True
    assert context["runAsUser"] == context["runAsGroup"] == context["fsGroup"] == int(user[1])
    assert context["seccompProfile"] == {"type": "RuntimeDefault"}
    assert inside["readOnlyRootFilesystem"] is True
    assert inside["allowPrivilegeEscalation"] is False
    assert inside["capabilities"] == {"drop": ["ALL"]}
    assert pod["automountServiceAccountToken"] is False


@workloads
def test_health_is_judged_as_in_the_image(name: str) -> None:
    healthcheck = re.search(
        r"HEALTHCHECK .*--timeout=(\d+)s .*\\\n\s+CMD (\[.*\])",
        (ROOT / "Dockerfile").read_text("utf-8"),
    )
    assert healthcheck is not None
    service = container(name)
    assert service["readinessProbe"]["exec"]["command"] == yaml.safe_load(healthcheck[2])
    assert service["readinessProbe"]["timeoutSeconds"] == int(healthcheck[1])
    assert PODS[name]["spec"]["shareProcessNamespace"] is True, "a process 1 is not to be killed"
    for probe in ("livenessProbe", "startupProbe"):
        assert service[probe]["exec"]["command"][:3] == ["python", "-m", HEARTBEAT]
    composed = COMPOSE["services"][name]["stop_grace_period"]
    assert f"{PODS[name]['spec']['terminationGracePeriodSeconds']}s" == composed


@workloads
def test_it_says_what_it_needs(name: str) -> None:
    resources = container(name)["resources"]
    assert set(resources["requests"]) == {"cpu", "memory"}
    assert set(resources["limits"]) == {"memory"}


def test_an_evaluator_yields_to_learner_and_actors() -> None:
    """A container's default is 1 024 shares; a request of CPU time is its weight in Kubernetes."""
    shares = {
        name: service.get("cpu_shares", 1024) for name, service in COMPOSE["services"].items()
    }
    assert min(shares, key=lambda name: shares[name]) == "evaluator"
    assert shares["learner"] == shares["actor"] == 1024


# -- what one takes from another ---------------------------------------------------------


@workloads
def test_a_workload_selects_its_own_pods(name: str) -> None:
    labels = WORKLOADS[name]["spec"]["selector"]["matchLabels"]
    assert selected(labels) == {name}


@workloads
def test_volumes_are_there(name: str) -> None:
    spec = WORKLOADS[name]["spec"]
    claims = {claim["metadata"]["name"] for claim in spec.get("volumeClaimTemplates", [])}
    volumes = PODS[name]["spec"]["volumes"]
    mounted = {mount["name"]: mount["mountPath"] for mount in container(name)["volumeMounts"]}
    assert set(mounted) == claims | {volume["name"] for volume in volumes}
    composed = {v.split(":")[1] for v in COMPOSE["services"][name].get("volumes", [])}
    composed -= {"/tmp/mrcdrl-10001"}  # weights that containers of a host share: pods have none
    assert set(mounted.values()) == composed | {"/tmp"}
    claimed = {
        v["persistentVolumeClaim"]["claimName"]
        for v in volumes
        if len(v) > 1 and "persistentVolumeClaim" in v
    }
    assert claimed <= {claim["metadata"]["name"] for claim in of_kind("PersistentVolumeClaim")}
    together = "affinity" in PODS[name]["spec"]
    assert together is bool(claimed), "who shares a volume of one node has to be on that node"


def test_whoever_shares_the_volume_goes_where_the_others_are() -> None:
    sharing = {name for name, pod in PODS.items() if "affinity" in pod["spec"]}
    assert sharing == {"learner", "evaluator", "status", "web"}
    for name in sharing:
        (term,) = PODS[name]["spec"]["affinity"]["podAffinity"][
            "requiredDuringSchedulingIgnoredDuringExecution"
        ]
        assert selected(term["labelSelector"]["matchLabels"]) == sharing


def test_services_lead_to_what_listens() -> None:
    services = {o["metadata"]["name"]: o["spec"] for o in of_kind("Service")}
    assert set(services) == {"router", "replay"}
    for name, spec in services.items():
        assert selected(spec["selector"]) == {name}
    assert services["replay"]["clusterIP"] == "None"
    assert WORKLOADS["replay"]["spec"]["serviceName"] == "replay"
    (port,) = services["router"]["ports"]
    assert f"tcp/0.0.0.0:{port['targetPort']}" in container("router")["args"]
    for name in set(WORKLOADS) - {"router"}:
        environment = {e["name"]: e.get("value") for e in container(name)["env"]}
        assert f'"tcp/router:{port["port"]}"' in environment["MRCDRL_TRANSPORT__CONNECT"]


def test_nobody_else_reaches_the_run() -> None:
    closed, opened = of_kind("NetworkPolicy")
    assert selected(closed["spec"]["podSelector"]["matchLabels"]) == set(WORKLOADS)
    assert "ingress" not in closed["spec"]
    assert selected(opened["spec"]["podSelector"]["matchLabels"]) == {"router"}
    (rule,) = opened["spec"]["ingress"]
    (sender,) = rule["from"]
    assert selected(sender["podSelector"]["matchLabels"]) == set(WORKLOADS)
    assert [port["port"] for port in rule["ports"]] == [7447]


def settings() -> Iterator[tuple[str, str]]:
    for config_map in of_kind("ConfigMap"):
        yield from config_map["data"].items()
    for name in WORKLOADS:
        for variable in container(name).get("env", []):
            if variable["name"].startswith("MRCDRL_"):
                yield variable["name"], variable["value"]


def test_settings_are_settings() -> None:
    given = dict(settings())
    config = load_config("quick", environ=given)
    assert config.replay.shards == WORKLOADS["replay"]["spec"]["replicas"]
    (source,) = container("replay")["envFrom"]
    names = {o["metadata"]["name"] for o in of_kind("ConfigMap")}
    assert source["configMapRef"]["name"] in names
    threads = dict(settings())["MRCDRL_LEARNER__THREADS"]
    assert container("learner")["resources"]["requests"]["cpu"] == threads


def test_the_run_has_a_name() -> None:
    named = {a[a.index("--run") + 1] for a in map(_arguments, WORKLOADS) if "--run" in a}
    (run,) = named
    assert check_name(run, "run name") == run


def _arguments(name: str) -> list[str]:
    found: list[str] = container(name)["args"]
    return found


def test_what_there_is_one_of_is_never_two() -> None:
    for name in ("router", "learner", "status"):
        assert WORKLOADS[name]["spec"]["replicas"] == 1
        assert WORKLOADS[name]["spec"]["strategy"] == {"type": "Recreate"}
