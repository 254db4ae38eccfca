"""Distributed training: rank, world size, process group, collectives with gradients."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist


# A rank may wait this long while another one records data or evaluates. A rank that has died is noticed by torchrun.
PATIENCE = timedelta(hours=6)


def launched() -> bool:
    """Whether ``torchrun`` started this process together with others."""
    return dist.is_available() and dist.is_torchelastic_launched() and int(os.environ["WORLD_SIZE"]) > 1


def together() -> bool:
    """Whether this process is one of several that have met."""
    return num_processes() > 1


def rank() -> int:
    """Number of this process, from 0; before the processes have met and after they parted, as ``torchrun`` has it.

    Examples:
        >>> rank(), world_size(), is_main()
        (0, 1, True)
    """
    if together():
        return dist.get_rank()
    return int(os.environ["RANK"]) if launched() else 0


def world_size() -> int:
    """Number of processes that have met; 1 for a process on its own."""
    return num_processes()


def is_main() -> bool:
    """Whether this process is the one that writes files and speaks to the user."""
    return rank() == 0


@contextmanager
def process_group(device: torch.device) -> Iterator[torch.device]:
    """Meets the other processes that ``torchrun`` started, and parts from them at the end; nothing without them.

    NCCL on CUDA, where every process takes a device of its own; gloo elsewhere.

    A process that fails inside leaves without a word: ``torchrun`` sees it end and stops the others, and those that
    wait for its numbers fail by themselves as soon as its connections close.

    Args:
        device: what the configuration asks for.

    Yields:
        the device of this process.

    Raises:
        ValueError: fewer CUDA devices than processes.
        RuntimeError: another process failed.
    """
    if not launched():
        yield device
        return
    if device.type == "cuda":
        device = _own_device(int(os.environ["LOCAL_RANK"]), torch.cuda.device_count())
        torch.cuda.set_device(device)
    on_cuda = device.type == "cuda"
    dist.init_process_group(
        "nccl" if on_cuda else "gloo", timeout=PATIENCE, device_id=device if on_cuda else None
    )
    try:
        yield device
        dist.barrier()
    except RuntimeError as error:
        if isinstance(error, dist.DistError) or "gloo" in str(error):
            raise RuntimeError(f"process {rank()} lost another one, which says above or below what failed.") from error
        raise
    dist.destroy_process_group()


def _own_device(local_rank: int, devices: int) -> torch.device:
    if local_rank >= devices:
        raise ValueError(
            f"process {local_rank} of this machine has no CUDA device, there are {devices}: start torchrun with "
            f"--nproc-per-node={devices} or less, or give device=cpu."
        )
    return torch.device("cuda", local_rank)


def average(values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Means over all processes of numbers that each has found on its share of a batch, detached.

    All processes must ask at the same moment, for the same keys. A process on its own gets what it gave.

    Args:
        values: tensors of any shape, floating, on one device.

    Examples:
        >>> average({"loss": torch.tensor(2.0, requires_grad=True)})
        {'loss': tensor(2.)}
    """
    values = {key: value.detach() for key, value in values.items()}
    if not together():
        return values
    flat = torch.cat([value.float().reshape(-1) for value in values.values()]) / world_size()
    dist.all_reduce(flat)
    parts = flat.split([value.numel() for value in values.values()])
    return {key: part.view(value.shape) for (key, value), part in zip(values.items(), parts, strict=True)}


def any_process(flag: bool, device: torch.device | str = "cpu") -> bool:
    """Whether the flag is up on some process. All must ask at the same moment.

    Examples:
        >>> any_process(True), any_process(False)
        (True, False)
    """
    if not together():
        return flag
    raised = torch.tensor(int(flag), device=device)
    dist.all_reduce(raised, dist.ReduceOp.MAX)
    return bool(raised)


def wait_for_all() -> None:
    """Returns when every process has come here."""
    if together():
        dist.barrier()


def from_main(value: Any) -> Any:
    """The main process's value, on every process. All must ask at the same moment.

    Examples:
        >>> from_main("run")
        'run'
    """
    if not together():
        return value
    box = [value]
    dist.broadcast_object_list(box, src=0)
    return box[0]


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
