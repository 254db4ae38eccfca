"""Trains a goal-conditioned policy on a run's frozen latents and its dataset.

    python train_policy.py checkpoint=runs/two_room_cpu_ficreg_seed0

The policy is saved in the run directory. It acts without planning (plan=policy), or proposes candidates to a search
(plan.policy=auto).
"""

from __future__ import annotations

import signal
import time
import warnings
from pathlib import Path

import numpy as np
import torch
from cli import entry_point
from omegaconf import DictConfig, OmegaConf
from run_dir import claim_folder, flatten, versions, write_json
from tensordict import TensorDict
from torchrl.objectives import BCLoss
from tqdm import trange
from utils import dataset_path, encoder_of, get_device, make_dataset, open_dataset, settings_of_card

from torchrl_ficreg import LatentWorldModel
from torchrl_ficreg._device import autocast
from torchrl_ficreg._safe_files import require_safetensors
from torchrl_ficreg._utils import read_json
from torchrl_ficreg.data.latents import BLOCKS, encode_episodes, GoalRows
from torchrl_ficreg.keys import ACTION, GOAL_LATENT, LATENT
from torchrl_ficreg.modules.goal_policy import GoalPolicy, load_goal_policy, save_goal_policy
from torchrl_ficreg.pretrained import ModelCard
from torchrl_ficreg.trainers import exit_on_signal, find_checkpoint, load_world_model, WarmupCosine

METRICS = "metrics.json"
# Settings that do not influence the weights of the policy.
_NOT_IN_FINGERPRINT = ("checkpoint", "dataset", "output", "overwrite", "device", "frames_per_batch")


@entry_point("train_policy")
def main(cfg: DictConfig) -> None:
    """Trains a policy, or shows the numbers of the existing one. After a signal the same command starts over."""
    if OmegaConf.is_missing(cfg, "checkpoint"):
        raise ValueError("name the model to train a policy for: checkpoint=runs/two_room_cpu_ficreg_seed0, say.")
    get_device(cfg.device)
    require_safetensors()
    with exit_on_signal(signal.SIGTERM, signal.SIGINT, resumes=False):
        train_for_run(cfg)


def train_for_run(cfg: DictConfig) -> None:
    """Trains the policy of a run in its folder; a folder that stays empty is removed."""
    checkpoint = find_checkpoint(cfg.checkpoint)
    folder = Path(cfg.output or checkpoint.parent.parent / "goal_policy")
    model, _, card = load_world_model(checkpoint)
    if (folder / METRICS).exists() and not cfg.overwrite:
        metrics = read_metrics(cfg, folder, model)
        print(f"{folder} holds this policy already: overwrite=true trains it again.")
        report(metrics)
        return
    before = folder.exists()
    claim_folder(folder, None if cfg.output else folder.parent)
    try:
        train_into(cfg, folder, checkpoint, model, card)
    except BaseException:
        if not before and not any(folder.iterdir()):
            folder.rmdir()
        raise


def train_into(cfg: DictConfig, folder: Path, checkpoint: Path, model: LatentWorldModel, card: ModelCard) -> None:
    """Encodes all frames once, trains, prints and writes; an existing policy is replaced at the end."""
    began = time.perf_counter()
    device = get_device(cfg.device)
    train_rows, held_out = make_rows(cfg, model.to(device), card)
    policy = train(cfg, model, train_rows)
    draw = torch.Generator().manual_seed(cfg.seed)
    metrics = {
        "train": measure(policy, train_rows.sample(cfg.validation_rows, generator=draw)),
        "validation": measure(policy, held_out.sample(cfg.validation_rows, generator=draw)),
        "rows": {"train": len(train_rows), "validation": len(held_out)},
        "seconds": time.perf_counter() - began,
        "checkpoint": checkpoint.name,
        "config": OmegaConf.to_container(cfg),
        "versions": versions(),
    }
    report(metrics)  # before anything is written, so that a full disk does not cost the numbers
    save_goal_policy(policy, folder, model)
    (folder / METRICS).unlink(missing_ok=True)  # written last: marks the folder as complete
    write_json(folder / METRICS, metrics)
    print(f"policy and {METRICS} in {folder}")


def make_rows(cfg: DictConfig, model: LatentWorldModel, card: ModelCard) -> tuple[GoalRows, GoalRows]:
    """Rows of the training and of the validation episodes; every frame is encoded once."""
    run = settings_of_card(card)
    # A missing dataset that is named explicitly is an error; otherwise it would be recorded again.
    run.dataset = cfg.dataset or run.dataset or str(dataset_path(run))
    store, encode, rows = open_dataset(run), encoder_of(model, cfg.optim.precision), []
    for split in ("train", "validation"):
        dataset = make_dataset(run, store, split, num_frames=2, batch_size=None, statistics=model.statistics)
        latent = encode_episodes(dataset, encode, batch_size=cfg.frames_per_batch, description=f"encode {split}")
        rows.append(GoalRows(dataset, latent, max_blocks=cfg.max_blocks))
    return rows[0], rows[1]


def train(cfg: DictConfig, model: LatentWorldModel, rows: GoalRows) -> GoalPolicy:
    """Trains by behaviour cloning (squared error) and returns the policy, in eval mode."""
    torch.manual_seed(cfg.seed)
    generator = torch.Generator().manual_seed(cfg.seed)
    network, device = model.predictor.module, rows.latent.device
    policy = GoalPolicy(network.latent_dim, network.action_dim, **cfg.policy)
    policy.standardize_by(rows.latent.cpu())  # in float64, which MPS does not have
    policy.to(device)
    with warnings.catch_warnings():  # TorchRL warns about target parameters, of which BCLoss has none
        warnings.filterwarnings("ignore", message="The name target_actor_network_params")
        loss_module = BCLoss(policy, loss_function="l2")
    optim = cfg.optim
    params = list(policy.parameters())
    optimizer = torch.optim.AdamW(params, lr=optim.lr, weight_decay=optim.weight_decay, fused=device.type != "mps")
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, WarmupCosine(optim.steps, optim.warmup))
    with trange(optim.steps, desc="train", unit="step", dynamic_ncols=True) as bar:
        for step in bar:
            with autocast(device, optim.precision):
                loss = loss_module(rows.sample(optim.batch_size, generator=generator))["loss_bc"]
            loss.backward()
            torch.nn.utils.clip_grad_norm_(params, optim.clip_norm, error_if_nonfinite=True)
            optimizer.step()
            optimizer.zero_grad()
            schedule.step()
            if step % 50 == 0:  # rarely: reading the loss synchronises with the GPU
                bar.set_postfix_str(f"loss {loss.item():.3f}", refresh=False)
    return policy.eval()


@torch.no_grad()
def measure(policy: GoalPolicy, rows: TensorDict) -> dict:
    """Mean squared error and R^2 of the actions of some rows, z-scored, also by distance of the goal.

    R^2 is 1 - squared error / variance about the mean, summed over the components of a block.
    """
    action = rows[ACTION]
    predicted = torch.cat([policy.module(part[LATENT], part[GOAL_LATENT]) for part in rows.split(4096)])
    # Summed in float64 by NumPy: MPS has no float64.
    error = (predicted - action).square().sum(-1).cpu().numpy().astype(np.float64)  # [B]
    deviation = (action - action.mean(0)).square().sum(-1).cpu().numpy().astype(np.float64)  # [B]
    blocks = rows[BLOCKS].cpu().numpy()
    near = {int(k): blocks == k for k in np.unique(blocks)}
    return {
        "loss": float(error.mean() / action.shape[-1]),
        "r2": _r2(error, deviation),
        "r2_by_blocks": {str(k): _r2(error[here], deviation[here]) for k, here in near.items()},
    }


def _r2(error: np.ndarray, deviation: np.ndarray) -> float | None:
    total = float(deviation.sum())
    return 1 - float(error.sum()) / total if total > 0 else None  # None if the action never changes


def report(metrics: dict) -> None:
    """Prints R^2, overall and by distance of the goal."""
    shown = {name: metrics[name]["r2"] for name in ("validation", "train")}
    held_out, seen = ("-" if value is None else f"{value:.3f}" for value in shown.values())
    by_blocks = metrics["validation"]["r2_by_blocks"].items()
    print(f"R^2 of the actions: {held_out} on held-out episodes, {seen} on training episodes")
    print("by blocks to the goal: " + ", ".join(f"{k}: {'-' if r2 is None else f'{r2:.3f}'}" for k, r2 in by_blocks))


def read_metrics(cfg: DictConfig, folder: Path, model: LatentWorldModel) -> dict:
    """The numbers of an existing policy, which must have the same settings.

    Raises:
        ValueError: it was trained with other settings, or for other weights.
    """
    load_goal_policy(folder, model)
    metrics = read_json(folder / METRICS, "numbers of a policy")
    try:
        ours, theirs = flatten(OmegaConf.to_container(cfg)), flatten(metrics["config"])
        [float(r2) for name in ("validation", "train") if (r2 := metrics[name]["r2"]) is not None]
        [float(r2) for r2 in metrics["validation"]["r2_by_blocks"].values() if r2 is not None]
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise ValueError(f"{folder / METRICS} is damaged ({error!r:.80}): overwrite=true trains the policy again.") from error
    differ = [key for key in sorted(ours | theirs) if ours.get(key) != theirs.get(key) and key not in _NOT_IN_FINGERPRINT]
    if differ:
        what = ", ".join(f"{key}: {theirs.get(key)} -> {ours.get(key)}" for key in differ[:3])
        raise ValueError(f"{folder} holds a policy of other settings ({what}): give overwrite=true, or output=...")
    return metrics


if __name__ == "__main__":
    main()
