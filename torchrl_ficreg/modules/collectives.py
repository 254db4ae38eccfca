"""Sums over processes that gradients flow through; a process on its own is not in their way.

The convention is that of distributed data parallel training, which averages gradients over processes: what flows back is
the sum over processes of their gradients, so that the average over processes of parameter gradients is the gradient of
the processes' mean loss.
"""

from __future__ import annotations

import torch
import torch.distributed as dist


def num_processes() -> int:
    """Number of processes that have met; 1 for a process on its own.

    Examples:
        >>> num_processes()
        1
    """
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def sum_over_processes(value: torch.Tensor) -> torch.Tensor:
    """Sum of the values of all processes, on each of them; differentiable. All must ask at the same moment.

    Args:
        value: [...], of the same shape on every process; not of type bool.

    Returns:
        [...].

    Examples:
        >>> sum_over_processes(torch.tensor([1.0, 2.0]))
        tensor([1., 2.])
    """
    return value if num_processes() == 1 else _all_reduce(value)


# An operator of its own, which torch.compile takes as it is.
@torch.library.custom_op("torchrl_ficreg::all_reduce", mutates_args=())
def _all_reduce(value: torch.Tensor) -> torch.Tensor:
    total = value.clone(memory_format=torch.contiguous_format)
    dist.all_reduce(total)
    return total


@_all_reduce.register_fake
def _(value):
    return torch.empty_like(value, memory_format=torch.contiguous_format)


_all_reduce.register_autograd(lambda ctx, grad: _all_reduce(grad))
