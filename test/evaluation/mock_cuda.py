"""A mock of a CUDA device for machines without one: it finds mixed devices, and nothing else that a GPU would show.

Inside :class:`MockCuda`, tensors that were moved to ``cuda`` are on the CPU and carry a tag. Operations pass it on, and raise
:class:`MixedDevices` where CUDA would raise: tensors of both devices in one operation, an index on the device into a tensor
on the CPU, a NumPy view of the device's memory.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves
from torch.utils.weak import WeakIdKeyDictionary

CUDA = torch.device("cuda", 0)
_LOOKS = "__get__ __set__ dim size stride numel __len__ is_floating_point is_complex type tolist item __repr__ data_ptr "
_LOOKS += "requires_grad_ untyped_storage element_size __bool__ __float__ __int__ __index__ is_contiguous __format__ "
_LOOKS += "__hash__ is_inference is_pinned get_device _is_view __deepcopy__ copy_"
_here = WeakIdKeyDictionary()  # tensors on the mocked device


class MixedDevices(RuntimeError):
    """Raised where CUDA would raise."""


def to_cuda(module: nn.Module) -> nn.Module:
    """Moves a module's parameters and buffers."""
    for tensor in (*module.parameters(), *module.buffers()):
        _here[tensor] = True
    return module


class MockCuda(TorchFunctionMode):
    """Context in which ``cuda`` is the mocked device."""

    def __torch_function__(self, func, types, args=(), kwargs=None) -> Any:
        """Called for every function of torch."""
        kwargs, name = dict(kwargs or {}), getattr(func, "__name__", str(func))
        if func == torch.Tensor.device.__get__:
            return CUDA if args[0] in _here else func(*args)
        if func == torch.Tensor.is_cuda.__get__:
            return args[0] in _here
        if func == torch.Tensor.numpy and args[0] in _here:
            raise MixedDevices("a NumPy view of a tensor on the device")
        if func == torch.Tensor.cpu:
            return _mark(func(*args).clone(), False)
        if func == torch.Tensor.to:
            return _to(func, args, kwargs)
        asked = kwargs.get("device")
        if asked is not None and torch.device(asked).type == "cuda":
            kwargs["device"] = torch.device("cpu")
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
            return _index(func, args, kwargs)
        if name not in _LOOKS.split() and len({tensor in _here for tensor in tensors if tensor.dim()}) == 2:
            places = ", ".join(f"{list(tensor.shape)} on {'cuda' if tensor in _here else 'cpu'}" for tensor in tensors)
            raise MixedDevices(f"{name}: {places}")
        result = func(*args, **kwargs)
        if name == "copy_":
            return result
        on = any(tensor in _here for tensor in tensors) if asked is None else torch.device(asked).type == "cuda"
        return _mark(result, on)


def _mark(result: Any, on: bool) -> Any:
    for tensor in tree_leaves(result):
        if isinstance(tensor, torch.Tensor) and on:
            _here[tensor] = True
        elif isinstance(tensor, torch.Tensor):
            _here.pop(tensor, None)
    return result


def _to(func, args: tuple, kwargs: dict[str, Any]) -> torch.Tensor:
    """``Tensor.to`` with a device, a dtype or another tensor, in whatever order."""
    tensor, on, dtype = args[0], args[0] in _here, None
    for wish in (*args[1:], kwargs.get("device"), kwargs.get("dtype")):
        if isinstance(wish, torch.Tensor):
            on, dtype = wish in _here, wish.dtype
        elif isinstance(wish, (str, torch.device)):
            on = torch.device(wish).type == "cuda"
        elif isinstance(wish, torch.dtype):
            dtype = wish
    result = tensor if dtype is None else func(tensor, dtype)
    return result if on == (result in _here) else _mark(result.clone(), on)


def _index(func, args: tuple, kwargs: dict[str, Any]) -> Any:
    base, index = args[:2]
    indices = [leaf for leaf in tree_leaves(index) if isinstance(leaf, torch.Tensor)]
    if base not in _here and any(leaf in _here and leaf.dim() for leaf in indices):
        raise MixedDevices("a tensor on the CPU indexed by one on the device")
    value = args[2] if len(args) > 2 else None
    if indices and isinstance(value, torch.Tensor) and value.dim() and (value in _here) != (base in _here):
        raise MixedDevices("rows of a tensor set to values on another device")
    result = func(*args, **kwargs)
    return _mark(result, base in _here) if isinstance(result, torch.Tensor) else result
