"""The folder of a run: it belongs to one configuration, and to one process at a time."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from utils import flatten

from torchrl_ficreg._utils import lock_folder, MOST_JSON_BYTES, read_bytes, write_atomic
from torchrl_ficreg.trainers.checkpoint import CHECKPOINTS, checkpoints_in, find_checkpoint, read_card
from torchrl_ficreg.trainers.offline import METRICS

README = "README.txt"
_README = """{name}: a run of train.py, begun or continued by

    python train.py {overrides}

The same command continues it after a stop of any kind (SIGTERM or Ctrl-C in training: it writes a checkpoint and exits
with code 85 or 130), and evaluates it again once it has finished. Without training, with other settings of the
evaluation:

    python evaluate.py checkpoint={run_dir}

checkpoints/          the latest two, and the best where evaluation.every was set: weights, optimiser, schedule, random
                      state, position in the data, action statistics and configuration; torchrl.checkpoint opens them,
                      torchrl_ficreg.trainers.load_world_model makes a model of them; epoch-* is the one that
                      results.json is about, where evaluation.epoch was set
config.yaml           every setting, resolved; from_run_dir: where the data lie, seen from here
metrics.csv           losses, gradient norms, health of the latents, speed and memory; a row every few steps, and one of
                      held-out clips after every epoch
pairs.json            starts and goals of the evaluation; pairs_*.json of the further tests of evaluation.also
results.json          success rates with their intervals, what training took, versions of the packages
episodes.gif          rollouts of the planner
learning_curve.png    losses against steps
latent_distance.png   distance in latent space against true distance
evaluation/           what evaluate.py found, a folder <search>_<hash of its settings> each: results.json, config.yaml and
                      episodes.gif
goal_policy/          what train_policy.py made
wandb/, tensorboard/  files of the logger, where one was asked for
"""

# Settings that change neither the weights nor how they are reached; a finished run may be given others.
_FREE = ("collect.", "distributed.", "device", "evaluation.", "plan.", "logger.", "resume")
_FREE += ("optim.checkpoint_activations",)  # which changes no number; a compiled graph draws other dropout masks
_FREE += ("env.budget", "env.goal_offset", "env.num_workers", "env.state_unit")
_PLACES = ("data_dir", "dataset")
_DAMAGE = (ValueError, TypeError, AttributeError, AssertionError, RecursionError)  # what a damaged config.yaml leads to
_FROM_RUN_DIR = "from_run_dir"  # of config.yaml; the other settings are those of the command line


def check_run_dir(cfg: DictConfig) -> Path:
    """The run's folder, which belongs to one configuration as soon as that one has trained. Writes nothing.

    Raises:
        ValueError: it holds a run of another configuration, or any run under ``resume=never``.
    """
    run_dir, ours = Path(cfg.runs_dir) / cfg.name, OmegaConf.to_container(cfg, resolve=True)
    for name in (CHECKPOINTS, "wandb", "tensorboard"):  # a folder from elsewhere may have come with its links
        if (run_dir / name).is_symlink():
            raise ValueError(f"{run_dir / name} is a link, through which nothing is written: remove it, or give another name=...")
    path = run_dir / "config.yaml"
    if path.exists() and ((run_dir / METRICS).exists() or (run_dir / CHECKPOINTS).exists()):
        theirs = _read_config(path)
        if cfg.resume == "never":
            raise ValueError(f"{run_dir} holds a run and resume=never: give another name=..., or resume=auto.")
        theirs["runs_dir"], places = ours["runs_dir"], theirs.pop(_FROM_RUN_DIR, None)  # it is the folder that was read
        _same_places(ours, theirs, _from_run_dir(ours, run_dir), places if isinstance(places, dict) else {})
        if what := _differences(ours, theirs):
            raise ValueError(f"{run_dir} holds a run of another configuration ({what}): give another name=...")
    return run_dir


def _read_config(path: Path) -> dict[str, Any]:
    """The settings that a run noted.

    Raises:
        ValueError: they cannot be read.
    """
    try:
        text = read_bytes(path, most=MOST_JSON_BYTES).decode()
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, Loader=yaml.SafeLoader)):
            raise ValueError("it has aliases, of which a few lines can stand for gigabytes")
        config = OmegaConf.to_container(OmegaConf.create(text))
        if not isinstance(config, dict) or "model" not in config:
            raise ValueError("it has no settings of a model")
    except (*_DAMAGE, yaml.YAMLError, OmegaConfBaseException) as error:
        reason = " ".join(str(error).split())[:150] or "it holds no settings"
        raise ValueError(f"{path} is damaged ({reason}): restore it, or give another name=...") from error
    return config


def _from_run_dir(config: dict[str, Any], run_dir: Path) -> dict[str, str]:
    """The way to each place from the run's folder, which stays the same wherever a command is given."""
    places = {key: config[key] for key in _PLACES if config[key] is not None}
    return {key: _way(Path(place).resolve(), run_dir.resolve()) for key, place in places.items()}


def _way(place: Path, start: Path) -> str:
    try:
        return os.path.relpath(place, start)
    except ValueError:  # two drives of Windows
        return str(place)


def _same_places(
    ours: dict[str, Any], theirs: dict[str, Any], our_ways: dict[str, str] | None = None, ways: dict[str, Any] | None = None
) -> None:
    """Writes their places as ours are where both are one: seen from the run's folder, or from the working folder."""
    for key in _PLACES:
        mine, other = ours.get(key), theirs.get(key)
        if mine is None or not isinstance(other, str):
            continue
        way = (our_ways or {}).get(key)
        if way is not None and way == (ways or {}).get(key) or Path(mine).resolve() == Path(other).resolve():
            theirs[key] = mine


def _differences(ours: dict[str, Any], theirs: dict[str, Any], free: tuple[str, ...] = ()) -> str:
    """The first settings that differ, in words; empty where none of weight does."""
    ours, theirs = flatten(ours), flatten(theirs)
    keys = [key for key in sorted(ours | theirs) if not key.startswith((*_FREE, *free))]
    differ = [key for key in keys if ours.get(key) != theirs.get(key)]
    return ", ".join(f"{key}: {str(theirs.get(key))[:60]} -> {str(ours.get(key))[:60]}" for key in differ[:3])


def find_start(cfg: DictConfig, run_dir: Path) -> Path | None:
    """The checkpoint that ``resume=<path>`` names, from which a run without any of its own begins; else None.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is an earlier one of this very run, or was made with other settings.
    """
    if cfg.resume in ("auto", "never"):
        return None
    start = find_checkpoint(cfg.resume)
    own = run_dir / CHECKPOINTS
    latest = next(reversed(checkpoints_in(own)), None)
    if latest is not None:
        if start.resolve().parent == own.resolve() and start.name != latest.name:
            raise ValueError(f"{own} holds later checkpoints than {start.name}: move those away, and resume=auto takes it.")
        return None
    ours, theirs = OmegaConf.to_container(cfg, resolve=True), dict(read_card(start).config)
    _same_places(ours, theirs)
    what = _differences(ours, theirs, free=("name", "data_dir", "runs_dir"))
    if what:
        raise ValueError(f"{start} was made with other settings ({what}): repeat them.")
    return start


def claim_run_dir(cfg: DictConfig) -> Path:
    """Makes the run's folder, takes it for this process and notes the configuration in it.

    Raises:
        ValueError: it holds a run of another configuration.
        RuntimeError: another process is at work in it.
    """
    run_dir = check_run_dir(cfg)
    run_dir.mkdir(parents=True, exist_ok=True)
    try:  # held, on the folder itself, until this process ends
        lock_folder(run_dir)
    except BlockingIOError as error:
        raise RuntimeError(f"another process is at work in {run_dir}: wait for it, or give another name=...") from error
    settings = OmegaConf.to_container(cfg, resolve=True)
    settings[_FROM_RUN_DIR] = _from_run_dir(settings, run_dir)
    write_atomic(run_dir / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(settings)))
    overrides = " ".join(HydraConfig.get().overrides.task) if HydraConfig.initialized() else f"name={cfg.name} ..."
    write_atomic(run_dir / README, _README.format(name=cfg.name, overrides=overrides, run_dir=f"{cfg.runs_dir}/{cfg.name}"))
    return run_dir
