"""Time of a training step by kernel, on the dataset and with the settings of a run."""

from __future__ import annotations

import inspect
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from step_cost import matrix_rate, operations_of_step, seconds, take_step, wait_for

from torchrl_ficreg import make_world_model
from torchrl_ficreg._device import uses_bf16
from torchrl_ficreg.trainers import OfflineTrainer

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "sota-implementations" / "ficreg"))
from utils import dataset_path, get_device, make_dataset, make_loss, model_config

KERNELS = 12  # number of kernels that are listed


def profile(run_dir: Path, steps: int) -> dict[str, Any]:
    """Measures training steps with a run's settings and new weights; the run's folder is only read.

    ``step_seconds`` is the time of a training step with loading and transfer of its batch, ``compute_seconds`` without
    them. ``loader_share`` is the share of a step spent waiting for data, and ``share_of_peak`` the rate of the matrix products
    in ``compute_seconds`` relative to one large matrix product.

    Args:
        run_dir: folder of a run of train.py.
        steps: number of steps to average over, after up to ten to warm up.
    """
    cfg = OmegaConf.load(run_dir / "config.yaml")
    device = get_device(cfg.device)
    trainer, clips = fresh_trainer(cfg, device)
    clip = clips.sample().to(device)
    for _ in range(min(steps, 10)):
        take_step(trainer, clip)
    operations = operations_of_step(trainer, clip)
    compute = seconds(lambda: [take_step(trainer, clip) for _ in range(steps)], device) / steps
    loader = clips_per_second(clips, steps)
    step, waited = training_seconds(trainer, clips, device, steps)
    dtype = torch.bfloat16 if uses_bf16(device, cfg.optim.precision) else torch.float32
    peak = matrix_rate(device, dtype, size=8192 if device.type == "cuda" else 1024)
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "dtype": str(dtype).removeprefix("torch."),
        "clips": cfg.optim.batch_size,
        "frames": cfg.optim.batch_size * (cfg.model.history + 1),
        "step_seconds": step,
        "compute_seconds": compute,
        "waiting_for_batch_seconds": waited,
        "loader_share": max(0.0, 1 - compute / step),
        "loader_clips_per_second": loader,
        "operations_per_step": operations,
        "peak_operations_per_second": peak,
        "share_of_peak": operations / compute / peak,
        "memory_bytes": torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None,
        "kernels": longest_kernels(trainer, clip, device),
    }


def fresh_trainer(cfg: DictConfig, device: torch.device) -> tuple[OfflineTrainer, Any]:
    """Trainer and clips of a configuration, with new weights and without files."""
    torch.manual_seed(cfg.seed)
    data = Path(cfg.dataset) if cfg.dataset else dataset_path(cfg)
    clips = make_dataset(cfg, data, "train", prefetch=1)
    model, inverse_model = make_world_model(model_config(cfg), clips.action_dim)
    model.statistics = clips.statistics
    loss = make_loss(cfg, model.to(device), inverse_model.to(device))
    known = inspect.signature(OfflineTrainer).parameters
    settings = {key: value for key, value in cfg.optim.items() if key in known}
    return OfflineTrainer(loss, clips, progress_bar=False, **settings), clips


def training_seconds(trainer: OfflineTrainer, clips: Any, device: torch.device, steps: int) -> tuple[float, float]:
    """Seconds of a step with its batch, and the seconds spent waiting for the batch."""
    waited = 0.0
    wait_for(device)
    began = time.perf_counter()
    for _ in range(steps):
        asked = time.perf_counter()
        clip = clips.sample()
        waited += time.perf_counter() - asked
        take_step(trainer, clip.to(device, non_blocking=True))
    wait_for(device)
    return (time.perf_counter() - began) / steps, waited / steps


def clips_per_second(clips: Any, batches: int) -> float:
    """Throughput of the loader alone."""
    clips.sample()
    began = time.perf_counter()
    for _ in range(batches):
        clips.sample()
    return batches * clips.batch_size / (time.perf_counter() - began)


def longest_kernels(trainer: OfflineTrainer, clip: Any, device: torch.device) -> dict[str, float]:
    """Share of each kernel (CUDA) or operator (CPU) in the time of one step."""
    cuda = device.type == "cuda"
    activities = [torch.profiler.ProfilerActivity.CPU] + [torch.profiler.ProfilerActivity.CUDA] * cuda
    with torch.profiler.profile(activities=activities) as trace:
        take_step(trainer, clip)
        wait_for(device)
    spent = seconds_by_name(trace.key_averages(), cuda)
    total = sum(spent.values()) or 1.0
    longest = sorted(spent, key=spent.__getitem__, reverse=True)[:KERNELS]
    return {name: spent[name] / total for name in longest}


def seconds_by_name(events: Iterable[Any], cuda: bool) -> dict[str, float]:
    """Self time of each kernel, or of each operator if ``cuda`` is false."""
    if not cuda:
        return {event.key: event.self_cpu_time_total for event in events}
    # Device time of operators and of annotations such as Optimizer.step repeats that of their kernels.
    kernels = [event for event in events if event.device_type == torch.autograd.DeviceType.CUDA]
    return {e.key: e.self_device_time_total for e in kernels if not getattr(e, "is_user_annotation", False)}
