"""What the scripts are built from: dataset, model card, loss, hooks and planner."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from run_dir import check_writable, flatten, is_writable
from torch import nn
from torchrl import torchrl_logger
from tqdm import tqdm

from torchrl_ficreg import (
    ActionEffort,
    CostSum,
    FICRegLoss,
    GoalDistance,
    InverseConsistency,
    InverseDynamicsModel,
    JointInverseLoss,
    LatentWorldModel,
    LeWMLoss,
    ModelConfig,
    MPCPolicy,
    PathDistance,
    PlanConfig,
    PLDMLoss,
    SIGReg,
    StayDistance,
)
from torchrl_ficreg._device import autocast, Precision
from torchrl_ficreg._utils import require_space
from torchrl_ficreg.data import EpisodeStore, EpisodeWriter, estimate_bytes, OfflineTrajectories
from torchrl_ficreg.data.latents import encode_episodes
from torchrl_ficreg.data.layout import META_FILE
from torchrl_ficreg.data.shards import open_store, shard_paths
from torchrl_ficreg.envs import collect_episodes, collect_on_ray, make_env
from torchrl_ficreg.envs.registry import ENVIRONMENTS
from torchrl_ficreg.modules.goal_policy import CONFIG_FILE, load_goal_policy, WEIGHTS_FILE
from torchrl_ficreg.modules.transformer import checkpoint_activations
from torchrl_ficreg.planners import SEARCHES
from torchrl_ficreg.pretrained import ModelCard
from torchrl_ficreg.trainers import CoefficientSchedule, CollapseMonitor, OfflineTrainer, PhaseLogger, stop_on_signal

DETAIL = "detail"  # the argument of environments that chooses how pictures are drawn
SIGREG_DECAY_FRACTION = 0.8  # share of training after which lambda has its last value
COSTS = {"goal": GoalDistance, "path": PathDistance, "stay": StayDistance}
COST_FIELDS = ("cost", "stay_discount", "effort", "consistency")  # of the plan group; the rest are fields of the search's configuration


# Dataset


def dataset_path(cfg: DictConfig) -> Path:
    """The folder of a configuration's own dataset."""
    data = cfg.env.data
    return Path(cfg.data_dir) / f"{cfg.env.name}_{cfg.model.image_size}px_{data.episodes}episodes_seed{data.seed}"


def open_dataset(cfg: DictConfig) -> EpisodeStore:
    """The dataset named by ``dataset``, or the configuration's own one, of which missing episodes are recorded.

    Raises:
        ValueError: the named one belongs to another environment, or has frames of another size or that are not square.
    """
    if cfg.dataset is None:
        return open_store(collect_dataset(cfg).absolute())
    store = open_store(Path(cfg.dataset).expanduser().absolute())
    env, (_, height, size) = store.header.meta.get("env"), store.header.shapes["pixels"]
    if env != cfg.env.name and env in ENVIRONMENTS:
        raise ValueError(f"the episodes of dataset={cfg.dataset} are of {env}: give env={env}.")
    if env != cfg.env.name:
        raise ValueError(
            f"the episodes of dataset={cfg.dataset} are of {env}, in which these scripts cannot plan (they can in "
            f"{sorted(ENVIRONMENTS)}): train on them in Python, with OfflineTrajectories and OfflineTrainer."
        )
    if height != size:
        raise ValueError(
            f"dataset={cfg.dataset} has frames of {height} x {size} pixels, the encoders take square ones: convert it again "
            f"into another target with image_size={min(height, size)}, which scales both sides to that."
        )
    if size != cfg.model.image_size:
        raise ValueError(
            f"dataset={cfg.dataset} has frames of {size} pixels: give model.image_size={size}, or convert it with "
            f"image_size={cfg.model.image_size}."
        )
    ours, theirs = OmegaConf.to_container(cfg.env.kwargs), store.header.meta.get("env_kwargs")
    theirs = theirs if isinstance(theirs, dict) else {}  # make_card() refuses anything else
    differ = [
        f"{key}={theirs[key]}, not {value}"
        for key, value in ours.items()
        if theirs.get(key, value) != value and key != DETAIL  # make_card() takes the dataset's
    ]
    if differ:
        torchrl_logger.warning(
            f"dataset={cfg.dataset} was made with {'; '.join(differ)}: the run is evaluated with its own env.kwargs."
        )
    return store


def collect_dataset(cfg: DictConfig) -> Path:
    """Records the missing episodes of the configuration's own dataset, if any, and returns its folder.

    Raises:
        ValueError: ``collect.ray`` is given, and the dataset was begun without it.
    """
    path, data = dataset_path(cfg), cfg.env.data
    low, high, state_size = describe_env(cfg)
    meta = {
        "env": cfg.env.name,
        "env_kwargs": OmegaConf.to_container(cfg.env.kwargs),
        "record_kwargs": OmegaConf.to_container(data.kwargs),
        "expert": OmegaConf.to_container(data.expert),
        "image_size": cfg.model.image_size,
        "max_steps": data.max_steps,
        "stop_at_success": data.stop_at_success,
        "seed": data.seed,
        "action_low": low,
        "action_high": high,
    }
    whole = (path / META_FILE).exists()  # one dataset, no folder of shards
    if (whole or shard_paths(path)) and not is_writable(path):
        store = open_store(path)  # raises if it is incomplete
        differ = [name for name, value in json.loads(json.dumps(meta)).items() if store.header.meta.get(name) != value]
        if differ:
            raise ValueError(f"{path} was recorded with another {', '.join(differ)}: repeat those, or give another data_dir.")
        return path
    # A new dataset needs room for all episodes, checked before its folder is created; a begun one for the missing ones.
    size = estimate_bytes(data.max_steps + 1, cfg.model.image_size, len(low), state_size, frames=cfg.collect.frames)
    if not path.exists():
        check_writable(path, "data_dir")
        require_space(path, data.episodes * size)
    frames, settings = cfg.collect.frames, record_settings(cfg)
    if not whole and (cfg.collect.ray is not None or shard_paths(path)):  # shards that exist are continued on Ray
        tasks = 1 if cfg.collect.ray is None else cfg.collect.ray
        return collect_on_ray(path, cfg.env.name, data.episodes, num_tasks=tasks, meta=meta, frames=frames, **settings)
    # Several runs may start at once: one of them records while the others wait for the writer's lock.
    with EpisodeWriter(path, target_episodes=data.episodes, meta=meta, frames=frames, wait=True) as writer:
        if writer.complete:
            return path
        if cfg.collect.ray is not None:
            raise ValueError(f"{path} was begun without Ray: leave out collect.ray, which continues it.")
        require_space(path, (data.episodes - writer.num_episodes) * size)
        episodes = collect_episodes(
            cfg.env.name, data.episodes, start=writer.num_episodes, num_workers=cfg.collect.num_workers, **settings
        )
        first_step, done = writer.num_steps, writer.num_episodes
        with tqdm(total=data.episodes, initial=done, desc="collect", unit="episode", dynamic_ncols=True) as bar:
            for episode in episodes:
                writer.append(episode)
                bar.update()
                rate = (writer.num_steps - first_step) / max(bar.format_dict["elapsed"], 1e-9)
                bar.set_postfix_str(f"{rate:.0f} frames/s", refresh=False)
    return path


def record_settings(cfg: DictConfig) -> dict[str, Any]:
    """Arguments of :func:`~torchrl_ficreg.envs.collect_episodes` that define an episode."""
    data = cfg.env.data
    return {
        "seed": data.seed,
        "image_size": cfg.model.image_size,
        "max_steps": data.max_steps,
        "stop_at_success": data.stop_at_success,
        "expert_kwargs": OmegaConf.to_container(data.expert),
        "env_kwargs": {**OmegaConf.to_container(cfg.env.kwargs), **OmegaConf.to_container(data.kwargs)},
    }


def make_dataset(cfg: DictConfig, data: EpisodeStore | Path, split: str, **changes: Any) -> OfflineTrajectories:
    """One split of a dataset as clips for the model of a configuration; splits of one store share its files."""
    settings = {
        "split": split,
        "num_frames": clip_frames(cfg),
        "frame_skip": cfg.model.frame_skip,
        "batch_size": cfg.optim.batch_size,
        "drop_last": split == "train",
        "seed": cfg.seed,
        "pin_memory": True,  # no effect without a CUDA device
    }
    return OfflineTrajectories(data, **{**settings, **changes})


def clip_frames(cfg: DictConfig) -> int:
    """T, frames of a clip: ``loss.num_frames``, or so many that the deepest rollout can start from a whole history."""
    loss = cfg.get("loss", {})  # which the cards of earlier runs may lack, or its newer fields
    given, steps = loss.get("num_frames"), max(loss.get("prediction_steps", 1), cfg.method.get("consistency_steps", 1))
    return cfg.model.history + steps if given is None else given


def describe_env(cfg: DictConfig) -> tuple[list[float], list[float], int]:
    """Bounds of a raw action [A], in environment units, and the size of the state."""
    try:
        env = make_env(cfg.env.name, image_size=cfg.model.image_size, **OmegaConf.to_container(cfg.env.kwargs))
    except TypeError as error:  # the constructor has no such argument
        raise ValueError(f"env.kwargs={cfg.env.kwargs} do not make {cfg.env.name}: {error}.") from error
    space = env.full_action_spec_unbatched["action"].space
    size = env.observation_spec["state"].shape[-1]
    env.close()
    return space.low.tolist(), space.high.tolist(), size


# Model and training


def get_device(name: str) -> torch.device:
    """The device of a configuration; ``auto`` is CUDA where available.

    Raises:
        ValueError: this machine has no such device.
    """
    try:
        torch.device("cpu" if name == "auto" else name)
    except RuntimeError as error:  # whose message lists all backends of PyTorch
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


def make_loss(cfg: DictConfig, model: LatentWorldModel, inverse_model: InverseDynamicsModel) -> LeWMLoss:
    """The loss of a configuration's ``method``.

    Raises:
        ValueError: an unknown method, or a setting that the loss refuses.
    """
    networks = (model.encoder, model.predictor, inverse_model)
    if cfg.optim.checkpoint_activations:
        checkpoint_activations(model)
    name, weights = cfg.method.name, cfg.loss
    settings = {key: value for key, value in cfg.method.items() if key not in ("name", "consistency_warmup")}
    settings["prediction_steps"] = weights.get("prediction_steps", 1)
    sigreg = SIGReg(seed=cfg.seed).to(next(model.parameters()).device)
    if name == "lewm":
        return LeWMLoss(*networks[:2], sigreg=sigreg, sigreg_coeff=weights.sigreg_coeff, **settings)
    settings |= {} if name == "pldm" else {"sigreg": sigreg, "sigreg_coeff": weights.sigreg_coeff, "idm_coeff": weights.idm_coeff}
    settings |= {"consistency_coeff": weights.consistency_coeff} if name == "ficreg" else {}
    kinds = {"ficreg": FICRegLoss, "joint_inverse": JointInverseLoss, "pldm": PLDMLoss}
    if name not in kinds:
        raise ValueError(f"method.name={name} is unknown: leave it out, and choose by method=.")
    return kinds[name](*networks, **settings)


def trainer_settings(cfg: DictConfig) -> dict[str, Any]:
    """Arguments of :class:`~torchrl_ficreg.trainers.OfflineTrainer` in ``optim``, which also has others' settings."""
    return {key: value for key, value in cfg.optim.items() if key not in ("batch_size", "checkpoint_activations")}


def refined(cfg: DictConfig) -> DictConfig:
    """The configuration of the training on latents: settings of ``refine`` in place of others."""
    changed, own = cfg.copy(), cfg.refine
    changed.optim.update({"epochs": own.epochs, "batch_size": own.batch_size, "lr": own.lr})
    changed.optim.update({"schedule_epochs": None, "accumulate": 1, "compile": False})
    if own.prediction_steps is not None:
        changed.loss.prediction_steps = own.prediction_steps
    if own.consistency_steps is not None and "consistency_steps" in changed.method:
        changed.method.consistency_steps = own.consistency_steps
    if own.num_frames is not None or own.prediction_steps is not None or own.consistency_steps is not None:
        changed.loss.num_frames = own.num_frames  # null: as long as its own steps need
    return changed


def encoder_of(model: LatentWorldModel, precision: Precision) -> Callable[[torch.Tensor], torch.Tensor]:
    """Frames [n, 3, H, W] -> latents [n, D], on the model's device."""
    device = model.action_mean.device

    def encode(pixels: torch.Tensor) -> torch.Tensor:
        with autocast(device, precision):
            return model.encode(pixels.to(device))

    return encode


def refine(
    cfg: DictConfig,
    data: EpisodeStore,
    networks: tuple[LatentWorldModel, InverseDynamicsModel],
    folder: Path,
    logger: PhaseLogger | None,
) -> float:
    """Trains predictor and inverse model further, on latents of the frozen encoder, and returns the seconds it took.

    Raises:
        FloatingPointError: a loss or a gradient is not finite.
        ValueError: ``folder`` holds checkpoints of another encoder.
    """
    (model, inverse_model), cfg = networks, refined(cfg)
    encode, clips = encoder_of(model.eval(), cfg.optim.precision), {}
    for split in ("train", "validation"):
        frames = make_dataset(cfg, data, split, statistics=model.statistics)
        latent = encode_episodes(frames, encode, description=f"encode {split}")
        ahead = 1 if split == "train" else None
        clips[split] = make_dataset(cfg, data, split, statistics=model.statistics, latent=latent, prefetch=ahead)
    trainer = OfflineTrainer(
        make_loss(cfg, model, inverse_model),
        clips["train"],
        run_dir=folder,
        validation_buffer=clips["validation"],
        log_interval=cfg.logger.interval,
        logger=logger,
        description="refine",
        **trainer_settings(cfg),
    )
    encoder = {name: value.clone() for name, value in model.encoder.state_dict().items()}
    resumed = trainer.resume()
    if not all(value.equal(encoder[name]) for name, value in model.encoder.state_dict().items()):
        raise ValueError(f"{folder} is a training on latents of another encoder: move it away, and the same command begins anew.")
    if resumed and trainer.step < trainer.total_steps:
        print(f"continuing {folder} after step {trainer.step} of {trainer.total_steps}")
    try:
        with stop_on_signal(trainer, signal.SIGTERM, signal.SIGINT):
            trainer.train()
    except FloatingPointError as error:
        raise FloatingPointError(f"refine, {error}") from error
    return trainer.clock.seconds


def add_hooks(cfg: DictConfig, trainer: OfflineTrainer) -> None:
    """Registers the collapse monitor and the schedules of coefficients."""
    CollapseMonitor(cfg.logger.alarm_interval, cfg.optim.precision, trainer.metrics_table).register(trainer)
    start, end = cfg.loss.sigreg_start, cfg.loss.sigreg_coeff
    if start is not None and cfg.method.name != "pldm":  # which has no SIGReg
        schedule = CoefficientSchedule(
            "sigreg_coeff",
            lambda done: start * (end / start) ** min(1.0, done / SIGREG_DECAY_FRACTION),
            trainer.total_steps,
        )
        schedule.register(trainer)
    share = cfg.method.get("consistency_warmup", 0.0)
    if share > 0:
        full = cfg.loss.consistency_coeff
        ramp = CoefficientSchedule("consistency_coeff", lambda done: full * min(1.0, done / share), trainer.total_steps)
        ramp.register(trainer)


def make_card(cfg: DictConfig, dataset: OfflineTrajectories) -> ModelCard:
    """The model card of the run's checkpoints, once the dataset describes an environment that fits its actions.

    Raises:
        ValueError: the dataset names no environment, no bounds of the actions, or wrong ones.
    """
    meta = dataset.meta
    where = f"{dataset.dataset_id} (meta.json)"
    missing = [name for name in ("env", "env_kwargs", "action_low", "action_high") if name not in meta]
    if missing:
        raise ValueError(f"{where} does not note {', '.join(missing)}: give them to EpisodeWriter(meta=...), or to convert.py.")
    bounds = [meta["action_low"], meta["action_high"]]
    try:
        low, high = (np.array(bound, dtype=np.float64) for bound in bounds)
        valid = low.shape == high.shape == (dataset.action_dim,) and (low <= high).all() and np.isfinite([low, high]).all()
    except (ValueError, TypeError):
        valid = False
    if not valid:
        raise ValueError(
            f"{where} notes action_low={str(bounds[0])[:60]} and action_high={str(bounds[1])[:60]}: expected two lists of "
            f"{dataset.action_dim} finite numbers, low <= high."
        )
    if not isinstance(meta["env_kwargs"], dict):
        raise ValueError(f"{where} notes env_kwargs={str(meta['env_kwargs'])[:60]}: expected names and values of settings.")
    env_kwargs = {**meta["env_kwargs"], **OmegaConf.to_container(cfg.env.kwargs)}
    env_kwargs.pop(DETAIL, None)  # an evaluation draws as the recording did, by default where the dataset notes no detail
    if DETAIL in meta["env_kwargs"]:
        env_kwargs[DETAIL] = meta["env_kwargs"][DETAIL]
    card = ModelCard(
        model=asdict(model_config(cfg)),
        env=meta["env"],
        env_kwargs=env_kwargs,
        action_low=low.tolist(),
        action_high=high.tolist(),
        config=OmegaConf.to_container(cfg, resolve=True),
    )
    try:
        env = make_env(card.env, image_size=card.model["image_size"], **card.env_kwargs)
        action_dim = env.full_action_spec_unbatched["action"].shape[-1]
        env.close()
    except (TypeError, ValueError, AttributeError) as error:
        kwargs = str(card.env_kwargs)[:80]
        raise ValueError(f"{where} notes env={card.env} and env_kwargs={kwargs}, which make no environment: {error}") from error
    if action_dim != card.action_dim:
        raise ValueError(f"{where} has actions of {card.action_dim} numbers, its environment {card.env} takes {action_dim}.")
    return card


def settings_of_card(card: ModelCard) -> DictConfig:
    """The configuration of the run that made a checkpoint, as plain values.

    Raises:
        ValueError: a part is missing, or a value is an interpolation: resolved, it could disclose environment variables.
    """
    config = card.config if isinstance(card.config, dict) else {}
    missing = [name for name in ("plan", "env", "method", "model") if not isinstance(config.get(name), dict)]
    if missing:
        raise ValueError(f"the checkpoint's card holds no settings of {', '.join(missing)}: was it made by train.py?")
    for key, value in flatten(config).items():
        if "${" in str(value):
            raise ValueError(f"the checkpoint's card has {key}={str(value)[:80]!r}: interpolations of a card are not resolved.")
    return OmegaConf.create(config)


# Planning


def plan_config(plan: DictConfig) -> PlanConfig:
    """The settings of the search.

    Raises:
        ValueError: an unknown search or cost, a setting of another search, or one outside its range.
    """
    values = OmegaConf.to_container(plan)
    search = values.pop("search")
    if search not in SEARCHES:
        raise ValueError(f"unknown plan.search {search!r}: choose one of {sorted(SEARCHES)}.")
    if values.get("cost", "goal") not in COSTS:
        raise ValueError(f"unknown plan.cost {values['cost']!r}: choose one of {sorted(COSTS)}.")
    if not 0 < values.get("stay_discount", 1.0) <= 1:
        raise ValueError(f"plan.stay_discount must lie in (0, 1], got {values['stay_discount']}.")
    wrong = [f"plan.{name}={values[name]}" for name in COST_FIELDS[2:] if not 0 <= values.get(name, 0.0) < math.inf]
    if wrong:
        raise ValueError(f"must be finite and not negative: {', '.join(wrong)}.")
    settings = {key: value for key, value in values.items() if key not in (*COST_FIELDS, "policy")}
    settings = _rename_earlier(search, settings)
    kind = SEARCHES[search].config_class
    foreign = sorted(settings.keys() - {field.name for field in fields(kind)})
    if foreign:
        raise ValueError(f"plan.search={search} has no {', '.join(foreign)}: choose it by plan={search} instead.")
    return kind(**settings)


def _rename_earlier(search: str, settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of earlier runs under their present names, without those that the search does not use."""
    unused = {"gradient": ("stop_spread",), "shooting": ("stop_spread", "num_elites"), "policy": ("stop_spread", "std")}
    settings = {key: value for key, value in settings.items() if key not in unused.get(search, ())}
    if "stop_spread" in settings:
        settings.setdefault("stop_std", settings.pop("stop_spread"))
    return settings


def make_cost(plan: DictConfig, inverse_model: InverseDynamicsModel) -> nn.Module:
    """The cost of the ``plan`` group; further terms are weighted relative to the standard deviation of the first."""
    name = plan.get("cost", "goal")
    terms, weights = [COSTS[name](*([plan.get("stay_discount", 0.3)] if name == "stay" else []))], [1.0]
    effort, consistency = plan.get("effort", 0.0), plan.get("consistency", 0.0)
    if effort:
        terms, weights = [*terms, ActionEffort()], [*weights, effort]
    if consistency:
        terms, weights = [*terms, InverseConsistency(inverse_model.eval())], [*weights, consistency]
    return CostSum(terms, weights, scale_free=True) if len(terms) > 1 else terms[0]


def make_policy(
    plan: DictConfig, model: LatentWorldModel, inverse_model: InverseDynamicsModel, card: ModelCard, run_dir: Path
) -> MPCPolicy:
    """The planner of a configuration's ``plan`` group as a policy: one raw action per environment step.

    Raises:
        FileNotFoundError: ``plan.policy`` names no goal-conditioned policy.
    """
    folder, policy = plan.get("policy"), None
    if folder is not None:
        folder = run_dir / "goal_policy" if folder == "auto" else Path(folder)
        if not any((folder / name).exists() for name in (CONFIG_FILE, WEIGHTS_FILE)):
            raise FileNotFoundError(f"no policy in {folder}: run train_policy.py checkpoint={run_dir} first.")
        policy = load_goal_policy(folder, model, device=model.action_mean.device)
    bounds, cost = (card.action_low, card.action_high), make_cost(plan, inverse_model)
    return MPCPolicy(SEARCHES[plan.search](model, plan_config(plan), action_bounds=bounds, cost=cost, policy=policy))
