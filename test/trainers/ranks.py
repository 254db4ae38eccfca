"""What each of two processes does for test_distributed_training.py."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from tiny import make_data, make_trainer, SIZES, weights

from torchrl_ficreg.distributed import process_group
from torchrl_ficreg.trainers import OfflineTrainer

WORLD = 2
STRATEGIES = ("ddp", "fsdp")
STILL = replace(SIZES, predictor_dropout=0.0)


def make_part(run_dir: Path | None, rank: int, world: int = WORLD, **settings: Any) -> OfflineTrainer:
    """The trainer of :func:`tiny.make_trainer`, three epochs of nine batches, on one of ``world`` parts of them."""
    held_out = make_data("validation", drop_last=False, part=(rank, world))
    settings = {"log_interval": 1, "validation_buffer": held_out, **settings}
    return make_trainer(run_dir, data=make_data(part=(rank, world)), validate=False, **settings)


def fail_after(step: int, trainer: OfflineTrainer, error: BaseException) -> None:
    """Lets the trainer raise after a step."""
    trainer.register_op("post_steps", lambda: trainer.step == step and (_ for _ in ()).throw(error))


def train_interrupted(trainer: OfflineTrainer, step: int) -> None:
    """Trains until an exception after a step, on every process. Checkpoints are written after steps 9, 18 and 27."""
    fail_after(step, trainer, KeyboardInterrupt())
    try:
        trainer.train()
    except KeyboardInterrupt:
        pass


def num_moments(trainer: OfflineTrainer) -> int:
    """Numbers that this process's optimiser keeps."""
    values = [value for state in trainer.optimizer.state.values() for value in state.values()]
    return sum(value.to_local().numel() if hasattr(value, "to_local") else value.numel() for value in values)


def scenarios(folder: Path, rank: int) -> Iterator[tuple[str, Any]]:
    """Names of findings, and what was found."""
    for strategy in STRATEGIES:
        moments: list[int] = []
        trainer = make_part(folder / strategy, rank, sizes=STILL, strategy=strategy)
        trainer.register_op("post_steps", lambda seen=moments, trainer=trainer: seen.append(num_moments(trainer)))
        trainer.train()
        yield strategy, weights(trainer)
        yield f"{strategy}, moments", moments[0]
    train_interrupted(make_part(folder / "three", rank, sizes=STILL, strategy="ddp"), 10)
    second = make_part(folder / "three", rank, sizes=STILL, strategy="fsdp")
    yield "second life begins", second.resume() and second.step
    train_interrupted(second, 19)
    quick = {"epochs": 2, "validation_buffer": None}
    whole = make_part(folder / "whole", rank, **quick)
    whole.train()
    yield "unbroken", weights(whole)
    yield "random state", torch.get_rng_state()
    train_interrupted(make_part(folder / "broken", rank, **quick), 14)
    again = make_part(folder / "broken", rank, **quick)
    torch.manual_seed(99)  # dropout must not depend on what the new process drew
    again.resume()
    yield "resumed at", again.step
    again.train()
    yield "resumed", weights(again)
    yield "not a number", nan_on_one(rank)


def nan_on_one(rank: int) -> tuple[int, str]:
    """Steps taken and message, when actions overflow on process 1 only, in the fourth step."""
    trainer = make_part(None, rank, sizes=STILL)
    if rank == 1:
        overflow = 1e38
        trainer.register_op(
            "batch_process",
            lambda batch: batch.set("action", overflow * batch["action"]) if trainer.step == 3 else batch,
        )
    try:
        trainer.train()
    except FloatingPointError as error:
        return trainer.step, str(error)
    return trainer.step, "none"


def work(rank: int, folder: Path) -> None:
    """One of two processes that were not started by torchrun."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=WORLD)
    torch.save(dict(scenarios(folder, rank)), folder / f"{rank}.pt")
    dist.barrier()
    dist.destroy_process_group()


def main(folder: Path, failing: int) -> None:
    """What torchrun starts: one process fails after step 5, if there is one of that number."""
    torch.set_num_threads(1)
    with process_group(torch.device("cpu")):
        trainer = make_part(folder / "run", dist.get_rank(), sizes=STILL, epochs=1, validation_buffer=None)
        if dist.get_rank() == failing:
            fail_after(5, trainer, OSError("injected"))
        trainer.train()
    (folder / f"{os.environ['RANK']} parted").touch()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
