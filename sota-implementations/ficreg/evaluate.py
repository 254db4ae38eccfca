"""Repeats the evaluation of a trained model: python evaluate.py checkpoint=runs/two_room_cpu_ficreg_seed0."""

from __future__ import annotations

from pathlib import Path

from cli import entry_point
from omegaconf import DictConfig, OmegaConf
from utils import get_device, make_policy, versions, write_json

from torchrl_ficreg.evaluation import evaluate_mpc, save_episodes_gif, StartGoalPairs
from torchrl_ficreg.trainers import find_checkpoint, load_world_model


@entry_point("evaluate")
def main(cfg: DictConfig) -> None:
    """Loads, plans on the frozen pairs, writes."""
    if OmegaConf.is_missing(cfg, "checkpoint"):
        raise ValueError("name the model to evaluate: checkpoint=runs/two_room_cpu_ficreg_seed0, say.")
    if cfg.budget is not None and cfg.budget < 1 or cfg.num_envs < 1 or cfg.record < 0:
        raise ValueError(
            f"budget and num_envs must be positive and record not negative, got {cfg.budget}, {cfg.num_envs} and "
            f"{cfg.record}."
        )
    checkpoint = find_checkpoint(cfg.checkpoint)
    run_dir = checkpoint.parent.parent
    manifest = Path(cfg.pairs or run_dir / "pairs.json")
    if not manifest.exists():
        raise FileNotFoundError(f"no start-goal pairs at {manifest}: let train.py finish, or give pairs=...")
    pairs = StartGoalPairs.load(manifest)
    model, _, card = load_world_model(checkpoint)
    if pairs.env != card.env:
        raise ValueError(f"the model was trained on {card.env}, the pairs belong to {pairs.env}: give others, pairs=...")
    policy = make_policy(cfg.plan, model.to(get_device(cfg.device)), card.action_low, card.action_high)
    outcome = evaluate_mpc(
        policy,
        pairs,
        budget=cfg.budget or card.config["env"]["budget"],
        image_size=card.model["image_size"],
        num_envs=cfg.num_envs,
        env_kwargs=card.env_kwargs,
        record=cfg.record,
    )
    output = Path(cfg.output or run_dir / "evaluation")
    output.mkdir(parents=True, exist_ok=True)
    write_json(output / "results.json", {**outcome.summary(), "plan": dict(cfg.plan), "versions": versions()})
    if cfg.record:
        save_episodes_gif(outcome, output / "episodes.gif")
    summary = outcome.summary()
    low, high = summary["success_interval"]
    print(f"success {summary['success_rate']:.1%} ({low:.1%} - {high:.1%}) on {len(pairs)} pairs; written to {output}")


if __name__ == "__main__":
    main()
