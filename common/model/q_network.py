"""The paper's action-value network (section 5.1, Fig. 4) and its parameters as bytes.

Invariants: parameters are float32 whatever precision they are computed or sent in; the output
layers and their sum are computed in float32 always (the gap between actions is about 1 % of Q,
below what bfloat16 resolves); the three kinds differ in their streams only; bytes that do not
fit are refused.

Shapes: B = states of a batch, S = images stacked in a state, V = width of an image in px.
"""

from dataclasses import dataclass, field
from typing import Final, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import NUM_ACTIONS
from mrcdrl.common.model.kernels.sparse_conv import NonzeroPixels, first_layer, nonzero_pixels
from mrcdrl.common.model.kernels.tensor_core_conv import Images, images_on_gpu
from mrcdrl.common.model.kernels.tensor_core_conv import first_layer as first_layer_on_gpu

Kind = Literal["duel", "ddqn", "dqn"]
Precision = Literal["auto", "float32", "bfloat16"]

HIDDEN_UNITS: Final = 512
_WHITE: Final = 255.0
_FLOAT32 = ("conv1.", "value.", "advantage.", "action_value.")  # operands that are it always

States = Tensor | NonzeroPixels | Images  # as the first layer takes them
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
            f"view_px {view_px}: the network's convolutions leave nothing of images below 31 px"
        )
    return 64 * side * side


class QNetwork(nn.Module):
    """Q(s, a) of a stack of images: float32 [B, 3] of uint8 [B, S, V, V].

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
            given = nonzero_pixels(observation)
        elif observation.device.type == "cuda" and self.compute_dtype == torch.bfloat16:
            given = images_on_gpu(observation)
        return self._dense(observation) if given is None else given

    def _dense(self, observation: Tensor) -> Tensor:
        """In the dtype and memory order of a convolution.

        In two passes: converting and reordering at once is twice as slow on a CPU.
        """
        return observation.to(self.compute_dtype).contiguous(memory_format=torch.channels_last)

    def operands(self) -> Operands:
        """The parameters as `evaluate` takes them, with gradient; valid until they change.

        White is 1: dividing the first kernel by 255 is the same as dividing the images, which
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
        if isinstance(states, NonzeroPixels):
            x = first_layer(states, weight, bias).to(self.compute_dtype)
        elif isinstance(states, Images):
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
