"""A followed run for Prometheus: the figures of the whole and of each process, bounded."""

import subprocess
import threading
from pathlib import Path

import pytest
from prometheus_client import generate_latest, make_asgi_app
from prometheus_client.parser import text_string_to_metric_families

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome, Stats
from mrcdrl.services.monitor.prometheus import (
    MAX_SERVICES,
    RUN_FAMILIES,
    FollowedRun,
    registry,
)
from mrcdrl.services.monitor.state import RunState
from tests.patience import PATIENCE_S

CONFIG = load_config("quick", environ={})
Samples = dict[str, dict[tuple[tuple[str, str], ...], float]]


def followed(state: RunState, path: Path | None = None, name: str = "r") -> FollowedRun:
    return FollowedRun(name, state, lambda: 90.0, threading.Lock(), path)


def page(*runs: FollowedRun) -> bytes:
    return generate_latest(registry(lambda: runs))


def parsed(text: bytes) -> Samples:
    found: Samples = {}
    for family in text_string_to_metric_families(text.decode()):
        for sample in family.samples:
            labels = tuple(sorted((k, v) for k, v in sample.labels.items() if k != "run"))
            assert labels not in found.setdefault(sample.name, {}), "a sample came twice"
            found[sample.name][labels] = sample.value
    return found


def evaluation(robots: int, rate: float, version: int) -> Evaluation:
    return Evaluation(
        "e", 1, version, 50 * version, robots, 100, rate, 1 - rate, 0.0, (rate / 2, 1.0),
        5, 5, 0, 110.0, 150.0, 1, 20.0,
    )  # fmt: skip


def learning(config: Config = CONFIG) -> RunState:
    """A run whose ring turns."""
    state = RunState(config)
    for second in (0.0, 1.0):
        state.observe_stats(
            Stats("replay", "replay-0", {"size": 9e4, "min_size": 1, "inserts": 5}), second
        )
        state.observe_stats(
            Stats("learner", "l", {"learner_steps": 20 + second, "weights_version": 7}), second
        )
        actor = {"robot_steps": 10 * second, "weights_version": 5.0, "weights_age_s": 4.0}
        state.observe_stats(
            Stats("actor", "a", actor | {"epsilon_min": 0.1, "epsilon_max": 0.1}), second
        )
    return state


def test_promtool_accepts_a_run_with_every_metric(promtool: str, tmp_path: Path) -> None:
    state = learning(load_config("curriculum", environ={}))
    for number in range(100):
        outcome = Outcome.SUCCESS if number % 4 else Outcome.TIMEOUT
        state.observe_episode(EpisodeSummary("a", 1, number, outcome, 9, 1, 1, 0, 5, 2, 4))
    for robots in state.config.arena.numbers:
        state.observe_evaluation(evaluation(robots, 0.5, 3), 50.0)
    text = page(followed(state, tmp_path), followed(learning(), tmp_path, "other"))
    found = subprocess.run(
        [promtool, "check", "metrics"],
        input=text,
        capture_output=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (found.returncode, found.stdout, found.stderr) == (0, b"", b""), text.decode()
    served = {family.name for family in text_string_to_metric_families(text.decode())}
    assert {family.exposed for family in RUN_FAMILIES} <= served


def test_the_whole_run_is_served(tmp_path: Path) -> None:
    state = learning()
    for rate in (0.4, 0.9, 0.6):
        state.observe_evaluation(evaluation(2, rate, 3), 50.0)
    state.observe_presence("actor", "gone", False)
    found = parsed(page(followed(state, tmp_path)))
    assert found["mrcdrl_run_duration_seconds"] == {(): 90.0}
    assert found["mrcdrl_run_learner_steps"] == {(): 21.0}
    assert found["mrcdrl_run_staleness_versions"] == {(): 2.0}
    assert found["mrcdrl_evaluation_success_ratio"] == {(("robots", "2"),): 0.6}
    assert found["mrcdrl_evaluation_best_success_ratio"] == {(("robots", "2"),): 0.9}
    assert found["mrcdrl_service_up"][("role", "actor"), ("worker", "gone")] == 0.0
    assert found["mrcdrl_service_silent_seconds"][("role", "actor"), ("worker", "a")] == 89.0
    assert list(found["mrcdrl_run_phase"]) == [(("phase", "learning"),)]
    assert len(found["mrcdrl_run_bottleneck"]) == 1
    assert found["mrcdrl_actor_weights_age_seconds"] == {(("worker", "a"),): 4.0}
    assert 0 < found["mrcdrl_disk_free_bytes"][()] <= found["mrcdrl_disk_size_bytes"][()]


def test_who_is_lost_serves_no_figures_of_its_own() -> None:
    state = learning()
    state.observe_presence("actor", "a", False)
    found = parsed(page(followed(state)))
    assert "mrcdrl_actor_weights_age_seconds" not in found
    assert found["mrcdrl_service_up"][("role", "actor"), ("worker", "a")] == 0.0


def test_a_run_without_a_disk_here_has_no_room_to_tell() -> None:
    for path in (None, Path("/nowhere")):
        assert "mrcdrl_disk_free_bytes" not in parsed(page(followed(learning(), path)))


def test_what_peers_claim_is_bounded_and_the_first_are_kept() -> None:
    state = learning()
    for number in range(2 * MAX_SERVICES):
        state.observe_presence("actor", f"0{number}", True)
    for number in range(100):
        state.observe_presence(f"role{number}", "x", True)
        state.observe_evaluation(evaluation(number, 0.5, 1), 1.0)
    found = parsed(page(followed(state)))
    assert len(found["mrcdrl_service_up"]) == MAX_SERVICES
    assert (("role", "learner"), ("worker", "l")) in found["mrcdrl_service_up"]
    omitted = 3 + 2 * MAX_SERVICES + 100 - MAX_SERVICES
    assert found["mrcdrl_services_omitted"] == {(): float(omitted)}
    assert list(found["mrcdrl_evaluation_success_ratio"]) == [(("robots", "2"),)]


@pytest.mark.parametrize("value", [float("inf"), float("nan"), -1e308, 2.0**63])
def test_absurd_statistics_of_a_hostile_name_are_served_within_their_labels(value: float) -> None:
    state = learning()
    name = 'x"} 1\n<script>\\'
    state.observe_stats(Stats("actor", name, {"weights_age_s": value, "robot_steps": 1.0}), 2.0)
    text = page(followed(state))
    labels = {worker for ((_, worker),) in parsed(text)["mrcdrl_actor_weights_age_seconds"]}
    assert labels == {"a", 'x"} 1\\n<script>\\'}
    assert all(line.startswith(("mrcdrl_", "# ")) for line in text.decode().splitlines())


def test_the_state_is_read_under_its_lock() -> None:
    lock = threading.Lock()
    run = FollowedRun("r", learning(), lambda: float(lock.locked()), lock, None)
    assert parsed(page(run))["mrcdrl_run_duration_seconds"] == {(): 1.0}
    assert not lock.locked()


def test_a_page_mounts_it_by_one_line() -> None:
    assert callable(make_asgi_app(registry(lambda: [followed(learning())])))
