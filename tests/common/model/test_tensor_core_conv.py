"""The first layer's kernels give torch's values and gradients.

No GPU needs to be here: the machine's C++ compiler takes the kernels' source with a small header
that runs a block's threads as threads of the system.
"""

import ctypes
import logging
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from mrcdrl.common.model.fast_forward import fast_forward, operands
from mrcdrl.common.model.kernels import tensor_core_conv as first_layer_cuda
from mrcdrl.common.model.kernels.cuda import KernelError, Launch, machine_code
from mrcdrl.common.model.kernels.sparse_conv_loops import CHANNELS, KERNEL
from mrcdrl.common.model.kernels.tensor_core_conv import (
    FirstLayer,
    Images,
    Layout,
    first_layer,
    first_layer_source,
    images_for,
    images_on_gpu,
)
from mrcdrl.common.model.q_network import QNetwork

HERE = Path(__file__).parent
LAYOUTS = [Layout(4, 60), Layout(1, 31), Layout(3, 34)]


@pytest.fixture(scope="module")
def on_a_cpu(
    cpp_compiler: str, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[Layout], FirstLayer]:
    """The kernels of a layout, compiled for the CPU; in two blocks at most."""
    folder = tmp_path_factory.mktemp("kernels")
    (folder / "tensor_core_conv.cu").write_text(first_layer_source(), "utf-8")

    @cache
    def compiled(layout: Layout) -> FirstLayer:
        library = folder / f"{layout.stack}-{layout.view_px}.so"
        options = ["-std=c++20", "-O2", "-Wall", "-Wextra", "-Werror", "-Wno-unknown-pragmas"]
        options += ["-shared", "-fPIC", "-pthread", f'-DFIRST_LAYER="{folder}/tensor_core_conv.cu"']
        macros = [f"-D{name}={value}" for name, value in layout.definitions.items()]
        source = str(HERE / "tensor_core_conv_on_a_cpu.cpp")
        command = [cpp_compiler, *options, *macros, source, "-o", str(library)]
        built = subprocess.run(command, capture_output=True, text=True, check=False)
        assert built.returncode == 0, built.stderr
        functions = ctypes.CDLL(str(library))

        def launch(function: Callable[..., None]) -> Launch:
            return lambda blocks, arguments: function(
                blocks,
                *(x if isinstance(x, int) else ctypes.c_void_p(x.data_ptr()) for x in arguments),
            )

        forward, backward = functions.forward_on_a_cpu, functions.backward_on_a_cpu
        return FirstLayer(layout, launch(forward), launch(backward), blocks=2)

    return compiled


def states_of(layout: Layout, num: int) -> Tensor:
    """Of windows two images longer, as the learner has them; mostly black ones and others."""
    rng = np.random.default_rng(0)
    shape = (num, layout.stack + 2, layout.view_px, layout.view_px)
    intensities = rng.integers(1, 256, shape, dtype=np.uint8)
    nonzero = np.where(np.arange(num) % 2, 1.0, 0.06)[:, None, None, None]
    windows = torch.from_numpy(
        np.where(rng.random(shape) < nonzero, intensities, 0).astype(np.uint8)
    )
    return windows[:, : layout.stack]


def parameters(stack: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(CHANNELS, stack, KERNEL, KERNEL, generator=generator) / 2550
    bias = torch.randn(CHANNELS, generator=generator) / 10
    return weight.requires_grad_(), bias.requires_grad_()


def reference(states: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """By torch's operations, of weights rounded as the kernels do, and nothing else rounded."""
    rounded = weight + (weight.bfloat16().float() - weight).detach()
    outputs = functional.conv2d(states.double(), rounded.double(), bias.double(), stride=2)
    return functional.relu(functional.max_pool2d(outputs, 2))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_values_and_gradients_are_those_of_torch(
    on_a_cpu: Callable[[Layout], FirstLayer], layout: Layout
) -> None:
    states, (weight, bias) = states_of(layout, 3), parameters(layout.stack)
    values = first_layer(images_for(on_a_cpu(layout), states), weight, bias)
    expected = reference(states, weight, bias)
    assert values.dtype == torch.bfloat16
    assert values.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(values.double(), expected, rtol=2**-8, atol=1e-6)

    generator = torch.Generator().manual_seed(1)
    passed = torch.randn(values.shape, generator=generator).bfloat16()
    found = torch.autograd.grad(values, (weight, bias), passed)
    wanted = torch.autograd.grad(expected, (weight, bias), passed.double())
    for gradient, exact in zip(found, wanted, strict=True):
        assert gradient.dtype == torch.float32
        torch.testing.assert_close(gradient, exact.float(), rtol=1e-4, atol=1e-2)


def test_a_network_computes_with_them(on_a_cpu: Callable[[Layout], FirstLayer]) -> None:
    layout = LAYOUTS[0]
    states = states_of(layout, 2)
    network = QNetwork("duel", compute_dtype=torch.bfloat16)
    images = images_for(on_a_cpu(layout), states)
    values = fast_forward(network, images, operands(network))
    torch.testing.assert_close(values, network(states), rtol=0.02, atol=0.02)


def test_what_is_not_a_number_stays_so(on_a_cpu: Callable[[Layout], FirstLayer]) -> None:
    layout = LAYOUTS[1]
    weight, bias = (x.detach().clone() for x in parameters(layout.stack))
    weight[3] = torch.nan
    bias[5] = torch.nan
    images = images_for(on_a_cpu(layout), states_of(layout, 1))
    odd = first_layer(images, weight, bias).isnan()
    assert odd[:, [3, 5]].all()
    assert odd.sum() == 2 * layout.pooled_px**2


def test_no_states_have_no_values(on_a_cpu: Callable[[Layout], FirstLayer]) -> None:
    layout = LAYOUTS[1]
    images = Images(states_of(layout, 0), on_a_cpu(layout))
    values = first_layer(images, *parameters(layout.stack))
    assert values.shape == (0, CHANNELS, layout.pooled_px, layout.pooled_px)


def test_where_the_kernels_cannot_be_had_torch_computes(caplog: pytest.LogCaptureFixture) -> None:
    first_layer_cuda._layer_on.cache_clear()
    with caplog.at_level(logging.WARNING, "network"):
        assert images_on_gpu(states_of(LAYOUTS[0], 1)) is None
        assert images_on_gpu(states_of(LAYOUTS[0], 2)) is None
    said = [record.message for record in caplog.records]
    assert said == ["the first layer uses PyTorch's operations: cpu is not a CUDA device"]


@pytest.mark.parametrize("layout", [*LAYOUTS, Layout(8, 84)])
@pytest.mark.parametrize("name", ["forward", "backward"])
def test_the_kernels_compile_for_gpus(layout: Layout, name: str) -> None:
    """Where PyTorch's build for CUDA is, the compiler is as well, GPU or not."""
    pytest.importorskip("cuda.bindings.nvrtc", reason="only with PyTorch's builds for CUDA")
    assert machine_code(first_layer_source(), name, (9, 0), layout.definitions)
    with pytest.raises(KernelError, match="does not compile"):
        machine_code("extern !", name, (9, 0), {})
