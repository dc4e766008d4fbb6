"""The layer over nonzero pixels gives torch's values and gradients, however many there are."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from mrcdrl.common.model.kernels.sparse_conv import MAX_NONZERO, first_layer, nonzero_pixels
from mrcdrl.common.model.kernels.sparse_conv_loops import CHANNELS, KERNEL


def images(num: int, stack: int, size: int, nonzero: float, seed: int = 0) -> Tensor:
    """Of random intensities; `nonzero` of the pixels are not black."""
    rng = np.random.default_rng(seed)
    shape = (num, stack, size, size)
    intensities = rng.integers(1, 256, shape, dtype=np.uint8)
    return torch.from_numpy(np.where(rng.random(shape) < nonzero, intensities, 0).astype(np.uint8))


def parameters(stack: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    weight = torch.randn(CHANNELS, stack, KERNEL, KERNEL, generator=generator) / 2550
    return weight.requires_grad_(), (
        torch.randn(CHANNELS, generator=generator) / 10
    ).requires_grad_()


def reference(states: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """In float64, by torch's operations."""
    outputs = functional.conv2d(states.double(), weight.double(), bias.double(), stride=2)
    return functional.relu(functional.max_pool2d(outputs, 2))


def ours(states: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    nonzero = nonzero_pixels(states)
    assert nonzero is not None
    return first_layer(nonzero, weight, bias)


def gradients_of(outputs: Tensor, weight: Tensor, bias: Tensor) -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(1)
    wanted = torch.randn(outputs.shape, generator=generator)
    return torch.autograd.grad(outputs, (weight, bias), wanted.to(outputs.dtype))


@settings(max_examples=40, deadline=None)
@given(
    num=st.integers(1, 3),
    stack=st.integers(1, 5),
    size=st.sampled_from([31, 32, 33, 60, 61, 62, 84, 255]),
    nonzero=st.floats(0.0, 0.2),
    seed=st.integers(0, 2**16),
)
def test_values_and_gradients_are_those_of_torch(
    num: int, stack: int, size: int, nonzero: float, seed: int
) -> None:
    states, (weight, bias) = images(num, stack, size, nonzero, seed), parameters(stack, seed)
    found, expected = ours(states, weight, bias), reference(states, weight, bias)
    torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=1e-4)
    got, due = gradients_of(found, weight, bias), gradients_of(expected, weight, bias)
    for gradient, exact in zip(got, due, strict=True):
        limit = 1e-4 * float(exact.abs().max()) + 1e-6
        torch.testing.assert_close(gradient.double(), exact.double(), atol=limit, rtol=0)


@settings(max_examples=20, deadline=None)
@given(nonzero=st.floats(0.0, 0.2), seed=st.integers(0, 2**16))
def test_bfloat16_outputs_are_the_float32_ones_rounded_once(nonzero: float, seed: int) -> None:
    states, (weight, bias) = images(3, 4, 60, nonzero, seed), parameters(4, seed)
    listed = nonzero_pixels(states)
    assert listed is not None
    exact = first_layer(listed, weight, bias)
    found = first_layer(listed, weight, bias, torch.bfloat16)
    assert torch.equal(found, exact.to(torch.bfloat16))
    wanted = torch.randn(exact.shape, generator=torch.Generator().manual_seed(seed))
    wanted = wanted.to(torch.bfloat16)
    for layout in (torch.contiguous_format, torch.channels_last):
        gradient_in = wanted.contiguous(memory_format=layout)
        got = torch.autograd.grad(found, (weight, bias), gradient_in, retain_graph=True)
        due = torch.autograd.grad(exact, (weight, bias), gradient_in.float(), retain_graph=True)
        for gradient, expected in zip(got, due, strict=True):
            assert torch.equal(gradient, expected)


def test_without_gradients_the_values_are_the_same_to_the_bit() -> None:
    states, (weight, bias) = images(3, 4, 60, 0.1), parameters(4)
    with torch.no_grad():
        plain = ours(states, weight, bias)
    assert not plain.requires_grad
    assert torch.equal(plain, ours(states, weight, bias))


def test_a_view_with_strides_is_read_as_it_lies() -> None:
    """The learner's states are the first images of longer windows."""
    windows, (weight, bias) = images(3, 7, 60, 0.1), parameters(4)
    for view in (windows[:, 2:6], windows[::2, :4], windows[:, :4].transpose(2, 3)):
        torch.testing.assert_close(
            ours(view, weight, bias).double(), reference(view, weight, bias), atol=1e-5, rtol=1e-4
        )


def test_some_states_are_listed_as_they_are_among_all() -> None:
    states, (weight, bias) = images(5, 4, 60, 0.1), parameters(4)
    listed = nonzero_pixels(states)
    assert listed is not None
    for rows in (slice(0, 2), slice(2, 5), slice(4, 9), slice(1, 1)):
        assert torch.equal(
            first_layer(listed[rows], weight, bias), ours(states[rows], weight, bias)
        )


def test_images_that_are_not_mostly_black_are_left_to_torch() -> None:
    assert nonzero_pixels(images(2, 4, 60, MAX_NONZERO + 0.1)) is None
    assert nonzero_pixels(images(2, 4, 60, MAX_NONZERO - 0.1)) is not None


def test_black_images_give_the_bias_and_only_it_learns() -> None:
    states, (weight, bias) = torch.zeros(2, 4, 60, 60, dtype=torch.uint8), parameters(4)
    outputs = ours(states, weight, bias)
    expected = bias.clamp(min=0)[None, :, None, None].expand(2, -1, 14, 14)
    assert torch.equal(outputs, expected)
    of_weight, of_bias = torch.autograd.grad(outputs.sum(), (weight, bias))
    assert torch.equal(of_weight, torch.zeros_like(weight))
    assert torch.equal(of_bias, torch.where(bias > 0, 2.0 * 14 * 14, 0.0))


@pytest.mark.parametrize("where", ["weight", "bias"])
def test_what_is_not_a_number_is_not_swallowed(where: str) -> None:
    """A learner stops at such values, so that it hands none on."""
    states, (weight, bias) = images(1, 4, 60, 0.2), parameters(4)
    listed = nonzero_pixels(states)
    assert listed is not None
    with torch.no_grad():
        (weight if where == "weight" else bias)[3] = torch.nan
        for dtype in (torch.float32, torch.bfloat16):
            outputs = first_layer(listed, weight, bias, dtype)
            assert bool(outputs[:, 3].isnan().any())
            assert not bool(outputs[:, 4].isnan().any())
