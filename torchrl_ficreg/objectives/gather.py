"""The batch of all processes together, for statistics that are no mean over clips."""

from __future__ import annotations

import torch
import torch.distributed as dist

from torchrl_ficreg.modules.collectives import num_processes, sum_over_processes


def gather_clips(value: torch.Tensor, dim: int = 0) -> torch.Tensor:
    """Joins the shares of all processes along the batch dimension, in their order; differentiable.

    Meant for a loss that every process then computes on the global batch. The gradient follows the convention of
    distributed data parallel training: averaged over processes, parameter gradients are those of one process on the
    whole batch. All processes must ask at the same moment. A process on its own gets what it gave.

    Args:
        value: [..., B, ...], of the same shape on every process; bool has no gradient, but may be gathered.
        dim: of the batch.

    Returns:
        [..., B * number of processes, ...].

    Examples:
        >>> gather_clips(torch.zeros(3, 8, 5), dim=1).shape
        torch.Size([3, 8, 5])
    """
    processes = num_processes()
    if processes == 1:
        return value
    rows = (value.byte() if value.dtype == torch.bool else value).movedim(dim, 0)  # [B, ...]
    before, after = dist.get_rank() * len(rows), (processes - 1 - dist.get_rank()) * len(rows)
    # Each process writes its rows into zeros: x + 0 is x to the last bit, and the sum knows its gradient already.
    padded = torch.cat([rows.new_zeros(before, *rows.shape[1:]), rows, rows.new_zeros(after, *rows.shape[1:])])
    return sum_over_processes(padded).to(value.dtype).movedim(0, dim)
