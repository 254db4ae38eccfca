"""Seconds per plan of the planners of this package, plain loops and TorchRL's CEMPlanner: docs/results/planning_speed_*.json.

All of them plan for the same latents with the same weights. They alternate within one run, so that other load slows all of them;
each time is the least of the repeats. The plain loop handles one environment at a time, and recomputes the whole window of
a textbook predictor at every step of every rollout.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from baselines import fused, matrix_rate, plain_precisions, plain_predictor
from tensordict import TensorDict
from torch.utils.flop_counter import FlopCounterMode
from torchrl.modules.planners import CEMPlanner

from torchrl_ficreg import CEMConfig, LatentCEMPlanner, LatentGoalEnv, LatentWorldModel, make_world_model, ModelConfig
from torchrl_ficreg._device import autocast, describe_processor, keep_freed_memory

RESULT = Path("planning_speed.json")
HORIZON, ACTIONS = 5, 2
BOUNDS = ([-1.0] * ACTIONS, [1.0] * ACTIONS)
Way = Callable[[torch.Tensor, torch.Tensor], object]


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=30, help="for one environment; a tenth as many for 50")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to check that it runs")
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parser.parse_args()
    repeats, iterations = (1, 2) if arguments.quick else (arguments.repeats, arguments.iterations)
    many = 3 if arguments.quick else 50
    model = world_model("paper")
    results = {
        "plain": [
            against_plain_loop(model, 1, iterations, repeats),
            against_plain_loop(model, many, max(1, iterations // 10), 1),
        ],
        "stock": [
            against_stock_planner(preset, envs, candidates, 2 if arguments.quick else 5, repeats)
            for preset, envs, candidates in (
                [("cpu", 1, 50)]
                if arguments.quick
                else [(p, e, k) for p in ("cpu", "paper") for e in (1, 8) for k in (100, 300)]
            )
        ],
        "profile": profile(model),
        "machine": {
            "processor": describe_processor(),
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
            "candidates": 300,
            "horizon": HORIZON,
        },
    }
    arguments.out.write_text(json.dumps(results, indent=2) + "\n")


def world_model(preset: str) -> LatentWorldModel:
    """A world model whose action modulation is not zero, as after training."""
    torch.manual_seed(0)
    model, _ = make_world_model(ModelConfig.preset(preset), ACTIONS)
    with torch.no_grad():
        for block in model.predictor.module.blocks:
            block.to_modulation.weight.normal_(std=0.02)
    return model.eval()


def against_plain_loop(model: LatentWorldModel, envs: int, iterations: int, repeats: int) -> dict:
    """Seconds per plan: this package, and the plain loop in fp32 and under bf16 autocast."""
    config = CEMConfig(iterations=iterations, num_candidates=300, num_elites=30, horizon=HORIZON)
    ways = {"ours": LatentCEMPlanner(model, config, action_bounds=BOUNDS).plan}
    ways |= {
        f"plain {precision}": partial(plain_cem, model, iterations=iterations, precision=precision)
        for precision in plain_precisions()
    }
    seconds = in_turns(ways, envs, model.latent_dim, repeats)
    row = {"environments": envs, "iterations": iterations, "seconds_per_plan": seconds}
    row["speedup"] = {name: seconds[name] / seconds["ours"] for name in seconds if name != "ours"}
    report(f"paper predictor, {envs} environments, {iterations} iterations", row)
    return row


def against_stock_planner(preset: str, envs: int, candidates: int, iterations: int, repeats: int) -> dict:
    """Seconds per plan: this package, and TorchRL's CEMPlanner on a LatentGoalEnv."""
    model = world_model(preset)
    settings = {"num_candidates": candidates, "num_elites": candidates // 10, "iterations": iterations}
    stock = CEMPlanner(
        LatentGoalEnv(model, action_bounds=BOUNDS),
        planning_horizon=HORIZON,
        optim_steps=iterations,
        num_candidates=candidates,
        top_k=candidates // 10,
    )

    def plan_stock(latent: torch.Tensor, goal: torch.Tensor) -> None:
        keep_freed_memory(32 * 2**20, allow_decrease=True)  # what glibc comes to by itself
        with torch.no_grad():
            stock(stock.env.reset(TensorDict({"latent": latent, "goal_latent": goal}, [len(latent)])))

    ways: dict[str, Way] = {"CEMPlanner": plan_stock}
    for name, precision in (("ours", "auto"), ("ours fp32", "fp32")):
        ways[name] = LatentCEMPlanner(model, CEMConfig(**settings, precision=precision), action_bounds=BOUNDS).plan
    seconds = in_turns(ways, envs, model.latent_dim, repeats)
    row = {"preset": preset, "environments": envs, "candidates": candidates, "iterations": iterations}
    row |= {"seconds_per_plan": seconds}
    row["speedup"] = {name: seconds["CEMPlanner"] / seconds[name] for name in ("ours", "ours fp32")}
    report(f"{preset} predictor, {envs} environments, {candidates} candidates x {iterations}", row)
    return row


def in_turns(ways: dict[str, Way], envs: int, latent_dim: int, repeats: int) -> dict[str, float]:
    """Least seconds per plan and environment of each way."""
    generator = torch.Generator().manual_seed(0)
    latent, goal = torch.randn(2, envs, latent_dim, generator=generator)
    for way in ways.values() if envs == 1 else ():
        way(latent, goal)  # warm-up: kernels choose their blocking at the first call
    least = dict.fromkeys(ways, float("inf"))
    for _ in range(repeats):
        for name, way in ways.items():
            began = time.perf_counter()
            way(latent, goal)
            least[name] = min(least[name], (time.perf_counter() - began) / envs)
    return least


@torch.no_grad()
def plain_cem(model: LatentWorldModel, latent: torch.Tensor, goal: torch.Tensor, iterations: int, precision: str) -> None:
    """CEM, environment by environment, 300 candidates, 30 elites."""
    keep_freed_memory(32 * 2**20, allow_decrease=True)  # what glibc comes to by itself
    for start, target in zip(latent, goal):
        mean, std = torch.zeros(HORIZON, model.block_dim), torch.ones(HORIZON, model.block_dim)
        for _ in range(iterations):
            action = mean + std * torch.randn(300, HORIZON, model.block_dim)
            with autocast("cpu", precision):
                end = plain_rollout(model, start.expand(300, 1, -1), action)[:, -1]
            best = (end.float() - target).square().sum(-1).topk(30, largest=False).indices
            mean, std = action[best].mean(0), action[best].std(0)


def plain_rollout(model: LatentWorldModel, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """[N, 1, D] and [N, S, F * A] -> [N, 1 + S, D]; recomputes the whole window at every step."""
    for step in range(action.shape[1]):
        first = max(0, step + 1 - model.history)
        window = latent[:, first:], action[:, first : step + 1]
        predicted = plain_predictor(model.predictor.module, *window, fused)[:, -1:]
        latent = torch.cat([latent, predicted], dim=1)
    return latent


@torch.no_grad()
def profile(model: LatentWorldModel) -> dict:
    """One iteration of one environment: seconds by kernel, and the least seconds of its matrix products."""
    planner = LatentCEMPlanner(model, CEMConfig(iterations=10), action_bounds=BOUNDS)
    latent, goal = torch.randn(2, 1, model.latent_dim)
    planner.plan(latent, goal)
    began = time.perf_counter()
    planner.plan(latent, goal)
    iteration = (time.perf_counter() - began) / 10
    with torch.profiler.profile() as trace:
        planner.plan(latent, goal)
    events = [(event.key, event.self_cpu_time_total) for event in trace.key_averages()]
    total = sum(spent for _, spent in events)
    shares = {name: spent / total for name, spent in sorted(events, key=lambda event: -event[1])[:12]}
    with FlopCounterMode(display=False) as counter:
        model.rollout(torch.zeros(300, 1, model.latent_dim), torch.zeros(300, HORIZON, model.block_dim))
    rate = matrix_rate()
    floor = counter.get_total_flops() / rate
    result = {
        "seconds_per_iteration": iteration,
        "operations_per_iteration": counter.get_total_flops(),
        "measured_operations_per_second": rate,
        "floor_seconds": floor,
        "times_the_floor": iteration / floor,
        "shares": shares,
    }
    print(f"\none iteration {1e3 * iteration:.1f} ms, its matrix products at least {1e3 * floor:.1f} ms")
    for name, share in shares.items():
        print(f"  {name:<34}{share:>7.1%}")
    return result


def report(title: str, row: dict) -> None:
    """Prints one comparison."""
    print(f"\n{title}")
    for name, spent in row["seconds_per_plan"].items():
        factor = row["speedup"].get(name)
        print(f"  {name:<22}{spent:>9.3f} s per plan" + (f"{factor:>8.2f} x" if factor else ""))


if __name__ == "__main__":
    main()
