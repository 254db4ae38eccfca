"""A logger besides ``metrics.csv``, and what it gets at the end."""

from __future__ import annotations

import re
import secrets
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from torchrl import torchrl_logger
from torchrl.record.loggers import get_logger, Logger
from utils import flatten

from torchrl_ficreg._utils import read_bytes, write_atomic
from torchrl_ficreg.trainers import TolerantLogger

PICTURES = ("learning_curve.png", "latent_distance.png")
ROLLOUTS = "episodes.gif"


def make_logger(cfg: DictConfig, run_dir: Path) -> TolerantLogger | None:
    """A TorchRL logger besides ``metrics.csv``, where one is asked for. Without its server a run does without it.

    Raises:
        ImportError: its package is missing.
        ValueError: wandb is not set up.
    """
    backend = cfg.logger.backend
    if backend == "csv":
        return None
    run_id = _run_id(run_dir) if backend == "wandb" else None
    try:
        logger = TolerantLogger(_connect(cfg, run_dir, run_id))
    except ImportError as error:
        package = "'torchrl_ficreg[wandb]'" if backend == "wandb" else "tensorboard"
        raise ImportError(f"logger.backend={backend} needs a package: pip install {package}.") from error
    except Exception as error:  # of any kind: what a backend raises is its own affair
        if type(error).__name__ == "UsageError":  # wandb's, for a missing key
            raise ValueError(f"wandb: {error} Log in with `wandb login`, or choose logger.mode=offline.") from error
        torchrl_logger.warning(f"{backend} cannot be reached ({error}): the run goes on without it.")
        return None
    settings = flatten(OmegaConf.to_container(cfg, resolve=True))
    plain = (int, float, str, bool)  # all that tensorboard takes
    logger.log_hparams({key: value if isinstance(value, plain) else str(value) for key, value in settings.items()})
    return logger


def _connect(cfg: DictConfig, run_dir: Path, run_id: str | None) -> Logger:
    backend, extra = cfg.logger.backend, {}
    if backend == "wandb":
        extra["wandb_kwargs"] = {"mode": cfg.logger.mode, "project": cfg.logger.project, "id": run_id}
    return get_logger(backend, logger_name=str(run_dir / backend), experiment_name=cfg.name, **extra)


def _run_id(run_dir: Path) -> str:
    """Under which wandb knows the run, in all its lives.

    Raises:
        ValueError: what is noted is no id.
    """
    path = run_dir / "wandb" / "run_id"
    if not path.exists():
        path.parent.mkdir(exist_ok=True)
        write_atomic(path, secrets.token_hex(4))
    run_id = read_bytes(path, most=128).decode(errors="replace").strip()
    if not re.fullmatch(r"[\w-]+", run_id, re.ASCII):
        raise ValueError(f"{path} holds {run_id[:40]!r}, which is no id of a run of wandb: remove it to get another one.")
    return run_id


def publish(logger: TolerantLogger | None, results: dict[str, Any], names: tuple[str, ...], run_dir: Path) -> None:
    """Hands over the results of the policies ``names``; wandb gets a table, the pictures and the rollouts too."""
    if logger is not None:
        logger.attempt(_publish, logger, results, names, run_dir)
        logger.shutdown()


def _publish(logger: Logger, results: dict[str, Any], names: tuple[str, ...], run_dir: Path) -> None:
    measured = {name: {key: v for key, v in results[name].items() if isinstance(v, (int, float))} for name in names}
    for name, row in measured.items():
        for key, value in row.items():
            logger.log_scalar(f"evaluation/{name}/{key}", value, step=0)
    if not (run_dir / "wandb").is_dir():
        return
    import wandb

    columns = list(dict.fromkeys(key for row in measured.values() for key in row))
    table = wandb.Table(
        columns=["policy", *columns], data=[[name, *(row.get(key) for key in columns)] for name, row in measured.items()]
    )
    shown = {name: wandb.Image(str(run_dir / name)) for name in PICTURES if (run_dir / name).exists()}
    if (run_dir / ROLLOUTS).exists():
        shown[ROLLOUTS] = wandb.Video(str(run_dir / ROLLOUTS), format="gif")
    logger.experiment.log({"results": table, **shown})
