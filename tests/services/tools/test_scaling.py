"""The model of what many actors need: sizes are true, needs rise with what is asked."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from mrcdrl.common.config import load_config
from mrcdrl.services.tools.simulate.scaling import (
    CHUNK_S,
    INSERT_S,
    PAYLOAD_S,
    SAMPLE_S,
    STATS_S,
    Pace,
    expected,
    flows,
    need,
    replay_cpu,
    weights_bytes,
)

ROOT = Path(__file__).resolve().parents[3]
QUICK = load_config("quick", environ={})
FRAMES = load_config("quick", {"arena.codec": "frames"}, environ={})
PRIORITIZED = load_config("apex", environ={})


def test_bytes_are_those_of_what_is_in_the_messages() -> None:
    for config in (QUICK, FRAMES):
        sizes = {flow.name: flow.message_bytes for flow in flows(config, Pace.free(1, 1000.0))}
        window = config.arena.stack + config.agent.n_step
        records = config.learner.sample_size * window * config.arena.record_bytes
        assert records < sizes["samples"] < 1.2 * records
        parameters = 1_110_308  # of the paper's duel network, in float32
        assert 4 * parameters < sizes["weights"] < 4 * parameters + 4096


def test_who_waits_for_the_learner_gives_no_more_than_it_draws() -> None:
    one, many = (Pace.throttled(QUICK, actors, 4300.0, 20.0) for actors in (1, 1000))
    assert one.transitions_per_s == many.transitions_per_s == 20 * 128 / 1
    assert one.publications_per_s == 20 / QUICK.learner.publish_period
    assert many.publications_per_s == one.publications_per_s
    most = Pace.throttled(QUICK, 10_000, 4300.0, 20.0)
    assert most.hosts == 313
    spent = most.publications_per_s * weights_bytes(QUICK) * most.hosts
    assert spent == pytest.approx(QUICK.learner.publish_bytes_per_s)
    fast = Pace.throttled(QUICK, 1, 4300.0, 10_000.0)
    assert fast.publications_per_s == 1 / QUICK.learner.publish_interval_s
    assert Pace.throttled(QUICK, 1, 10.0, 100.0).transitions_per_s == 10


def test_flows_of_transitions_rise_with_them_and_others_with_actors() -> None:
    few, many = (
        {flow.name: flow.per_s for flow in flows(PRIORITIZED, Pace(actors, 1000.0, 2.0))}
        for actors in (10, 100)
    )
    assert many["weights"] == 2 * 4  # hosts
    assert many["notices of weights"] == 2 * 100
    assert many["statistics"] == 100
    same = {"chunks", "acknowledgements", "episodes", "samples", "sample requests", "priorities"}
    assert all(few[name] == many[name] > 0 for name in same)


@pytest.mark.parametrize(
    ("pace", "first"),
    [
        (Pace(10, 1000.0, 1.0), "nothing"),
        (Pace(10, 100_000.0, 1.0), "replay's process"),
        (Pace(1000, 1000.0, 10.0), "the router's link"),
        (Pace(8000, 1000.0, 0.0), "the router's process"),
    ],
)
def test_what_is_full_first(pace: Pace, first: str) -> None:
    found = need(QUICK, pace)
    assert found.first == first
    assert (found.shards > 1) is (first == "replay's process")
    assert (found.routers > 1) is first.startswith("the router")


def test_shards_and_routers_are_whole_and_enough() -> None:
    found = need(FRAMES, Pace(1000, 100_000.0, 1.0))
    assert found.replay_cores / found.shards <= 0.9 < found.replay_cores / (found.shards - 1)
    larger = need(FRAMES, replace(Pace(1000, 100_000.0, 1.0), actors=20_000))
    assert larger.routers > found.routers


def test_the_model_of_a_trial_counts_what_the_trial_did() -> None:
    figures = {
        "command": "mrcdrl simulate --transport.shared_memory false",
        "actors": 100,
        "inserts_per_s": 10.0,
        "chunks_per_s": 20.0,
        "chunk_bytes": 1e6,
        "samples_per_s": 1280.0,
        "weights_bytes_per_s": 0,
        "processes": {"replay-0": {}},
    }
    drawn = 10 * INSERT_S + 20 * CHUNK_S + 10 * SAMPLE_S
    assert replay_cpu(inserts=10, chunks=20, samples=1280) == pytest.approx(drawn)
    assert expected(figures) == pytest.approx(drawn + 20e6 * PAYLOAD_S + 100 * STATS_S)
    routed = figures | {"processes": {"router": {}}, "command": "mrcdrl simulate"}
    assert expected(routed) == pytest.approx(drawn)


@pytest.mark.parametrize("name", ["idle", "inserts", "max", "samples", "weights", "frames-far"])
def test_costs_are_those_that_were_measured(name: str) -> None:
    path = ROOT / "benchmarks/results/simulate" / f"{name}.json"
    figures = json.loads(path.read_text("utf-8"))
    measured = figures["processes"]["replay-0"]["cores"]
    assert expected(figures) == pytest.approx(measured, rel=0.1, abs=0.01)
