"""The folder of a run: it belongs to one configuration, and to one process at a time."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from utils import flatten, write_text

from torchrl_ficreg.trainers.checkpoint import CHECKPOINTS
from torchrl_ficreg.trainers.offline import METRICS

# Settings that change neither the weights nor how they are reached; a finished run may be given others.
_FREE = ("collect.", "device", "evaluation.", "plan.", "logger.")
_FREE += ("env.budget", "env.goal_offset", "env.num_workers", "env.state_unit")


def check_run_dir(cfg: DictConfig) -> Path:
    """The run's folder, which belongs to one configuration as soon as that one has trained. Writes nothing.

    Raises:
        ValueError: it holds a run of another configuration.
    """
    run_dir, ours = Path(cfg.runs_dir) / cfg.name, OmegaConf.to_container(cfg, resolve=True)
    path = run_dir / "config.yaml"
    if path.exists() and ((run_dir / METRICS).exists() or (run_dir / CHECKPOINTS).exists()):
        theirs = OmegaConf.to_container(OmegaConf.load(path))
        if not isinstance(theirs, dict) or "model" not in theirs:
            raise ValueError(f"{path} is damaged: restore it, or give another name=...")
        for config in (ours, theirs):  # a project may be moved, or started from another folder
            config["data_dir"], config["runs_dir"] = (str(Path(config[key]).resolve()) for key in ("data_dir", "runs_dir"))
        ours, theirs = flatten(ours), flatten(theirs)
        differ = [key for key in sorted(ours | theirs) if ours.get(key) != theirs.get(key) and not key.startswith(_FREE)]
        if differ:
            what = ", ".join(f"{key}: {theirs.get(key)} -> {ours.get(key)}" for key in differ[:3])
            raise ValueError(f"{run_dir} holds a run of another configuration ({what}): give another name=...")
    return run_dir


def claim_run_dir(cfg: DictConfig) -> Path:
    """Makes the run's folder, takes it for this process and notes the configuration in it.

    Raises:
        ValueError: it holds a run of another configuration.
        RuntimeError: another process is at work in it.
    """
    run_dir = check_run_dir(cfg)
    run_dir.mkdir(parents=True, exist_ok=True)
    try:  # held, on the folder itself, until this process ends
        fcntl.flock(os.open(run_dir, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise RuntimeError(f"another process is at work in {run_dir}: wait for it, or give another name=...") from error
    write_text(run_dir / "config.yaml", OmegaConf.to_yaml(cfg, resolve=True))
    return run_dir
