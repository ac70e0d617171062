"""A device that is not the CPU, on any machine: tensors that hold real values but keep a graphics card's rules.

A tensor moved to `FAKE_DEVICE` computes what it would compute on the CPU, and refuses what a tensor on a graphics card
refuses: to meet a tensor on the CPU (single numbers apart), and to be handed to numpy or numba. So code that would
break or fall back on a graphics card breaks here as well. Speed cannot be told so; the number of operations can.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

FAKE_DEVICE = torch.device("lazy")
"""A device type that no build of torch without its own plugin computes on, and whose gradients need no extra thread."""
ATEN = torch.ops.aten
MIXED_DEVICE_OPERATIONS = (ATEN._to_copy.default, ATEN.copy_.default)


class FakeDeviceTensor(Tensor):
    """A tensor on the device `FAKE_DEVICE`; `cpu_tensor` has its values."""

    cpu_tensor: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, cpu_tensor: Tensor) -> "FakeDeviceTensor":
        """Same shape, strides and type as what it holds."""
        layout = (cpu_tensor.shape, cpu_tensor.stride(), cpu_tensor.storage_offset())
        return Tensor._make_wrapper_subclass(cls, *layout, dtype=cpu_tensor.dtype, device=FAKE_DEVICE)

    def __init__(self, cpu_tensor: Tensor) -> None:
        self.cpu_tensor = cpu_tensor

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Compute with what the tensors hold."""
        return _compute(operation, args, kwargs or {})

    def tolist(self) -> list:
        """As on a graphics card, by way of the CPU."""
        return self.cpu().tolist()


def _is_elsewhere(device: Any) -> bool:
    return device is not None and torch.device(device).type == FAKE_DEVICE.type


def _strip(value: Any) -> Any:
    if isinstance(value, FakeDeviceTensor):
        return value.cpu_tensor
    return torch.device("cpu") if isinstance(value, torch.device) else value


def _compute(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    ours = [isinstance(tensor, FakeDeviceTensor) for tensor in tensors]
    if any(ours) and operation not in MIXED_DEVICE_OPERATIONS:
        for tensor, is_ours in zip(tensors, ours, strict=True):
            if not is_ours and tensor.dim():
                raise RuntimeError(f"{operation}: {tuple(tensor.shape)} lies on the CPU, other tensors elsewhere")
    result = operation(*tree_map(_strip, args), **tree_map(_strip, kwargs))
    stays = _is_elsewhere(kwargs["device"]) if kwargs.get("device") is not None else any(ours)
    if operation is ATEN.copy_.default:
        return args[0]
    if not stays:
        return result
    wrapped = tree_map(lambda x: FakeDeviceTensor(x) if isinstance(x, Tensor) else x, result)
    return return_and_correct_aliasing(operation, args, kwargs, wrapped)


class _OperationCounter(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        here = not any(isinstance(leaf, FakeDeviceTensor) for leaf in tree_leaves((args, kwargs)))
        if here and not _is_elsewhere(kwargs.get("device")):
            return operation(*args, **kwargs)
        self.count += not operation.is_view
        return _compute(operation, args, kwargs)


@contextmanager
def elsewhere() -> Iterator[_OperationCounter]:
    """While it lasts, `FAKE_DEVICE` can be computed on; `count` of what it yields counts operations there but views."""
    # Without this, torch.tensor(..., device=ELSEWHERE) asks torch itself for memory there.
    before = torch._C._only_lift_cpu_tensors()
    torch._C._set_only_lift_cpu_tensors(True)
    try:
        with _OperationCounter() as calls:
            yield calls
    finally:
        torch._C._set_only_lift_cpu_tensors(before)
