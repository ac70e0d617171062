"""A device other than the CPU, on any machine: tensors that hold real values and follow the rules of GPU tensors.

A tensor on `FAKE_DEVICE` computes what it would compute on the CPU, but refuses what a GPU tensor refuses: operations
with CPU tensors (except single numbers), and conversion to numpy or numba. Code that would fail or fall back to the CPU
on a GPU therefore does so here as well. Speed cannot be measured; the number of operations can.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

FAKE_DEVICE = torch.device("lazy")
"""Device type for which torch has no implementation without a plugin, and whose gradients need no extra thread."""
ATEN = torch.ops.aten
MIXED_DEVICE_OPERATIONS = (ATEN._to_copy.default, ATEN.copy_.default)


class FakeDeviceTensor(Tensor):
    """A tensor on the device `FAKE_DEVICE`; `cpu_tensor` has its values."""

    cpu_tensor: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, cpu_tensor: Tensor) -> "FakeDeviceTensor":
        """Make a tensor with shape, strides and type of `cpu_tensor`."""
        layout = (cpu_tensor.shape, cpu_tensor.stride(), cpu_tensor.storage_offset())
        return Tensor._make_wrapper_subclass(cls, *layout, dtype=cpu_tensor.dtype, device=FAKE_DEVICE)

    def __init__(self, cpu_tensor: Tensor) -> None:
        self.cpu_tensor = cpu_tensor

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Compute with the values of the tensors."""
        return _compute(operation, args, kwargs or {})

    def tolist(self) -> list:
        """Convert to a list through the CPU, as a GPU tensor does."""
        return self.cpu().tolist()


def _is_fake(device: Any) -> bool:
    return device is not None and torch.device(device).type == FAKE_DEVICE.type


def _strip(value: Any) -> Any:
    if isinstance(value, FakeDeviceTensor):
        return value.cpu_tensor
    return torch.device("cpu") if isinstance(value, torch.device) else value


def _compute(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    are_fake = [isinstance(tensor, FakeDeviceTensor) for tensor in tensors]
    if any(are_fake) and operation not in MIXED_DEVICE_OPERATIONS:
        for tensor, is_fake in zip(tensors, are_fake, strict=True):
            if not is_fake and tensor.dim():
                raise RuntimeError(f"{operation}: {tuple(tensor.shape)} is on the CPU, other tensors are not")
    result = operation(*tree_map(_strip, args), **tree_map(_strip, kwargs))
    stays_fake = _is_fake(kwargs["device"]) if kwargs.get("device") is not None else any(are_fake)
    if operation is ATEN.copy_.default:
        return args[0]
    if not stays_fake:
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
        if here and not _is_fake(kwargs.get("device")):
            return operation(*args, **kwargs)
        self.count += not operation.is_view
        return _compute(operation, args, kwargs)


@contextmanager
def fake_device() -> Iterator[_OperationCounter]:
    """Make `FAKE_DEVICE` usable in the block; `count` of the yielded object counts its operations except views."""
    # Without this, torch.tensor(..., device=FAKE_DEVICE) allocates memory on that device itself.
    before = torch._C._only_lift_cpu_tensors()
    torch._C._set_only_lift_cpu_tensors(True)
    try:
        with _OperationCounter() as calls:
            yield calls
    finally:
        torch._C._set_only_lift_cpu_tensors(before)
