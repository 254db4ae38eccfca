"""Seconds per training step, of this package and of plain formulations: docs/results/training_speed_*.json.

All of them train the same weights on the same clips: 8 of 4 frames at 224 pixels for the paper's model, 128 at 64 pixels for
the small ones. Each has its own process, with the allocator settings that its users have. They alternate within one run, so
that other load slows all of them; each time is the least of all repeats in all rounds, and each round starts new processes,
because the memory layout differs between processes. "Textbook" computes attention by its formula, "fused" by
``scaled_dot_product_attention``; otherwise the four plain formulations are equal.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

import torch
from baselines import fused, matrix_rate, Mix, parts, plain_encoder, plain_precisions, plain_terms, textbook
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from torchrl_ficreg import FICRegLoss, make_world_model, ModelConfig
from torchrl_ficreg._device import autocast, describe_processor, keep_freed_memory, Precision

RESULT = Path("training_speed.json")
ACTIONS = 2
MODELS = {
    "paper": ModelConfig.preset("paper", predictor_attention_dropout=0.0),
    "cpu": ModelConfig.preset("cpu"),
    "conv": ModelConfig.preset("cpu", encoder="conv", encoder_projector_dim=128, history=1),
}
KEPT = 2**31 - 1  # bytes, as OfflineTrainer keeps
Terms = dict[str, torch.Tensor]
PLAIN: dict[str, tuple[Mix, Precision]] = {
    "textbook fp32": (textbook, "fp32"),
    "fused fp32": (fused, "fp32"),
    "textbook bf16": (textbook, "bf16"),
    "fused bf16": (fused, "bf16"),
}


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", choices=MODELS, nargs="+", default=[*MODELS])
    parser.add_argument("--clips", type=int, help="default: 8, of the small models 128")
    parser.add_argument("--repeats", type=int, default=6, help="steps in each round")
    parser.add_argument("--rounds", type=int, default=3, help="of new processes")
    parser.add_argument("--quick", action="store_true", help="two clips, one repeat, to check that it runs; writes no file by default")
    parser.add_argument("--profile", action="store_true", help="only print a profile of this package's step")
    parser.add_argument("--out", type=Path, help=f"default: {RESULT}")
    arguments = parser.parse_args()
    repeats, rounds = (1, 1) if arguments.quick else (arguments.repeats, arguments.rounds)
    results = {}
    for model in arguments.models:
        clips = 2 if arguments.quick else arguments.clips or (8 if model == "paper" else 128)
        if arguments.profile:
            profile(make_way("ours", model, clips))
            continue
        results[model] = measure_model(model, clips, repeats, rounds)
    out = arguments.out or (None if arguments.quick or arguments.profile else RESULT)
    if out:
        out.write_text(json.dumps(results, indent=2) + "\n")


def measure_model(model: str, clips: int, repeats: int, rounds: int) -> dict:
    """Measures all formulations of one model; prints and returns the results."""
    plain = [name for name, (_, precision) in PLAIN.items() if precision in plain_precisions()]
    losses, seconds, cpu_seconds, encoding = measure(("ours", *plain), model, clips, repeats, rounds)
    results = {
        "seconds_per_step": seconds,
        "cpu_seconds_per_step": cpu_seconds,
        "seconds_per_encoding": encoding,
        "speedup": ratios(seconds),
        "cpu_speedup": ratios(cpu_seconds),
        "speedup_of_encoding": ratios(encoding),
        "losses": losses,
        "relative_difference_of_losses": differences(losses),
        "floor": floor(make_way("textbook fp32", model, clips)),
        "machine": {
            "processor": describe_processor(),
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
            "clips": clips,
            "frames": MODELS[model].history + 1,
            "repeats": repeats,
            "rounds": rounds,
        },
    }
    report(model, results)
    return results


class Way:
    """One formulation, with its own weights and optimizer."""

    def __init__(
        self,
        start: FICRegLoss,
        clip: TensorDictBase,
        objective: Callable[[FICRegLoss, TensorDictBase], Terms],
        encode: Callable[[FICRegLoss, torch.Tensor], torch.Tensor],
        precision: Precision,
        *,
        fused: bool,
    ) -> None:
        self.loss, self.clip, self.objective, self.precision = start, clip, objective, precision
        self.encode = encode
        self.params = [param for param in self.loss.parameters() if param.requires_grad]
        kind = {"fused": True} if fused else {}  # torch's default for plain formulations
        self.optimizer = torch.optim.AdamW(self.params, lr=5e-5, weight_decay=1e-3, **kind)

    def terms(self) -> Terms:
        """The weighted terms of the objective."""
        with autocast("cpu", self.precision):
            return self.objective(self.loss, self.clip)

    def step(self) -> tuple[float, float]:
        """Forward, backward, clip, update: wall and processor seconds."""
        began, busy = time.perf_counter(), time.process_time()
        sum(self.terms().values()).backward()
        nn.utils.clip_grad_norm_(self.params, 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad()
        return time.perf_counter() - began, time.process_time() - busy

    @torch.no_grad()
    def encoding(self) -> tuple[float, float]:
        """The frames of all clips to latents: wall and processor seconds."""
        began, busy = time.perf_counter(), time.process_time()
        with autocast("cpu", self.precision):
            self.encode(self.loss, self.clip["pixels"])
        return time.perf_counter() - began, time.process_time() - busy

    def compare(self) -> dict[str, float]:
        """Terms and gradient norm before any update, on copied weights, without dropout."""
        way = copy.deepcopy(self)
        for network in (way.loss.encoder, way.loss.predictor):
            for module in network.modules():
                if isinstance(module, nn.Dropout):
                    module.p = 0.0
        terms = way.terms()
        total = sum(terms.values())
        total.backward()
        norm = nn.utils.get_total_norm([param.grad for param in way.loss.parameters() if param.grad is not None])
        return {**{key: value.item() for key, value in terms.items()}, "sum": total.item(), "grad_norm": norm.item()}


def make_way(name: str, model: str, clips: int) -> Way:
    """The formulation of that name, with the common initial weights."""
    start, clip = starting_point(MODELS[model]), random_clips(MODELS[model], clips)
    if name == "ours":
        keep_freed_memory(KEPT)
        return Way(start, clip, our_terms, our_latents, "auto", fused=True)
    mix, precision = PLAIN[name]
    return Way(start, clip, partial(plain_terms, mix=mix), partial(plain_latents, mix=mix), precision, fused=False)


def starting_point(config: ModelConfig) -> FICRegLoss:
    """The loss with all its weights; the action modulation is not zero, as after training."""
    torch.manual_seed(0)
    model, inverse_model = make_world_model(config, ACTIONS)
    with torch.no_grad():
        for block in model.predictor.module.blocks:
            block.to_modulation.weight.normal_(std=0.02)
    return FICRegLoss(model.encoder, model.predictor, inverse_model)


def random_clips(config: ModelConfig, clips: int) -> TensorDict:
    """Clips of noise: ``pixels`` [B, T, 3, H, W] uint8 and ``action`` [B, T, F * A]."""
    generator = torch.Generator().manual_seed(0)
    lead, size = (clips, config.history + 1), config.image_size
    pixels = torch.randint(0, 256, (*lead, 3, size, size), dtype=torch.uint8, generator=generator)
    action = torch.randn(*lead, 5 * ACTIONS, generator=generator)
    return TensorDict({"pixels": pixels, "action": action}, lead)


def our_terms(loss: FICRegLoss, clip: TensorDictBase) -> Terms:
    """The terms of this package's loss."""
    return dict(loss(clip).items())


def our_latents(loss: FICRegLoss, pixels: torch.Tensor) -> torch.Tensor:
    """[B, T, 3, H, W] -> [B, T, D]."""
    return parts(loss, "encoder")(pixels)


def plain_latents(loss: FICRegLoss, pixels: torch.Tensor, mix: Mix) -> torch.Tensor:
    """As :func:`our_latents`, by the plain formulation."""
    return plain_encoder(parts(loss, "encoder"), pixels, mix)


def measure(names: tuple[str, ...], model: str, clips: int, repeats: int, rounds: int) -> tuple[dict, dict, dict, dict]:
    """For each formulation: losses, least wall and processor seconds of a step, and least seconds of encoding."""
    losses, wall, cpu, encoding = {}, *(dict.fromkeys(names, math.inf) for _ in range(3))
    for _ in range(rounds):
        with ways(names, model, clips) as pipes:
            losses = losses or {name: ask(pipe, "compare") for name, pipe in pipes.items()}  # equal in every round
            for repeat in range(-3, repeats):  # warm-up of kernels and allocators
                for name, pipe in pipes.items():
                    spent, busy = ask(pipe, "step")
                    alone, _ = ask(pipe, "encoding")
                    if repeat >= 0:
                        wall[name], cpu[name] = min(wall[name], spent), min(cpu[name], busy)
                        encoding[name] = min(encoding[name], alone)
    return losses, wall, cpu, encoding


@contextmanager
def ways(names: tuple[str, ...], model: str, clips: int) -> Iterator[dict[str, Connection]]:
    """A process for each formulation, and the pipe to it."""
    context, pipes, workers = multiprocessing.get_context("spawn"), {}, []
    for name in names:
        pipes[name], other = context.Pipe()
        workers.append(context.Process(target=serve, args=(other, name, model, clips), daemon=True))
        os.environ["THP_MEM_ALLOC_ENABLE"] = "1" if name == "ours" else "0"  # as train.py sets it, and torch's default
        workers[-1].start()
        other.close()
    yield pipes
    for pipe, worker in zip(pipes.values(), workers):
        pipe.send(None)
        worker.join()


def serve(pipe: Connection, name: str, model: str, clips: int) -> None:
    """Calls methods of one formulation by name, until it receives None."""
    way = make_way(name, model, clips)
    for method in iter(pipe.recv, None):
        pipe.send(getattr(way, method)())


def ask(pipe: Connection, method: str) -> dict[str, float] | tuple[float, float]:
    """Calls a method in the process at the other end."""
    pipe.send(method)
    return pipe.recv()


def ratios(seconds: dict[str, float]) -> dict[str, float]:
    """Speed-up of this package over each other formulation."""
    return {name: spent / seconds["ours"] for name, spent in seconds.items() if name != "ours"}


def differences(losses: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Relative difference of each loss and of the gradient norm from textbook fp32."""
    exact = losses["textbook fp32"]
    return {
        name: {key: abs(value - exact[key]) / abs(exact[key]) for key, value in terms.items()}
        for name, terms in losses.items()
        if name != "textbook fp32"
    }


def floor(way: Way) -> dict[str, float]:
    """Operations of the matrix products of a step, and their time at the rate of one large product."""
    with FlopCounterMode(display=False) as counter:
        sum(way.terms().values()).backward()
    way.optimizer.zero_grad()
    rate = matrix_rate()
    return {
        "operations_per_step": counter.get_total_flops(),
        "operations_per_second": rate,
        "seconds_per_step": counter.get_total_flops() / rate,
    }


def report(model: str, results: dict) -> None:
    """Prints the table of a model."""
    print(f"\n{model}, on {results['machine']['processor']}")
    print(f"{'':<22}{'s per step':>12}{'cpu s':>9}{'ours is':>10}{'cpu':>8}{'encoding':>10}{'ours is':>10}{'losses differ':>15}{'grad norm':>11}")
    for name, spent in results["seconds_per_step"].items():
        row = f"{name:<22}{spent:>12.3f}{results['cpu_seconds_per_step'][name]:>9.3f}"
        factor, cpu_factor = (results[key].get(name) for key in ("speedup", "cpu_speedup"))
        row += f"{factor:>8.2f} x{cpu_factor:>6.2f} x" if factor else " " * 18
        alone, factor = results["seconds_per_encoding"][name], results["speedup_of_encoding"].get(name)
        row += f"{alone:>10.3f}" + (f"{factor:>8.2f} x" if factor else " " * 10)
        difference = results["relative_difference_of_losses"].get(name)
        if difference:
            worst = max(value for key, value in difference.items() if key.startswith("loss"))
            row += f"{worst:>15.1e}{difference['grad_norm']:>11.1e}"
        print(row)
    print(f"{'matrix products alone':<22}{results['floor']['seconds_per_step']:>12.3f}")


def profile(way: Way) -> None:
    """Prints the time of one step by kernel."""
    with torch.profiler.profile(record_shapes=True) as trace:
        way.step()
    print(trace.key_averages(group_by_input_shape=True).table(sort_by="self_cpu_time_total", row_limit=45))
    print(trace.key_averages().table(sort_by="self_cpu_time_total", row_limit=30))


if __name__ == "__main__":
    main()
