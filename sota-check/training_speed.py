"""Seconds per training step of the paper's model, ours beside the plain formulation: docs/results/training_speed.json.

All ways train the same weights on the same 8 clips of 4 frames at 224 pixels, in turns within one run, so that a busy
machine slows all of them; times are the least of the repeats. The plain formulation is what one writes first: a
textbook transformer on ``scaled_dot_product_attention``, one sine and one cosine for every knot of SIGReg, and an AdamW
that walks over the parameters one by one.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import platform
import time
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from torchrl_ficreg import FICRegLoss, make_world_model, ModelConfig
from torchrl_ficreg.modules.memory import keep_freed_memory
from torchrl_ficreg.modules.pixels import IMAGENET_MEAN, IMAGENET_STD
from torchrl_ficreg.modules.precision import autocast, Precision
from torchrl_ficreg.objectives.sigreg import standard_normal

RESULT = Path(__file__).resolve().parents[1] / "docs" / "results" / "training_speed.json"
ACTIONS, FRAMES = 2, 4
Terms = dict[str, torch.Tensor]
Objective = Callable[[FICRegLoss, TensorDictBase], Terms]


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="two clips and one repeat, to see it run")
    parser.add_argument("--profile", action="store_true", help="also print where the time of our step goes")
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parser.parse_args()
    clips, repeats = (2, 1) if arguments.quick else (arguments.clips, arguments.repeats)
    start, clip = starting_point(), random_clips(clips)
    ways = {
        "ours": Way(start, clip, our_terms, "auto", fused=True),
        "plain fp32": Way(start, clip, plain_terms, "fp32", fused=False),
        "plain bf16 autocast": Way(start, clip, plain_terms, "bf16", fused=False),
    }
    losses = {name: way.compare() for name, way in ways.items()}
    seconds, cpu_seconds = in_turns(ways, repeats)
    results = {
        "seconds_per_step": seconds,
        "cpu_seconds_per_step": cpu_seconds,
        "speedup": ratios(seconds),
        "cpu_speedup": ratios(cpu_seconds),
        "losses": losses,
        "relative_difference_of_losses": differences(losses),
        "floor": floor(ways["plain fp32"]),
        "machine": {
            "processor": platform.machine(),
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
            "clips": clips,
            "frames": FRAMES,
            "repeats": repeats,
        },
    }
    report(results)
    if arguments.profile:
        profile(ways["ours"])
    arguments.out.write_text(json.dumps(results, indent=2) + "\n")


def starting_point() -> FICRegLoss:
    """The loss with all its weights. The action modulation is moved off its start at zero, as training does."""
    torch.manual_seed(0)
    model, inverse_model = make_world_model(ModelConfig.preset("paper", predictor_attention_dropout=0.0), ACTIONS)
    with torch.no_grad():
        for block in model.predictor.module.blocks:
            block.to_modulation.weight.normal_(std=0.02)
    return FICRegLoss(model.encoder, model.predictor, inverse_model)


def random_clips(clips: int) -> TensorDict:
    """Clips of noise: ``pixels`` [B, T, 3, 224, 224] uint8 and ``action`` [B, T, F * A]."""
    generator = torch.Generator().manual_seed(0)
    pixels = torch.randint(0, 256, (clips, FRAMES, 3, 224, 224), dtype=torch.uint8, generator=generator)
    action = torch.randn(clips, FRAMES, 5 * ACTIONS, generator=generator)
    return TensorDict({"pixels": pixels, "action": action}, [clips, FRAMES])


class Way:
    """One way to train: its own copy of the weights, its own optimiser."""

    def __init__(
        self, start: FICRegLoss, clip: TensorDictBase, objective: Objective, precision: Precision, *, fused: bool
    ) -> None:
        self.loss, self.clip, self.objective, self.precision = copy.deepcopy(start), clip, objective, precision
        self.params = [param for param in self.loss.parameters() if param.requires_grad]
        kind = {"fused": True} if fused else {"foreach": False, "fused": False}
        self.optimizer = torch.optim.AdamW(self.params, lr=5e-5, weight_decay=1e-3, **kind)

    def terms(self) -> Terms:
        """The weighted terms of the objective."""
        with autocast("cpu", self.precision):
            return self.objective(self.loss, self.clip)

    def step(self) -> None:
        """Forward, backward, clip, update."""
        sum(self.terms().values()).backward()
        nn.utils.clip_grad_norm_(self.params, 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad()

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


def our_terms(loss: FICRegLoss, clip: TensorDictBase) -> Terms:
    """The package's own."""
    return dict(loss(clip).items())


def plain_terms(loss: FICRegLoss, clip: TensorDictBase) -> Terms:
    """The same objective with nothing but textbook layers."""
    encoder, predictor, judge = (parts(loss, name) for name in ("encoder", "predictor", "inverse_model"))
    action = clip["action"][:, :-1]  # [B, T - 1, F * A]
    latent = plain_encoder(encoder, clip["pixels"])  # [B, T, D]
    predicted = plain_predictor(predictor, latent[:, :-1], action)  # [B, T - 1, D]
    sigreg = plain_sigreg(latent.transpose(0, 1).float(), directions(loss, latent.shape[-1]))
    real = latent.detach()
    recovered = judge(real[:, :-1], real[:, 1:])
    imagined = plain_predictor(predictor, real[:, :-1], action, track=False)
    for param in judge.parameters():
        param.requires_grad_(False)
    judged = judge(real[:, :-1], imagined)
    for param in judge.parameters():
        param.requires_grad_(True)
    return {
        "loss_pred": F.mse_loss(predicted.float(), latent[:, 1:].float()),
        "loss_sigreg": loss.sigreg_coeff * sigreg,
        "loss_idm": loss.idm_coeff * F.mse_loss(recovered.float(), action),
        "loss_consistency": loss.consistency_coeff * F.mse_loss(judged.float(), action),
    }


def parts(loss: FICRegLoss, name: str) -> nn.Module:
    """The network of that name, holding the parameters that the loss trains."""
    network = getattr(loss, name)
    getattr(loss, f"{name}_params").to_module(network, preserve_module_state=False)
    return network.module


def directions(loss: FICRegLoss, dim: int) -> torch.Tensor:
    """Unit vectors [D, M], those our own regulariser would draw, by torch's own generator once training began."""
    state, count = loss.sigreg.generator_state, dim * loss.sigreg.num_directions
    drawn = standard_normal(state, count) if state[1] == 0 else torch.randn(count)
    loss.sigreg.generator_state[1] += 1
    drawn = drawn.view(dim, -1)
    return drawn / drawn.norm(dim=0)


def plain_sigreg(latent: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Latents [T, B, D] float32 -> the statistic []."""
    with torch.autocast("cpu", enabled=False):
        knots = torch.linspace(0, 3, 17)
        weights = torch.full((17,), 2 * 3 / 16)
        weights[[0, -1]] = 3 / 16
        gaussian = torch.exp(-knots.square() / 2)
        angle = (latent @ directions).unsqueeze(-1) * knots  # [T, B, M, 17]
        error = (angle.cos().mean(-3) - gaussian).square() + angle.sin().mean(-3).square()  # [T, M, 17]
        return ((error @ (weights * gaussian)) * latent.shape[-2]).mean()


def plain_encoder(network: nn.Module, pixels: torch.Tensor) -> torch.Tensor:
    """The vision transformer as a textbook writes it: [B, T, 3, H, W] uint8 -> [B, T, D]."""
    mean, std = (torch.tensor(value).view(3, 1, 1) for value in (IMAGENET_MEAN, IMAGENET_STD))
    frames = (pixels.flatten(0, 1).float() / 255 - mean) / std  # [N, 3, H, W]
    size = network.patch_size
    kernel = network.to_patch.weight.view(-1, 3, size, size)
    tokens = F.conv2d(frames, kernel, network.to_patch.bias, stride=size).flatten(2).transpose(1, 2)
    tokens = torch.cat([network.class_token.expand(len(tokens), -1, -1), tokens], dim=1) + network.position
    for block in network.blocks:
        tokens = tokens + plain_attention(block.attn, plain_norm(block.attn_norm, tokens), causal=False)
        tokens = tokens + plain_mlp(block.mlp, plain_norm(block.mlp_norm, tokens))
    latent = plain_projector(network.projector, plain_norm(network.norm, tokens)[:, 0])
    return latent.unflatten(0, pixels.shape[:2])


def plain_predictor(
    network: nn.Module, latent: torch.Tensor, action: torch.Tensor, *, track: bool = True
) -> torch.Tensor:
    """The predictor as a textbook writes it: [B, T, D] and [B, T, F * A] -> [B, T, D]."""
    x = latent + network.position[:, : latent.shape[1]]
    embedding = network.action_embedding
    condition = embedding.layer_out(F.silu(embedding.layer_in(embedding.compress(action))))
    for block in network.blocks:
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = block.to_modulation(F.silu(condition)).chunk(6, dim=-1)
        h = plain_norm(block.attn_norm, plain_norm(block.adaptive_norm, x) * (1 + scale_a) + shift_a)
        x = x + gate_a * plain_attention(block.attn, h, causal=True)
        h = plain_norm(block.mlp_norm, plain_norm(block.adaptive_norm, x) * (1 + scale_m) + shift_m)
        x = x + gate_m * plain_mlp(block.mlp, h)
    return plain_projector(network.projector, plain_norm(network.norm, x).flatten(0, 1), track).unflatten(
        0, latent.shape[:2]
    )


def plain_norm(layer: nn.LayerNorm, x: torch.Tensor) -> torch.Tensor:
    """[..., C] -> [..., C]."""
    return F.layer_norm(x, layer.normalized_shape, layer.weight, layer.bias, layer.eps)


def plain_attention(layer: nn.Module, x: torch.Tensor, causal: bool) -> torch.Tensor:
    """[N, T, C] -> [N, T, C]."""
    projected = F.linear(x, layer.to_qkv.weight, layer.to_qkv.bias)
    query, key, value = (part.unflatten(-1, (layer.heads, -1)).transpose(1, 2) for part in projected.chunk(3, dim=-1))
    mixed = F.scaled_dot_product_attention(query, key, value, is_causal=causal).transpose(1, 2).flatten(2)
    return F.dropout(F.linear(mixed, layer.to_out.weight, layer.to_out.bias), layer.dropout.p)


def plain_mlp(layers: nn.Sequential, x: torch.Tensor) -> torch.Tensor:
    """[N, T, C] -> [N, T, C]."""
    rate = layers[2].p
    hidden = F.dropout(F.gelu(F.linear(x, layers[0].weight, layers[0].bias)), rate)
    return F.dropout(F.linear(hidden, layers[3].weight, layers[3].bias), rate)


def plain_projector(layer: nn.Module, x: torch.Tensor, track: bool = True) -> torch.Tensor:
    """[N, C] -> [N, D]."""
    norm = layer.norm
    statistics = (norm.running_mean, norm.running_var) if track else (None, None)
    hidden = F.linear(x, layer.layer_in.weight, layer.layer_in.bias)
    hidden = F.gelu(F.batch_norm(hidden, *statistics, norm.weight, norm.bias, training=True))
    return F.linear(hidden, layer.layer_out.weight, layer.layer_out.bias)


def in_turns(ways: dict[str, Way], repeats: int) -> tuple[dict[str, float], dict[str, float]]:
    """Least wall seconds and least processor seconds per step of each way."""
    for way in ways.values():
        way.step()  # kernels choose their blocking at the first call
    wall, cpu = (dict.fromkeys(ways, math.inf) for _ in range(2))
    for _ in range(repeats):
        for name, way in ways.items():
            keep_freed_memory(2**31 - 1 if name == "ours" else 32 * 2**20)  # OfflineTrainer's, and glibc's own
            began, busy = time.perf_counter(), time.process_time()
            way.step()
            wall[name] = min(wall[name], time.perf_counter() - began)
            cpu[name] = min(cpu[name], time.process_time() - busy)
    return wall, cpu


def ratios(seconds: dict[str, float]) -> dict[str, float]:
    """How many times faster ours is than each other way."""
    return {name: spent / seconds["ours"] for name, spent in seconds.items() if name != "ours"}


def differences(losses: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Of each loss and the gradient norm, relative to those of the plain formulation in fp32."""
    exact = losses["plain fp32"]
    return {
        name: {key: abs(value - exact[key]) / abs(exact[key]) for key, value in terms.items()}
        for name, terms in losses.items()
        if name != "plain fp32"
    }


def floor(way: Way) -> dict[str, float]:
    """Operations of the matrix products of a step, and the seconds they need at the rate of a large bf16 product."""
    with FlopCounterMode(display=False) as counter:
        sum(way.terms().values()).backward()
    way.optimizer.zero_grad()
    a, b = torch.randn(2, 2048, 2048).bfloat16()
    least = math.inf
    for _ in range(20):
        began = time.perf_counter()
        a @ b
        least = min(least, time.perf_counter() - began)
    rate = 2 * 2048**3 / least
    return {
        "operations_per_step": counter.get_total_flops(),
        "operations_per_second": rate,
        "seconds_per_step": counter.get_total_flops() / rate,
    }


def report(results: dict) -> None:
    """Prints the table."""
    print(f"{'':<22}{'s per step':>12}{'cpu s':>9}{'ours is':>10}{'cpu':>8}{'losses differ':>15}{'grad norm':>11}")
    for name, spent in results["seconds_per_step"].items():
        row = f"{name:<22}{spent:>12.3f}{results['cpu_seconds_per_step'][name]:>9.3f}"
        factor, cpu_factor = (results[key].get(name) for key in ("speedup", "cpu_speedup"))
        row += f"{factor:>8.2f} x{cpu_factor:>6.2f} x" if factor else " " * 18
        difference = results["relative_difference_of_losses"].get(name)
        if difference:
            worst = max(value for key, value in difference.items() if key.startswith("loss"))
            row += f"{worst:>15.1e}{difference['grad_norm']:>11.1e}"
        print(row)
    print(f"{'matrix products alone':<22}{results['floor']['seconds_per_step']:>12.3f}")


def profile(way: Way) -> None:
    """Where the time of one step goes, by kernel."""
    with torch.profiler.profile(record_shapes=True) as trace:
        way.step()
    print(trace.key_averages(group_by_input_shape=True).table(sort_by="self_cpu_time_total", row_limit=45))
    print(trace.key_averages().table(sort_by="self_cpu_time_total", row_limit=30))


if __name__ == "__main__":
    main()
