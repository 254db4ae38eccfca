"""The README's example of one loss trains what the README's table promises."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from torchrl_ficreg import CEMConfig, LatentCEMPlanner, MPCPolicy
from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.envs import collect_episodes
from torchrl_ficreg.evaluation import evaluate_mpc, StartGoalPairs
from torchrl_ficreg.trainers import OfflineTrainer

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def example() -> dict:
    """The names that the README's block leaves behind once it has run, as it stands there."""
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    (block,) = [text for text in blocks if "FICRegLoss(" in text]
    torch.manual_seed(0)
    names: dict = {}
    exec(compile(block, "README.md", "exec"), names)
    return names


def test_the_example_has_the_weights_of_its_preset(example, config):
    """Those of ``make train``; every network got gradient."""
    weights = config("train").loss
    for name in ("sigreg_coeff", "idm_coeff", "consistency_coeff"):
        assert float(getattr(example["loss"], name)) == pytest.approx(weights[name])
    for network in (example["model"].encoder, example["model"].predictor, example["inverse_model"]):
        assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


@pytest.mark.slow
def test_the_example_reaches_the_success_rate_of_the_readme(example, config):
    """Trained and planned with as ``make train`` does: the 95 % intervals of both success rates overlap."""
    cfg = OmegaConf.to_container(config("train"), resolve=True)
    env, optim, evaluation, plan = cfg["env"], cfg["optim"], cfg["evaluation"], cfg["plan"]
    model, data = example["model"], env["data"]
    episodes = list(
        collect_episodes(
            "two_room",
            data["episodes"],
            seed=data["seed"],
            num_workers=0,
            max_steps=data["max_steps"],
            stop_at_success=data["stop_at_success"],
            expert_kwargs=data["expert"],
            env_kwargs=env["kwargs"],
        )
    )
    clips, held_out = (
        OfflineTrajectories.from_episodes(
            episodes, split=split, num_frames=2, frame_skip=5, batch_size=optim["batch_size"], drop_last=split == "train"
        )
        for split in ("train", "evaluation")
    )
    example["loss"].zero_grad()
    recipe = {name: optim[name] for name in ("lr", "weight_decay", "warmup", "clip_norm")}
    OfflineTrainer(example["loss"], clips, epochs=optim["epochs"], progress_bar=False, **recipe).train()
    model.statistics = clips.statistics
    config = CEMConfig(**{name: plan[name] for name in ("num_candidates", "num_elites", "iterations")})
    pairs = StartGoalPairs.draw(held_out, "two_room", evaluation["num_pairs"], env["goal_offset"], evaluation["seed"])
    policy = MPCPolicy(LatentCEMPlanner(model.eval(), config, action_bounds=([-1.0, -1.0], [1.0, 1.0])))
    outcome = evaluate_mpc(
        policy, pairs, budget=env["budget"], num_envs=evaluation["num_envs"], env_kwargs=env["kwargs"], progress_bar=False
    ).summary()
    print(f"success rate of the README's example: {outcome['success_rate']:.0%}")
    published = json.loads((ROOT / "docs" / "results" / "two_room.json").read_text())["pooled"]["ficreg"]
    assert outcome["success_interval"][1] >= published["success_interval"][0], outcome
