"""What each of two ranks does for test_stepper_distributed.py."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from tiny import fail_after, make_data, make_trainer, STILL, train_interrupted, weights

from torchrl_ficreg import make_world_model
from torchrl_ficreg.distributed import process_group
from torchrl_ficreg.objectives import PLDMLoss
from torchrl_ficreg.trainers import CollapseMonitor, OfflineTrainer

WORLD_SIZE = 2


def make_ranked(run_dir: Path | None, rank: int, world_size: int = WORLD_SIZE, **settings: Any) -> OfflineTrainer:
    """The trainer of :func:`tiny.make_trainer` on one of ``world_size`` ranks: three epochs of nine batches."""
    ranked = {"rank": rank, "world_size": world_size}
    settings = {"log_interval": 1, "validation_buffer": make_data("validation", drop_last=False, **ranked), **settings}
    return make_trainer(run_dir, data=make_data(**ranked), validate=False, **settings)


def make_pldm(run_dir: Path, rank: int, world_size: int = WORLD_SIZE) -> OfflineTrainer:
    """One epoch of PLDM with a collapse monitor at steps 1, 3, 6 and 9."""
    torch.manual_seed(0)
    model, inverse_model = make_world_model(STILL, action_dim=2)
    loss = PLDMLoss(model.encoder, model.predictor, inverse_model, idm_coeff=1.0)
    settings = {"epochs": 1, "lr": 1e-2, "log_interval": 1, "precision": "fp32", "progress_bar": False}
    trainer = OfflineTrainer(loss, make_data(rank=rank, world_size=world_size), run_dir=run_dir, **settings)
    CollapseMonitor(3, "fp32", trainer.metrics_table).register(trainer)
    return trainer


def scenarios(folder: Path, rank: int) -> Iterator[tuple[str, Any]]:
    """Names of findings, and what was found."""
    trainer = make_ranked(folder / "ficreg", rank, sizes=STILL)
    trainer.train()
    yield "ficreg", weights(trainer)
    trainer = make_pldm(folder / "pldm", rank)
    trainer.train()
    yield "pldm", weights(trainer)
    train_interrupted(make_ranked(folder / "moved", rank, sizes=STILL), 10)
    quick = {"epochs": 2, "validation_buffer": None}
    whole = make_ranked(folder / "whole", rank, **quick)
    whole.train()
    yield "unbroken", weights(whole)
    yield "random state", torch.get_rng_state()
    train_interrupted(make_ranked(folder / "broken", rank, **quick), 14)
    again = make_ranked(folder / "broken", rank, **quick)
    torch.manual_seed(99)  # dropout must not depend on what the new process drew
    again.resume()
    yield "resumed at", again.step
    again.train()
    yield "resumed", weights(again)
    yield "not finite", overflow_on_one(rank)


def overflow_on_one(rank: int) -> tuple[int, str]:
    """Steps taken and message, when actions overflow on rank 1 only, in the fourth step."""
    trainer = make_ranked(None, rank, sizes=STILL)
    if rank == 1:
        trainer.register_op(
            "batch_process", lambda batch: batch.set("action", 1e38 * batch["action"]) if trainer.step == 3 else batch
        )
    try:
        trainer.train()
    except FloatingPointError as error:
        return trainer.step, str(error)
    return trainer.step, "none"


def work(rank: int, folder: Path) -> None:
    """One of two ranks that were not started by torchrun."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=WORLD_SIZE)
    torch.save(dict(scenarios(folder, rank)), folder / f"{rank}.pt")
    dist.barrier()
    dist.destroy_process_group()


def main(folder: Path, failing: int) -> None:
    """What torchrun starts. The rank ``failing`` raises after step 5; -1: none."""
    torch.set_num_threads(1)
    with process_group(torch.device("cpu")):
        trainer = make_ranked(folder / "run", dist.get_rank(), sizes=STILL, epochs=1, validation_buffer=None)
        if dist.get_rank() == failing:
            fail_after(trainer, 5, OSError("injected"))
        trainer.train()
    (folder / f"{os.environ['RANK']} done").touch()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
