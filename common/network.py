"""The paper's action-value network (section 5.1, Fig. 4) and its parameters as bytes.

Invariants: parameters are float32 whatever precision they are computed or sent in; the output
layers and their sum are computed in float32 always (the gap between actions is about 1 % of Q,
below what bfloat16 resolves); the three kinds differ in their streams only; bytes that do not
fit are refused.

Shapes: B = states of a batch, S = pictures stacked in a state, V = width of a picture in px.
"""

import json
import struct
from dataclasses import dataclass, field
from typing import Final, Literal, TypeGuard

import torch
from safetensors import SafetensorError
from safetensors.torch import load as read_safetensors
from safetensors.torch import save as write_safetensors
from torch import Tensor, nn
from torch.nn import functional

from common.errors import CheckpointError, ConfigError
from common.first_layer import LitPixels, first_layer, lit_pixels
from common.first_layer_cuda import Pictures, pictures_on_gpu
from common.first_layer_cuda import first_layer as first_layer_on_gpu
from common.trajectory import NUM_ACTIONS

Kind = Literal["duel", "ddqn", "dqn"]
Precision = Literal["auto", "float32", "bfloat16"]

HIDDEN_UNITS: Final = 512
FORMAT_VERSION: Final = 1
SENT_AS: Final = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
_METADATA_KEY: Final = "mrcdrl"  # one JSON text: safetensors does not keep an order of several
_WHITE: Final = 255.0
_FLOAT32 = ("conv1.", "value.", "advantage.", "action_value.")  # operands that are it always

States = Tensor | LitPixels | Pictures  # as the first layer takes them
Operands = dict[str, Tensor]  # by parameter name


@dataclass(frozen=True, slots=True)
class Trace:
    """What an evaluation passed through."""

    units: list[Tensor] = field(default_factory=list)  # outputs of each hidden layer
    # of fully connected ones, by their weight's name: inputs [B, F], and sums before ReLU [B, U]
    products: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict)


def precision(setting: Precision, device: str | torch.device = "cpu") -> torch.dtype:
    """The dtype of convolutions and hidden layers for a setting on a device.

    `auto` is bfloat16 where the processor computes in it natively, else float32: emulated
    bfloat16 is slower than float32.
    """
    if setting == "float32":
        return torch.float32
    if setting == "bfloat16":
        return torch.bfloat16
    if torch.device(device).type == "cuda":
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        native = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return torch.bfloat16 if native else torch.float32


def resolve_device(setting: str, name: str) -> torch.device:
    """`auto`: cuda if there is one, else cpu. name: of the setting.

    Raises ConfigError for a device that is none.
    """
    if setting == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(setting)
    except RuntimeError as error:
        raise ConfigError(f"{name} {setting!r} is no device; use auto or cpu") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"{name} {setting!r}: no CUDA device here; use auto or cpu")
    return device


def feature_size(view_px: int) -> int:
    """Units after the last convolution, 1024 for 60 px; raises ConfigError if nothing is left."""
    side = (view_px - 5) // 2 + 1  # convolution 5x5, stride 2
    side //= 2  # max-pool 2x2
    side = (side - 3) // 2 + 1  # convolution 3x3, stride 2
    side -= 2  # convolution 3x3
    if side < 1:
        raise ConfigError(
            f"view_px {view_px}: the network's convolutions leave nothing of pictures below 31 px"
        )
    return 64 * side * side


class QNetwork(nn.Module):
    """Q(s, a) of a stack of pictures: float32 [B, 3] of uint8 [B, S, V, V].

    kind: `duel` has a value stream and an advantage stream, joined by Eq. (1) of the paper;
    `ddqn` and `dqn` have one stream, and differ in the learner's target only.
    """

    def __init__(
        self,
        kind: Kind,
        *,
        stack: int = 4,
        view_px: int = 60,
        num_actions: int = NUM_ACTIONS,
        compute_dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        self.kind: Kind = kind
        self.stack = stack
        self.view_px = view_px
        self.num_actions = num_actions
        self.compute_dtype = compute_dtype
        features = feature_size(view_px)
        self.conv1 = nn.Conv2d(stack, 32, kernel_size=5, stride=2)
        self.conv2 = nn.Conv2d(32, 64, kernel_size=3, stride=2)
        self.conv3 = nn.Conv2d(64, 64, kernel_size=3)
        if kind == "duel":
            self.value_hidden = nn.Linear(features, HIDDEN_UNITS)
            self.value = nn.Linear(HIDDEN_UNITS, 1)
            self.advantage_hidden = nn.Linear(features, HIDDEN_UNITS)
            self.advantage = nn.Linear(HIDDEN_UNITS, num_actions)
        else:
            self.hidden = nn.Linear(features, HIDDEN_UNITS)
            self.action_value = nn.Linear(HIDDEN_UNITS, num_actions)
        hidden = ("value_hidden", "advantage_hidden") if kind == "duel" else ("hidden",)
        self.hidden_weights = tuple(f"{name}.weight" for name in hidden)  # nearly all parameters

    def forward(self, observation: Tensor) -> Tensor:
        """Values float32 [B, num_actions] of states uint8 [B, S, V, V], by torch alone."""
        return self.evaluate(self._dense(observation), self.operands())

    def prepare(self, observation: Tensor) -> States:
        """States uint8 [B, S, V, V] as the first layer is fastest on them.

        On a CPU those that are mostly black are what is not black of them; on a GPU that computes
        in bfloat16 they are left as they are, where its kernels can be had.
        """
        given: States | None = None
        if observation.device.type == "cpu":
            given = lit_pixels(observation)
        elif observation.device.type == "cuda" and self.compute_dtype == torch.bfloat16:
            given = pictures_on_gpu(observation)
        return self._dense(observation) if given is None else given

    def _dense(self, observation: Tensor) -> Tensor:
        """In the dtype and memory order of a convolution.

        In two passes: converting and reordering at once is twice as slow on a CPU.
        """
        return observation.to(self.compute_dtype).contiguous(memory_format=torch.channels_last)

    def operands(self) -> Operands:
        """The parameters as `evaluate` takes them, with gradient; valid until they change.

        White is 1: dividing the first kernel by 255 is the same as dividing the pictures, which
        stay exact integers, also in bfloat16.
        """
        operands: Operands = dict(self.named_parameters())
        operands["conv1.weight"] = operands["conv1.weight"] / _WHITE
        for name, parameter in operands.items():
            if not name.startswith(_FLOAT32):
                operands[name] = parameter.to(self.compute_dtype)
        return operands

    def scale_gradients(self, gradients: Operands) -> None:
        """From those of the operands to those of the parameters, in place."""
        gradients["conv1.weight"] /= _WHITE

    def evaluate(self, states: States, operands: Operands, trace: Trace | None = None) -> Tensor:
        """Values float32 [B, num_actions] of what `prepare` and `operands` returned.

        Pooling before the ReLU is the same as after it, on a quarter of the numbers. trace: is
        filled, if given.
        """
        trace = trace or Trace()
        weight, bias = operands["conv1.weight"], operands["conv1.bias"]
        if isinstance(states, LitPixels):
            x = first_layer(states, weight, bias).to(self.compute_dtype)
        elif isinstance(states, Pictures):
            x = first_layer_on_gpu(states, weight, bias)
        else:
            weight, bias = weight.to(self.compute_dtype), bias.to(self.compute_dtype)
            x = functional.max_pool2d(functional.conv2d(states, weight, bias, stride=2), 2)
            x = functional.relu_(x)
        trace.units.append(x)
        x = functional.conv2d(x, operands["conv2.weight"], operands["conv2.bias"], stride=2)
        x = functional.relu_(x)
        trace.units.append(x)
        x = functional.conv2d(x, operands["conv3.weight"], operands["conv3.bias"])
        x = functional.relu_(x)
        trace.units.append(x)
        features = x.flatten(1)
        if self.kind == "duel":
            value = _stream(features, operands, "value_hidden", "value", trace)
            advantage = _stream(features, operands, "advantage_hidden", "advantage", trace)
            return value + advantage - advantage.mean(dim=1, keepdim=True)
        return _stream(features, operands, "hidden", "action_value", trace)


def _stream(features: Tensor, operands: Operands, hidden: str, output: str, trace: Trace) -> Tensor:
    """A hidden layer and, in float32, an output layer."""
    weight = f"{hidden}.weight"
    sums = functional.linear(features, operands[weight], operands[f"{hidden}.bias"])
    units = functional.relu(sums)
    trace.units.append(units)
    trace.products[weight] = features, sums
    return functional.linear(
        units.float(), operands[f"{output}.weight"], operands[f"{output}.bias"]
    )


def weights_to_bytes(network: QNetwork, dtype: torch.dtype = torch.float32) -> bytes:
    """The parameters as safetensors: by name, with what they belong to in the header.

    dtype: one of SENT_AS; all but float32 round. Raises CheckpointError if a value is not finite,
    or not once it is rounded: weights that diverged are handed to nobody.
    """
    arrays = {
        name: parameter.detach().to("cpu", dtype).contiguous()
        for name, parameter in network.state_dict().items()
    }
    _check_finite(arrays)
    return write_safetensors(arrays, {_METADATA_KEY: json.dumps(_metadata(network))})


def load_weights(network: QNetwork, payload: bytes) -> None:
    """Set the network's parameters in place, cast up where they were sent in half precision.

    Raises CheckpointError, leaving the network as it was, if the payload is unreadable, belongs
    to another kind or shape of network, or holds a value that is not finite.
    """
    metadata = _read_metadata(payload)
    expected = _metadata(network)
    for name, value in expected.items():
        if metadata.get(name) != value:
            raise CheckpointError(f"weights have {name} {metadata.get(name)!r}, not {value!r}")
    arrays = read_arrays(payload)
    own = network.state_dict()
    if odd := sorted(own.keys() ^ arrays.keys()):
        where = "lack" if odd[0] in own else "have an unknown"
        raise CheckpointError(f"weights {where} parameter {odd[0]!r}")
    sent_as = arrays[next(iter(own))].dtype
    dtype = sent_as if sent_as in SENT_AS.values() else torch.float32
    for name, parameter in own.items():
        array = arrays[name]
        if array.dtype != dtype or array.shape != parameter.shape:
            raise CheckpointError(
                f"weights: {name} is {array.dtype} {list(array.shape)}, "
                f"not {dtype} {list(parameter.shape)}"
            )
    _check_finite(arrays)
    network.load_state_dict(arrays)


def network_from_bytes(
    payload: bytes, *, compute_dtype: torch.dtype = torch.float32, device: str = "cpu"
) -> QNetwork:
    """The network that the payload's header names, with its parameters.

    Raises CheckpointError as `load_weights` does.
    """
    metadata = _read_metadata(payload)
    kind, stack, view_px = metadata.get("kind"), metadata.get("stack"), metadata.get("view_px")
    num_actions = metadata.get("num_actions")
    if (
        kind not in ("duel", "ddqn", "dqn")
        or not _in_range(stack, 16)
        or not _in_range(view_px, 255)
        or not _in_range(num_actions, 255)
    ):
        raise CheckpointError(f"weights name no network of ours: {json.dumps(metadata)[:200]}")
    try:
        network = QNetwork(
            kind, stack=stack, view_px=view_px, num_actions=num_actions, compute_dtype=compute_dtype
        )
    except ConfigError as error:
        raise CheckpointError(f"weights name an impossible network: {error}") from error
    load_weights(network, payload)
    return network.to(device)


def read_arrays(payload: bytes) -> dict[str, Tensor]:
    """Tensors by name of a safetensors payload; raises CheckpointError if it is unreadable."""
    try:
        return read_safetensors(payload)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        first_line = str(error).partition("\n")[0]
        raise CheckpointError(f"weights are unreadable: {first_line}") from error


def _metadata(network: QNetwork) -> dict[str, object]:
    return {
        "format_version": FORMAT_VERSION,
        "kind": network.kind,
        "stack": network.stack,
        "view_px": network.view_px,
        "num_actions": network.num_actions,
    }


def _in_range(value: object, highest: int) -> TypeGuard[int]:
    return type(value) is int and 1 <= value <= highest


def _read_metadata(payload: bytes) -> dict[str, object]:
    try:
        (length,) = struct.unpack_from("<Q", payload)
        header = json.loads(payload[8 : 8 + length])
        metadata = json.loads(header["__metadata__"][_METADATA_KEY])
    except (struct.error, ValueError, OverflowError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(
            f"weights of {len(payload)} bytes are unreadable: no header of ours"
        ) from error
    if not isinstance(metadata, dict):
        raise CheckpointError("weights are unreadable: the header is no table")
    return metadata


def _check_finite(arrays: dict[str, Tensor]) -> None:
    for name, array in arrays.items():
        if not bool(torch.isfinite(array).all()):
            raise CheckpointError(f"weights: {name} has values that are not finite")
