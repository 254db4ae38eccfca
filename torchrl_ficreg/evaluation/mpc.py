"""Does the planner reach the goals? Success rates on frozen start-goal pairs."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from torchrl_ficreg.envs import make_env
from torchrl_ficreg.evaluation.metrics import wilson_interval
from torchrl_ficreg.evaluation.pairs import StartGoalPairs
from torchrl_ficreg.keys import ACTION, GOAL_PIXELS, PIXELS, SUCCESS
from torchrl_ficreg.planners.base import PLAN_SEED
from torchrl_ficreg.planners.mpc import MPCPolicy


class UniformPolicy(TensorDictModuleBase):
    """Actions drawn uniformly between the bounds: the floor every planner is compared with.

    Each environment (``plan_seed`` [E], or 0, 1, ...) draws from a generator of its own.

    Args:
        low, high: [A], environment units.
        seed: of the draws.
    """

    def __init__(self, low: list[float], high: list[float], seed: int = 0) -> None:
        super().__init__()
        self.low, self.high, self.seed = torch.tensor(low), torch.tensor(high), seed
        self.in_keys, self.out_keys = [], [ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` [E, A] and, under ``random_step``, how many were drawn."""
        count = tensordict.get("random_step", torch.zeros(tensordict.batch_size, dtype=torch.long))
        seeds = tensordict.get(PLAN_SEED, torch.arange(count.numel()).reshape(count.shape))
        draws = [
            np.random.default_rng([self.seed, seed, step]).random(len(self.low), dtype=np.float32)
            for seed, step in zip(seeds.flatten().tolist(), count.flatten().tolist())
        ]
        unit = torch.from_numpy(np.stack(draws)).reshape(*count.shape, -1)  # [E, A] in [0, 1)
        return tensordict.set(ACTION, self.low + (self.high - self.low) * unit).set("random_step", count + 1)


@dataclass
class Evaluation:
    """Outcome of one policy on N start-goal pairs.

    Attributes:
        success: [N, budget + 1] bool, at the start and after every step.
        seconds_per_plan: mean wall time of one plan of one environment; 0 for a policy that does not plan.
        pairs_hash: of the pairs.
        recorded: rows of the pairs whose episodes were recorded, ascending.
        frames: these episodes, each [budget + 1, 3, H, W] uint8.
        goals: their goals, each [3, H, W] uint8.
    """

    success: np.ndarray
    seconds_per_plan: float
    pairs_hash: str
    recorded: list[int] = field(default_factory=list)
    frames: list[np.ndarray] = field(default_factory=list)
    goals: list[np.ndarray] = field(default_factory=list)

    @property
    def ever(self) -> np.ndarray:
        """[N] bool: in the goal after any step of the budget."""
        return self.success[:, 1:].any(1)

    @property
    def at_start(self) -> np.ndarray:
        """[N] bool: in the goal before the first step."""
        return self.success[:, 0]

    @property
    def success_rate(self) -> float:
        """Share of all pairs solved."""
        return float(self.ever.mean())

    def summary(self) -> dict[str, Any]:
        """Plain JSON values; rates in 0..1, intervals by Wilson at 95 %."""
        open_pairs = ~self.at_start
        solved_open = self.ever[open_pairs]
        first = np.where(self.ever, self.success[:, 1:].argmax(1) + 1, -1)
        return {
            "pairs": len(self.ever),
            "pairs_hash": self.pairs_hash,
            "budget": self.success.shape[1] - 1,
            "success_rate": self.success_rate,
            "success_interval": wilson_interval(int(self.ever.sum()), len(self.ever)),
            "success_rate_at_end": float(self.success[:, -1].mean()),
            "solved_at_start": int(self.at_start.sum()),
            "success_rate_unsolved_at_start": float(solved_open.mean()) if len(solved_open) else None,
            "seconds_per_plan": self.seconds_per_plan,
            "first_success_step": first.tolist(),
        }


def evaluate_mpc(
    policy: TensorDictModuleBase,
    pairs: StartGoalPairs,
    *,
    budget: int = 50,
    image_size: int = 64,
    num_envs: int = 50,
    num_workers: int | None = None,
    env_kwargs: dict[str, Any] | None = None,
    record: int = 0,
    progress_bar: bool = True,
    description: str = "evaluate",
) -> Evaluation:
    """Lets a policy act from every start state and counts the goals it reaches.

    Episodes go on after success, so that reaching a goal and staying there are counted separately; an environment that
    stopped at its goal would count as one that stays. An outcome depends neither on ``num_envs`` nor on
    ``num_workers``: the policy is told, by ``plan_seed``, which pair it acts for, and the environment is seeded by it.

    Args:
        policy: reads ``pixels`` and ``goal_pixels``, writes ``action``.
        pairs: starts and goals.
        budget: environment steps allowed.
        image_size: of the frames the policy sees.
        num_envs: pairs evaluated side by side.
        num_workers: None to step the environments in this process; W to divide them among W processes, or among as
            many as there are environments, see :func:`~torchrl_ficreg.envs.make_env`.
        env_kwargs: further arguments of the environment.
        record: number of episodes whose frames are kept, k of N: rows 0, N / k, 2 N / k, ... rounded down, since
            neighbours in the list often come from one recorded episode; at most N.
        progress_bar, description: of the progress bar.

    Raises:
        ValueError: ``budget`` or ``num_envs`` below 1, ``num_workers`` too, ``env_kwargs`` that are set here, or a
            planner that imagines further ahead than ``budget`` steps.
    """
    for name, value in (("budget", budget), ("num_envs", num_envs), ("record", record)):
        if not isinstance(value, int) or isinstance(value, bool):
            raise ValueError(f"{name} must be an integer, got {value!r}.")
    if budget < 1 or num_envs < 1:
        raise ValueError(f"budget and num_envs must be positive, got {budget} and {num_envs}.")
    if num_workers is not None and num_workers < 1:
        raise ValueError(f"num_workers must be None or at least 1, got {num_workers}.")
    if isinstance(policy, MPCPolicy):
        ahead = policy.planner.config.horizon * policy.planner.world_model.frame_skip
        if ahead > budget:
            raise ValueError(
                f"the planner imagines {ahead} steps ahead, the budget is {budget}: shorten its horizon (action blocks "
                f"of {policy.planner.world_model.frame_skip} steps), or raise the budget."
            )
    taken = {"image_size", "terminate_on_success", "num_envs", "num_workers", "seed"} & set(env_kwargs or {})
    if taken:
        raise ValueError(f"env_kwargs must not hold {sorted(taken)}: evaluate_mpc sets them.")
    shown = min(record, len(pairs))
    recorded = [len(pairs) * i // shown for i in range(shown)]
    outcome = Evaluation(np.zeros((len(pairs), budget + 1), dtype=bool), 0.0, pairs.hash, recorded)
    seconds, plans = 0.0, 0
    bar = tqdm(total=len(pairs) * budget, desc=description, unit="step", disable=not progress_bar, dynamic_ncols=True)
    env = None
    try:
        for first in range(0, len(pairs), num_envs):
            group = np.arange(first, min(first + num_envs, len(pairs)))
            if env is None or env.numel() != len(group):  # all groups but the last share one: processes start slowly
                if env is not None:
                    env.close()
                env = make_env(
                    pairs.env,
                    len(group),
                    image_size=image_size,
                    terminate_on_success=False,
                    num_workers=None if num_workers is None else min(num_workers, len(group)),
                    **(env_kwargs or {}),
                )
            group_seconds, group_plans = _run_group(env, policy, pairs, group, outcome, bar)
            seconds, plans = seconds + group_seconds, plans + group_plans
    finally:
        if env is not None:
            env.close(raise_if_closed=False)
        bar.close()
    outcome.seconds_per_plan = seconds / plans if plans else 0.0
    return outcome


def _run_group(
    env: EnvBase,
    policy: TensorDictModuleBase,
    pairs: StartGoalPairs,
    group: np.ndarray,
    outcome: Evaluation,
    bar: tqdm,
) -> tuple[float, int]:
    """Runs the pairs of one group side by side and fills in their rows; returns policy seconds and plans made."""
    scenes = [
        {"seed": int(i), "options": {"state": pairs.start_state[i], "goal_state": pairs.goal_state[i]}} for i in group
    ]
    td = env.reset(list_of_kwargs=scenes) if env.batch_size else env.reset(**scenes[0])
    lead = td.batch_size
    td[PLAN_SEED] = torch.from_numpy(group).reshape(lead)
    kept = [row - int(group[0]) for row in outcome.recorded if row in group]

    def pictures(key: str) -> np.ndarray:
        """Copies of the recorded environments' pictures, [kept, 3, H, W]."""
        return td[key].reshape(len(group), *td[key].shape[-3:])[kept].numpy()

    frames = [pictures(PIXELS)]
    outcome.goals += list(pictures(GOAL_PIXELS))
    outcome.success[group, 0] = td[SUCCESS].reshape(-1).numpy()
    seconds = 0.0
    for step in range(1, outcome.success.shape[1]):
        began = time.perf_counter()
        td = policy(td)
        seconds += time.perf_counter() - began
        td = step_mdp(env.step(td), keep_other=True)
        outcome.success[group, step] = td[SUCCESS].reshape(-1).numpy()
        if kept:
            frames.append(pictures(PIXELS))
        bar.update(len(group))
    outcome.frames += list(np.stack(frames, axis=1)) if kept else []
    plans = td.get(("mpc", "count"), None)
    return seconds, 0 if plans is None else int(plans.sum())
