"""Random states as a component of a checkpoint, which another machine can take over."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torchrl import torchrl_logger
from torchrl.checkpoint import GlobalRNGState

_CUDA, _ALL_CUDA = "cuda", "torch_cuda"  # ours: one device; TorchRL's: a list of all, found in older checkpoints


class RandomState(GlobalRNGState):
    """Random states of Python, NumPy, PyTorch's CPU and one device; TorchRL's component keeps those of all devices.

    A run may so be continued with fewer devices, or without any: states of absent ones are left out with one warning.

    Args:
        device: the one that is trained on. Default: the current one, where CUDA is in use.

    Examples:
        >>> state = RandomState()
        >>> before = state.state_dict()
        >>> first = torch.rand(1)
        >>> state.load_state_dict(before)
        >>> torch.equal(torch.rand(1), first)
        True
    """

    def __init__(self, device: torch.device | str | None = None) -> None:
        self._device = None if device is None else torch.device(device)

    def state_dict(self) -> dict[str, Any]:
        """The states as they are now."""
        state = super().state_dict()
        if _ALL_CUDA in state:
            every = state.pop(_ALL_CUDA)
            if self._device is None or self._device.type == "cuda":
                state[_CUDA] = every[self._index()]
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Takes over the states of what is there. One that a checkpoint does not have stays as it is."""
        states = dict(state_dict)
        every, one = states.pop(_ALL_CUDA, ()), states.pop(_CUDA, None)
        devices = torch.cuda.device_count() if torch.cuda.is_available() else 0
        absent = [f"cuda:{number}" for number in range(devices, len(every))]
        if one is not None and not devices:
            absent.append("cuda")
        for name in ("xpu", "mps"):
            if f"torch_{name}" in states and not getattr(torch, name).is_available():
                del states[f"torch_{name}"]
                absent.append(name)
        super().load_state_dict(states)
        for number, state in enumerate(every[:devices]):
            torch.cuda.set_rng_state(state.cpu(), number)
        if one is not None and devices:
            torch.cuda.set_rng_state(one.cpu(), self._index())
        if absent:
            torchrl_logger.warning(
                f"random states of {', '.join(absent)} are left out, no such device is here: the run goes on, with "
                "other random numbers than where it began."
            )

    def _index(self) -> int:
        index = None if self._device is None else self._device.index
        return torch.cuda.current_device() if index is None else index
