"""`mrcdrl evaluate`, `render` and `config` as a person calls them."""

import json
import tomllib
from pathlib import Path
from typing import Any

import av
import pytest

from mrcdrl.common.config import load_config, to_toml, validate_config
from tests.system.system_processes import Finished, printed

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


def evaluated(folder: Path, *arguments: str | Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads(printed(folder, "evaluate", *arguments, "--json"))
    return result


def check_rates(result: dict[str, Any], episodes: int) -> None:
    rates = [result[f"{name}_rate"] for name in ("success", "collision", "timeout")]
    assert all(0 <= rate <= 1 for rate in rates)
    assert sum(rates) == pytest.approx(1.0)
    assert result["episodes"] == episodes
    low, high = result["success_interval"]
    assert 0 <= low <= result["success_rate"] <= high <= 1
    assert {"max_per_100", "mean_per_100", "variance_per_100"} <= result.keys()


def test_a_controller_is_judged_the_same_for_the_same_seed(tmp_path: Path) -> None:
    arguments = ("--controller", "greedy", "--robots", "2", "--episodes", "40")
    first, second, other = (
        evaluated(tmp_path, *arguments, "--seed", seed) for seed in ("7", "7", "8")
    )
    for result in (first, second, other):
        check_rates(result, 40)
        del result["wall_s"]
    assert first == second
    assert first != other | {"seed": 7}
    assert first["success_rate"] > 0.5  # it sees the true state
    assert first["max_per_100"] >= first["mean_per_100"] >= 0
    assert first["variance_per_100"] >= 0
    assert len(first["outcomes"]) == 40
    for letter, name in (("s", "success"), ("c", "collision"), ("t", "timeout")):
        assert first["outcomes"].count(letter) == round(40 * first[f"{name}_rate"])
    navigation = first["navigation"]
    assert navigation["success_rate"] == first["success_rate"]
    collided = [navigation[f"collision_with_{whom}_rate"] for whom in ("robot", "wall")]
    assert sum(collided) == pytest.approx(first["collision_rate"])
    assert len(navigation["robots"]) == 2


def test_weights_are_judged_in_the_arena_of_their_run(finished: Finished, tmp_path: Path) -> None:
    best = finished.path / "checkpoints" / "best.safetensors"
    for weights in (best, finished.path):
        result = evaluated(tmp_path, weights, "--episodes", "3", "--seed", "1")
        check_rates(result, 3)
        assert (result["num_robots"], result["seed"]) == (2, 1)
        assert result["weights_version"] >= 1
    text = printed(tmp_path, "evaluate", best, "--episodes", "2")
    assert "success" in text
    assert "95 % interval" in text


def test_render_makes_a_film(finished: Finished, tmp_path: Path) -> None:
    film = tmp_path / "films" / "film.mp4"
    said = printed(tmp_path, "render", finished.path, "--out", film, "--episodes", "1")
    assert said.startswith(f"{film}: 1 episode, ")
    with av.open(film) as opened:
        frames = [frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)]
    assert len(frames) >= 10
    assert frames[0].std() > 5  # something is drawn
    assert (frames[0] != frames[-1]).any()  # and moves


def test_config_prints_what_reads_back(tmp_path: Path) -> None:
    text = printed(
        *(tmp_path, "config", "--config", "smoke", "--agent.gamma", "0.95"),
        MRCDRL_LEARNER__BATCH_SIZE="48",
        MRCDRL_AGENT__GAMMA="0.5",
    )
    config = validate_config(tomllib.loads(text))
    assert config.agent.gamma == 0.95  # the flag over the environment
    assert config.learner.batch_size == 48  # the environment over the file
    assert config.actor.chunk_length == 16  # the file over the default
    again = tmp_path / "again.toml"
    again.write_text(text, "utf-8")
    assert load_config(str(again), environ={}) == config
    assert printed(tmp_path, "config", "--config", again).strip() == to_toml(config).strip()
