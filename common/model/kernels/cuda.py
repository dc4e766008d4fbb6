"""CUDA kernels of this project, compiled for the GPU at hand by NVIDIA's run-time compiler.

PyTorch's CUDA builds bring that compiler and its binding (`cuda-bindings`); neither a toolkit nor a
C compiler is needed. KernelError says so where they are missing.
"""

import ctypes
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from typing import Any

import torch
from torch import Tensor

Launch = Callable[[int, Sequence[Tensor | int]], None]
"""Runs a kernel with so many blocks and these arguments: tensors as pointers, numbers as int."""


class KernelError(Exception):
    """A kernel that does not exist on this device; the text says why."""


class Kernel:
    """One function of a compiled source, on one device."""

    def __init__(
        self, function: Any, module: Any, device: torch.device, threads: int, shared_bytes: int
    ) -> None:
        self._function = function
        self._module = module  # lives as long as its function
        self._device = device
        self._threads = threads
        self._shared_bytes = shared_bytes

    def __call__(self, blocks: int, arguments: Sequence[Tensor | int]) -> None:
        """Launch it on the device's current stream."""
        from cuda.bindings import driver

        values = tuple(x if isinstance(x, int) else x.data_ptr() for x in arguments)
        kinds = tuple(ctypes.c_int if isinstance(x, int) else ctypes.c_void_p for x in arguments)
        shape = blocks, 1, 1, self._threads, 1, 1
        with torch.cuda.device(self._device):
            stream = torch.cuda.current_stream().cuda_stream
            _check(
                driver.cuLaunchKernel(
                    self._function, *shape, self._shared_bytes, stream, (values, kinds), 0
                )
            )


def source_of(package: str, name: str) -> str:
    """The text of a source file beside a package's modules."""
    return files(package).joinpath(name).read_text("utf-8")


def compile_kernel(
    source: str,
    name: str,
    device: torch.device,
    definitions: Mapping[str, object],
    *,
    threads: int,
    shared_bytes: int = 0,
) -> Kernel:
    """The function `name` (extern "C") of a CUDA C++ source, for one device.

    definitions: macros. threads: of a block. shared_bytes: of memory that it shares, besides what
    the source declares with a size.

    Raises KernelError where the device is not a CUDA device or is too small, or the compiler is
    missing or refuses the source.
    """
    if device.type != "cuda":
        raise KernelError(f"{device} is not a CUDA device")
    try:
        from cuda.bindings import driver
    except ImportError as error:
        raise KernelError(f"cuda-bindings is missing: {error}") from error
    with torch.cuda.device(device):
        torch.cuda.current_stream().synchronize()  # the context of the device exists from here on
        binary = machine_code(source, name, torch.cuda.get_device_capability(), definitions)
        (module,) = _check(driver.cuModuleLoadData(binary))
        (function,) = _check(driver.cuModuleGetFunction(module, name.encode()))
        most = driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
        _check(driver.cuFuncSetAttribute(function, most, shared_bytes))
    return Kernel(function, module, device, threads, shared_bytes)


def machine_code(
    source: str, name: str, capability: tuple[int, int], definitions: Mapping[str, object]
) -> bytes:
    """The source compiled for devices of this compute capability; none needs to be present.

    Raises KernelError as `compile_kernel` does.
    """
    try:
        from cuda.bindings import nvrtc
    except ImportError as error:
        raise KernelError(f"cuda-bindings is missing: {error}") from error
    defined = [f"--define-macro={key}={value}" for key, value in definitions.items()]
    options = ["--gpu-architecture=sm_{}{}".format(*capability), "--std=c++17", *defined]
    try:
        (program,) = _check(
            nvrtc.nvrtcCreateProgram(source.encode(), f"{name}.cu".encode(), 0, [], [])
        )
    except RuntimeError as error:  # the library is not there
        raise KernelError(f"the run-time compiler is missing: {error}") from error
    (result,) = nvrtc.nvrtcCompileProgram(program, len(options), [o.encode() for o in options])
    if result != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        log = _read(nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog, program)
        raise KernelError(f"{name} does not compile: {log.decode(errors='replace').strip()}")
    return _read(nvrtc.nvrtcGetCUBINSize, nvrtc.nvrtcGetCUBIN, program)


def _read(size_of: Any, fill: Any, program: Any) -> bytes:
    (size,) = _check(size_of(program))
    buffer = b" " * int(size)
    _check(fill(program, buffer))  # writes into it
    return buffer


def _check(result: tuple[Any, ...]) -> tuple[Any, ...]:
    """The results of a call of the bindings; raises KernelError for its error."""
    error, *values = result
    if int(error) != 0:
        raise KernelError(f"CUDA refused: {error.name}")
    return tuple(values)
