"""Policies from saved weights: where they are found, what they do, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

import mrcdrl
from mrcdrl.common.config import load_config, to_toml
from mrcdrl.common.errors import CheckpointError, ConfigError
from mrcdrl.common.model.policy import Policy, averaged_symmetries
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.saved_policy import load_policy, weights_path
from mrcdrl.common.model.weights_files import write_weights
from mrcdrl.common.model.weights_io import weights_to_bytes

VIEW_PX = 32
SMALL = load_config(
    "smoke", {"arena.view_px": str(VIEW_PX), "learner.precision": "float32"}, environ={}
)


@pytest.fixture(scope="module")
def network() -> QNetwork:
    return QNetwork("duel", view_px=VIEW_PX)


@pytest.fixture(scope="module")
def payload(network: QNetwork) -> bytes:
    return weights_to_bytes(network)


def test_a_runs_policy_gives_the_values_of_its_network(
    tmp_path: Path, network: QNetwork, payload: bytes
) -> None:
    (tmp_path / "config.toml").write_text(to_toml(SMALL))
    known = {"weights_epoch": 1, "weights_version": 7, "learner_step": 700}
    write_weights(tmp_path / "checkpoints" / "best.safetensors", payload, known)
    states = np.random.default_rng(0).integers(0, 256, (5, 4, VIEW_PX, VIEW_PX), dtype=np.uint8)
    policy = load_policy(tmp_path)
    assert (policy.weights_epoch, policy.weights_version, policy.learner_step) == (1, 7, 700)
    expected = Policy(network, averaged_symmetries(SMALL))
    np.testing.assert_array_equal(policy.q_values(states), expected.q_values(states))
    actions = policy.select_actions(states, 0.0, np.random.default_rng(0)).actions
    assert (actions == policy.q_values(states).argmax(axis=1)).all()


def test_a_file_is_loaded_with_the_configuration_given(tmp_path: Path, payload: bytes) -> None:
    path = tmp_path / "some.safetensors"
    path.write_bytes(payload)
    assert load_policy(str(path), SMALL).weights_version == 0
    with pytest.raises(CheckpointError, match="sees 4 images of 32 px, the arena gives 4 of 60"):
        load_policy(path)


def test_it_is_part_of_the_public_api() -> None:
    assert mrcdrl.load_policy is load_policy


@pytest.mark.parametrize("content", [b"", b"no weights", b"\x08" + b"\x00" * 7 + b"{}      "])
def test_other_files_are_named_and_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "txt.safetensors"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"txt\.safetensors: not an MRCDRL weights file"):
        load_policy(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"none\.safetensors: No such file"):
        load_policy(tmp_path / "none.safetensors")


def test_a_wrong_configuration_is_refused(tmp_path: Path, payload: bytes) -> None:
    (tmp_path / "config.toml").write_text("[arena]\nrobots = 2\n")
    write_weights(tmp_path / "checkpoints" / "best.safetensors", payload, {})
    with pytest.raises(ConfigError, match="robots"):
        load_policy(tmp_path)


def test_a_run_directory_stands_for_its_best_weights_or_the_newest(
    tmp_path: Path, payload: bytes
) -> None:
    checkpoints = tmp_path / "checkpoints"
    with pytest.raises(CheckpointError, match="holds no weights"):
        weights_path(tmp_path)
    for step in (5, 40, 300):
        folder = checkpoints / f"step_{step:09d}"
        folder.mkdir(parents=True)
        (folder / "model.safetensors").write_bytes(payload)
    assert weights_path(tmp_path) == checkpoints / "step_000000300" / "model.safetensors"
    folder = checkpoints / "step_000000040"
    assert weights_path(folder) == folder / "model.safetensors"
    (checkpoints / "best.safetensors").write_bytes(payload)
    assert weights_path(tmp_path) == checkpoints / "best.safetensors"
