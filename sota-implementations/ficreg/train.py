"""Trains a latent world model, plans with it on frozen start-goal pairs and reports success rates.

    python train.py                             FICReg on TwoRoom, minutes on two cores
    python train.py method=lewm                 the same without FICReg's two terms
    python train.py seed=1 optim.epochs=4 name=short
    torchrun --nproc-per-node=8 train.py        one training on eight devices

Missing episodes are recorded first. Under torchrun, optim.batch_size counts the clips of all ranks; rank 0 writes all
files and, after training, evaluates.

The same command continues an interrupted run: after a crash or a kill from the last checkpoint, after SIGTERM (exit
code 85) or Ctrl-C (130) during training from the step it had reached.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # huge pages for large CPU tensors; read when torch is imported
import torch
from cli import entry_point
from configs import check_settings, goals
from omegaconf import DictConfig
from results import draw_tests, evaluate_tests, log_results, make_logger, Networks, validate
from run_dir import check_run_dir, claim_run_dir, find_start, REFINE, versions, write_json
from utils import (
    add_hooks,
    get_device,
    make_card,
    make_dataset,
    make_loss,
    model_config,
    open_dataset,
    refine,
    refined,
    trainer_settings,
)

from torchrl_ficreg import make_world_model
from torchrl_ficreg._device import describe_precision
from torchrl_ficreg.data import EpisodeStore
from torchrl_ficreg.distributed import is_main, process_group, rank, world_size
from torchrl_ficreg.pretrained import ModelCard
from torchrl_ficreg.trainers import (
    checkpoint_components,
    EvaluationHook,
    load_world_model,
    OfflineTrainer,
    PhaseLogger,
    Refinement,
    stop_on_signal,
    TolerantLogger,
)


@entry_point("train")
def main(cfg: DictConfig) -> None:
    """Builds, trains, evaluates; everything that can be refused is refused before the first episode or step."""
    check_settings(cfg)
    start = find_start(cfg, check_run_dir(cfg))
    data = open_dataset(cfg)  # under torchrun one process records while the others wait for its lock
    card = make_card(cfg, make_dataset(cfg, data, "train"))
    make_dataset(cfg, data, "validation")  # refuses a split without episodes
    for split in ("train", "validation") if cfg.refine.epochs else ():
        make_dataset(refined(cfg), data, split)  # refuses clips longer than every episode, or fewer than a batch
    tests = draw_tests(cfg, data, card.env_kwargs, goals(cfg)) if is_main() else []
    with claim_run_dir(cfg) as run_dir:
        logger = make_logger(cfg, run_dir) if is_main() else None
        networks, training = train(cfg, data, card, run_dir, logger, start)
        if not is_main():
            return
        results = evaluate_tests(cfg, data, card, run_dir, networks, tests)
        write_json(run_dir / "results.json", {**results, "training": training, "versions": versions()})
        log_results(logger, {cfg.method.name: results["policy"], "random": results["random"]}, run_dir)
        print(f"results and pictures in {run_dir}")


def train(
    cfg: DictConfig, data: EpisodeStore, card: ModelCard, run_dir: Path, logger: TolerantLogger | None, start: Path | None
) -> tuple[Networks, dict[str, Any]]:
    """Trains, or continues, and returns the networks to be evaluated, in eval mode, and numbers about the training."""
    with process_group(get_device(cfg.device)) as device:
        if is_main():
            print(f"training on {describe_precision(device, cfg.optim.precision)}")
        torch.manual_seed(cfg.seed)
        shard = {"rank": rank(), "world_size": world_size()}
        clips = make_dataset(cfg, data, "train", prefetch=1, **shard)
        model, inverse_model = make_world_model(model_config(cfg), card.action_dim)
        model.statistics = clips.statistics
        refinement = Refinement(done=not cfg.refine.epochs)
        trainer = OfflineTrainer(
            make_loss(cfg, model.to(device), inverse_model.to(device)),
            clips,
            run_dir=run_dir,
            validation_buffer=make_dataset(cfg, data, "validation", **shard),
            components={**checkpoint_components(model, inverse_model, card), "refinement": refinement},
            log_interval=cfg.logger.interval,
            logger=logger,
            keep_epoch=cfg.evaluation.epoch,
            **trainer_settings(cfg),
        )
        add_hooks(cfg, trainer)
        success = EvaluationHook(
            lambda: validate(cfg, data, card, run_dir, (model, inverse_model)),
            max(1, cfg.evaluation.every) * trainer.steps_per_epoch,
            trainer.metrics_table,
        )
        if cfg.evaluation.every and is_main():
            success.register(trainer)
        resumed_at = trainer.step if trainer.resume(start) else 0
        if 0 < resumed_at < trainer.total_steps and is_main():
            print(f"continuing {run_dir} after step {resumed_at} of {trainer.total_steps}")
        with stop_on_signal(trainer, signal.SIGTERM, signal.SIGINT):
            trainer.train()
    if not refinement.done and is_main():
        later = PhaseLogger(logger, "refine/", trainer.collected_frames) if logger else None
        refinement.seconds = refine(cfg, data, (model, inverse_model), run_dir / REFINE, later)
        refinement.done = True
        success.forget()
        trainer.save_trainer(force_save=True)
    if trainer.kept is not None and is_main() and cfg.evaluation.epoch < cfg.optim.epochs:
        model, inverse_model = (network.to(device) for network in load_world_model(trainer.kept)[:2])
    training = {
        "steps": trainer.step,
        "evaluated_epoch": cfg.evaluation.epoch or cfg.optim.epochs,
        "clips": len(clips),
        "resumed_at_step": resumed_at,
        "seconds": trainer.clock.seconds,
        "refinement_epochs": cfg.refine.epochs,
        "refinement_seconds": refinement.seconds,
        "parameters": sum(p.numel() for p in model.parameters()),
        "dataset_fingerprint": clips.fingerprint,
    }
    return (model.eval(), inverse_model.eval()), training


if __name__ == "__main__":
    main()
