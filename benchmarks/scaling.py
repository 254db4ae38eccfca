"""Cost of a training step, measured on this CPU, and modelled time of the paper's runs on GPUs: docs/results/scaling.json.

Measured: operations, dispatched operators and bytes kept for the backward pass, of the layers as a GPU runs them, and
seconds of processor time on one thread. Modelled: all numbers about GPUs, by ``step_seconds`` below; they were not measured.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from step_cost import matrix_rate, operations_of_step, state_bytes, take_step, without_cpu_kernels
from tensordict import TensorDictBase
from torch.utils._python_dispatch import TorchDispatchMode

from torchrl_ficreg import FICRegLoss, make_world_model, ModelConfig, SIGReg
from torchrl_ficreg._device import describe_processor
from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.trainers import OfflineTrainer

RESULT = Path(__file__).resolve().parents[1] / "docs" / "results" / "scaling.json"
FRAMES, ACTIONS, BATCH, EPOCHS = 4, 2, 128, 10
# Number of clips in the published data and history of the predictor there. Clips have history + 1 frames, 5 steps apart: an
# episode of n rows holds n - 19 clips of four frames, n - 9 of two.
CLIPS = {"two_room": (830_809, 1), "push_t": (1_981_721, 3), "reacher": (1_820_000, 3), "cube": (1_820_000, 3)}
PRESETS = {
    "cpu": ModelConfig.preset("cpu"),
    "gpu_short": ModelConfig.preset("paper", image_size=112),
    "paper": ModelConfig.preset("paper"),
    "paper, two_room": ModelConfig.preset("paper", history=1),
}
# The model of a GPU: dense bf16 peak and memory bandwidth between GPUs by their data sheets; the rest is assumed.
GPU = {
    "name": "H100 or H200 SXM",
    "peak": 990e12,  # operations per second
    "share": 0.2,  # utilization: rate of the matrix products of a step relative to the peak
    "launch": 4e-6,  # seconds to launch one operator, without CUDA graphs
    "bandwidth": 200e9,  # bytes per second of an all-reduce, within a machine
    "bandwidth_between_machines": 40e9,  # of 8 GPUs each
}


def main() -> None:
    """Measures, models, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="smallest sizes only, to check that it runs; writes no file by default")
    parser.add_argument("--out", type=Path, help=f"default: {RESULT}")
    arguments = parser.parse_args()
    out = arguments.out or (None if arguments.quick else RESULT)
    torch.set_num_threads(1)
    repeats, paper = arguments.repeats, PRESETS["paper"]
    sizes = (28, 56) if arguments.quick else (56, 112, 168, 224)
    small = ModelConfig.preset("paper", image_size=28) if arguments.quick else ModelConfig.preset("paper", image_size=112)
    measured = {
        "batch": [measure(small, clips, repeats) for clips in (2, 4, 8)],
        "resolution": [measure(ModelConfig.preset("paper", image_size=size), 2, repeats) for size in sizes],
        "predictor": [measure(replace_depth(small, depth), 2, repeats) for depth in (2, 6, 12)],
    }
    presets = {"cpu": PRESETS["cpu"]} if arguments.quick else PRESETS
    measured["presets"] = {name: measure(config, 2, repeats) for name, config in presets.items()}
    measured["presets, 4 clips"] = {name: measure(config, 4, 1) for name, config in presets.items()}
    rows = {name: [measured[key][name] for key in ("presets", "presets, 4 clips")] for name in presets}
    if "gpu_short" in rows:
        rows["gpu_short"] = measured["batch"]  # the same model, also with 8 clips
    result = {
        "measured": measured,
        "modelled": {"gpu": GPU, "memory": memory(rows), "runs": runs(measured["presets"])},
        "machine": {
            "processor": describe_processor(),
            "threads": 1,
            "torch": torch.__version__,
            "matrix_operations_per_second": matrix_rate(torch.device("cpu"), size=1024),
        },
        "settings": {"paper_parameters": parameters(paper), "repeats": repeats, "seed": 0},
    }
    report(result)
    if out:
        out.write_text(json.dumps(result, indent=2) + "\n")


def replace_depth(config: ModelConfig, depth: int) -> ModelConfig:
    """The same model with another number of predictor layers."""
    return ModelConfig(**{**vars(config), "predictor_depth": depth})


def parameters(config: ModelConfig) -> int:
    """Of the world model."""
    return sum(p.numel() for p in make_world_model(config, ACTIONS)[0].parameters())


def measure(config: ModelConfig, clips: int, repeats: int) -> dict[str, Any]:
    """One FICReg step of a few random clips on the CPU."""
    torch.manual_seed(0)
    rng, rows, size = np.random.default_rng(0), 5 * config.history + 1, config.image_size
    episodes = [
        {
            "pixels": rng.integers(0, 256, (rows, 3, size, size), dtype=np.uint8),
            "action": np.pad(rng.normal(size=(rows - 1, ACTIONS)), ((0, 1), (0, 0))).astype(np.float32),
            "state": np.zeros((rows, 1)),
        }
        for _ in range(clips)
    ]
    data = OfflineTrajectories.from_episodes(
        episodes, split="all", num_frames=config.history + 1, frame_skip=5, batch_size=clips
    )
    model, inverse_model = make_world_model(config, ACTIONS)
    loss = FICRegLoss(model.encoder, model.predictor, inverse_model, sigreg=SIGReg(seed=0))
    trainer = OfflineTrainer(loss, data, epochs=1, progress_bar=False)
    clip = data.sample()
    with without_cpu_kernels(fused=True):
        kept = kept_bytes(trainer, clip)
        with _Dispatched() as dispatched:
            take_step(trainer, clip)
    times = []
    for _ in range(repeats):
        began = time.process_time()
        take_step(trainer, clip)
        times.append(time.process_time() - began)
    return {
        "image_size": size,
        "clips": clips,
        "frames": clips * (config.history + 1),
        "predictor_depth": config.predictor_depth,
        "cpu_seconds": min(times),
        "operations": operations_of_step(trainer, clip),
        "operators": dispatched.count,
        "kept_bytes": kept,
        "state_bytes": state_bytes(trainer),
    }


def kept_bytes(trainer: OfflineTrainer, clip: TensorDictBase) -> int:
    """Bytes saved by the forward pass for the backward pass, without weights; each storage counts once."""
    weights = {p.untyped_storage().data_ptr() for p in trainer.loss_module.parameters()}
    kept: dict[int, int] = {}

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in weights:
            kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        take_step(trainer, clip)
    return sum(kept.values())


class _Dispatched(TorchDispatchMode):
    """Counts the operators of a step that are not views; without compilation most are one kernel on a GPU."""

    count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += not func.is_view
        return func(*args, **(kwargs or {}))


def step_seconds(row: dict[str, Any], gpus: int) -> float:
    """Modelled seconds of one step of 128 clips: the maximum of computing and launching, plus the all-reduce."""
    compute = row["operations"] / row["clips"] * BATCH / gpus / (GPU["peak"] * GPU["share"])
    launch = row["operators"] * GPU["launch"]
    gradients = row["state_bytes"] / 4
    rate = GPU["bandwidth"] if gpus <= 8 else GPU["bandwidth_between_machines"]
    reduce = 0.0 if gpus == 1 else 2 * gradients * (gpus - 1) / gpus / rate
    return max(compute, launch) + reduce


def memory(rows: dict[str, list[dict[str, Any]]]) -> dict[str, dict[str, float]]:
    """Modelled bytes of training with 128 clips on one GPU, extrapolated linearly from a few clips.

    Args:
        rows: for each model, measurements with at least two numbers of clips.
    """
    result = {}
    for name, measured in rows.items():
        per_clip, constant = np.polyfit([row["clips"] for row in measured], [row["kept_bytes"] for row in measured], 1)
        result[name] = {
            "state": measured[0]["state_bytes"],
            "constant": round(constant),
            "per_clip": round(per_clip),
            "activations": round(constant + per_clip * BATCH),
        }
    return result


def runs(presets: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Modelled hours of the paper's ten epochs on 1, 8 and 64 GPUs."""
    result = {}
    for env, (clips, history) in CLIPS.items():
        row = presets.get("paper" if history == FRAMES - 1 else "paper, two_room")
        if row is None:
            continue
        steps = EPOCHS * (clips // BATCH)
        hours = {gpus: steps * step_seconds(row, gpus) / 3600 for gpus in (1, 8, 64)}
        loader = {gpus: BATCH / step_seconds(row, gpus) for gpus in (1, 8, 64)}
        result[env] = {"steps": steps, "hours": hours, "clips_per_second": loader}
    return result


def report(result: dict[str, Any]) -> None:
    """Prints the tables."""
    for title, rows in result["measured"].items():
        print(f"\n{title}: px, clips, frames, predictor layers, s, GFLOP, operators, MB kept")
        for row in rows.values() if isinstance(rows, dict) else rows:
            print(
                f"  {row['image_size']:>4}{row['clips']:>4}{row['frames']:>5}{row['predictor_depth']:>4}"
                f"{row['cpu_seconds']:>9.3f}{row['operations'] / 1e9:>9.1f}{row['operators']:>7}"
                f"{row['kept_bytes'] / 1e6:>9.1f}"
            )
    print(json.dumps(result["modelled"], indent=1))


if __name__ == "__main__":
    main()
