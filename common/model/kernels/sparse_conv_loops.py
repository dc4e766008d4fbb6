"""Loops of the first layer over nonzero pixels (`sparse_conv.py`).

Everything between pixels and pooled outputs stays in the processor's first-level cache: two lines
of outputs at a time. The channels lie side by side, and every operation works on all of them at
once. Numba does not find these vector operations by itself, so they are written in LLVM's terms.

Where outputs and gradients are to be bfloat16, which numba does not have, their arrays are of its
bits, int16.

Invariants: pure; the first of equal outputs counts as the largest, and NaN counts as larger than
any number, both as in PyTorch.

Shapes: B = states, S = images of a state, V = their width, C = channels, P = width when pooled.
"""

from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic as _intrinsic

from mrcdrl.common.runtime.compiled import compiled

KERNEL: Final = 5  # px, with stride 2 and then a max-pool of 2
CHANNELS: Final = 32
TAPS: Final = (
    4,
    2,
    0,
    3,
    1,
)  # columns of the kernel as a pixel meets them, in an even column or odd
_EVEN, _ODD = 3, 2  # how many of each
_MARGIN = 2  # outputs left and right of the image, which take what nobody reads

intrinsic: Any = _intrinsic  # its annotations take the first argument for one of the call's
_FLOAT, _BYTE, _INDEX = ir.FloatType(), ir.IntType(8), ir.IntType(32)
_HALF, _WORD = ir.IntType(16), ir.IntType(32)  # the bits of bfloat16 and float32
_QUIET_NAN = 0x7FC0
_CONTRACT = ("contract",)  # a product and a sum may be rounded once


class _Lanes:
    """Writes loads and stores of neighbouring numbers; arrays are without gaps, indices flat."""

    def __init__(self, context: Any, builder: Any, signature: Any) -> None:
        self._context, self._builder, self._types = context, builder, signature.args

    def load(
        self, array: Any, number: int, index: Any, kind: Any = _FLOAT, num: int = CHANNELS
    ) -> Any:
        """array: the argument of that number."""
        return self._builder.load(
            self._pointer(array, number, index, ir.VectorType(kind, num)), align=1
        )

    def store(self, value: Any, array: Any, number: int, index: Any) -> None:
        self._builder.store(value, self._pointer(array, number, index, value.type), align=1)

    def load_numbers(self, array: Any, number: int, index: Any) -> Any:
        """Load float32 from an array of float32, or of the bits of bfloat16."""
        if self._types[number].dtype == types.float32:
            return self.load(array, number, index)
        bits = self._builder.zext(
            self.load(array, number, index, _HALF), ir.VectorType(_WORD, CHANNELS)
        )
        return self._builder.bitcast(
            self._builder.shl(bits, _constant(16, _WORD)), ir.VectorType(_FLOAT, CHANNELS)
        )

    def store_numbers(self, value: Any, array: Any, number: int, index: Any) -> None:
        """Store float32 in an array of float32 or, rounded to even, of the bits of bfloat16."""
        if self._types[number].dtype == types.float32:
            self.store(value, array, number, index)
            return
        builder = self._builder
        bits = builder.bitcast(value, ir.VectorType(_WORD, CHANNELS))
        upper = builder.lshr(bits, _constant(16, _WORD))
        odd = builder.and_(upper, _constant(1, _WORD))
        up = builder.add(builder.add(bits, odd), _constant(0x7FFF, _WORD))
        rounded = builder.lshr(up, _constant(16, _WORD))
        unordered = builder.fcmp_unordered("uno", value, value)
        rounded = builder.select(unordered, _constant(_QUIET_NAN, _WORD), rounded)
        self.store(builder.trunc(rounded, ir.VectorType(_HALF, CHANNELS)), array, number, index)

    def _pointer(self, array: Any, number: int, index: Any, vector: Any) -> Any:
        data = self._context.make_array(self._types[number])(
            self._context, self._builder, array
        ).data
        return self._builder.bitcast(self._builder.gep(data, [index]), vector.as_pointer())

    def splat(self, value: Any, num: int) -> Any:
        """The number in every lane."""
        vector = ir.VectorType(value.type, num)
        nothing = ir.Constant(vector, ir.Undefined)
        one = self._builder.insert_element(nothing, value, ir.Constant(_INDEX, 0))
        return self._builder.shuffle_vector(
            one, nothing, ir.Constant(ir.VectorType(_INDEX, num), [0] * num)
        )


def _constant(value: float, kind: Any = _FLOAT) -> Any:
    return ir.Constant(ir.VectorType(kind, CHANNELS), [value] * CHANNELS)


@intrinsic
def _copy(typing: Any, out: Any, at: Any, source: Any, source_at: Any) -> Any:
    """out[at : at + C] = source[source_at : source_at + C]."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = _Lanes(context, builder, signature)
        out, at, source, source_at = arguments
        lanes.store(lanes.load(source, 2, source_at), out, 0, at)
        return context.get_dummy_value()

    return types.void(out, types.intp, source, types.intp), write


def _make_add(num: int) -> Any:
    @intrinsic
    def add(typing: Any, out: Any, at: Any, scale: Any, source: Any, source_at: Any) -> Any:
        """out[at : at + num] += scale * source[source_at : source_at + num]."""

        def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            lanes = _Lanes(context, builder, signature)
            out, at, scale, source, source_at = arguments
            product = builder.fmul(
                lanes.load(source, 3, source_at, num=num), lanes.splat(scale, num), flags=_CONTRACT
            )
            total = builder.fadd(lanes.load(out, 0, at, num=num), product, flags=_CONTRACT)
            lanes.store(total, out, 0, at)
            return context.get_dummy_value()

        return types.void(out, types.intp, types.float32, source, types.intp), write

    return add


_add_even, _add_odd = _make_add(_EVEN * CHANNELS), _make_add(_ODD * CHANNELS)


@intrinsic
def _pool(typing: Any, lines: Any, at: Any, step: Any, pooled: Any, largest: Any, out: Any) -> Any:
    """The largest of two outputs at `at` and the two that are `step` further, and its ReLU."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = _Lanes(context, builder, signature)
        lines, at, step, pooled, largest, out = arguments
        best, which = lanes.load(lines, 0, at), _constant(0, _BYTE)
        for i, offset in enumerate(_offsets(builder, step)[1:], start=1):
            value = lanes.load(lines, 0, builder.add(at, offset))
            larger = builder.fcmp_ordered(">", value, best)
            larger = builder.or_(larger, builder.fcmp_unordered("uno", value, value))
            best = builder.select(larger, value, best)
            which = builder.select(larger, _constant(i, _BYTE), which)
        negative = builder.fcmp_ordered("<", best, _constant(0.0))
        lanes.store_numbers(builder.select(negative, _constant(0.0), best), pooled, 3, out)
        lanes.store(which, largest, 4, out)
        return context.get_dummy_value()

    return types.void(lines, types.intp, types.intp, pooled, largest, types.intp), write


@intrinsic
def _unpool(
    typing: Any, gradient: Any, pooled: Any, largest: Any, out: Any,
    lines: Any, at: Any, step: Any, bias: Any,
) -> Any:  # fmt: skip
    """The gradient of `_pool`: what goes to each of the four outputs; the bias gets it all."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = _Lanes(context, builder, signature)
        gradient, pooled, largest, out, lines, at, step, bias = arguments
        positive = builder.fcmp_ordered(">", lanes.load_numbers(pooled, 1, out), _constant(0.0))
        passed = builder.select(positive, lanes.load_numbers(gradient, 0, out), _constant(0.0))
        which, zero = lanes.load(largest, 2, out, _BYTE), ir.Constant(at.type, 0)
        for i, offset in enumerate(_offsets(builder, step)):
            its = builder.icmp_unsigned("==", which, _constant(i, _BYTE))
            lanes.store(
                builder.select(its, passed, _constant(0.0)), lines, 4, builder.add(at, offset)
            )
        lanes.store(builder.fadd(lanes.load(bias, 7, zero), passed), bias, 7, zero)
        return context.get_dummy_value()

    index = types.intp
    return types.void(gradient, pooled, largest, index, lines, index, index, bias), write


def _offsets(builder: Any, step: Any) -> list[Any]:
    """Offsets of the four outputs that are pooled: two side by side in each of two lines."""
    right = ir.Constant(step.type, CHANNELS)
    return [ir.Constant(step.type, 0), right, step, builder.add(step, right)]


@compiled
def list_nonzero(images, words, ends, columns, intensities):  # type: ignore[no-untyped-def]
    """Whether they all found room; words: the same memory, several pixels a word."""
    num, stack, size, num_words = words.shape
    width = size // num_words
    found = row = 0
    for n in range(num):
        for s in range(stack):
            for y in range(size):
                if found + size > len(intensities):
                    return False
                for i in range(num_words):
                    if words[n, s, y, i]:
                        for x in range(i * width, (i + 1) * width):
                            grey = images[n, s, y, x]
                            if grey:
                                columns[found], intensities[found] = x, grey
                                found += 1
                row += 1
                ends[row] = found
    return True


@compiled
def layer(  # type: ignore[no-untyped-def]
    ends, columns, intensities, stack, size, taps, bias, pooled, largest
):
    """Fill pooled and largest [B, P, P, C] from nonzero pixels; taps [S, 5, 5, C] in their order"""
    num, side = pooled.shape[:2]
    width = (size - KERNEL) // 2 + 1 + 2 * _MARGIN
    lines = np.empty(2 * width * CHANNELS, np.float32)  # of outputs, that are pooled into one
    for n in range(num):
        for p in range(side):
            for i in range(2 * width):
                _copy(lines, i * CHANNELS, bias, 0)
            for r in range(2):
                for s in range(stack):
                    row = (n * stack + s) * size + 2 * (2 * p + r)
                    for k in range(KERNEL):
                        tap = (s * KERNEL + k) * KERNEL * CHANNELS
                        for i in range(ends[row + k], ends[row + k + 1]):
                            at = (r * width + (columns[i] >> 1)) * CHANNELS
                            if columns[i] & 1:
                                _add_odd(
                                    lines,
                                    at + CHANNELS,
                                    intensities[i],
                                    taps,
                                    tap + _EVEN * CHANNELS,
                                )
                            else:
                                _add_even(lines, at, intensities[i], taps, tap)
            for q in range(side):
                at = (2 * q + _MARGIN) * CHANNELS
                _pool(
                    lines,
                    at,
                    width * CHANNELS,
                    pooled,
                    largest,
                    ((n * side + p) * side + q) * CHANNELS,
                )


@compiled
def differentiate(  # type: ignore[no-untyped-def]
    ends, columns, intensities, size, gradient, pooled, largest, taps, bias
):
    """Adds the gradients of taps [S, 5, 5, C] and bias [C] to them; the rest as in `layer`."""
    num, side = pooled.shape[:2]
    stack = len(taps)
    width = (size - KERNEL) // 2 + 1 + 2 * _MARGIN
    lines = np.zeros(2 * width * CHANNELS, np.float32)
    for n in range(num):
        for p in range(side):
            for q in range(side):
                at = (2 * q + _MARGIN) * CHANNELS
                out = ((n * side + p) * side + q) * CHANNELS
                _unpool(gradient, pooled, largest, out, lines, at, width * CHANNELS, bias)
            for r in range(2):
                for s in range(stack):
                    row = (n * stack + s) * size + 2 * (2 * p + r)
                    for k in range(KERNEL):
                        tap = (s * KERNEL + k) * KERNEL * CHANNELS
                        for i in range(ends[row + k], ends[row + k + 1]):
                            at = (r * width + (columns[i] >> 1)) * CHANNELS
                            if columns[i] & 1:
                                _add_odd(
                                    taps,
                                    tap + _EVEN * CHANNELS,
                                    intensities[i],
                                    lines,
                                    at + CHANNELS,
                                )
                            else:
                                _add_even(taps, tap, intensities[i], lines, at)
