"""Settings of the scripts: their names, types and ranges, and the checks that come before any work.

The schemas are registered in Hydra's ConfigStore, so that Hydra refuses an unknown field and a value of another type. The
values, and what each field means, are in the YAML files below ``config/``. The sizes of the networks are those of
:meth:`torchrl_ficreg.ModelConfig.preset`; what a search, a loss, an environment or an expert accepts is checked by its
constructor.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Dict, get_origin, get_type_hints, List, Literal, Optional

import numpy as np
import torch
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, MISSING, OmegaConf
from run_dir import check_writable, flatten
from utils import clip_frames, describe_env, get_device, make_loss, model_config, plan_config, record_settings, refined

from torchrl_ficreg import LatentWorldModel, make_world_model, ModelConfig
from torchrl_ficreg.data.dataset import split_episodes, SPLITS
from torchrl_ficreg.data.frames import check_frame_format
from torchrl_ficreg.distributed import planned_world_size
from torchrl_ficreg.envs.collect import EpisodeRecorder
from torchrl_ficreg.envs.registry import find_entry
from torchrl_ficreg.keys import GOAL_STATE, STATE
from torchrl_ficreg.modules.config import PRESETS
from torchrl_ficreg.trainers.checkpoint import require_checkpoint_space
from torchrl_ficreg.trainers.stepper import check_batch_size

MAX_COUNT, MAX_WORKERS, MAX_LAYERS = 10**8, 1024, 1000  # of any count, of processes, of layers of the predictor
LOGGERS = {"csv": "", "wandb": "'torchrl_ficreg[wandb]'", "tensorboard": "tensorboard"}  # and the package each needs


class SettingError(ValueError):
    """A setting outside its range."""


def _setting(accepts: Callable[[Any], bool], expected: str) -> Any:
    return dataclasses.field(default=MISSING, metadata={"accepts": accepts, "expected": expected})


def _at_least(least: int) -> Any:
    return _setting(lambda value: value >= least, f"at least {least}")


def _positive() -> Any:
    return _setting(lambda value: value > 0, "more than 0")


def _seed() -> Any:
    return _setting(lambda value: 0 <= value < 2**63, "0 to 2^63 - 1")


def _choice(*choices: str) -> Any:
    return _setting(lambda value: value in choices, f"one of {list(choices)}")


def _schema(config_class: type, name: str, **extra: type) -> type:
    """The fields of a dataclass in types that OmegaConf knows: a string for a literal, a list for a tuple."""
    plain = {Literal: str, tuple: List[int]}
    known = [(key, plain.get(get_origin(kind), kind)) for key, kind in get_type_hints(config_class).items()]
    fields = [(key, kind, MISSING) for key, kind in [*extra.items(), *known]]
    return dataclasses.make_dataclass(name, fields, namespace={"__module__": __name__})


Model = _schema(ModelConfig, "Model", preset=str)


@dataclasses.dataclass
class Data:
    """``env.data``: the recording of an environment's dataset."""

    episodes: int = _at_least(1)
    max_steps: int = _at_least(1)
    stop_at_success: bool = MISSING
    kwargs: Dict[str, Any] = dataclasses.field(default_factory=dict)
    seed: int = _seed()
    expert: Dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass
class Env:
    """``env``: the environment and its planning task."""

    name: str = MISSING
    kwargs: Dict[str, Any] = dataclasses.field(default_factory=dict)
    data: Data = dataclasses.field(default_factory=Data)
    num_workers: int = _at_least(0)
    goal_offset: int = _at_least(1)
    budget: int = _at_least(1)
    state_unit: str = MISSING


@dataclasses.dataclass
class Loss:
    """``loss``: weights of the terms, and the rollouts they are computed on."""

    sigreg_coeff: float = MISSING
    sigreg_start: Optional[float] = MISSING
    idm_coeff: float = MISSING
    consistency_coeff: float = MISSING
    prediction_steps: int = _at_least(1)
    num_frames: Optional[int] = _at_least(2)


@dataclasses.dataclass
class AdamW:
    """What ``optim`` has in every script that trains."""

    batch_size: int = _at_least(1)
    lr: float = _positive()
    weight_decay: float = _setting(lambda value: value >= 0, "at least 0")
    warmup: float = _setting(lambda value: 0 <= value < 1, "a number in [0, 1)")
    clip_norm: float = _positive()
    precision: str = _choice("auto", "fp32", "bf16")


@dataclasses.dataclass
class Optim(AdamW):
    """``optim`` of train.py."""

    epochs: int = _at_least(1)
    schedule_epochs: Optional[int] = MISSING
    validation_batches: int = _at_least(1)
    accumulate: int = _at_least(1)
    checkpoint_activations: bool = MISSING
    compile: bool = MISSING


@dataclasses.dataclass
class Collect:
    """``collect``: how episodes are recorded."""

    num_workers: int = _at_least(0)
    frames: str = MISSING
    ray: Optional[int] = _at_least(1)


@dataclasses.dataclass
class Evaluation:
    """``evaluation``: planning on start-goal pairs."""

    num_pairs: int = _at_least(1)
    seed: int = _seed()
    num_envs: int = _at_least(1)
    num_workers: int = _at_least(0)
    record: int = _at_least(1)
    every: int = _at_least(0)
    every_pairs: int = _at_least(1)
    epoch: Optional[int] = _at_least(1)
    also: List[Any] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class Refine:
    """``refine``: training on the latents of the frozen encoder."""

    epochs: int = _at_least(0)
    batch_size: int = _at_least(2)
    lr: float = MISSING
    prediction_steps: Optional[int] = _at_least(1)
    consistency_steps: Optional[int] = _at_least(1)
    num_frames: Optional[int] = _at_least(2)


@dataclasses.dataclass
class Logging:
    """``logger``: where metrics go."""

    backend: str = _choice(*LOGGERS)
    project: str = MISSING
    mode: str = MISSING
    interval: int = _at_least(1)
    alarm_interval: int = _at_least(1)


@dataclasses.dataclass
class Train:
    """Settings of train.py and collect.py."""

    env: Env = dataclasses.field(default_factory=Env)
    model: Model = dataclasses.field(default_factory=Model)
    method: Any = MISSING
    plan: Any = MISSING
    loss: Loss = dataclasses.field(default_factory=Loss)
    optim: Optim = dataclasses.field(default_factory=Optim)
    name: str = _setting(
        lambda name: name and Path(name).name == name and not name.startswith("."),
        "the plain name of a folder (runs_dir says where that folder goes)",
    )
    seed: int = _seed()
    resume: str = MISSING
    device: str = MISSING
    runs_dir: str = MISSING
    data_dir: str = MISSING
    dataset: Optional[str] = MISSING
    collect: Collect = dataclasses.field(default_factory=Collect)
    evaluation: Evaluation = dataclasses.field(default_factory=Evaluation)
    refine: Refine = dataclasses.field(default_factory=Refine)
    logger: Logging = dataclasses.field(default_factory=Logging)


@dataclasses.dataclass
class Evaluate:
    """Settings of evaluate.py."""

    plan: Any = MISSING
    checkpoint: str = MISSING
    pairs: Optional[str] = MISSING
    budget: Optional[int] = _at_least(1)
    device: str = MISSING
    num_envs: int = _at_least(1)
    num_workers: int = _at_least(0)
    record: int = _at_least(0)
    output: Optional[str] = MISSING


@dataclasses.dataclass
class Convert:
    """Settings of convert.py."""

    env: Any = None
    source: str = MISSING
    target: str = MISSING
    format: str = MISSING
    env_name: Optional[str] = MISSING
    frames: str = MISSING
    image_size: Optional[int] = MISSING
    limit: Optional[int] = MISSING
    pixels: Optional[str] = MISSING
    action: Optional[str] = MISSING
    state: Any = None
    shift: int = MISSING
    action_low: Any = None
    action_high: Any = None
    check_alignment: bool = MISSING
    allow_incomplete: bool = MISSING
    skip_bad_episodes: bool = MISSING


@dataclasses.dataclass
class PolicyNetwork:
    """``policy``: sizes of the goal-conditioned policy."""

    hidden_dim: int = _at_least(1)
    depth: int = _at_least(1)


@dataclasses.dataclass
class PolicyOptim(AdamW):
    """``optim`` of train_policy.py."""

    steps: int = _at_least(1)


@dataclasses.dataclass
class TrainPolicy:
    """Settings of train_policy.py."""

    checkpoint: str = MISSING
    dataset: Optional[str] = MISSING
    output: Optional[str] = MISSING
    overwrite: bool = MISSING
    seed: int = _seed()
    device: str = MISSING
    max_blocks: int = _at_least(1)
    policy: PolicyNetwork = dataclasses.field(default_factory=PolicyNetwork)
    optim: PolicyOptim = dataclasses.field(default_factory=PolicyOptim)
    validation_rows: int = _at_least(1)
    frames_per_batch: int = _at_least(1)


def register() -> None:
    """Puts the schemas, and the presets of the model, where the YAML files find them."""
    store = ConfigStore.instance()
    for script, schema in {"train": Train, "evaluate": Evaluate, "convert": Convert, "train_policy": TrainPolicy}.items():
        store.store(f"{script}_schema", schema)
    for preset, config in PRESETS.items():
        store.store(preset, {"preset": preset, **dataclasses.asdict(config)}, group="preset")


register()


def check_ranges(cfg: DictConfig) -> None:
    """Refuses numbers and choices that the schema of a configuration excludes.

    Raises:
        SettingError: all of them, in one message.
    """
    wrong = list(_out_of_range(cfg))
    for key, value in flatten(OmegaConf.to_container(cfg, resolve=True)).items():
        limit = MAX_WORKERS if key.endswith("num_workers") else MAX_COUNT
        if isinstance(value, float) and not math.isfinite(value) and not key.endswith("clip_norm"):  # inf: no clipping
            wrong.append(f"{key}={value}: expected a finite number")
        elif isinstance(value, int) and value > limit and not key.endswith("seed"):
            wrong.append(f"{key}={value}: expected at most {limit}")
    if wrong:
        raise SettingError(f"{'; '.join(wrong)}.")


def _out_of_range(cfg: DictConfig, prefix: str = "") -> Iterator[str]:
    for field in dataclasses.fields(OmegaConf.get_type(cfg)):
        value = None if OmegaConf.is_missing(cfg, field.name) else cfg[field.name]
        if isinstance(value, DictConfig) and dataclasses.is_dataclass(OmegaConf.get_type(value)):
            yield from _out_of_range(value, f"{prefix}{field.name}.")
        elif value is not None and "accepts" in field.metadata and not field.metadata["accepts"](value):
            yield f"{prefix}{field.name}={value}: expected {field.metadata['expected']}"


def check_settings(cfg: DictConfig, training: bool = True) -> None:
    """Finds settings that do not fit each other or this machine, before anything is written.

    Args:
        cfg: of train.py, or of collect.py.
        training (bool, optional): False where episodes are recorded only: there may be fewer of them than a training
            needs. Default: ``True``.

    Raises:
        ImportError: a package that a setting needs is missing.
        OSError: the run's folder cannot be written, or has no room for a checkpoint.
        ValueError: everything else.
    """
    optim, evaluation = cfg.optim, cfg.evaluation
    plan_config(cfg.plan)
    check_consistency(cfg.plan, cfg)
    if cfg.collect.ray is not None and find_spec("ray") is None:
        raise ImportError("collect.ray needs a package: pip install 'torchrl_ficreg[ray]'.")
    check_frame_format(cfg.collect.frames)
    check_batch_size(optim.batch_size)
    for _, budget in goals(cfg):
        check_horizon(cfg.plan, cfg.model.frame_skip, budget)
    if not cfg.refine.lr > 0:
        raise ValueError(f"refine.lr must be positive, got {cfg.refine.lr}.")
    _check_clips(cfg, "loss", "method")
    _check_clips(refined(cfg), "refine", "refine")
    if cfg.logger.backend != "csv" and find_spec(cfg.logger.backend) is None:
        backend = cfg.logger.backend
        raise ImportError(f"logger.backend={backend} needs a package: pip install {LOGGERS[backend]}.")
    model = _check_networks(cfg)
    start, end = cfg.loss.sigreg_start, cfg.loss.sigreg_coeff
    if start is not None and not (start > 0 and end > 0):
        raise ValueError(
            f"loss.sigreg_start and loss.sigreg_coeff must be positive to fall from one to the other, got {start} and {end}."
        )
    if optim.schedule_epochs is not None and optim.schedule_epochs < optim.epochs:
        raise ValueError(
            f"optim.schedule_epochs must be null or at least optim.epochs={optim.epochs}, got {optim.schedule_epochs}."
        )
    epoch = evaluation.epoch
    if epoch is not None and epoch > optim.epochs:
        raise ValueError(f"evaluation.epoch must be null or an epoch from 1 to optim.epochs={optim.epochs}, got {epoch}.")
    if epoch is not None and cfg.refine.epochs:
        raise ValueError(f"evaluation.epoch={epoch} leaves no use for refine.epochs={cfg.refine.epochs}: set one to null or 0.")
    local = optim.batch_size // planned_world_size()
    if optim.accumulate > 1 and local % (2 * optim.accumulate):
        raise ValueError(
            f"optim.accumulate={optim.accumulate} must divide the {local} clips of a process into equal micro-batches of at "
            "least 2 clips: choose another number, or another optim.batch_size."
        )
    describe_env(cfg)
    if cfg.dataset is None:
        _check_recording(cfg)
    if cfg.dataset is None and training:
        _check_amounts(cfg)
    if training:
        run_dir = Path(cfg.runs_dir) / cfg.name
        check_writable(run_dir, "runs_dir")
        require_checkpoint_space(run_dir, model.parameters())


def _check_clips(cfg: DictConfig, section: str, method_section: str) -> None:
    """Refuses clips that are shorter than the rollouts of the loss.

    Args:
        cfg: the whole configuration of a training.
        section: of ``prediction_steps`` and ``num_frames`` in messages.
        method_section: of ``consistency_steps`` in messages.

    Raises:
        ValueError: a rollout is deeper than a clip.
    """
    frames = clip_frames(cfg)
    steps = {f"{section}.prediction_steps": cfg.loss.prediction_steps}
    steps[f"{method_section}.consistency_steps"] = cfg.method.get("consistency_steps", 1)
    for name, depth in steps.items():
        if depth >= frames:
            raise ValueError(
                f"{name}={depth} needs clips of at least {depth + 1} frames, {section}.num_frames gives {frames}: raise it, or "
                "set it to null, which makes clips long enough."
            )


def goals(cfg: DictConfig) -> list[tuple[int, int]]:
    """Goal offset and budget, in environment steps, of the main test and of those of ``evaluation.also``.

    Raises:
        ValueError: ``evaluation.also`` is no list of such pairs, or repeats an offset.
    """
    tests = [(cfg.env.goal_offset, cfg.env.budget)]
    for test in cfg.evaluation.also:
        whole = OmegaConf.is_list(test) and all(type(steps) is int and steps > 0 for steps in test)
        if not whole or len(test) != 2:
            raise ValueError(
                f"evaluation.also must list pairs of a goal offset and a budget in steps, such as [[100,150]], got {test}."
            )
        tests.append(tuple(test))
    if len({offset for offset, _ in tests}) < len(tests):
        raise ValueError(f"evaluation.also must have other goal offsets than env.goal_offset and each other, got {tests}.")
    return tests


def check_horizon(plan: DictConfig, frame_skip: int, budget: int) -> None:
    """Refuses a horizon beyond the budget.

    Raises:
        ValueError: the horizon, in environment steps, exceeds the budget.
    """
    if plan.horizon * frame_skip > budget:
        raise ValueError(
            f"plan.horizon={plan.horizon} blocks of {frame_skip} steps reach beyond the budget of {budget} steps: "
            f"set plan.horizon (and plan.receding_horizon) to at most {budget // frame_skip}, or raise the budget."
        )


def check_consistency(plan: DictConfig, config: DictConfig | dict[str, Any]) -> None:
    """Refuses to plan with an inverse model that a run does not train.

    Args:
        plan: the ``plan`` group.
        config: the whole configuration of the run.

    Raises:
        ValueError: ``plan.consistency`` is not zero, and nothing trains the inverse model.
    """
    if not plan.get("consistency", 0.0) > 0:
        return
    method, loss = config["method"], config.get("loss", {})
    weight = {"lewm": 0.0, "pldm": method.get("idm_coeff")}.get(method["name"], loss.get("idm_coeff"))
    if weight == 0:
        raise ValueError(
            f"plan.consistency={plan.consistency} asks the inverse model, which method={method['name']} has not trained "
            "with these settings: give plan.consistency=0.0, or train with idm_coeff > 0 (method=ficreg, for instance)."
        )


def _check_networks(cfg: DictConfig) -> LatentWorldModel:
    """Lets networks and loss check their settings, on the meta device, where they take no memory.

    Raises:
        ValueError: a setting that they refuse, or networks too large for this machine.
    """
    if cfg.model.predictor_depth > MAX_LAYERS:
        raise ValueError(f"model.predictor_depth={cfg.model.predictor_depth}: expected at most {MAX_LAYERS} layers.")
    method, device = cfg.method, get_device(cfg.device)
    with torch.device("meta"):
        try:
            model, inverse_model = make_world_model(model_config(cfg), action_dim=1)
        except RuntimeError as error:
            raise ValueError(f"the model settings make no networks ({error}): choose smaller sizes.") from error
        make_loss(cfg, model, inverse_model)
    if not 0 <= method.get("consistency_warmup", 0.0) <= 1:
        raise ValueError(f"method.consistency_warmup must lie in [0, 1], got {method.consistency_warmup}.")
    params = [*model.parameters(), *inverse_model.parameters()]
    need = 4 * sum(p.numel() * p.element_size() for p in params)  # weights, gradients, optimizer state of AdamW (2)
    if device.type == "cuda":
        available = torch.cuda.get_device_properties(device).total_memory
    else:
        available = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else need
    available *= planned_world_size()
    if need > available:
        raise ValueError(
            f"networks of {len(params)} tensors and {need / 16e9:.1f} billion weights take {need / 1e9:.0f} GB to train, this "
            f"machine has {available / 1e9:.0f} GB: lower model.image_size={cfg.model.image_size} or the widths of the model."
        )
    return model


def _check_recording(cfg: DictConfig) -> None:
    """Builds environment and expert as a recording does, and takes one step; writes nothing.

    Raises:
        ValueError: their settings do not fit, or lead to actions that are not finite.
    """
    data = cfg.env.data
    settings = f"env.kwargs={cfg.env.kwargs}, env.data.kwargs={data.kwargs}, env.data.expert={data.expert}"
    arguments = record_settings(cfg)
    arguments["env_kwargs"]["image_size"] = arguments.pop("image_size")
    try:
        env, expert, observation, _ = EpisodeRecorder(find_entry(cfg.env.name), **arguments).begin(0)
    except (TypeError, AttributeError) as error:  # the constructor has no such argument
        raise ValueError(f"{cfg.env.name} cannot be recorded with {settings}: {error}.") from error
    action = np.asarray(expert(observation[STATE], observation[GOAL_STATE]))
    if not np.isfinite(action).all():
        raise ValueError(f"the expert's first action is {action.tolist()}, which is not finite: see {settings}.")
    env.step(action)
    env.close()


def _check_amounts(cfg: DictConfig) -> None:
    """Checks, before the recording, that it can be enough for a batch, for every split and for the pairs.

    Raises:
        ValueError: even episodes of full length would be too few.
    """
    data, evaluation, rows = cfg.env.data, cfg.evaluation, cfg.env.data.max_steps + 1
    episodes = {split: len(split_episodes(data.episodes, split)) for split in SPLITS}
    if empty := [split for split, count in episodes.items() if not count]:
        raise ValueError(
            f"env.data.episodes={data.episodes} leave no episode for {' and '.join(empty)}: record more (20 are enough)."
        )
    phases = [("loss", "optim", cfg)] + ([("refine", "refine", refined(cfg))] if cfg.refine.epochs else [])
    for section, optim, phase in phases:
        clip = (clip_frames(phase) - 1) * cfg.model.frame_skip  # environment steps from the first frame to the last
        if clip >= rows:
            raise ValueError(
                f"the clips of {section} are {clip} steps long, episodes at most {data.max_steps}: lower "
                f"{section}.prediction_steps or {section}.num_frames, or raise env.data.max_steps."
            )
        clips = episodes["train"] * (rows - clip)
        if clips < phase.optim.batch_size:
            raise ValueError(
                f"{data.episodes} episodes of at most {data.max_steps} steps make at most {clips} training clips, less than "
                f"one batch of {optim}.batch_size={phase.optim.batch_size}: lower it, or raise env.data.episodes."
            )
    wanted = {"evaluation": ("num_pairs", evaluation.num_pairs)}
    if evaluation.every:
        wanted["validation"] = ("every_pairs", evaluation.every_pairs)
    for split, (name, count) in wanted.items():
        starts = episodes[split] * max(0, rows - cfg.env.goal_offset)
        if starts < count:
            raise ValueError(
                f"cannot draw {count} pairs (evaluation.{name}) {cfg.env.goal_offset} steps apart: the {split} episodes will "
                f"have at most {starts} such starts. Collect more episodes, or ask for fewer pairs."
            )
