"""Launches of numba kernels on a CUDA GPU, with torch tensors as arguments.

Imported only where a tensor is on a GPU. With NUMBA_ENABLE_CUDASIM=1 kernels run in numba's simulator, on tensors of
the CPU, which is how they are tested on machines without a GPU.

numba's own launch makes an array object of each tensor and looks up the types of all arguments, which takes longer than
most kernels here run. The launch here passes addresses and shapes of tensors straight on, in the order in which kernels
of numba take them: a training step takes 7 instead of 13 ms (docs/decisions/field.md).
"""

import ctypes
import math
from functools import cache, lru_cache
from typing import Any

import numba
import numpy as np
import torch
from numba import cuda
from torch import Tensor

from pipeline.kernels.common.numba_options import CUDA_CACHE_FOLDER

CUDA_OPTIONS: dict[str, Any] = {"cache": True}
"""Arguments of `numba.cuda.jit` for kernels."""
THREADS_PER_BLOCK = 128
IS_SIMULATED = bool(numba.config.ENABLE_CUDASIM)

if not IS_SIMULATED:
    from cuda import core
    from numba.cuda.core import config

    config.CACHE_DIR = str(CUDA_CACHE_FOLDER)

_compiled: dict[tuple, Any] = {}


def device_function(function: Any) -> Any:
    """Return a function that `njit` compiles for the CPU as one that CUDA kernels may call."""
    return cuda.jit(device=True)(function.py_func)


def launch(kernel: Any, threads: int, *arguments: Any) -> None:
    """Run at least `threads` threads of a kernel in torch's default stream; its `cuda.grid(1)` is the thread.

    arguments: contiguous tensors on the GPU, integers, float32 scalars, and tuples of these.

    Raises:
        ValueError: a tensor is not contiguous.
    """
    if not threads:
        return
    blocks = (threads + THREADS_PER_BLOCK - 1) // THREADS_PER_BLOCK
    if IS_SIMULATED:
        kernel[blocks, THREADS_PER_BLOCK](*map(_array_argument, arguments))
        return
    key: list[Any] = [kernel]
    values: list[Any] = []
    for argument in arguments:
        _flatten(argument, key, values)
    compiled = _compiled.get(tuple(key))
    if compiled is None:
        types = tuple(kernel.typeof_pyval(_array_argument(argument)) for argument in arguments)
        compiled = _compiled[tuple(key)] = kernel.compile(types)._codelibrary.get_cufunc().kernel
    core.launch(_default_stream(), _launch_config(blocks), compiled, *values)


@cache
def _default_stream() -> Any:
    return core.Stream.from_handle(torch.cuda.default_stream().cuda_stream)


@lru_cache(maxsize=4096)
def _launch_config(blocks: int) -> Any:
    return core.LaunchConfig(grid=blocks, block=THREADS_PER_BLOCK)


def _flatten(argument: Any, key: list[Any], values: list[Any]) -> None:
    """Append the values that numba passes for an argument, and to `key` what its type follows from."""
    if isinstance(argument, Tensor):
        _check_contiguous(argument)
        before, after = _array_layout(argument.shape, argument.element_size())
        key += (argument.dtype, argument.ndim)
        values += before
        values.append(argument.data_ptr())
        values += after
    elif isinstance(argument, tuple):
        key.append(type(argument))
        for element in argument:
            _flatten(element, key, values)
    elif isinstance(argument, np.float32):
        key.append(np.float32)
        values.append(ctypes.c_float(float(argument)))
    else:
        key.append(int)
        values.append(ctypes.c_int64(argument))


@lru_cache(maxsize=4096)
def _array_layout(shape: tuple[int, ...], element_size: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return what numba passes for an array before and after its address.

    Two pointers that kernels do not use, the number of elements and the bytes of one; then shape and strides in bytes.
    """
    strides, stride = [], element_size
    for size in reversed(shape):
        strides.append(stride)
        stride *= size
    return (0, 0, math.prod(shape), element_size), (*shape, *reversed(strides))


def _array_argument(argument: Any) -> Any:
    """Return an argument with numba arrays instead of tensors."""
    if isinstance(argument, Tensor):
        _check_contiguous(argument)
        return argument.detach().numpy() if IS_SIMULATED else cuda.as_cuda_array(argument.detach())
    if isinstance(argument, tuple):
        elements = map(_array_argument, argument)
        return type(argument)(*elements) if hasattr(argument, "_fields") else tuple(elements)
    return argument


def _check_contiguous(tensor: Tensor) -> None:
    if not tensor.is_contiguous():
        raise ValueError(f"a kernel takes contiguous tensors, not strides {tensor.stride()}")
