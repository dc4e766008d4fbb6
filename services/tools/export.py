"""`mrcdrl export`: write weights for other programs, as ONNX, torch.export or TorchScript.

Invariants: a file is written only if, read back, it gave the network's own values for states of
real episodes, singly and in batches; it computes in float32.
"""

import importlib.util
import io
import json
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mrcdrl.common.arena import make_arenas, make_codec
from mrcdrl.common.config import Config
from mrcdrl.common.errors import CheckpointError, ConfigError
from mrcdrl.common.model.policy import FrameStack, Policy
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import network_from_bytes
from mrcdrl.common.runtime.files import atomic_write, prepare_output, reason
from mrcdrl.services.tools import flags
from mrcdrl.services.tools.progress import Progress
from mrcdrl.services.tools.subject import Subject, subject

NAMES = ("observation", "q_values")  # uint8 [B, S, V, V], float32 [B, A]
METADATA = "mrcdrl.json"
_ONNX_PACKAGES = ("onnx", "onnxscript", "onnxruntime")
_STATES = 64
_TOLERANCE = 1e-4  # relative to the largest value
Run = Callable[[Tensor], Tensor]


def main(argv: Sequence[str]) -> int:
    """Export, print the largest difference; return the exit code."""
    arguments = flags.export().parse_args(argv)
    if arguments.out.suffix not in FORMATS:
        extension = arguments.out.suffix
        raise ConfigError(f"--out: unsupported extension {extension!r}; use {', '.join(FORMATS)}")
    if arguments.out.suffix == ".onnx":
        require_onnx()
    prepare_output(arguments.out)
    given = subject(arguments)
    with Progress() as progress:
        difference = export(given, arguments.out, progress)
    told = {"out": str(arguments.out), "states": _STATES, "largest_difference": difference}
    text = f"{arguments.out}: {_STATES} states, largest difference from torch {difference:.2g}"
    print(json.dumps(told) if arguments.json else text)
    return 0


def export(given: Subject, out: Path, progress: Progress) -> float:
    """Write the weights in the suffix's format; return the largest difference in values.

    Raises ConfigError for a controller, missing packages or a file that cannot be written, and
    CheckpointError if the file's values would differ from the network's.
    """
    if given.policy is None:
        raise ConfigError("a controller cannot be exported: give weights")
    network = network_from_bytes(given.weights.payload).eval().requires_grad_(requires_grad=False)
    pack, unpack = FORMATS[out.suffix]
    metadata = {
        "kind": network.kind,
        "stack": network.stack,
        "view_px": network.view_px,
        "weights_version": given.weights.version,
        "learner_step": given.weights.learner_step,
    }
    progress.stage("states of real episodes")
    states = torch.from_numpy(real_states(given.config, given.policy, _STATES))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns about its own internals
        progress.stage(out.name)
        content = pack(network, states[:2], json.dumps(metadata))
        progress.stage("comparing its values with the network's")
        difference = _difference(network, unpack(content), states)
    try:
        atomic_write(out, content)
    except OSError as error:
        raise ConfigError(f"{out} cannot be written: {reason(error)}") from error
    return difference


def real_states(config: Config, policy: Policy, count: int) -> np.ndarray:
    """States uint8 [count, S, V, V] of episodes played by the policy with epsilon 0.3."""
    arena = config.arena.with_robots(config.arena.num_robots)
    codec, rng = make_codec(arena), np.random.default_rng(0)
    arenas = make_arenas(arena, [rng], [0])
    frames = FrameStack(arena.num_robots, arena.stack, arena.view_px)
    seen: list[np.ndarray] = []
    while sum(map(len, seen)) < count:
        step = arenas.reset(0)
        frames.reset(slice(None), codec.decode(step.records))
        while not step.last:
            if rng.random() < 0.2:
                seen.append(frames.stacks.copy())
            actions = policy.select_actions(frames.stacks, 0.3, rng).actions
            step = arenas.step(actions[np.newaxis])[0]
            frames.push(codec.decode(step.records))
    return np.concatenate(seen)[:count]


def _difference(network: QNetwork, run: Run, states: Tensor) -> float:
    expected = network(states)
    together, alone = run(states), run(states[:1])
    difference = max(float((together - expected).abs().max()),
                     float((alone - expected[:1]).abs().max()))  # fmt: skip
    if not difference <= _TOLERANCE * max(1.0, float(expected.abs().max())):
        raise CheckpointError(
            f"not exported: the file's values differ by {difference:.2g} from the network's"
        )
    return difference


def _dynamic() -> dict[int, torch.export.Dim]:
    return {0: torch.export.Dim("batch", min=1, max=65536)}


def require_onnx() -> None:
    """Raise ConfigError, naming the extra, if a package for ONNX is not installed."""
    if missing := [name for name in _ONNX_PACKAGES if importlib.util.find_spec(name) is None]:
        raise ConfigError(
            f".onnx needs {', '.join(missing)}: not installed, use pip install 'mrcdrl[export]'"
        )


def _pack_onnx(network: QNetwork, example: Tensor, metadata: str) -> bytes:
    program = torch.onnx.export(
        network,
        (example,),
        dynamo=True,
        verbose=False,
        input_names=NAMES[:1],
        output_names=NAMES[1:],
        dynamic_shapes=(_dynamic(),),
    )
    if program is None:
        raise CheckpointError("not exported: torch gave no ONNX program")
    model = program.model_proto
    model.metadata_props.add(key=METADATA, value=metadata)
    content: bytes = model.SerializeToString()
    return content


def _run_onnx(content: bytes) -> Run:
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    return lambda states: torch.from_numpy(session.run([NAMES[1]], {NAMES[0]: states.numpy()})[0])


def _pack_pt2(network: QNetwork, example: Tensor, metadata: str) -> bytes:
    program = torch.export.export(network, (example,), dynamic_shapes=(_dynamic(),))
    buffer = io.BytesIO()
    torch.export.save(program, buffer, extra_files={METADATA: metadata})
    return buffer.getvalue()


def _run_pt2(content: bytes) -> Run:
    return torch.export.load(io.BytesIO(content)).module()


def _pack_torchscript(network: QNetwork, example: Tensor, metadata: str) -> bytes:
    buffer = io.BytesIO()
    traced = torch.jit.trace(network, example)  # type: ignore[no-untyped-call]
    torch.jit.save(traced, buffer, {METADATA: metadata})
    return buffer.getvalue()


def _run_torchscript(content: bytes) -> Run:
    loaded: Run = torch.jit.load(io.BytesIO(content))  # type: ignore[no-untyped-call]
    return loaded


FORMATS: dict[str, tuple[Callable[[QNetwork, Tensor, str], bytes], Callable[[bytes], Run]]] = {
    ".onnx": (_pack_onnx, _run_onnx),
    ".pt2": (_pack_pt2, _run_pt2),
    ".ts": (_pack_torchscript, _run_torchscript),
}
