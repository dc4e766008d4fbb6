"""The network's values, computed fast: what actors, evaluators and the learner call.

Parameters are scaled and cast once for many evaluations (`operands`). The first layer, most of
the work on mostly black images, runs in kernels of ours where they exist (`prepare`). A trace
keeps what a shared gradient and the diagnostics need. The oracle is `QNetwork.forward`.

Invariant: the values are the oracle's within the rounding of `compute_dtype`.

Shapes: B = states of a batch, S = images stacked in a state, V = width of an image in px.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional

from mrcdrl.common.model.kernels.sparse_conv import NonzeroPixels, nonzero_pixels
from mrcdrl.common.model.kernels.sparse_conv import first_layer as sparse_first_layer
from mrcdrl.common.model.kernels.tensor_core_conv import Images, images_on_gpu
from mrcdrl.common.model.kernels.tensor_core_conv import first_layer as tensor_core_first_layer
from mrcdrl.common.model.q_network import WHITE, QNetwork

States = Tensor | NonzeroPixels | Images  # as the first layer takes them
Operands = dict[str, Tensor]  # by parameter name
_FLOAT32 = ("conv1.", "value.", "advantage.", "action_value.")  # operands that stay float32


@dataclass(frozen=True, slots=True)
class Trace:
    """What an evaluation passed through."""

    units: list[Tensor] = field(default_factory=list)  # outputs of each hidden layer
    # of fully connected layers, by their weight's name: inputs [B, F], sums before ReLU [B, U]
    products: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict)


def hidden_weights(network: QNetwork) -> tuple[str, ...]:
    """Names of the fully connected hidden layers' weights: nearly all parameters."""
    hidden = ("value_hidden", "advantage_hidden") if network.kind == "duel" else ("hidden",)
    return tuple(f"{name}.weight" for name in hidden)


def prepare(network: QNetwork, observation: Tensor) -> States:
    """States uint8 [B, S, V, V] as the first layer is fastest on them.

    On a CPU, mostly black images become their nonzero pixels. On a GPU that computes in bfloat16,
    images stay bytes where its kernels can be had. Everything else becomes a dense tensor.
    """
    states: States | None = None
    if observation.device.type == "cpu":
        states = nonzero_pixels(observation)
    elif observation.device.type == "cuda" and network.compute_dtype == torch.bfloat16:
        states = images_on_gpu(observation)
    if states is not None:
        return states
    # two passes: converting and reordering at once is twice as slow on a CPU
    dense = observation.to(network.compute_dtype)
    return dense.contiguous(memory_format=torch.channels_last)


def operands(network: QNetwork) -> Operands:
    """The parameters as `fast_forward` takes them, with gradient; valid until they change."""
    found: Operands = dict(network.named_parameters())
    found["conv1.weight"] = found["conv1.weight"] / WHITE
    for name, parameter in found.items():
        if not name.startswith(_FLOAT32):
            found[name] = parameter.to(network.compute_dtype)
    return found


def scale_gradients(gradients: Operands) -> None:
    """Turn gradients of the operands into those of the parameters, in place."""
    gradients["conv1.weight"] /= WHITE


def fast_forward(
    network: QNetwork, states: States, operands: Operands, trace: Trace | None = None
) -> Tensor:
    """Values float32 [B, num_actions] of what `prepare` and `operands` returned.

    trace: filled if given.
    """
    trace, dtype = trace or Trace(), network.compute_dtype
    weight, bias = operands["conv1.weight"], operands["conv1.bias"]
    if isinstance(states, NonzeroPixels):
        x = sparse_first_layer(states, weight, bias, dtype)
    elif isinstance(states, Images):
        x = tensor_core_first_layer(states, weight, bias)
    else:
        x = functional.conv2d(states, weight.to(dtype), bias.to(dtype), stride=2)
        x = functional.relu_(functional.max_pool2d(x, 2))
    trace.units.append(x)
    for name, stride in (("conv2", 2), ("conv3", 1)):
        x = functional.conv2d(x, operands[f"{name}.weight"], operands[f"{name}.bias"], stride)
        x = functional.relu_(x)
        trace.units.append(x)
    features = x.flatten(1)
    if network.kind != "duel":
        return _stream(features, operands, "hidden", "action_value", trace)
    value = _stream(features, operands, "value_hidden", "value", trace)
    advantage = _stream(features, operands, "advantage_hidden", "advantage", trace)
    return value + advantage - advantage.mean(dim=1, keepdim=True)


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
