"""The parts that the scripts put together."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import platform
import tempfile
from collections.abc import Callable
from dataclasses import asdict, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import tensordict
import torch
import torchrl
from episodes import check_amounts, check_recording, describe_env
from omegaconf import DictConfig, OmegaConf
from planning import check_consistency, check_horizon, plan_config
from sharded import check_collector
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
from torchrl_ficreg._device import autocast, check_precision, describe_processor, Precision
from torchrl_ficreg._utils import write_atomic
from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.data.frames import check_frame_format
from torchrl_ficreg.distributed import launched, world_size
from torchrl_ficreg.envs import make_env
from torchrl_ficreg.envs.registry import find_entry
from torchrl_ficreg.evaluation import evaluate_mpc, Evaluation, StartGoalPairs, UniformPolicy
from torchrl_ficreg.keys import STATE
from torchrl_ficreg.modules.inverse import InverseDynamicsModel
from torchrl_ficreg.modules.transformer import checkpoint_activations
from torchrl_ficreg.pretrained import ModelCard
from torchrl_ficreg.trainers import CoefficientSchedule, LatentAlarm, OfflineTrainer, Refinement
from torchrl_ficreg.trainers.stepper import check_processes

EASY_START, EASY_RANDOM = 0.2, 0.5  # shares of pairs above which an evaluation tells little
MOST_COUNT, MOST_WORKERS = 10**8, 1024  # of anything counted in a configuration; of processes
METHODS = ("ficreg", "lewm", "joint_inverse", "pldm")
MOST_LAYERS = 1000  # of the predictor; building more takes minutes even without their memory
SIGREG_FALL = 0.8  # share of training after which lambda has its last value


def get_device(name: str) -> torch.device:
    """The device a configuration names.

    Raises:
        ValueError: there is no such device on this machine.
    """
    name = str(name)  # device=1
    try:
        torch.device("cpu" if name == "auto" else name)
    except RuntimeError as error:  # which lists every backend there ever was
        hint = f"did you mean device={name.replace('gpu', 'cuda')}? Choose" if name.startswith("gpu") else "choose"
        raise ValueError(f"device={name} cannot be used here, it is unknown: {hint} auto, cpu, cuda or cuda:1.") from error
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
    """What a checkpoint tells about itself.

    Raises:
        ValueError: the dataset notes no environment, no bounds of the actions, or bounds that are none.
    """
    meta = dataset.meta
    where = f"{dataset.dataset_id} (meta.json)"
    missing = [name for name in ("env", "env_kwargs", "action_low", "action_high") if name not in meta]
    if missing:
        raise ValueError(f"{where} does not note {', '.join(missing)}: give them to EpisodeWriter(meta=...), or to convert.py.")
    bounds = [meta["action_low"], meta["action_high"]]
    try:
        low, high = (np.array(bound, dtype=np.float64) for bound in bounds)
        right = low.shape == high.shape == (dataset.action_dim,) and (low <= high).all() and np.isfinite([low, high]).all()
    except (ValueError, TypeError):
        right = False
    if not right:
        raise ValueError(
            f"{where} notes action_low={str(bounds[0])[:60]} and action_high={str(bounds[1])[:60]}: expected two lists of "
            f"{dataset.action_dim} finite numbers, low <= high."
        )
    if not isinstance(meta["env_kwargs"], dict):
        raise ValueError(f"{where} notes env_kwargs={str(meta['env_kwargs'])[:60]}: expected names and values of settings.")
    return ModelCard(
        model=asdict(model_config(cfg)),
        env=meta["env"],
        env_kwargs={**meta["env_kwargs"], **OmegaConf.to_container(cfg.env.kwargs)},
        action_low=low.tolist(),
        action_high=high.tolist(),
        config=OmegaConf.to_container(cfg, resolve=True),
    )


def check_card(cfg: DictConfig, dataset: OfflineTrajectories) -> None:
    """Finds out before the training whether a dataset notes all that the evaluation will need.

    Raises:
        ValueError: it does not, or its environment cannot be made as noted, or takes other actions.
    """
    card = make_card(cfg, dataset)
    where = f"{dataset.dataset_id} (meta.json)"
    try:
        env = make_env(card.env, image_size=card.model["image_size"], **card.env_kwargs)
        action_dim = env.full_action_spec_unbatched["action"].shape[-1]
        env.close()
    except (TypeError, ValueError, AttributeError) as error:
        kwargs = str(card.env_kwargs)[:80]
        raise ValueError(f"{where} notes env={card.env} and env_kwargs={kwargs}, which make no environment: {error}") from error
    if action_dim != card.action_dim:
        raise ValueError(f"{where} has actions of {card.action_dim} numbers, its environment {card.env} takes {action_dim}.")


def check_pairs(pairs: StartGoalPairs, env_kwargs: dict[str, Any], data: Path) -> None:
    """Finds out before the training whether the environment accepts all starts and goals.

    Raises:
        ValueError: it does not.
    """
    env = find_entry(pairs.env).load_env()(**env_kwargs)
    try:
        for state in (*pairs.start_state, *pairs.goal_state):
            env.check_state(STATE, state)
    except ValueError as error:
        raise ValueError(f"{data} holds states that {pairs.env} cannot be in ({str(error).rstrip('.')}): correct its env, or convert it again.") from error
    finally:
        env.close()


def evaluate_beside_random(
    policy: MPCPolicy, pairs: StartGoalPairs, card: ModelCard, *, record: int, num_workers: int, **settings: Any
) -> tuple[Evaluation, Evaluation]:
    """A policy, and uniformly random actions, on the same pairs in the environment that a model was trained on."""
    shared = {"image_size": card.model["image_size"], "env_kwargs": card.env_kwargs, **settings}
    shared["num_workers"] = num_workers or None
    outcome = evaluate_mpc(policy, pairs, record=record, description="plan", **shared)
    floor = evaluate_mpc(UniformPolicy(card.action_low, card.action_high), pairs, description="random", **shared)
    return outcome, floor


def _goals(cfg: DictConfig) -> list[tuple[int, int]]:
    """Goal offset and budget of the main test and of those of ``evaluation.also``, in environment steps."""
    goals = [(cfg.env.goal_offset, cfg.env.budget)]
    for goal in cfg.evaluation.also:
        whole = OmegaConf.is_list(goal) and all(isinstance(steps, int) and steps > 0 for steps in goal)
        if not whole or len(goal) != 2:
            raise ValueError(
                f"evaluation.also must list pairs of a goal offset and a budget in steps, such as [[100,150]], got {goal}."
            )
        goals.append(tuple(goal))
    if len({offset for offset, _ in goals}) < len(goals):
        raise ValueError(f"evaluation.also must have other goal offsets than env.goal_offset and each other, got {goals}.")
    return goals


def check_settings(cfg: DictConfig, training: bool = True) -> None:
    """Finds mistakes in a configuration before anything is written.

    Args:
        cfg: of train.py, or of collect.py.
        training: False where episodes are recorded only: there may be fewer of them than a training needs.

    Raises:
        ImportError: a package that a setting needs is missing.
        ValueError: a setting outside its range, an unknown choice, or settings that do not fit each other.
    """
    check_values(cfg)
    plan_config(cfg.plan)
    check_consistency(cfg.plan, cfg)
    check_collector(cfg.collect.collector)
    check_processes(cfg.distributed.strategy, cfg.optim.batch_size)
    for _, budget in _goals(cfg):
        check_horizon(cfg.plan, cfg.model.frame_skip, budget)
    get_device(cfg.device)
    Refinement(**cfg.refine)
    if not isinstance(cfg.name, str):
        raise ValueError(f"name={cfg.name} is a number, and a folder wants a name: name=run{cfg.name}, for instance.")
    if not cfg.name or Path(cfg.name).name != cfg.name or cfg.name.startswith("."):
        raise ValueError(f"name={cfg.name!r} must be the plain name of a folder; runs_dir says where that folder goes.")
    if cfg.logger.backend not in ("csv", "wandb", "tensorboard"):
        raise ValueError(f"unknown logger.backend {cfg.logger.backend!r}: choose csv, wandb or tensorboard.")
    check_frame_format(cfg.collect.frames)
    if cfg.logger.backend != "csv" and find_spec(cfg.logger.backend) is None:
        package = "'torchrl_ficreg[wandb]'" if cfg.logger.backend == "wandb" else cfg.logger.backend
        raise ImportError(f"logger.backend={cfg.logger.backend} needs a package: pip install {package}.")
    check_size(cfg)
    if cfg.method.get("consistency_steps", 1) > cfg.model.history:
        raise ValueError(
            f"method.consistency_steps={cfg.method.consistency_steps} is deeper than a clip: give at most "
            f"model.history={cfg.model.history}, or raise that."
        )
    start = cfg.loss.sigreg_start
    if start is not None and not (isinstance(start, (int, float)) and start > 0 and cfg.loss.sigreg_coeff > 0):
        raise ValueError(
            "loss.sigreg_start and loss.sigreg_coeff must be positive to fall from one to the other, got "
            f"{cfg.loss.sigreg_start} and {cfg.loss.sigreg_coeff}."
        )
    if not 0 <= cfg.method.get("consistency_warmup", 0.0) <= 1:
        raise ValueError(f"method.consistency_warmup must lie in [0, 1], got {cfg.method.consistency_warmup}.")
    optim, evaluation = cfg.optim, cfg.evaluation
    length, epoch = optim.schedule_epochs, evaluation.epoch
    if length is not None and not (isinstance(length, int) and length >= optim.epochs):
        raise ValueError(f"optim.schedule_epochs must be null or at least optim.epochs={optim.epochs}, got {length}.")
    if epoch is not None and not (isinstance(epoch, int) and 1 <= epoch <= optim.epochs):
        raise ValueError(f"evaluation.epoch must be null or an epoch from 1 to optim.epochs={optim.epochs}, got {epoch}.")
    if epoch is not None and cfg.refine.steps:
        raise ValueError(f"evaluation.epoch={epoch} leaves no use for refine.steps={cfg.refine.steps}: set one to null or 0.")
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
        check_precision(precision)
    parts = optim.accumulate
    local = optim.batch_size // _num_processes()
    if parts < 1 or parts > 1 and local % (2 * parts):
        raise ValueError(
            f"optim.accumulate={parts} must cut the {local} clips of a batch into equal parts of at least 2: choose another "
            "number, or another optim.batch_size."
        )
    describe_env(cfg)
    if cfg.dataset is None:
        check_recording(cfg)
    if cfg.dataset is None and training:
        check_amounts(cfg)


def check_values(cfg: DictConfig) -> None:
    """Refuses numbers that no setting can have, and names of methods that do not exist.

    Raises:
        ValueError: one is not finite, or a count is beyond all that a machine can do.
    """
    for key, value in flatten(OmegaConf.to_container(cfg)).items():
        if isinstance(value, float) and not math.isfinite(value) and key != "optim.clip_norm":  # inf: no clipping
            raise ValueError(f"{key}={value}: expected a finite number.")
        most = MOST_WORKERS if key.endswith("num_workers") else MOST_COUNT
        if isinstance(value, int) and value > most and not key.endswith("seed"):
            raise ValueError(f"{key}={value}: expected at most {most}.")
    if cfg.method.name not in METHODS:
        raise ValueError(f"method.name={cfg.method.name} is unknown: leave it out, and choose by method=.")


def make_networks_without_memory(cfg: DictConfig) -> tuple[LatentWorldModel, InverseDynamicsModel]:
    """The networks of a configuration on the meta device: sizes, and no numbers."""
    with torch.device("meta"):
        return make_world_model(model_config(cfg), action_dim=1)


def _num_processes() -> int:
    return max(world_size(), int(os.environ["WORLD_SIZE"]) if launched() else 1)


def check_size(cfg: DictConfig) -> None:
    """Builds networks and loss without their memory, and compares what they would take with what there is.

    Raises:
        ValueError: a setting that they refuse, or networks too large for this machine.
    """
    if cfg.model.predictor_depth > MOST_LAYERS:
        raise ValueError(f"model.predictor_depth={cfg.model.predictor_depth}: expected at most {MOST_LAYERS} layers.")
    try:
        model, inverse_model = make_networks_without_memory(cfg)
    except RuntimeError as error:
        raise ValueError(f"the model settings make no networks ({error}): choose smaller sizes.") from error
    params = [*model.parameters(), *inverse_model.parameters()]
    need = 4 * sum(p.numel() * p.element_size() for p in params)  # weights, gradients, two moments
    if get_device(cfg.device).type == "cuda":
        there = torch.cuda.get_device_properties(get_device(cfg.device)).total_memory
    else:
        there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else need
    there *= _num_processes()
    if need > there:
        raise ValueError(
            f"networks of {len(params)} tensors and {need / 16e9:.1f} billion weights take {need / 1e9:.0f} GB to train, this "
            f"machine has {there / 1e9:.0f} GB: lower model.image_size={cfg.model.image_size} or the widths of the model."
        )
    with torch.device("meta"):
        make_loss(cfg, model, inverse_model)


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one level of dotted names."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Writes strict JSON in one piece; a NaN or an infinity becomes null."""
    write_atomic(path, json.dumps(_finite(values), indent=2, allow_nan=False) + "\n")


def _finite(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _finite(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [_finite(value) for value in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def claim_folder(folder: Path, parent: Path | None = None) -> Path:
    """Makes a folder and proves that files can be written there, before the work whose results go into it.

    Args:
        folder: to write in.
        parent: further folder that must not be a link, because its owner need not be the user.

    Raises:
        OSError: nothing can be written there, or it is a link.
    """
    for place in (parent, folder):
        if place is not None and place.is_symlink():
            raise OSError(f"{place} is a link, through which nothing is written: remove it, or give output=<folder>.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"0")
    except OSError as error:
        raise OSError(f"cannot write in {folder} ({error.strerror}): give output=<a folder that can be written>.") from error
    return folder


def settings_of_card(card: ModelCard) -> DictConfig:
    """The configuration of the run that made a checkpoint, as plain values.

    Raises:
        ValueError: a part is missing, or a value is an interpolation: resolved, it could disclose this environment.
    """
    config = card.config if isinstance(card.config, dict) else {}
    missing = [name for name in ("plan", "env", "method", "model") if not isinstance(config.get(name), dict)]
    if missing:
        raise ValueError(f"the checkpoint's card holds no settings of {', '.join(missing)}: was it made by train.py?")
    for key, value in flatten(config).items():
        if "${" in str(value):
            raise ValueError(f"the checkpoint's card has {key}={str(value)[:80]!r}: interpolations of a card are not resolved.")
    return OmegaConf.create(config)


def result_rows(method: str, plan: DictConfig, outcome: Evaluation, floor: Evaluation) -> dict[str, Any]:
    """The entries of ``results.json`` that every evaluation has, under the same keys whatever the method."""
    return {"method": method, "search": plan.search, "policy": outcome.summary(), "random": floor.summary()}


def report(rows: list[tuple[str, dict[str, Any], str]]) -> None:
    """Prints the numbers a reader asks for first.

    Args:
        rows: name, summary and differing settings of each policy; the first one is the one just evaluated, the last one
            acts at random on the same pairs.
    """
    width = max(14, *(len(name) + 2 for name, _, _ in rows))
    print(
        f"\n{'policy':<{width}}{'success':>8}{'95 % interval':>18}{'at the end':>12}{'of those not solved at start':>30}"
        f"{'s / plan':>10}" + ("  settings that differ" if any(note for _, _, note in rows) else "")
    )
    for name, row, note in rows:
        low, high = row["success_interval"]
        count, rate = row["pairs"] - row["solved_at_start"], row["success_rate_unsolved_at_start"]
        unsolved = "of none" if rate is None else f"{rate:.1%} of {count}"  # None: every pair was solved at the start
        line = (
            f"{name:<{width}}{row['success_rate']:>8.1%}{f'{low:.1%} - {high:.1%}':>18}{row['success_rate_at_end']:>12.1%}"
            f"{unsolved:>30}{row['seconds_per_plan']:>10.2f}  {note}"
        )
        print(line.rstrip())
    first, floor = rows[0][1], rows[-1][1]
    print(f"{first['pairs']} frozen held-out pairs")
    doubts = []
    if first["solved_at_start"] > EASY_START * first["pairs"]:
        doubts.append(f"{first['solved_at_start']} of {first['pairs']} pairs are solved at the start")
    if floor["success_rate"] > EASY_RANDOM:
        doubts.append(f"random actions solve {floor['success_rate']:.1%}")
    if doubts:
        print(f"warning: {' and '.join(doubts)}: these pairs tell little; draw harder ones (env.goal_offset, env.budget).")


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
        "processor": describe_processor(),
    }
