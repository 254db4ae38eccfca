"""Several processes that train one model: who they are, how they meet and part, and what they tell each other."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist

from torchrl_ficreg.modules.collectives import num_processes

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
