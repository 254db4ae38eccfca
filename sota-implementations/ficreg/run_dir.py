"""Folders and files of the scripts: the run directory of one configuration and one process, output folders, JSON."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import platform
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from pathlib import Path
from typing import Any

import tensordict
import torch
import torchrl
import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_ficreg._device import describe_processor
from torchrl_ficreg._utils import lock_folder, MOST_JSON_BYTES, nearest_folder, read_bytes, write_atomic
from torchrl_ficreg.distributed import is_main
from torchrl_ficreg.trainers.checkpoint import CHECKPOINTS, checkpoints_in, find_checkpoint, read_card
from torchrl_ficreg.trainers.offline import METRICS

README = "README.txt"
_README = """{name}: a run of train.py, started or continued by

    python train.py {overrides}

The same command continues the run after any interruption (on SIGTERM or Ctrl-C, training writes a checkpoint and exits
with code 85 or 130), and evaluates it again once it has finished. To evaluate with other settings, without training:

    python evaluate.py checkpoint={run_dir}

checkpoints/          the latest two, and the best one if evaluation.every is set: weights, optimizer, schedule, random
                      state, position in the data, action statistics and configuration. torchrl.checkpoint opens them;
                      torchrl_ficreg.trainers.load_world_model returns the model. epoch-* is the one evaluated in
                      results.json, if evaluation.epoch is set
refine/               checkpoints and metrics.csv of the training on latents of the frozen encoder, if refine.epochs is set;
                      when it is done, the last checkpoint above has its weights
config.yaml           all settings, resolved; from_run_dir: paths of the data relative to this folder
metrics.csv           losses, gradient norms, collapse diagnostics, throughput and memory every few steps; losses of
                      validation clips after every epoch
pairs.json            starts and goals of the evaluation; pairs_*.json of the further tests of evaluation.also
results.json          success rates with confidence intervals, training time, versions of the packages
episodes.gif          rollouts of the planner
learning_curve.png    losses against steps; that of refine/ is in there
latent_distance.png   distance in latent space against true distance
evaluation/           results of evaluate.py, in folders <search>_<hash of its settings>: results.json, config.yaml and
                      episodes.gif
goal_policy/          the policy of train_policy.py
wandb/, tensorboard/  files of the logger, if one is set
"""

REFINE = "refine"  # folder of the second phase, in the run directory

# Settings that do not influence the weights: a run may be continued with other values.
_NOT_IN_FINGERPRINT = ("collect.", "distributed.", "device", "evaluation.", "plan.", "logger.", "resume")
_NOT_IN_FINGERPRINT += ("optim.checkpoint_activations",)  # not optim.compile: a compiled graph draws other dropout masks
_NOT_IN_FINGERPRINT += ("env.budget", "env.goal_offset", "env.num_workers", "env.state_unit")
# Settings that came after or went since a run was made, and the value that means what the run did.
_ADDED = {"refine.epochs": 0, "loss.prediction_steps": 1}
_REMOVED = {"refine.steps": 0}
# Settings that only one encoder reads; the networks of another do not depend on them.
_OF_ENCODER = {"conv": ("model.conv_channels",), "keypoint": ("model.keypoint_channels", "model.num_keypoints")}
_PATHS = ("data_dir", "dataset")
_DAMAGE = (ValueError, TypeError, AttributeError, AssertionError, RecursionError)  # errors of a damaged config.yaml
_FROM_RUN_DIR = "from_run_dir"  # entry of config.yaml: _PATHS relative to the run directory


def check_run_dir(cfg: DictConfig) -> Path:
    """The run directory. As soon as a configuration has trained in it, it refuses any other. Writes nothing.

    Raises:
        ValueError: it holds a run of another configuration, or any run under ``resume=never``.
    """
    run_dir, ours = Path(cfg.runs_dir) / cfg.name, OmegaConf.to_container(cfg, resolve=True)
    for name in (CHECKPOINTS, REFINE, f"{REFINE}/{CHECKPOINTS}", "wandb", "tensorboard"):  # a copied folder may contain links
        if (run_dir / name).is_symlink():
            raise ValueError(f"{run_dir / name} is a link, through which nothing is written: remove it, or give another name=...")
    path = run_dir / "config.yaml"
    if path.exists() and ((run_dir / METRICS).exists() or (run_dir / CHECKPOINTS).exists()):
        theirs = _read_config(path)
        if cfg.resume == "never":
            raise ValueError(f"{run_dir} holds a run and resume=never: give another name=..., or resume=auto.")
        theirs["runs_dir"] = ours["runs_dir"]  # the folder that was just read
        recorded = theirs.pop(_FROM_RUN_DIR, None)
        _unify_paths(ours, theirs, _from_run_dir(ours, run_dir), recorded if isinstance(recorded, dict) else {})
        if what := _differences(ours, theirs):
            raise ValueError(f"{run_dir} holds a run of another configuration ({what}): give another name=...")
    return run_dir


def _read_config(path: Path) -> dict[str, Any]:
    """The settings in a run's config.yaml.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        text = read_bytes(path, most=MOST_JSON_BYTES).decode()
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, Loader=yaml.SafeLoader)):
            raise ValueError("it has aliases, which can expand to gigabytes")
        config = OmegaConf.to_container(OmegaConf.create(text))
        if not isinstance(config, dict) or "model" not in config:
            raise ValueError("it has no settings of a model")
    except (*_DAMAGE, yaml.YAMLError, OmegaConfBaseException) as error:
        reason = " ".join(str(error).split())[:150] or "it holds no settings"
        raise ValueError(f"{path} is damaged ({reason}): restore it, or give another name=...") from error
    return config


def recorded_paths(run_dir: Path) -> dict[str, Path]:
    """``data_dir`` and ``dataset`` of a run, found from its folder wherever a command is started; empty if it holds neither.

    Raises:
        ValueError: its config.yaml is damaged.
    """
    path = run_dir / "config.yaml"
    recorded = _read_config(path).get(_FROM_RUN_DIR) if path.exists() else None
    recorded = recorded if isinstance(recorded, dict) else {}
    return {key: run_dir / recorded[key] for key in _PATHS if isinstance(recorded.get(key), str)}


def _from_run_dir(config: dict[str, Any], run_dir: Path) -> dict[str, str]:
    """The paths of the data relative to the run directory, which do not depend on the working directory."""
    paths = {key: Path(config[key]).resolve() for key in _PATHS if config[key] is not None}
    try:
        return {key: os.path.relpath(path, run_dir.resolve()) for key, path in paths.items()}
    except ValueError:  # another drive of Windows
        return {key: str(path) for key, path in paths.items()}


def _unify_paths(
    ours: dict[str, Any],
    theirs: dict[str, Any],
    our_relative: dict[str, str] | None = None,
    their_relative: dict[str, Any] | None = None,
) -> None:
    """Replaces their paths by ours where both are the same place, relative to the run or to the working directory."""
    for key in _PATHS:
        mine, other = ours.get(key), theirs.get(key)
        if mine is None or not isinstance(other, str):
            continue
        relative = (our_relative or {}).get(key)
        if relative is not None and relative == (their_relative or {}).get(key) or Path(mine).resolve() == Path(other).resolve():
            theirs[key] = mine


def _differences(ours: dict[str, Any], theirs: dict[str, Any], free: tuple[str, ...] = ()) -> str:
    """The first three settings that differ, as text; empty if only settings outside the fingerprint do."""
    ours, theirs = ({**_ADDED, **flatten(settings)} for settings in (ours, theirs))
    theirs = {key: value for key, value in theirs.items() if key in ours or value != _REMOVED.get(key)}
    unused = [key for kind, keys in _OF_ENCODER.items() if kind != ours.get("model.encoder") for key in keys]
    keys = [key for key in sorted(ours | theirs) if not key.startswith((*_NOT_IN_FINGERPRINT, *free, *unused))]
    differ = [key for key in keys if ours.get(key) != theirs.get(key)]
    return ", ".join(f"{key}: {str(theirs.get(key))[:60]} -> {str(ours.get(key))[:60]}" for key in differ[:3])


def find_start(cfg: DictConfig, run_dir: Path) -> Path | None:
    """The checkpoint of ``resume=<path>``, if the run has none of its own yet; else None.

    Raises:
        FileNotFoundError: there is no such checkpoint.
        ValueError: it is an earlier checkpoint of the same run, or was made with other settings.
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
    _unify_paths(ours, theirs)
    what = _differences(ours, theirs, free=("name", "data_dir", "runs_dir"))
    if what:
        raise ValueError(f"{start} was made with other settings ({what}): repeat them.")
    return start


@contextmanager
def claim_run_dir(cfg: DictConfig) -> Iterator[Path]:
    """Creates the run directory, writes the configuration into it and locks it. Only rank 0 does; others pass through.

    Raises:
        ValueError: it holds a run of another configuration.
        RuntimeError: another process works in it.
    """
    if not is_main():
        yield Path(cfg.runs_dir) / cfg.name
        return
    run_dir = check_run_dir(cfg)
    run_dir.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            stack.enter_context(lock_folder(run_dir))
        except BlockingIOError as error:
            raise RuntimeError(f"another process is at work in {run_dir}: wait for it, or give another name=...") from error
        settings = OmegaConf.to_container(cfg, resolve=True)
        settings[_FROM_RUN_DIR] = _from_run_dir(settings, run_dir)
        write_atomic(run_dir / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(settings)))
        overrides = " ".join(HydraConfig.get().overrides.task) if HydraConfig.initialized() else f"name={cfg.name} ..."
        text = _README.format(name=cfg.name, overrides=overrides, run_dir=f"{cfg.runs_dir}/{cfg.name}")
        write_atomic(run_dir / README, text)
        yield run_dir


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one level of dotted names."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def is_writable(path: Path) -> bool:
    """Whether files can be created in a folder, or in its nearest existing parent."""
    place = nearest_folder(path)
    return place.is_dir() and os.access(place, os.W_OK | os.X_OK)


def check_writable(path: Path, setting: str) -> None:
    """Checks, before any work, that results can be written.

    Args:
        path: the folder they go to, which need not exist yet.
        setting: the setting that names it.

    Raises:
        OSError: they cannot.
    """
    if not is_writable(path):
        raise OSError(f"{path} cannot be written (read-only, not yours, or below a file): give another {setting}=...")


def claim_folder(folder: Path, parent: Path | None = None) -> Path:
    """Creates a folder and checks that files can be written there, before the work whose results go into it.

    Args:
        folder: the folder.
        parent: a further folder that must not be a link, because its owner may be someone else.

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


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Writes strict JSON atomically; NaN and infinity become null."""
    write_atomic(path, json.dumps(_finite(values), indent=2, allow_nan=False) + "\n")


def _finite(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _finite(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [_finite(value) for value in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def versions() -> dict[str, str]:
    """Versions and hardware that a result depends on."""

    def version(package: str) -> str:
        try:
            return importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:  # found on the path
            return "not installed"

    return {
        "python": platform.python_version(),
        "torch": torch.__version__,
        "torchrl": torchrl.__version__,
        "tensordict": tensordict.__version__,
        "torchrl_ficreg": version("torchrl_ficreg"),
        "numpy": version("numpy"),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} torch threads",
        "processor": describe_processor(),
    }
