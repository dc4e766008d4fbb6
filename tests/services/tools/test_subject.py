"""The subject that flags name, and the flags that are refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from mrcdrl.common.config import load_config, to_toml
from mrcdrl.common.errors import CheckpointError, ConfigError
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_files import write_weights
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.common.runtime.files import sha256
from mrcdrl.services.evaluator.trial import ControllerPlayer, PolicyPlayer
from mrcdrl.services.tools import evaluate, flags
from mrcdrl.services.tools.episode_frames import film_frames
from mrcdrl.services.tools.subject import Subject, subject

VIEW_PX = 32
VIEW = f"--arena.view_px={VIEW_PX}"


@pytest.fixture(scope="module")
def payload() -> bytes:
    return weights_to_bytes(QNetwork("duel", view_px=VIEW_PX))


def named(*argv: object) -> Subject:
    return subject(flags.evaluate().parse_args([str(arg) for arg in argv]))


def test_a_controller_plays_in_the_preset_quick() -> None:
    found = named("--controller", "greedy", "--robots", "3")
    assert (found.controller, found.policy, found.weights.version) == ("greedy", None, 0)
    assert found.config.arena.num_robots == 3
    assert isinstance(found.player(0), ControllerPlayer)


def test_an_unknown_controller_is_refused() -> None:
    with pytest.raises(ConfigError, match="'greed'; did you mean greedy"):
        named("--controller", "greed")


@pytest.mark.parametrize("argv", [(), ("weights.safetensors", "--controller", "greedy")])
def test_either_weights_or_a_controller(argv: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match="either weights or --controller"):
        named(*argv)


def test_weights_are_loaded_with_their_manifest(tmp_path: Path, payload: bytes) -> None:
    known = {"weights_epoch": 1, "weights_version": 7, "learner_step": 700}
    write_weights(tmp_path / "best.safetensors", payload, known)
    found = named(tmp_path / "best.safetensors", VIEW)
    assert (found.weights.order, found.weights.learner_step) == ((1, 7), 700)
    assert found.weights.payload == payload
    assert found.policy is not None
    assert isinstance(found.player(0), PolicyPlayer)


def test_weights_without_a_manifest_are_version_0(tmp_path: Path, payload: bytes) -> None:
    (tmp_path / "some.safetensors").write_bytes(payload)
    assert named(tmp_path / "some.safetensors", VIEW).weights.order == (0, 0)


def test_damaged_weights_are_refused(tmp_path: Path, payload: bytes) -> None:
    altered = payload[:-1] + bytes([payload[-1] ^ 1])  # as valid as before, to the network
    write_weights(tmp_path / "best.safetensors", payload, {"weights_version": 7})
    (tmp_path / "best.safetensors").write_bytes(altered)
    with pytest.raises(CheckpointError, match=r"best\.safetensors are damaged"):
        named(tmp_path / "best.safetensors", VIEW)
    (tmp_path / "manifest.json").write_text(
        json.dumps({"sha256": {"model.safetensors": sha256(payload)}, "weights_version": 7})
    )
    (tmp_path / "model.safetensors").write_bytes(payload)
    assert named(tmp_path / "model.safetensors", VIEW).weights.version == 7
    (tmp_path / "model.safetensors").write_bytes(altered)
    with pytest.raises(CheckpointError, match=r"model\.safetensors is damaged"):
        named(tmp_path / "model.safetensors", VIEW)


def test_json_of_another_program_beside_weights_says_nothing_about_them(
    tmp_path: Path, payload: bytes
) -> None:
    (tmp_path / "some.safetensors").write_bytes(payload)
    (tmp_path / "some.json").write_text('{"weights_version": 7}')
    assert named(tmp_path / "some.safetensors", VIEW).weights.version == 0


def test_missing_weights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="No such file"):
        named(tmp_path / "none.safetensors")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no safetensors",
        b"\x08" + b"\x00" * 7 + b"{}      ",
        save({"conv": np.zeros((3, 3), np.float32)}, {"format": "pt"}),
    ],
)
def test_foreign_bytes_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "foreign.safetensors").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"weights|unreadable"):
        named(tmp_path / "foreign.safetensors", VIEW)


def test_weights_cut_off_or_of_another_type_are_refused(tmp_path: Path, payload: bytes) -> None:
    file = tmp_path / "some.safetensors"
    for changed in (payload[: len(payload) // 2], payload.replace(b'"F32"', b'"F64"')):
        assert changed != payload
        file.write_bytes(changed)
        with pytest.raises(CheckpointError, match=r"weights|unreadable"):
            named(file, VIEW)


def test_weights_of_another_view_are_refused(tmp_path: Path, payload: bytes) -> None:
    (tmp_path / "some.safetensors").write_bytes(payload)
    with pytest.raises(CheckpointError, match="sees 4 images of 32 px, the arena gives 4 of 60"):
        named(tmp_path / "some.safetensors")


def test_a_runs_weights_play_in_its_own_arena(
    tmp_path: Path, payload: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    own = load_config("smoke", {"arena.num_robots": "4", "arena.view_px": str(VIEW_PX)}, {})
    (tmp_path / "config.toml").write_text(to_toml(own))
    write_weights(tmp_path / "checkpoints" / "best.safetensors", payload, {})
    assert named(tmp_path).config.arena == own.arena
    assert not caplog.messages
    assert named(tmp_path, "--robots", "2").config.arena.num_robots == 2
    assert caplog.messages.pop().endswith("trained with 4 robots, plays with 2")
    assert named(tmp_path, "--config", "smoke", VIEW).config.arena.num_robots == 2


def test_several_numbers_of_robots_take_turns_and_are_tested_apart(
    tmp_path: Path,
    payload: bytes,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    settings = {"arena.robots": "[1, 4]", "arena.view_px": str(VIEW_PX), "arena.max_frames": "5"}
    (tmp_path / "config.toml").write_text(to_toml(load_config("smoke", settings, {})))
    write_weights(tmp_path / "checkpoints" / "best.safetensors", payload, {})
    found = named(tmp_path)
    assert [one.config.arena.num_robots for one in found.each_number()] == [1, 4]
    done: list[int] = []
    episodes = found.episodes(5, 0, done.append)
    assert done == sorted(done)
    assert [episode.robots.shape[1] for episode in episodes] == [4, 1, 4, 1, 4]
    frames = list(film_frames(found.config.arena, episodes[:2]))
    assert len({frame.shape for frame in frames}) == 1, "a film has one size"
    assert evaluate.main([str(tmp_path), "--episodes", "3", "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(line["num_robots"], line["episodes"]) for line in lines] == [(1, 3), (4, 3)]
    assert evaluate.main([str(tmp_path), "--episodes", "3", "--json", "--robots", "4"]) == 0
    (alone,) = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    del alone["wall_s"], lines[1]["wall_s"]
    assert alone == lines[1]
    assert not caplog.messages, "it has learned with that number"
    named(tmp_path, "--robots", "3")
    assert caplog.messages.pop().endswith("trained with 1, 4 robots, plays with 3")
