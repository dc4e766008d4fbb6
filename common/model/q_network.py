"""The paper's action-value network (section 5.1, Fig. 4), as it reads.

`fast_forward.py` computes the same values several times as fast, for learner and actors; this is
its oracle, and what `mrcdrl export` writes.

Invariants: parameters are float32 whatever precision they are computed in; the output layers and
their sum are computed in float32 always (the gap between actions is about 1 % of Q, below what
bfloat16 resolves); the three kinds differ in their streams only.

Shapes: B = states of a batch, S = images stacked in a state, V = width of an image in px.
"""

from typing import Final, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import NUM_ACTIONS

Kind = Literal["duel", "ddqn", "dqn"]
Precision = Literal["auto", "float32", "bfloat16"]

HIDDEN_UNITS: Final = 512
WHITE: Final = 255.0


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
    """The device that a setting names; `auto`: cuda if there is one, else cpu.

    name: the setting, for ConfigError where the device does not exist.
    """
    if setting == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(setting)
    except RuntimeError as error:
        raise ConfigError(f"{name} {setting!r} is not a device; use auto or cpu") from error
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

    def forward(self, observation: Tensor) -> Tensor:
        """Values float32 [B, num_actions] of states uint8 [B, S, V, V].

        White is 1: dividing the first kernel by 255 is the same as dividing the images, which stay
        exact integers, also in bfloat16. Pooling before the ReLU is the same as after it.
        """
        dtype = self.compute_dtype
        x = observation.to(dtype).contiguous(memory_format=torch.channels_last)
        weight, bias = self.conv1.parameters()
        x = functional.conv2d(x, (weight / WHITE).to(dtype), bias.to(dtype), stride=2)
        x = functional.relu(functional.max_pool2d(x, 2))
        for layer in (self.conv2, self.conv3):
            kernel, offset = (p.to(dtype) for p in layer.parameters())
            x = functional.relu(functional.conv2d(x, kernel, offset, layer.stride))
        features = x.flatten(1)
        if self.kind != "duel":
            return self._stream(features, self.hidden, self.action_value)
        value = self._stream(features, self.value_hidden, self.value)
        advantage = self._stream(features, self.advantage_hidden, self.advantage)
        return value + advantage - advantage.mean(dim=1, keepdim=True)  # Eq. (1)

    def _stream(self, features: Tensor, hidden: nn.Linear, output: nn.Linear) -> Tensor:
        """A hidden layer and, in float32, an output layer."""
        weight, bias = (p.to(self.compute_dtype) for p in hidden.parameters())
        units: Tensor = output(functional.relu(functional.linear(features, weight, bias)).float())
        return units
