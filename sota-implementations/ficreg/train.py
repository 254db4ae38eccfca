"""Collects data if there is none, trains a latent world model, plans with it and reports.

    python train.py                             FICReg on TwoRoom, minutes on two cores
    python train.py method=lewm                 the same without FICReg's two terms
    python train.py seed=1 optim.epochs=4 name=short
    torchrun --nproc-per-node=8 train.py        on eight devices, with the numbers of one

Under torchrun optim.batch_size stays the number of clips of a step over all processes. They train together; the first
one writes all files and, when the others have ended, evaluates.

An interrupted run continues when the same command is given again: after a crash or a kill from the last checkpoint,
after SIGTERM (exit code 85) or Ctrl-C (130) in training from the step it had reached.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # huge pages for large tensors on CPUs: torch looks when it starts
import torch
from cli import entry_point
from episodes import check_writable, find_dataset, is_writable, make_dataset
from loggers import make_logger, publish
from omegaconf import DictConfig
from planning import make_policy
from run_dir import check_run_dir, claim_run_dir, find_start
from utils import (
    add_hooks,
    check_card,
    check_pairs,
    check_settings,
    encoder_of,
    evaluate_beside_random,
    get_device,
    make_card,
    make_loss,
    make_networks_without_memory,
    model_config,
    report,
    result_rows,
    versions,
    write_json,
)

from torchrl_ficreg import InverseDynamicsModel, LatentWorldModel, make_world_model
from torchrl_ficreg._device import describe_precision
from torchrl_ficreg._utils import nearest_folder
from torchrl_ficreg.data.latents import encode_episodes, LatentClips
from torchrl_ficreg.distributed import is_main, process_group, rank, world_size
from torchrl_ficreg.evaluation import (
    evaluate_mpc,
    latent_distance,
    plot_latent_distance,
    plot_learning_curve,
    save_episodes_gif,
    StartGoalPairs,
)
from torchrl_ficreg.trainers import (
    checkpoint_components,
    load_world_model,
    ModelCard,
    NoRegularizer,
    OfflineTrainer,
    on_frozen_latents,
    Refinement,
    stop_on_signal,
    SuccessRate,
    TolerantLogger,
)
from torchrl_ficreg.trainers.checkpoint import check_room
from torchrl_ficreg.trainers.offline import METRICS

NOT_THE_TRAINERS = ("batch_size", "checkpoint_activations")  # of optim: settings of the dataset, and of the networks


@entry_point("train")
def main(cfg: DictConfig) -> None:
    """Data, training, evaluation, report."""
    check_settings(cfg)
    run_dir = check_run_dir(cfg)
    check_writable(run_dir, "runs_dir")
    check_room(nearest_folder(run_dir), make_networks_without_memory(cfg)[0].parameters())
    start = find_start(cfg, run_dir)
    data = find_dataset(cfg)  # of several processes one records, and the others wait for its lock
    check_card(cfg, make_dataset(cfg, data, "train"))
    make_dataset(cfg, data, "validation", drop_last=False)
    if not is_main():
        train(cfg, data, run_dir, None, start)
        return
    tests = draw_tests(cfg, data)  # before training: too few episodes shall not come to light after it
    claim_run_dir(cfg)
    logger = make_logger(cfg, run_dir)
    model, inverse_model, card, training = train(cfg, data, run_dir, logger, start)
    outcome = evaluate(cfg, data, run_dir, model, inverse_model, card, tests)
    results = {**outcome, "training": training, "versions": versions()}
    write_json(run_dir / "results.json", results)
    rows = {cfg.method.name: results["policy"], "random": results["random"]}
    publish(logger, rows, tuple(rows), run_dir)
    print(f"results and pictures in {run_dir}")


def train(
    cfg: DictConfig, data: Path, run_dir: Path, logger: TolerantLogger | None = None, start: Path | None = None
) -> tuple[LatentWorldModel, InverseDynamicsModel, ModelCard, dict]:
    """Trains, or continues, and returns the networks to be evaluated, in eval mode. Processes part before that."""
    with process_group(get_device(cfg.device)) as device:
        if is_main():
            print(f"training on {describe_precision(device, cfg.optim.precision)}")
        torch.manual_seed(cfg.seed)
        clips = make_dataset(cfg, data, "train", prefetch=1, part=(rank(), world_size()))
        held_out = make_dataset(cfg, data, "validation", drop_last=False, part=(rank(), world_size()))
        card = make_card(cfg, clips)
        model, inverse_model = make_world_model(model_config(cfg), card.action_dim)
        model.statistics = clips.statistics
        loss = make_loss(cfg, model.to(device), inverse_model.to(device))
        refinement = Refinement(seed=cfg.seed, precision=cfg.optim.precision, **cfg.refine)
        trainer = OfflineTrainer(
            loss,
            clips,
            run_dir=run_dir,
            validation_buffer=held_out,
            components={**checkpoint_components(model, inverse_model, card), "refinement": refinement},
            log_interval=cfg.logger.interval,
            logger=logger,
            strategy=cfg.distributed.strategy,
            keep_epoch=cfg.evaluation.epoch,
            **{key: value for key, value in cfg.optim.items() if key not in NOT_THE_TRAINERS},
        )
        add_hooks(cfg, trainer)
        success = SuccessRate(
            lambda: measure_success(cfg, data, run_dir, model, inverse_model, card),
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
        refine(cfg, data, model, inverse_model, refinement)
        success.forget()
        trainer.save_trainer(force_save=True)
    if trainer.kept is not None and is_main() and cfg.evaluation.epoch < cfg.optim.epochs:
        model, inverse_model, _ = load_world_model(trainer.kept)
        model, inverse_model = model.to(device), inverse_model.to(device)
    training = {
        "steps": trainer.step,
        "evaluated_epoch": cfg.evaluation.epoch or cfg.optim.epochs,
        "clips": clips.num_clips,
        "resumed_at_step": resumed_at,
        "seconds": trainer.clock.seconds,
        "refinement_steps": refinement.steps,
        "refinement_seconds": refinement.seconds,
        "parameters": sum(p.numel() for p in model.parameters()),
        "dataset_fingerprint": clips.fingerprint,
    }
    return model.eval(), inverse_model.eval(), card, training


def refine(
    cfg: DictConfig, data: Path, model: LatentWorldModel, inverse_model: InverseDynamicsModel, refinement: Refinement
) -> None:
    """Trains predictor and inverse model further, on latents of the frozen encoder."""
    clips = make_dataset(cfg, data, "train", statistics=model.statistics)
    latent = encode_episodes(clips, encoder_of(model.eval(), cfg.optim.precision), description="encode")
    loss = make_loss(cfg, on_frozen_latents(model), inverse_model, sigreg=NoRegularizer())
    refinement.run(loss, LatentClips(clips, latent))


def measure_success(
    cfg: DictConfig,
    data: Path,
    run_dir: Path,
    model: LatentWorldModel,
    inverse_model: InverseDynamicsModel,
    card: ModelCard,
) -> dict[str, float]:
    """Plans on pairs of the validation split: the best checkpoint is not chosen by the pairs that judge it."""
    held_out, settings = make_dataset(cfg, data, "validation", drop_last=False), cfg.evaluation
    pairs = StartGoalPairs.draw(held_out, cfg.env.name, settings.every_pairs, cfg.env.goal_offset, settings.seed)
    outcome = evaluate_mpc(
        make_policy(cfg.plan, model, inverse_model, (card.action_low, card.action_high), run_dir),
        pairs,
        budget=cfg.env.budget,
        image_size=card.model["image_size"],
        num_envs=settings.num_envs,
        num_workers=settings.num_workers or None,
        env_kwargs=card.env_kwargs,
        progress_bar=False,
    )
    return {"success_rate": outcome.success_rate}


def draw_tests(cfg: DictConfig, data: Path) -> list[tuple[StartGoalPairs, int, str]]:
    """Frozen start-goal pairs beside the dataset, their budget and a name: the main test, then those of ``also``."""
    held_out = make_dataset(cfg, data, "evaluation", drop_last=False)
    count, seed, tests = cfg.evaluation.num_pairs, cfg.evaluation.seed, []
    for offset, budget in [(cfg.env.goal_offset, cfg.env.budget), *cfg.evaluation.also]:
        manifest = data / f"pairs_{count}x{offset}_seed{seed}.json"
        if not manifest.exists() and not is_writable(data):  # then they stand in the run's folder only, by evaluate()
            pairs = StartGoalPairs.draw(held_out, cfg.env.name, count, offset, seed)
        else:
            pairs = StartGoalPairs.frozen(manifest, held_out, cfg.env.name, count, offset, seed)
        check_pairs(pairs, make_card(cfg, held_out).env_kwargs, data)
        tests.append((pairs, budget, f"goals_{offset}_steps_ahead_within_{budget}"))
    return tests


def evaluate(
    cfg: DictConfig,
    data: Path,
    run_dir: Path,
    model: LatentWorldModel,
    inverse_model: InverseDynamicsModel,
    card: ModelCard,
    tests: list[tuple[StartGoalPairs, int, str]],
) -> dict:
    """Plans on the frozen pairs of every test, prints the numbers, looks at the latent space, draws the pictures."""
    held_out = make_dataset(cfg, data, "evaluation", drop_last=False)
    settings = cfg.evaluation
    policy = make_policy(cfg.plan, model, inverse_model, (card.action_low, card.action_high), run_dir)
    tables, outcome = {}, None
    for pairs, budget, name in tests:
        pairs.save(run_dir / ("pairs_" + name + ".json" if tables else "pairs.json"))
        found, floor = evaluate_beside_random(
            policy,
            pairs,
            card,
            budget=budget,
            num_envs=settings.num_envs,
            num_workers=settings.num_workers,
            record=0 if tables else settings.record,
        )
        outcome = outcome or found  # the pictures are of the first test
        rows = tables[name] = result_rows(cfg.method.name, cfg.plan, found, floor)
        # Before anything is written: a full disk shall not cost the numbers.
        if len(tests) > 1:
            print(f"\n{name.replace('_', ' ')}, {budget} steps allowed:")
        report([(f"{cfg.method.name}, {cfg.plan.search}", rows["policy"], ""), ("random", rows["random"], "")])
    profile = latent_distance(model, held_out)
    if (run_dir / METRICS).exists():
        plot_learning_curve(run_dir / METRICS, run_dir / "learning_curve.png")
    plot_latent_distance(profile, run_dir / "latent_distance.png", unit=cfg.env.state_unit)
    save_episodes_gif(outcome, run_dir / "episodes.gif")
    first, *others = tables
    return {**tables[first], "latent_distance": profile.summary(), **{name: tables[name] for name in others}}


if __name__ == "__main__":
    main()
