"""Statistics for Prometheus: names and units by its conventions, counters that do not fall."""

import math
import subprocess

import pytest
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from mrcdrl.common.messages.metrics import SCHEMAS, definitions, kinds
from mrcdrl.common.runtime.names import MAX_NAME
from mrcdrl.common.sync.exposition import ServiceFamilies, exposed_name, process_registry
from mrcdrl.common.sync.stats import Report
from tests.patience import PATIENCE_S


def reports(value: float = 1.0) -> list[Report]:
    """One of each role, with all metrics."""
    return [
        Report("r", role, f"{role}-0", dict.fromkeys(kinds(schema), value))
        for role, schema in SCHEMAS.items()
    ]


def samples(families: ServiceFamilies, given: list[Report]) -> dict[str, float]:
    return {
        f"{sample.name} {sample.labels['worker']}": sample.value
        for family in families.families(given)
        for sample in family.samples
    }


def test_names_follow_the_conventions() -> None:
    names = {
        (role, each.name): exposed_name(role, each)
        for role, schema in SCHEMAS.items()
        for each in definitions(schema)
    }
    assert names["replay", "size"] == "mrcdrl_replay_transitions"
    assert names["replay", "inserts"] == "mrcdrl_replay_inserts_total"
    assert names["learner", "learner_steps"] == "mrcdrl_learner_steps_total"
    assert names["learner", "step_share"] == "mrcdrl_learner_step_ratio"
    assert names["learner", "q_bin_3"] == "mrcdrl_learner_q_bin_ratio"
    assert names["actor", "weights_age_s"] == "mrcdrl_actor_weights_age_seconds"
    fields = {(role, each.field) for role in SCHEMAS for each in definitions(SCHEMAS[role])}
    assert len(set(names.values())) == len(fields)


def test_promtool_accepts_what_every_process_serves(promtool: str) -> None:
    for report in reports():
        page = generate_latest(process_registry(lambda report=report: report))  # type: ignore[misc]
        found = subprocess.run(
            [promtool, "check", "metrics"],
            input=page,
            capture_output=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert (found.returncode, found.stdout, found.stderr) == (0, b"", b""), page.decode()


def test_items_of_a_field_are_told_apart_by_a_label() -> None:
    report = Report("r", "actor", "a", {"success_by_robots_2": 0.5, "success_by_robots_4": 0.25})
    (family,) = ServiceFamilies().families([report])
    assert {s.labels["robots"]: s.value for s in family.samples} == {"2": 0.5, "4": 0.25}


def test_a_counter_that_falls_back_with_a_checkpoint_does_not_fall_here() -> None:
    families, name = ServiceFamilies(), "mrcdrl_learner_steps_total l"
    steps = [100.0, 150.0, 90.0, 120.0]  # killed after 150, and back at 90
    served = [
        samples(families, [Report("r", "learner", "l", {"learner_steps": step})])[name]
        for step in steps
    ]
    assert served == [0.0, 50.0, 50.0, 80.0]


def test_a_counter_of_an_actor_is_its_own() -> None:
    families = ServiceFamilies()
    for steps in (7.0, 3.0):  # restarted: Prometheus knows a counter that begins anew
        given = [Report("r", "actor", "a", {"robot_steps": steps})]
        assert samples(families, given)["mrcdrl_actor_robot_steps_total a"] == steps


def test_who_has_left_is_forgotten() -> None:
    families = ServiceFamilies()
    for worker in map(str, range(100)):
        samples(families, [Report("r", "learner", worker, {"learner_steps": 1.0})])
    assert len(families._rising) == 1


HOSTILE = [
    'a"} 1\nmrcdrl_replay_transitions{worker="b',
    "<script>alert(1)</script>",
    "\\",
    "\r\x00",
]


@pytest.mark.parametrize("worker", HOSTILE)
def test_a_hostile_name_stays_within_its_label(worker: str) -> None:
    report = Report("r", "replay", worker, {"size": 5.0, "capacity": math.inf, "bytes": -1e308})
    text = generate_latest(process_registry(lambda: report)).decode()
    parsed = {
        sample.name: sample
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert parsed["mrcdrl_replay_transitions"].value == 5.0
    assert parsed["mrcdrl_replay_capacity"].value == math.inf
    assert parsed["mrcdrl_replay_transitions"].labels["run"] == "r"
    assert parsed["mrcdrl_replay_transitions"].labels["worker"].isprintable()
    assert all(line.startswith(("mrcdrl_", "process_", "# ")) for line in text.splitlines())


def test_names_that_are_alike_once_they_are_cut_count_once() -> None:
    long = "x" * MAX_NAME
    given = [Report("r", "replay", long + end, {"size": float(len(end))}) for end in ("", "a")]
    (family,) = ServiceFamilies().families(given)
    assert [s.value for s in family.samples] == [0.0]
