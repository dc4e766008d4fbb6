"""An exported file gives the network's values, or is not written."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from mrcdrl.common.errors import CheckpointError, ConfigError, MrcdrlError
from mrcdrl.common.model.q_network import Kind, QNetwork
from mrcdrl.common.model.weights_io import network_from_bytes, weights_to_bytes
from mrcdrl.services.tools import export as exporting
from mrcdrl.services.tools import flags
from mrcdrl.services.tools.export import FORMATS, METADATA, NAMES, main, real_states
from mrcdrl.services.tools.subject import subject

VIEW_PX = 32
FLAGS = (f"--arena.view_px={VIEW_PX}", "--config", "smoke")
MISSING = [n for n in ("onnx", "onnxscript", "onnxruntime") if not importlib.util.find_spec(n)]
pytestmark = pytest.mark.timeout(600)  # the first ONNX export imports for a long time
needs_onnx = pytest.mark.skipif(bool(MISSING), reason=f"ONNX is NOT tested: no {MISSING}")
EVERY = [
    pytest.param(".onnx", "duel", marks=needs_onnx),
    (".pt2", "duel"),
    (".ts", "duel"),
    (".ts", "ddqn"),
]


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    return put(tmp_path / "some.safetensors", "duel")


def put(path: Path, kind: Kind) -> Path:
    with torch.random.fork_rng():
        torch.manual_seed(1)
        path.write_bytes(weights_to_bytes(QNetwork(kind, view_px=VIEW_PX)))
    return path


def states_of(weights: Path, count: int) -> torch.Tensor:
    given = subject(flags.evaluate().parse_args([str(weights), *FLAGS]))
    assert given.policy is not None
    return torch.from_numpy(real_states(given.config, given.policy, count))


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
@pytest.mark.parametrize(("suffix", "kind"), EVERY)
def test_the_file_gives_the_networks_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str, kind: Kind
) -> None:
    weights, out = put(tmp_path / "some.safetensors", kind), tmp_path / f"policy{suffix}"
    assert main([str(weights), "--out", str(out), *FLAGS]) == 0
    assert "largest difference from torch" in capsys.readouterr().out
    run, states = FORMATS[suffix][1](out.read_bytes()), states_of(weights, 7)
    expected = network_from_bytes(weights.read_bytes())(states).detach()
    assert float(expected.std()) > 1e-3, "images and values differ"
    for count in (1, 2, 7):
        values = run(states[:count])
        assert values.dtype == torch.float32
        torch.testing.assert_close(values, expected[:count], rtol=1e-4, atol=1e-5)


@needs_onnx
def test_onnx_names_its_ends_and_what_it_is(tmp_path: Path, weights: Path) -> None:
    import onnxruntime

    main([str(weights), "--out", str(tmp_path / "policy.onnx"), *FLAGS])
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    (entry,), (end,) = session.get_inputs(), session.get_outputs()
    assert (entry.name, end.name) == NAMES
    assert (entry.type, entry.shape[1:]) == ("tensor(uint8)", [4, VIEW_PX, VIEW_PX])
    told = json.loads(session.get_modelmeta().custom_metadata_map[METADATA])
    assert (told["kind"], told["view_px"]) == ("duel", VIEW_PX)


def test_states_are_of_real_episodes(weights: Path) -> None:
    states = states_of(weights, 40).numpy()
    assert states.shape == (40, 4, VIEW_PX, VIEW_PX)
    assert len(np.unique(states.reshape(40, -1), axis=0)) > 20


def test_a_file_of_other_values_is_not_written(
    tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pack, unpack = FORMATS[".ts"]

    def wrong(network: QNetwork, example: torch.Tensor, metadata: str) -> bytes:
        with torch.no_grad():
            network.value.bias += 0  # the network itself stays
        return pack(QNetwork(network.kind, view_px=VIEW_PX), example, metadata)

    monkeypatch.setitem(exporting.FORMATS, ".ts", (wrong, unpack))
    with pytest.raises(CheckpointError, match="not exported: the file's values differ"):
        main([str(weights), "--out", str(tmp_path / "policy.ts"), *FLAGS])
    assert not (tmp_path / "policy.ts").exists()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (
            ("{weights}", "--out", "policy.h5"),
            r"unsupported extension '.h5'; use .onnx, .pt2, .ts",
        ),
        (("{weights}", "--out", "/proc/policy.ts"), "cannot be written: No such file"),
    ],
)
def test_what_cannot_be_exported_is_said(
    tmp_path: Path, weights: Path, argv: tuple[str, ...], message: str
) -> None:
    words = [word.format(weights=weights, folder=tmp_path) for word in argv]
    with pytest.raises(MrcdrlError, match=message):
        main([*words, *FLAGS])


def test_a_controller_is_not_offered(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    told = capsys.readouterr().out
    assert "weights" in told
    assert "--controller" not in told


def test_without_its_packages_onnx_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(
        ConfigError, match=r"needs onnx, onnxscript, onnxruntime: not installed.*mrcdrl\[export\]"
    ):
        main(["none.safetensors", "--out", str(tmp_path / "policy.onnx"), *FLAGS])
