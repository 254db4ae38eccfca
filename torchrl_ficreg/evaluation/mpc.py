"""Success rates of a policy on frozen start-goal pairs."""

from __future__ import annotations

import sys
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
from torchrl_ficreg.envs.base import DRAW_EVERY
from torchrl_ficreg.evaluation.metrics import wilson_interval
from torchrl_ficreg.evaluation.pairs import StartGoalPairs
from torchrl_ficreg.keys import ACTION, GOAL_PIXELS, GOAL_STATE, MPC_MEMORY, PIXELS, PLAN_SEED, STATE, SUCCESS
from torchrl_ficreg.planners.mpc import MPCPolicy


class UniformPolicy(TensorDictModuleBase):
    """The random baseline: actions drawn uniformly between the bounds.

    Each environment has its own generator, seeded by ``plan_seed`` [E] (0, 1, ... if there is none).

    Args:
        low (list of float): lower bounds of an action [A], in environment units.
        high (list of float): upper bounds [A].
        seed (int, optional): seed of the draws. Default: ``0``.

    Examples:
        >>> from tensordict import TensorDict
        >>> UniformPolicy([-1.0, 2.0], [1.0, 6.0])(TensorDict({}, [3]))["action"].shape
        torch.Size([3, 2])
    """

    frame_interval = sys.maxsize  # it reads no frames

    def __init__(self, low: list[float], high: list[float], seed: int = 0) -> None:
        super().__init__()
        self.low, self.high, self.seed = torch.tensor(low), torch.tensor(high), seed
        self.in_keys, self.out_keys = [], [ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` [E, A] and the number of actions drawn so far, ``random_step`` [E]."""
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
        success (np.ndarray): bool [N, budget + 1], whether the goal is reached at the start and after every step.
        seconds_per_plan (float): mean wall time of one plan of one environment; 0 for a policy that does not plan.
        pairs_hash (str): :attr:`StartGoalPairs.hash`.
        recorded (list of int): rows of the pairs whose episodes are recorded, ascending.
        frames (list of np.ndarray): these episodes, uint8 [budget + 1, 3, H, W] each.
        goals (list of np.ndarray): their goal images, uint8 [3, H, W] each.
    """

    success: np.ndarray
    seconds_per_plan: float
    pairs_hash: str
    recorded: list[int] = field(default_factory=list)
    frames: list[np.ndarray] = field(default_factory=list)
    goals: list[np.ndarray] = field(default_factory=list)

    @property
    def ever(self) -> np.ndarray:
        """Bool [N], whether the goal is reached after any step of the budget."""
        return self.success[:, 1:].any(1)

    @property
    def at_start(self) -> np.ndarray:
        """Bool [N], whether the goal is reached before the first step."""
        return self.success[:, 0]

    @property
    def success_rate(self) -> float:
        """Share of all pairs whose goal is reached after any step."""
        return float(self.ever.mean())

    @property
    def success_rate_at_end(self) -> float:
        """Share of all pairs whose goal is reached after the last step."""
        return float(self.success[:, -1].mean())

    def summary(self) -> dict[str, Any]:
        """JSON values: counts, rates in [0, 1], a 95 % interval by :func:`wilson_interval`, steps of first success (-1: none)."""
        open_pairs = ~self.at_start
        solved_open = self.ever[open_pairs]
        first = np.where(self.ever, self.success[:, 1:].argmax(1) + 1, -1)
        return {
            "pairs": len(self.ever),
            "pairs_hash": self.pairs_hash,
            "budget": self.success.shape[1] - 1,
            "success_rate": self.success_rate,
            "success_interval": wilson_interval(int(self.ever.sum()), len(self.ever)),
            "success_rate_at_end": self.success_rate_at_end,
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
    """Runs a policy from every start state and counts the goals it reaches.

    Episodes continue after success, so that reaching a goal and staying there are counted separately. The outcome of a
    pair depends neither on ``num_envs`` nor on ``num_workers``: the number of the pair is the seed of the environment, and
    the policy reads it as ``plan_seed``. Frames that neither the policy reads nor ``record`` keeps are not drawn: a policy
    that reads every k-th frame only has ``frame_interval = k``, as :class:`~torchrl_ficreg.MPCPolicy` and
    :class:`UniformPolicy` have.

    Args:
        policy (TensorDictModuleBase): reads ``pixels`` and ``goal_pixels``, writes ``action``.
        pairs (StartGoalPairs): starts and goals.

    Keyword Args:
        budget (int, optional): number of environment steps allowed. Default: ``50``.
        image_size (int, optional): height and width of the frames, in pixels. Default: ``64``.
        num_envs (int, optional): number of pairs evaluated side by side. Default: ``50``.
        num_workers (int, optional): number of processes that step the environments, at most ``num_envs``; see
            :func:`~torchrl_ficreg.envs.make_env`. Default: ``None``, this process.
        env_kwargs (dict, optional): further arguments of the environment. Default: ``None``.
        record (int, optional): number k of episodes whose frames are kept, at most N: rows 0, N / k, 2 N / k, ... rounded
            down, since neighbours in the list often come from one recorded episode. Default: ``0``.
        progress_bar (bool, optional): show a progress bar. Default: ``True``.
        description (str, optional): text in front of the progress bar. Default: ``"evaluate"``.

    Returns:
        the :class:`Evaluation`.

    Raises:
        ValueError: ``budget``, ``num_envs`` or ``num_workers`` below 1, ``env_kwargs`` that this function sets, or a
            planning horizon beyond the budget.
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
                f"the planning horizon is {ahead} steps, the budget {budget}: shorten the horizon (action blocks "
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
            if env is None or env.numel() != len(group):  # shared by all groups but the last
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
    """Runs the pairs of one group and fills in their rows of ``outcome``; returns seconds in the policy and plans made."""
    interval = getattr(policy, "frame_interval", 1)
    scenes = [
        {
            "seed": int(i),
            "options": {
                STATE: pairs.start_state[i],
                GOAL_STATE: pairs.goal_state[i],
                DRAW_EVERY: 1 if i in outcome.recorded else interval,
            },
        }
        for i in group
    ]
    td = env.reset(list_of_kwargs=scenes) if env.batch_size else env.reset(**scenes[0])
    lead = td.batch_size
    seed_key = policy.tensor_keys.plan_seed if isinstance(policy, MPCPolicy) else PLAN_SEED
    td[seed_key] = torch.from_numpy(group).reshape(lead)
    kept = [row - int(group[0]) for row in outcome.recorded if row in group]

    def pictures(key: str) -> np.ndarray:
        """Copies of the recorded environments' images, [kept, 3, H, W]."""
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
    memory = td.get(policy.tensor_keys.memory if isinstance(policy, MPCPolicy) else MPC_MEMORY, None)
    return seconds, 0 if memory is None else int(memory["count"].sum())
