"""The parts that the scripts put together."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import tensordict
import torch
import torchrl
from episodes import describe_env
from omegaconf import DictConfig, OmegaConf
from planning import check_horizon, plan_config
from torch import nn

from torchrl_ficreg import (
    FICRegLoss,
    JointInverseLoss,
    LatentWorldModel,
    LeWMLoss,
    make_world_model,
    ModelConfig,
    MPCPolicy,
    PLDMLoss,
    SIGReg,
)
from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.data.frames import check_frame_format
from torchrl_ficreg.evaluation import Evaluation, evaluate_mpc, StartGoalPairs, UniformPolicy
from torchrl_ficreg.modules.inverse import InverseDynamicsModel
from torchrl_ficreg.modules.precision import autocast, Precision, uses_bf16
from torchrl_ficreg.modules.recompute import checkpoint_activations
from torchrl_ficreg.trainers import CoefficientSchedule, LatentAlarm, ModelCard, OfflineTrainer, Refinement

SIGREG_FALL = 0.8  # share of training after which lambda has its last value


def get_device(name: str) -> torch.device:
    """The device a configuration names.

    Raises:
        ValueError: there is no such device on this machine.
    """
    try:
        device = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device={name} cannot be used here ({error}): choose device=auto or device=cpu.") from error
    return device


def model_config(cfg: DictConfig) -> ModelConfig:
    """The sizes in a configuration's ``model`` group."""
    names = {field.name for field in fields(ModelConfig)}
    values = OmegaConf.to_container(cfg.model)
    return ModelConfig(**{name: value for name, value in values.items() if name in names})


def make_loss(
    cfg: DictConfig, model: LatentWorldModel, inverse_model: InverseDynamicsModel, sigreg: nn.Module | None = None
) -> LeWMLoss:
    """The loss of a configuration's ``method``, with SIGReg unless told otherwise."""
    networks = (model.encoder, model.predictor, inverse_model)
    if cfg.optim.checkpoint_activations:
        checkpoint_activations(model)
    weights = {key: value for key, value in cfg.loss.items() if key != "sigreg_start"}
    settings = {key: value for key, value in cfg.method.items() if key not in ("name", "consistency_warmup")}
    sigreg = SIGReg(seed=cfg.seed).to(next(model.parameters()).device) if sigreg is None else sigreg
    if cfg.method.name == "lewm":
        return LeWMLoss(*networks[:2], sigreg=sigreg, sigreg_coeff=cfg.loss.sigreg_coeff)
    if cfg.method.name == "joint_inverse":
        return JointInverseLoss(
            *networks, sigreg=sigreg, sigreg_coeff=cfg.loss.sigreg_coeff, idm_coeff=cfg.loss.idm_coeff
        )
    if cfg.method.name == "pldm":
        return PLDMLoss(*networks, **settings)
    return FICRegLoss(*networks, sigreg=sigreg, **settings, **weights)


def encoder_of(model: LatentWorldModel, precision: Precision) -> Callable[[torch.Tensor], torch.Tensor]:
    """Frames [n, 3, H, W] -> latents [n, D], on the model's device."""
    device = model.action_mean.device

    def encode(pixels: torch.Tensor) -> torch.Tensor:
        with autocast(device, precision):
            return model.encode(pixels.to(device))

    return encode


def add_hooks(cfg: DictConfig, trainer: OfflineTrainer) -> None:
    """The alarm, and the schedules of coefficients where they are asked for."""
    LatentAlarm(cfg.logger.alarm_interval, cfg.optim.precision, trainer.metrics_table).register(trainer)
    start, end = cfg.loss.sigreg_start, cfg.loss.sigreg_coeff
    if start is not None and cfg.method.name != "pldm":  # which has no SIGReg
        fall = CoefficientSchedule(
            "sigreg_coeff", lambda done: start * (end / start) ** min(1.0, done / SIGREG_FALL), trainer.total_steps
        )
        fall.register(trainer)
    share = cfg.method.get("consistency_warmup", 0.0)
    if share > 0:
        full = cfg.loss.consistency_coeff
        ramp = CoefficientSchedule("consistency_coeff", lambda done: full * min(1.0, done / share), trainer.total_steps)
        ramp.register(trainer)


def make_card(cfg: DictConfig, dataset: OfflineTrajectories) -> ModelCard:
    """What a checkpoint tells about itself."""
    meta = dataset.meta
    return ModelCard(
        model=asdict(model_config(cfg)),
        env=meta["env"],
        env_kwargs=meta["env_kwargs"],
        action_low=meta["action_low"],
        action_high=meta["action_high"],
        config=OmegaConf.to_container(cfg, resolve=True),
    )


def evaluate_beside_random(
    policy: MPCPolicy, pairs: StartGoalPairs, card: ModelCard, *, record: int, num_workers: int, **settings: Any
) -> tuple[Evaluation, Evaluation]:
    """A policy, and uniformly random actions, on the same pairs in the environment that a model was trained on."""
    shared = {"image_size": card.model["image_size"], "env_kwargs": card.env_kwargs, **settings}
    shared["num_workers"] = num_workers or None
    outcome = evaluate_mpc(policy, pairs, record=record, description="plan", **shared)
    floor = evaluate_mpc(UniformPolicy(card.action_low, card.action_high), pairs, description="random", **shared)
    return outcome, floor


def check_settings(cfg: DictConfig) -> None:
    """Finds mistakes in a configuration before anything is written.

    Raises:
        ValueError: a setting outside its range, or an unknown choice.
    """
    plan_config(cfg.plan)
    check_horizon(cfg.plan, cfg.model.frame_skip, cfg.env.budget)
    get_device(cfg.device)
    Refinement(**cfg.refine)
    if not isinstance(cfg.name, str):
        raise ValueError(f"name={cfg.name} is a number, and a folder wants a name: name=run{cfg.name}, for instance.")
    if not cfg.name or Path(cfg.name).name != cfg.name or cfg.name.startswith("."):
        raise ValueError(f"name={cfg.name!r} must be the plain name of a folder; runs_dir says where that folder goes.")
    if cfg.logger.backend not in ("csv", "wandb", "tensorboard"):
        raise ValueError(f"unknown logger.backend {cfg.logger.backend!r}: choose csv, wandb or tensorboard.")
    check_frame_format(cfg.collect.frames)
    model, inverse_model = make_world_model(model_config(cfg), action_dim=1)
    make_loss(cfg, model, inverse_model)
    if cfg.loss.sigreg_start is not None and not (cfg.loss.sigreg_start > 0 and cfg.loss.sigreg_coeff > 0):
        raise ValueError(
            "loss.sigreg_start and loss.sigreg_coeff must be positive to fall from one to the other, got "
            f"{cfg.loss.sigreg_start} and {cfg.loss.sigreg_coeff}."
        )
    if not 0 <= cfg.method.get("consistency_warmup", 0.0) <= 1:
        raise ValueError(f"method.consistency_warmup must lie in [0, 1], got {cfg.method.consistency_warmup}.")
    optim, evaluation = cfg.optim, cfg.evaluation
    positive = {"optim.epochs": optim.epochs, "optim.batch_size": optim.batch_size, "optim.lr": optim.lr}
    positive |= {"optim.clip_norm": optim.clip_norm, "env.data.episodes": cfg.env.data.episodes}
    positive |= {"env.budget": cfg.env.budget, "env.goal_offset": cfg.env.goal_offset}
    positive |= {"evaluation.num_pairs": evaluation.num_pairs, "evaluation.num_envs": evaluation.num_envs}
    positive |= {"evaluation.record": evaluation.record, "logger.interval": cfg.logger.interval}
    positive |= {"logger.alarm_interval": cfg.logger.alarm_interval, "evaluation.every_pairs": evaluation.every_pairs}
    positive |= {"optim.validation_batches": optim.validation_batches, "env.data.max_steps": cfg.env.data.max_steps}
    wrong = [f"{key}={value}" for key, value in positive.items() if not value > 0]
    if wrong:
        raise ValueError(f"must be positive: {', '.join(wrong)}.")
    natural = {"seed": cfg.seed, "env.data.seed": cfg.env.data.seed, "evaluation.seed": evaluation.seed}
    natural |= {"evaluation.num_workers": evaluation.num_workers, "evaluation.every": evaluation.every}
    natural |= {"collect.num_workers": cfg.collect.num_workers, "optim.weight_decay": optim.weight_decay}
    wrong = [f"{key}={value}" for key, value in natural.items() if not 0 <= value < 2**63]
    if wrong:
        raise ValueError(f"must not be negative nor exceed 63 bits: {', '.join(wrong)}.")
    if not 0 <= optim.warmup < 1:
        raise ValueError(f"optim.warmup must lie in [0, 1), got {optim.warmup}.")
    for precision in (optim.precision, cfg.plan.precision):
        uses_bf16("cpu", precision)
    describe_env(cfg)


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one level of dotted names."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def write_text(path: Path, text: str) -> None:
    """Writes a file in one piece."""
    part = path.with_name(path.name + ".part")
    part.write_text(text)
    os.replace(part, path)


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Writes a JSON file in one piece."""
    write_text(path, json.dumps(values, indent=2) + "\n")


def report(results: dict[str, Any], names: tuple[str, ...], where: Path) -> None:
    """Prints the numbers a reader asks for first, a row for each policy."""
    print(f"\n{'policy':<14}{'success':>9}{'95 % interval':>18}{'at the end':>12}{'unsolved at start':>19}{'s / plan':>10}")
    for name in names:
        row = results[name]
        low, high = row["success_interval"]
        unsolved = row["success_rate_unsolved_at_start"]  # None where every pair was solved at the start
        print(
            f"{name:<14}{row['success_rate']:>9.1%}{f'{low:.1%} - {high:.1%}':>18}{row['success_rate_at_end']:>12.1%}"
            f"{'-' if unsolved is None else f'{unsolved:.1%}':>19}{row['seconds_per_plan']:>10.2f}"
        )
    print(f"{results[names[0]]['pairs']} frozen held-out pairs; results and pictures in {where}")


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"  # but found on the path


def versions() -> dict[str, str]:
    """What a result depends on besides its configuration."""
    return {
        "python": platform.python_version(),
        "torch": torch.__version__,
        "torchrl": torchrl.__version__,
        "tensordict": tensordict.__version__,
        "torchrl_ficreg": _version("torchrl_ficreg"),
        "numpy": _version("numpy"),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} torch threads",
    }
