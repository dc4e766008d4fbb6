"""The best weights are kept, over restarts too."""

from collections.abc import Sequence
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from mrcdrl.common import arena
from mrcdrl.common.arena import Start
from mrcdrl.common.config import load_config
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.trajectory import Evaluation, Outcome, Weights
from mrcdrl.common.model.policy import Policy, averaged_symmetries, make_policy
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_files import read_weights
from mrcdrl.common.model.weights_io import SENT_AS, network_from_bytes, weights_to_bytes
from mrcdrl.services.evaluator.evaluator import (
    AllNumbers,
    BestWeights,
    WeightsEvaluator,
    confirming,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "checkpoints" / "best.safetensors"


def result(version: int, rate: float, frames: float, num_robots: int = 2) -> Evaluation:
    return Evaluation(
        worker="evaluator-0",
        weights_epoch=0,
        weights_version=version,
        learner_step=10 * version,
        num_robots=num_robots,
        episodes=100,
        success_rate=rate,
        collision_rate=1 - rate,
        timeout_rate=0.0,
        success_interval=(0.0, 1.0),
        max_per_100=100 * rate,
        mean_per_100=100 * rate,
        variance_per_100=0.0,
        mean_frames=frames,
        mean_score=0.0,
        seed=1,
        wall_s=1.0,
    )


def offer(best: BestWeights, version: int, rate: float, frames: float) -> None:
    weights = Weights.of(0, version, 10 * version, f"weights {version}".encode())
    best.offer(weights, [result(version, rate, frames)])


def kept(path: Path) -> str:
    payload, manifest = read_weights(path)
    assert payload == f"weights {manifest['weights_version']}".encode()
    return payload.decode()


@pytest.mark.parametrize(
    ("probe", "succeeds", "played"),
    [
        (2, set(), 2),  # hopeless: the rest is not worth its time
        (2, {3}, 2),  # nor is it known that a later one would succeed
        (2, {1}, 5),
        (0, set(), 5),
        (5, set(), 5),
        (9, {4}, 5),
    ],
)
def test_an_evaluation_ends_early_if_no_probe_episode_succeeds(
    monkeypatch: pytest.MonkeyPatch, probe: int, succeeds: set[int], played: int
) -> None:
    settings = {"arena.view_px": "32", "evaluator.episodes": "5"}
    config = load_config("smoke", {**settings, "evaluator.probe_episodes": str(probe)}, environ={})
    seen: list[Start] = []

    def play(_config: object, part: Sequence[Start], *_: object, **__: object) -> list[MagicMock]:
        numbers = range(len(seen), len(seen) + len(part))
        seen.extend(part)
        outcomes = [Outcome.SUCCESS if n in succeeds else Outcome.TIMEOUT for n in numbers]
        return [MagicMock(outcome=outcome, frames=7, score=1.0) for outcome in outcomes]

    monkeypatch.setattr("mrcdrl.services.evaluator.evaluator.play", play)
    weights = Weights.of(0, 1, 10, weights_to_bytes(QNetwork("duel", view_px=32)))
    found = WeightsEvaluator(config, "evaluator-0").evaluate(weights, lambda: True)
    assert found is not None
    assert found.episodes == played
    assert found.success_rate == len([i for i in succeeds if i < played]) / played
    starts = arena.test_starts(config.arena, 5, config.evaluator.seed)
    assert repr(seen) == repr(list(starts[:played]))  # the same whatever the probe


@pytest.mark.parametrize("restarts", [False, True])
@pytest.mark.parametrize(
    ("offers", "expected"),
    [
        ([(0.0, 0)], 0),
        ([(0.0, 0), (0.0, 0)], 1),  # untrained weights are not the best of a run that was stopped
        ([(0.5, 90), (0.6, 200)], 1),
        ([(0.5, 90), (0.4, 10)], 0),
        ([(0.5, 90), (0.5, 80)], 1),
        ([(0.5, 90), (0.5, 90)], 0),
        ([(0.5, 90), (0.5, 100)], 0),
        ([(0.1, 9), (0.9, 50), (0.8, 5), (0.9, 60)], 1),
    ],
)
def test_more_successes_or_as_many_in_less_time_are_kept(
    path: Path, offers: list[tuple[float, float]], expected: int, restarts: bool
) -> None:
    best = BestWeights(path)
    for version, (rate, frames) in enumerate(offers):
        offer(best, version, rate, frames)
        best = BestWeights(path) if restarts else best
    assert kept(path) == f"weights {expected}"


@pytest.mark.parametrize("precision", ["float32", "bfloat16", "float16"])
def test_the_kept_weights_give_the_values_that_were_evaluated(path: Path, precision: str) -> None:
    small = {"arena.view_px": "32", "learner.precision": "float32"}
    config = load_config("smoke", small, environ={})
    evaluated = make_policy(config)
    payload = weights_to_bytes(QNetwork("duel", view_px=32), SENT_AS[precision])
    weights = Weights.of(0, 1, 10, payload)
    evaluated.adopt(weights)
    BestWeights(path).offer(weights, [result(1, 0.5, 90)])
    kept_payload, manifest = read_weights(path)
    assert manifest["sha256"] == weights.digest
    states = np.random.default_rng(0).integers(0, 256, (5, 4, 32, 32), dtype=np.uint8)
    loaded = Policy(network_from_bytes(kept_payload), averaged_symmetries(config))
    np.testing.assert_array_equal(loaded.q_values(states), evaluated.q_values(states))


def test_a_torn_manifest_tells_nothing_of_the_kept_weights(path: Path) -> None:
    offer(BestWeights(path), 0, 0.9, 50)
    path.with_suffix(".json").write_text("{")
    offer(BestWeights(path), 1, 0.1, 50)
    assert kept(path) == "weights 1"


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").write_text("a file in its place")
    best = BestWeights(tmp_path / "checkpoints" / "best.safetensors")
    with pytest.raises(CheckpointError, match="not written"):
        offer(best, 0, 0.5, 50)


@pytest.mark.parametrize(
    ("offers", "expected"),
    [
        ([(0.95, 0.93), (0.98, 0.91)], 0),  # luck
        ([(0.95, 0.93), (0.94, 0.96)], 1),  # bad luck at first
        ([(0.95, 0.93), (0.92, 0.99)], 0),  # not worth a second look: below the confirmed best
        ([(0.5, 0.1), (0.6, 0.0)], 1),  # below 90 % nothing is confirmed
        ([(0.95, 0.93), (0.96, None)], 1),  # stopped meanwhile: the first evaluation counts
    ],
)
def test_the_best_is_confirmed_and_not_drawn_by_luck(
    path: Path, offers: list[tuple[float, float | None]], expected: int
) -> None:
    again = {v: [] if r is None else [result(v, r, 50)] for v, (_, r) in enumerate(offers)}
    best = BestWeights(path, lambda weights: again[weights.version])
    for version, (rate, _) in enumerate(offers):
        offer(best, version, rate, 50)
    assert kept(path) == f"weights {expected}"
    due = again[expected] if offers[expected][0] >= 0.9 else None
    rate = due[0].success_rate if due else offers[expected][0]
    assert read_weights(path)[1]["success_rate"] == rate


def test_it_is_confirmed_from_other_starts_as_many_as_configured() -> None:
    small = {"arena.view_px": "32", "arena.max_frames": "5", "evaluator.confirm_episodes": "6"}
    config = load_config("smoke", small, environ={})
    weights = Weights.of(0, 1, 10, weights_to_bytes(QNetwork("duel", view_px=32)))
    found = WeightsEvaluator(confirming(config), "evaluator-0").evaluate(weights, lambda: True)
    assert found is not None
    assert found.episodes == 6
    assert found.seed != config.evaluator.seed
    config = load_config("smoke", {**small, "evaluator.confirm_episodes": "0"}, environ={})
    assert WeightsEvaluator(confirming(config), "e").evaluate(weights, lambda: True) is None


@pytest.mark.parametrize("restarts", [False, True])
@pytest.mark.parametrize(
    ("offers", "expected"),
    [
        ([(0.9, 0.1), (0.5, 0.2)], 1),  # the number that succeeds least counts most
        ([(0.9, 0.3), (1.0, 0.2)], 0),
        ([(0.2, 0.0), (0.5, 0.0), (0.4, 0.0)], 1),  # then the mean
        ([(0.3, 0.2), (0.2, 0.3)], 0),  # whichever number it is
    ],
)
def test_of_several_numbers_the_weakest_decides(
    path: Path, offers: list[tuple[float, float]], expected: int, restarts: bool
) -> None:
    best = BestWeights(path)
    for version, rates in enumerate(offers):
        weights = Weights.of(0, version, 10 * version, f"weights {version}".encode())
        pairs = zip((1, 4), rates, strict=True)
        best.offer(weights, [result(version, rate, 50, number) for number, rate in pairs])
        best = BestWeights(path) if restarts else best
    assert kept(path) == f"weights {expected}"
    manifest = read_weights(path)[1]
    assert manifest["success_rate"] == min(offers[expected])
    assert manifest["success_by_robots"] == dict(zip("14", offers[expected], strict=True))


def test_each_number_of_robots_is_evaluated_apart() -> None:
    small = {"arena.view_px": "32", "arena.max_frames": "5", "evaluator.episodes": "3"}
    config = load_config("smoke", {**small, "arena.robots": "[1, 3]"}, environ={})
    weights = Weights.of(0, 1, 10, weights_to_bytes(QNetwork("duel", view_px=32)))
    published: list[Evaluation] = []
    found = AllNumbers(config, "evaluator-0", lambda: True)(weights, published.append)
    assert [(e.num_robots, e.episodes) for e in found] == [(1, 3), (3, 3)]
    assert published == found
    assert AllNumbers(config, "evaluator-0", lambda: False)(weights) == []
