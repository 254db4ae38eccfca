"""Repeats the evaluation of a trained model: python evaluate.py checkpoint=runs/two_room_cpu_ficreg_seed0."""

from __future__ import annotations

from pathlib import Path

from cli import entry_point
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from planning import check_horizon, make_policy, plan_config
from utils import evaluate_beside_random, get_device, report, versions, write_json

from torchrl_ficreg.evaluation import save_episodes_gif, StartGoalPairs
from torchrl_ficreg.trainers import find_checkpoint, load_world_model, ModelCard


@entry_point("evaluate")
def main(cfg: DictConfig) -> None:
    """Loads, plans on the frozen pairs, writes."""
    if OmegaConf.is_missing(cfg, "checkpoint"):
        raise ValueError("name the model to evaluate: checkpoint=runs/two_room_cpu_ficreg_seed0, say.")
    if cfg.budget is not None and cfg.budget < 1 or cfg.num_envs < 1 or min(cfg.record, cfg.num_workers) < 0:
        raise ValueError(
            "budget and num_envs must be positive, record and num_workers not negative, got "
            f"{cfg.budget}, {cfg.num_envs}, {cfg.record} and {cfg.num_workers}."
        )
    checkpoint = find_checkpoint(cfg.checkpoint)
    run_dir = checkpoint.parent.parent
    manifest = Path(cfg.pairs or run_dir / "pairs.json")
    if not manifest.exists():
        raise FileNotFoundError(f"no start-goal pairs at {manifest}: let train.py finish, or give pairs=...")
    pairs = StartGoalPairs.load(manifest)
    model, inverse_model, card = load_world_model(checkpoint)
    if pairs.env != card.env:
        raise ValueError(f"the model was trained on {card.env}, the pairs belong to {pairs.env}: give others, pairs=...")
    plan = plan_of_run(cfg, card)
    budget = cfg.budget or card.config["env"]["budget"]
    plan_config(plan)
    check_horizon(plan, model.frame_skip, budget)
    device = get_device(cfg.device)
    bounds = (card.action_low, card.action_high)
    policy = make_policy(plan, model.to(device), inverse_model.to(device), bounds, run_dir)
    method = card.config["method"]["name"]
    outcome, floor = evaluate_beside_random(
        policy,
        pairs,
        card,
        budget=budget,
        num_envs=cfg.num_envs,
        num_workers=cfg.num_workers,
        record=cfg.record,
    )
    results = {method: outcome.summary(), "random": floor.summary(), "plan": OmegaConf.to_container(plan)}
    output = Path(cfg.output or run_dir / "evaluation")
    output.mkdir(parents=True, exist_ok=True)
    write_json(output / "results.json", {**results, "checkpoint": checkpoint.name, "versions": versions()})
    if cfg.record:
        save_episodes_gif(outcome, output / "episodes.gif")
    report(results, (method, "random"), output)


def plan_of_run(cfg: DictConfig, card: ModelCard) -> DictConfig:
    """The plan settings of the training run, with what was typed on the command line instead."""
    typed = [override.split("=")[0] for override in HydraConfig.get().overrides.task]
    if "plan" in typed:
        return cfg.plan
    plan = OmegaConf.create(card.config["plan"])
    for field in typed:
        if field.startswith("plan."):
            OmegaConf.update(plan, field.removeprefix("plan."), OmegaConf.select(cfg, field))
    return plan


if __name__ == "__main__":
    main()
