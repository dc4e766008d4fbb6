"""The network's first layer on a GPU's tensor cores: convolution, max-pool and ReLU in one.

Torch's operations move all that a convolution gives through memory, four times as much as is left
when it is pooled, and have no fast one for as few images as a state stacks. The kernels are in
`tensor_core_conv.cu`; where they cannot be had, torch's operations do the same (`q_network.py`).

Invariants: the values are those of torch's operations in bfloat16 within its rounding; the same
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
_BLOCKS = 2  # that a multiprocessor has at once; with 1 or 3 it takes a fifth longer


@dataclass(frozen=True, slots=True)
class Layout:
    """How the kernels see states; the macros and sizes that they are compiled for."""

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
        """Of memory that a block shares, for one state's images."""
        return self.stack * self.view_px * ((self.view_px + 2) // 2) * 4

    @property
    def gradient_bytes(self) -> int:
        """For the gradients of its pooled numbers."""
        return CHANNELS * 3 * ((self.pooled_px**2 + 15) // 16 * 16 + 8)


@dataclass(frozen=True, slots=True)
class FirstLayer:
    """The kernels for one layout on one device."""

    layout: Layout
    forward: Launch
    backward: Launch
    blocks: int  # at most

    @classmethod
    def on(cls, device: torch.device, layout: Layout) -> Self:
        """Raises KernelError where they cannot be had."""
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
    """States as bytes, uint8 [B, S, V, V], rows without gaps, and what reads them."""

    intensities: Tensor
    layer: FirstLayer


def first_layer_source() -> str:
    """CUDA C++ with the functions `forward` and `backward`."""
    return source_of("mrcdrl.common.model.kernels", "tensor_core_conv.cu")


def images_on_gpu(observation: Tensor) -> Images | None:
    """States uint8 [B, S, V, V] on a GPU as the kernels take them; None where there are none."""
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
        _LOG.warning("the first layer is computed by torch's operations: %s", error)
        return None


def first_layer(images: Images, weight: Tensor, bias: Tensor) -> Tensor:
    """max(0, max-pool(convolution)), bfloat16 [B, C, P, P], channels last in memory.

    weight: float32 [C, S, 5, 5], of intensities as they are; bias: float32 [C].
    """
    outputs: Tensor = _FirstLayer.apply(images, weight, bias)  # type: ignore[no-untyped-call]
    return outputs


class _FirstLayer(torch.autograd.Function):
    """With the gradients of weight and bias; images have none."""

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
