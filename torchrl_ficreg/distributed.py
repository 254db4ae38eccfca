"""Training on several processes: rank and world size, the process group, and collectives, two of them with gradients.

One process is the default everywhere: without a process group the rank is 0, the world size 1, and every collective returns
its argument. With one, all ranks must call a collective at the same point, as ``torch.distributed`` asks.

================================  ===============================================  ==========
function                          result on every rank                             gradient
================================  ===============================================  ==========
:func:`all_reduce_sum`            sum of a tensor                                  yes
:func:`all_gather`                tensors concatenated along the batch dimension   yes
:func:`all_reduce_mean`           means of a mapping of tensors, for logging       no
:func:`any_rank`                  whether a flag is set on some rank
:func:`broadcast_from_rank0`      any object of rank 0
:func:`barrier`                   nothing; waits for the other ranks
================================  ===============================================  ==========
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist


# Of collectives: the other ranks wait while rank 0 records data or evaluates. torchrun notices a rank that ended.
TIMEOUT = timedelta(hours=6)


def rank() -> int:
    """Rank of this process; outside of :func:`process_group` the one that ``torchrun`` assigned, or 0.

    Examples:
        >>> rank(), world_size(), is_main()
        (0, 1, True)
    """
    if world_size() > 1:
        return dist.get_rank()
    return int(os.environ["RANK"]) if torchrun_world_size() > 1 else 0


def world_size() -> int:
    """Number of processes in the process group; 1 without one.

    Examples:
        >>> world_size()
        1
    """
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def planned_world_size() -> int:
    """Number of processes that share a batch: those of the process group, or those that ``torchrun`` started for one.

    Examples:
        >>> planned_world_size()
        1
    """
    return max(world_size(), torchrun_world_size())


def torchrun_world_size() -> int:
    """Number of processes that ``torchrun`` started, whether or not they have a process group yet; 1 without it.

    Examples:
        >>> torchrun_world_size()
        1
    """
    return int(os.environ["WORLD_SIZE"]) if dist.is_available() and dist.is_torchelastic_launched() else 1


def is_main() -> bool:
    """Whether this process has rank 0, which alone writes files and prints."""
    return rank() == 0


@contextmanager
def process_group(device: torch.device) -> Iterator[torch.device]:
    """Initialises the process group of the processes that ``torchrun`` started, and destroys it at the end.

    The backend is NCCL on CUDA, with one device for each process, and gloo elsewhere. Without ``torchrun`` nothing happens.

    After an error the process ends without waiting for the others: ``torchrun`` then stops them, and their pending
    collectives fail as soon as the connections close.

    Args:
        device (torch.device): type of the device to train on.

    Yields:
        torch.device: the device of this process.

    Raises:
        ValueError: fewer CUDA devices than processes on this machine.
        RuntimeError: another rank failed.
    """
    if torchrun_world_size() == 1:
        yield device
        return
    if device.type == "cuda":
        device = _own_device(int(os.environ["LOCAL_RANK"]), torch.cuda.device_count())
        torch.cuda.set_device(device)
    on_cuda = device.type == "cuda"
    dist.init_process_group("nccl" if on_cuda else "gloo", timeout=TIMEOUT, device_id=device if on_cuda else None)
    try:
        yield device
        dist.barrier()
    except RuntimeError as error:
        if isinstance(error, dist.DistError) or "gloo" in str(error):
            raise RuntimeError(f"rank {rank()} lost the connection to another rank: see the error of that rank.") from error
        raise
    dist.destroy_process_group()


def _own_device(local_rank: int, devices: int) -> torch.device:
    if local_rank >= devices:
        raise ValueError(
            f"process {local_rank} of this machine has no CUDA device, there are {devices}: start torchrun with "
            f"--nproc-per-node={devices} or less, or give device=cpu."
        )
    return torch.device("cuda", local_rank)


def all_reduce_sum(value: torch.Tensor) -> torch.Tensor:
    """Sum of a tensor over all ranks; differentiable.

    Args:
        value (torch.Tensor): [...], of the same shape on every rank; not of type bool.

    Returns:
        torch.Tensor: [...].

    Examples:
        >>> all_reduce_sum(torch.tensor([1.0, 2.0]))
        tensor([1., 2.])
    """
    return value if world_size() == 1 else _all_reduce(value)


# A custom operator, which torch.compile does not trace into.
@torch.library.custom_op("torchrl_ficreg::all_reduce", mutates_args=())
def _all_reduce(value: torch.Tensor) -> torch.Tensor:
    total = value.clone(memory_format=torch.contiguous_format)
    dist.all_reduce(total)
    return total


@_all_reduce.register_fake
def _(value):
    return torch.empty_like(value, memory_format=torch.contiguous_format)


_all_reduce.register_autograd(lambda ctx, grad: _all_reduce(grad))


def all_gather(value: torch.Tensor, dim: int = 0) -> torch.Tensor:
    """Concatenates the batches of all ranks, in the order of ranks; differentiable.

    For a loss that every rank computes on the global batch. The gradient follows the convention of distributed data
    parallel training: averaged over ranks, parameter gradients are those of one process on the global batch.

    Args:
        value (torch.Tensor): [..., B, ...], of the same shape on every rank. A bool tensor has no gradient.
        dim (int, optional): the batch dimension. Default: ``0``.

    Returns:
        torch.Tensor: [..., B * world size, ...].

    Examples:
        >>> all_gather(torch.zeros(3, 8, 5), dim=1).shape
        torch.Size([3, 8, 5])
    """
    ranks = world_size()
    if ranks == 1:
        return value
    rows = (value.byte() if value.dtype == torch.bool else value).movedim(dim, 0)  # [B, ...]
    before, after = dist.get_rank() * len(rows), (ranks - 1 - dist.get_rank()) * len(rows)
    # A sum of rows padded with zeros: x + 0 is exact, and the sum is differentiable already.
    padded = torch.cat([rows.new_zeros(before, *rows.shape[1:]), rows, rows.new_zeros(after, *rows.shape[1:])])
    return all_reduce_sum(padded).to(value.dtype).movedim(0, dim)


def all_reduce_mean(values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Means over all ranks, detached, in one collective.

    Args:
        values (Mapping[str, torch.Tensor]): floating tensors of any shape on one device, with the same keys and shapes on
            every rank.

    Returns:
        dict[str, torch.Tensor]: float32 on several ranks.

    Examples:
        >>> all_reduce_mean({"loss": torch.tensor(2.0, requires_grad=True)})
        {'loss': tensor(2.)}
    """
    values = {key: value.detach() for key, value in values.items()}
    if world_size() == 1:
        return values
    flat = torch.cat([value.float().reshape(-1) for value in values.values()]) / world_size()
    dist.all_reduce(flat)
    chunks = flat.split([value.numel() for value in values.values()])
    return {key: chunk.view(value.shape) for (key, value), chunk in zip(values.items(), chunks, strict=True)}


def any_rank(flag: bool, device: torch.device | str = "cpu") -> bool:
    """Whether a flag is set on at least one rank.

    Args:
        flag (bool): of this rank.
        device (torch.device or str, optional): one that the backend communicates on. Default: ``"cpu"``.

    Examples:
        >>> any_rank(True), any_rank(False)
        (True, False)
    """
    if world_size() == 1:
        return flag
    raised = torch.tensor(int(flag), device=device)
    dist.all_reduce(raised, dist.ReduceOp.MAX)
    return bool(raised)


def broadcast_from_rank0(value: Any) -> Any:
    """The object of rank 0, on every rank.

    Args:
        value (Any): anything that can be pickled; ignored on the other ranks.

    Examples:
        >>> broadcast_from_rank0("run")
        'run'
    """
    if world_size() == 1:
        return value
    objects = [value]
    dist.broadcast_object_list(objects, src=0)
    return objects[0]


def barrier() -> None:
    """Waits until every rank has called it."""
    if world_size() > 1:
        dist.barrier()
