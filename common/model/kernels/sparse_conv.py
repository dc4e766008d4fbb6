"""The network's first layer on mostly black images: convolution, max-pool and ReLU in one.

A black pixel adds nothing to a convolution, and 92 to 96 % of an arena's images are black: at most
a twelfth of the products is left. `fast_forward.py` gives brighter images to PyTorch's operations,
which are faster on them.

Invariants: the values are those of PyTorch's operations within the rounding of float32, rounded
once more where bfloat16 is asked for; the same images and parameters give the same bits.

Shapes: B = states, S = images of a state, V = their width, C = channels, P = width when pooled.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrcdrl.common.messages.trajectory import Float32Array, UInt8Array
from mrcdrl.common.model.kernels.sparse_conv_loops import (
    CHANNELS,
    KERNEL,
    TAPS,
    differentiate,
    layer,
    list_nonzero,
)

MAX_NONZERO: Final = 0.25  # of all pixels; with more, torch's operations are faster


def pooled_px(view_px: int) -> int:
    """Width of the layer's pooled outputs for images of this width."""
    return ((view_px - KERNEL) // 2 + 1) // 2


@dataclass(frozen=True, slots=True)
class NonzeroPixels:
    """The pixels of states that are not black, row by row."""

    shape: tuple[int, int, int]  # B, S, V
    ends: NDArray[np.int32]  # [B S V + 1]: row i has the pixels ends[i] to ends[i + 1]
    columns: UInt8Array
    intensities: Float32Array

    def __getitem__(self, states: slice) -> "NonzeroPixels":
        """The pixels of some states, as views."""
        num, stack, size = self.shape
        begin, end, _ = states.indices(num)
        lines = slice(begin * stack * size, end * stack * size + 1)
        shape = (end - begin, stack, size)
        return NonzeroPixels(shape, self.ends[lines], self.columns, self.intensities)


def nonzero_pixels(observation: Tensor) -> NonzeroPixels | None:
    """List the nonzero pixels of states uint8 [B, S, V, V] on the CPU.

    None if more than MAX_NONZERO of all pixels are nonzero.
    """
    images: UInt8Array = observation.numpy()
    num, stack, size, _ = images.shape
    if images.strides[3] != 1:
        images = np.ascontiguousarray(images)
    most = int(MAX_NONZERO * images.size)
    columns, intensities = np.empty(most, np.uint8), np.empty(most, np.float32)
    ends = np.zeros(num * stack * size + 1, np.int32)
    words = images.view(np.uint32) if size % 4 == 0 else images
    if not list_nonzero(images, words, ends, columns, intensities):
        return None
    return NonzeroPixels((num, stack, size), ends, columns, intensities)


def first_layer(
    nonzero: NonzeroPixels, weight: Tensor, bias: Tensor, dtype: torch.dtype = torch.float32
) -> Tensor:
    """max(0, max-pool(convolution)), [B, C, P, P], channels last in memory.

    weight: float32 [C, S, 5, 5], for intensities of 0 to 255; bias: float32 [C]. dtype: float32 or
    bfloat16, of the outputs.
    """
    if torch.is_grad_enabled() and weight.requires_grad:
        outputs: Tensor = _FirstLayer.apply(nonzero, weight, bias, dtype)  # type: ignore[no-untyped-call]
        return outputs
    return _forward(nonzero, weight, bias, dtype)[0]


class _FirstLayer(torch.autograd.Function):
    """The layer with gradients of weight and bias; images have none."""

    @staticmethod
    def forward(
        ctx: Any, nonzero: NonzeroPixels, weight: Tensor, bias: Tensor, dtype: torch.dtype
    ) -> Tensor:
        pooled, largest = _forward(nonzero, weight, bias, dtype)
        ctx.nonzero = nonzero
        ctx.save_for_backward(pooled, largest)
        return pooled

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor, Tensor, None]:
        nonzero: NonzeroPixels = ctx.nonzero
        _, stack, size = nonzero.shape
        taps = np.zeros((stack, KERNEL, KERNEL, CHANNELS), np.float32)
        bias = np.zeros(CHANNELS, np.float32)
        passed, pooled, largest = map(_channels_last, (gradient, *ctx.saved_tensors))
        pixels = (nonzero.ends, nonzero.columns, nonzero.intensities, size)
        differentiate(*pixels, passed, pooled, largest, taps, bias)
        weight = torch.from_numpy(taps)[:, :, _COLUMNS].permute(3, 0, 1, 2)
        return None, weight, torch.from_numpy(bias), None


_COLUMNS = np.argsort(TAPS).tolist()


def _forward(
    nonzero: NonzeroPixels, weight: Tensor, bias: Tensor, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """The outputs, and which of the four pooled values is the largest, uint8; both [B, C, P, P]."""
    num, stack, size = nonzero.shape
    side = pooled_px(size)
    pooled = torch.empty(num, side, side, CHANNELS, dtype=dtype)
    largest = torch.empty(num, side, side, CHANNELS, dtype=torch.uint8)
    taps = weight.detach().permute(1, 2, 3, 0)[:, :, list(TAPS)].contiguous()
    pixels = (nonzero.ends, nonzero.columns, nonzero.intensities, stack, size)
    layer(*pixels, taps.numpy(), bias.detach().numpy(), _array(pooled), largest.numpy())
    return pooled.permute(0, 3, 1, 2), largest.permute(0, 3, 1, 2)


def _channels_last(x: Tensor) -> NDArray[Any]:
    """A tensor [B, C, P, P] as an array [B, P, P, C] without gaps."""
    return _array(x.detach().permute(0, 2, 3, 1).contiguous())


def _array(x: Tensor) -> NDArray[Any]:
    """The tensor's memory as an array; of bfloat16, which numpy lacks, the bits as int16."""
    array: NDArray[Any] = (x.view(torch.int16) if x.dtype == torch.bfloat16 else x).numpy()
    return array
