"""The network's first layer on mostly black pictures: convolution, max-pool and ReLU in one.

A black pixel adds nothing to a convolution, and of an arena's pictures 92 to 96 % are black: what
is left is a twelfth of the products, or less. Pictures with more light in them go through torch's
own operations (`common/network.py`), which are then faster.

Invariants: the values are those of torch's operations within float32's rounding; the same pictures
and parameters give the same bits.

Shapes: B = states, S = pictures of a state, V = their width, C = channels, P = width when pooled.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from common.lit_kernels import CHANNELS, KERNEL, TAPS, differentiate, layer, list_lit
from common.trajectory import Float32Array, UInt8Array

MOST_LIT: Final = 0.25  # of all pixels; with more, torch's operations are faster


def pooled_px(view_px: int) -> int:
    """Width of what the layer gives for pictures of this width, once it is pooled."""
    return ((view_px - KERNEL) // 2 + 1) // 2


@dataclass(frozen=True, slots=True)
class LitPixels:
    """The pixels of states that are not black, row after row."""

    shape: tuple[int, int, int]  # B, S, V
    ends: NDArray[np.int32]  # [B S V + 1]: those of row i are ends[i] to ends[i + 1]
    columns: UInt8Array
    greys: Float32Array


def lit_pixels(observation: Tensor) -> LitPixels | None:
    """Those of states uint8 [B, S, V, V] on the CPU; None where they are more than MOST_LIT."""
    pictures: UInt8Array = observation.numpy()
    num, stack, size, _ = pictures.shape
    if pictures.strides[3] != 1:
        pictures = np.ascontiguousarray(pictures)
    most = int(MOST_LIT * pictures.size)
    columns, greys = np.empty(most, np.uint8), np.empty(most, np.float32)
    ends = np.zeros(num * stack * size + 1, np.int32)
    words = pictures.view(np.uint32) if size % 4 == 0 else pictures
    if not list_lit(pictures, words, ends, columns, greys):
        return None
    return LitPixels((num, stack, size), ends, columns, greys)


def first_layer(lit: LitPixels, weight: Tensor, bias: Tensor) -> Tensor:
    """max(0, max-pool(convolution)), float32 [B, C, P, P], channels last in memory.

    weight: float32 [C, S, 5, 5], of greys as they are; bias: float32 [C].
    """
    if torch.is_grad_enabled() and weight.requires_grad:
        outputs: Tensor = _FirstLayer.apply(lit, weight, bias)  # type: ignore[no-untyped-call]
        return outputs
    return _forward(lit, weight, bias)[0]


class _FirstLayer(torch.autograd.Function):
    """With the gradients of weight and bias; pictures have none."""

    @staticmethod
    def forward(ctx: Any, lit: LitPixels, weight: Tensor, bias: Tensor) -> Tensor:
        pooled, largest = _forward(lit, weight, bias)
        ctx.lit = lit
        ctx.save_for_backward(pooled, largest)
        return pooled

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor, Tensor]:
        lit: LitPixels = ctx.lit
        _, stack, size = lit.shape
        taps = np.zeros((stack, KERNEL, KERNEL, CHANNELS), np.float32)
        bias = np.zeros(CHANNELS, np.float32)
        passed, pooled, largest = map(_channels_last, (gradient, *ctx.saved_tensors))
        pixels = (lit.ends, lit.columns, lit.greys, size)
        differentiate(*pixels, passed, pooled, largest, taps, bias)
        weight = torch.from_numpy(taps)[:, :, _COLUMNS].permute(3, 0, 1, 2)
        return None, weight, torch.from_numpy(bias)


_COLUMNS = np.argsort(TAPS).tolist()


def _forward(lit: LitPixels, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """The outputs, and which of the four each is the largest of, uint8; both [B, C, P, P]."""
    num, stack, size = lit.shape
    side = pooled_px(size)
    pooled = torch.empty(num, side, side, CHANNELS)
    largest = torch.empty(num, side, side, CHANNELS, dtype=torch.uint8)
    taps = weight.detach().permute(1, 2, 3, 0)[:, :, list(TAPS)].contiguous()
    inputs = (lit.ends, lit.columns, lit.greys, stack, size, taps.numpy(), bias.detach().numpy())
    layer(*inputs, pooled.numpy(), largest.numpy())
    return pooled.permute(0, 3, 1, 2), largest.permute(0, 3, 1, 2)


def _channels_last(x: Tensor) -> NDArray[Any]:
    """A tensor [B, C, P, P] as an array [B, P, P, C] without gaps."""
    array: NDArray[Any] = x.detach().permute(0, 2, 3, 1).contiguous().numpy()
    return array
