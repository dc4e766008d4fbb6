"""The network's first layer on a GPU's tensor cores: convolution, max-pool and ReLU in one.

PyTorch's operations move a convolution's whole output through memory, four times as much as pooling
leaves of it, and are slow for as few channels as a state stacks images. The kernels are in
`tensor_core_conv.cu`. Where they do not compile, `fast_forward.py` uses PyTorch's operations.

Invariants: the values are those of PyTorch's operations in bfloat16 within its rounding; the same
images and parameters give the same bits.

Shapes: B = states, S = images of a state, V = their width, C = channels, P = width when pooled.
"""

import logging
from dataclasses import dataclass
from functools import cache
from typing import Any, Self

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrcdrl.common.model.kernels.cuda import KernelError, Launch, compile_kernel, source_of
from mrcdrl.common.model.kernels.sparse_conv import pooled_px
from mrcdrl.common.model.kernels.sparse_conv_loops import CHANNELS, KERNEL

_LOG = logging.getLogger("network")
_THREADS = 256
_BLOCKS = 2  # at once on a multiprocessor; 1 or 3 take a fifth longer


@dataclass(frozen=True, slots=True)
class Layout:
    """The form of states that the kernels are compiled for, and the sizes that follow from it."""

    stack: int
    view_px: int

    @property
    def definitions(self) -> dict[str, object]:
        return {"STACK": self.stack, "VIEW": self.view_px}

    @property
    def pooled_px(self) -> int:
        return pooled_px(self.view_px)

    @property
    def sums(self) -> int:
        """Numbers of a channel's gradient: six a row of taps, and then one of the bias."""
        return (self.stack * 15 + 16) // 16 * 32

    @property
    def image_bytes(self) -> int:
        """Shared memory of a block for one state's images."""
        return self.stack * self.view_px * ((self.view_px + 2) // 2) * 4

    @property
    def gradient_bytes(self) -> int:
        """Shared memory of a block for the gradients of a state's pooled values."""
        return CHANNELS * 3 * ((self.pooled_px**2 + 15) // 16 * 16 + 8)


@dataclass(frozen=True, slots=True)
class FirstLayer:
    """The kernels for one layout on one device."""

    layout: Layout
    forward: Launch
    backward: Launch
    blocks: int  # at most, of one launch

    @classmethod
    def on(cls, device: torch.device, layout: Layout) -> Self:
        """Compile the kernels; raises KernelError where that fails."""
        source, macros = first_layer_source(), layout.definitions
        shared = layout.image_bytes
        forward = compile_kernel(
            source, "forward", device, macros, threads=_THREADS, shared_bytes=shared
        )
        shared += layout.gradient_bytes
        backward = compile_kernel(
            source, "backward", device, macros, threads=_THREADS, shared_bytes=shared
        )
        num = torch.cuda.get_device_properties(device).multi_processor_count
        return cls(layout, forward, backward, num * _BLOCKS)


@dataclass(frozen=True, slots=True)
class Images:
    """States as bytes, uint8 [B, S, V, V], rows without gaps, and the kernels that read them."""

    intensities: Tensor
    layer: FirstLayer


def first_layer_source() -> str:
    """CUDA C++ with the functions `forward` and `backward`."""
    return source_of("mrcdrl.common.model.kernels", "tensor_core_conv.cu")


def images_on_gpu(observation: Tensor) -> Images | None:
    """States uint8 [B, S, V, V] on a GPU as the kernels take them; None if they do not compile."""
    _, stack, size, _ = observation.shape
    layer = _layer_on(observation.device, Layout(stack, size))
    return None if layer is None else images_for(layer, observation)


def images_for(layer: FirstLayer, observation: Tensor) -> Images:
    """States uint8 [B, S, V, V] for these kernels."""
    size = layer.layout.view_px
    if observation.stride()[2:] != (size, 1):
        observation = observation.contiguous()
    return Images(observation, layer)


@cache
def _layer_on(device: torch.device, layout: Layout) -> FirstLayer | None:
    try:
        return FirstLayer.on(device, layout)
    except KernelError as error:
        _LOG.warning("the first layer uses PyTorch's operations: %s", error)
        return None


def first_layer(images: Images, weight: Tensor, bias: Tensor) -> Tensor:
    """max(0, max-pool(convolution)), bfloat16 [B, C, P, P], channels last in memory.

    weight: float32 [C, S, 5, 5], for intensities of 0 to 255; bias: float32 [C].
    """
    outputs: Tensor = _FirstLayer.apply(images, weight, bias)  # type: ignore[no-untyped-call]
    return outputs


class _FirstLayer(torch.autograd.Function):
    """The layer with gradients of weight and bias; images have none."""

    @staticmethod
    def forward(ctx: Any, images: Images, weight: Tensor, bias: Tensor) -> Tensor:
        intensities, layer = images.intensities, images.layer
        num, side = len(intensities), layer.layout.pooled_px
        pooled = torch.empty(
            (num, CHANNELS, side, side),
            dtype=torch.bfloat16,
            device=intensities.device,
            memory_format=torch.channels_last,
        )
        largest = torch.empty_like(pooled, dtype=torch.uint8)
        if num:
            parameters = weight.detach().contiguous(), bias.detach().contiguous()
            outputs = pooled, largest
            layer.forward(
                min(num, layer.blocks),
                [
                    intensities,
                    *parameters,
                    *outputs,
                    num,
                    intensities.stride(0),
                    intensities.stride(1),
                ],
            )
        ctx.images = images
        ctx.save_for_backward(pooled, largest)
        return pooled

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor, Tensor]:
        intensities, layer = ctx.images.intensities, ctx.images.layer
        layout, num = layer.layout, len(intensities)
        blocks = min(num, layer.blocks)
        sums = torch.empty(blocks, CHANNELS, layout.sums, device=intensities.device)
        if num:
            passed = gradient.contiguous(memory_format=torch.channels_last)
            inputs = intensities, passed, *ctx.saved_tensors
            layer.backward(
                blocks, [*inputs, sums, num, intensities.stride(0), intensities.stride(1)]
            )
        summed = sums.sum(0)
        end = layout.stack * KERNEL * (KERNEL + 1)
        taps = summed[:, :end].reshape(CHANNELS, layout.stack, KERNEL, KERNEL + 1)
        return None, taps[..., :KERNEL], summed[:, end]
