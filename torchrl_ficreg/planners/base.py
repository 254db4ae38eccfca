"""Base of all planners: from a tensordict to a :class:`Problem` that a search solves.

To read the cross-entropy method, read ``config.py`` (settings), this file (``plan`` and ``Problem.cost``) and ``cem.py``
(loop and update). Left out there: input checks (``inputs.py``), bounds of z-scored blocks (``bounds.py``), the bfloat16 copy
of the predictor (``dynamics.py``) and ``set_keys`` (``modules/keyed.py``).
"""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from torchrl_ficreg._device import autocast, keep_freed_memory
from torchrl_ficreg.keys import ACTION, GOAL_LATENT, LATENT, PAST_ACTION, PLAN, PLAN_COST, PLAN_SEED, TRACE
from torchrl_ficreg.modules.feed import require_tensordict
from torchrl_ficreg.modules.goal_policy import GoalPolicy
from torchrl_ficreg.modules.keyed import KeyedMixin
from torchrl_ficreg.modules.world_model import LatentWorldModel
from torchrl_ficreg.planners.bounds import block_bounds, check_bounds
from torchrl_ficreg.planners.config import PlanConfig
from torchrl_ficreg.planners.costs import call_cost, Cost, GoalDistance, keywords_of
from torchrl_ficreg.planners.dynamics import BFloat16Copy, plans_in_bf16, predictor_dtype, rollouts_within
from torchrl_ficreg.planners.inputs import check_inputs, PlanInputs

ROWS_AT_ONCE = 512  # candidates that keep the cores of a CPU busy


@dataclass
class Problem:
    """A batch of e planning problems: context, goals, bounds and a cost function over action sequences.

    Attributes:
        latent: context [e, C, D], oldest first.
        past_action: z-scored blocks executed between the frames of the context [e, C - 1, F * A].
        goal: [e, D].
        initial: mean of the first iteration [e, horizon, F * A].
        time_to_go: blocks until the goal is due [e] int64, from 1 to the horizon.
        bounds: of a z-scored block, (low [F * A], high [F * A]), equal where a component is constant, or None.
        generators: one for each environment.
        imagined_cost: (latent, past_action, goal, time_to_go, candidates [e, K, horizon, F * A]) -> [e, K].
        proposals: plans of the goal policy [e, 1, horizon, F * A], or None.
    """

    latent: torch.Tensor
    past_action: torch.Tensor
    goal: torch.Tensor
    initial: torch.Tensor
    time_to_go: torch.Tensor
    bounds: tuple[torch.Tensor, torch.Tensor] | None
    generators: list[torch.Generator]
    imagined_cost: Callable[..., torch.Tensor]
    proposals: torch.Tensor | None = None

    def cost(self, candidates: torch.Tensor) -> torch.Tensor:
        """Imagined cost [e, K] of z-scored action blocks [e, K, horizon, F * A]."""
        return self.imagined_cost(self.latent, self.past_action, self.goal, self.time_to_go, candidates)

    def clamp(self, action: torch.Tensor) -> torch.Tensor:
        """Blocks [..., F * A] inside the bounds."""
        return action if self.bounds is None else action.clamp(*self.bounds)

    def noise(self, count: int) -> torch.Tensor:
        """Standard normal draws [e, count, horizon, F * A], each environment's from its own generator."""
        shape = (count, *self.initial.shape[1:])
        draws = [torch.randn(shape, generator=g, device=self.initial.device, dtype=torch.float32) for g in self.generators]
        return torch.stack(draws).to(self.initial.dtype)


class LatentPlanner(KeyedMixin, TensorDictModuleBase, abc.ABC):
    """Plans action sequences in latent space, from a world model (dynamics), a cost and a search.

    Reads ``latent`` [E, D] and ``goal_latent`` [E, D]; a predictor with a history also uses a context: ``latent`` [E, C, D]
    with ``past_action`` [E, C - 1, F * A], the z-scored blocks executed between its frames. ``plan_seed`` [E] int64
    identifies the random draws of each environment; 0, 1, ... by default. Writes ``plan`` [E, horizon, F * A], z-scored, its
    predicted ``plan_cost`` [E], its first block as ``action`` [E, F * A] and, with ``config.trace``, ``trace``. All keys can
    be changed with :meth:`set_keys`.

    Each environment has its own random generator, so its plan does not depend on the other environments, up to the float
    kernels: environments are planned in groups, on CPUs of 512 candidates in all. With 257 candidates or more, a group is one
    environment, and its plan on a CPU is the same to the last bit.

    An action component that never changed in the training data stays at its mean, as does one whose bounds are equal. Rollouts
    run in the predictor's dtype unless ``config.precision`` says otherwise; the search computes in float32, or in float64 for
    float64 latents.

    Args:
        world_model (LatentWorldModel): the dynamics, in ``eval()`` mode.
        config (PlanConfig, optional): settings, an instance of ``config_class``. Default: ``config_class()``.
        action_bounds (tuple, optional): (low [A], high [A]) in environment units. Needed unless ``config.bounds`` is ``"none"``.
        cost (Cost, optional): see :mod:`torchrl_ficreg.planners.costs`. Default: :class:`~torchrl_ficreg.GoalDistance`.
        policy (GoalPolicy, optional): proposes ``config.num_proposals`` of the first candidates.

    Raises:
        ValueError: the bounds are missing or do not fit the model's actions, or the policy does not fit the model.
        TypeError: settings of another planner, or a cost that cannot be called.
    """

    @dataclass(frozen=True)
    class _AcceptedKeys:
        latent: NestedKey = LATENT
        goal_latent: NestedKey = GOAL_LATENT
        past_action: NestedKey = PAST_ACTION
        plan_seed: NestedKey = PLAN_SEED
        action: NestedKey = ACTION
        plan: NestedKey = PLAN
        plan_cost: NestedKey = PLAN_COST
        trace: NestedKey = TRACE

    config_class: type[PlanConfig] = PlanConfig
    needs_gradient = False  # of the cost with respect to the candidates

    def __init__(
        self,
        world_model: LatentWorldModel,
        config: PlanConfig | None = None,
        *,
        action_bounds: tuple[Sequence[float], Sequence[float]] | None = None,
        cost: Cost | None = None,
        policy: GoalPolicy | None = None,
    ) -> None:
        super().__init__()
        self.config = self.config_class() if config is None else config
        if type(self.config) is not self.config_class:  # a subclass holds settings that this planner would ignore
            raise TypeError(
                f"{type(self).__name__} takes a {self.config_class.__name__}, got a {type(self.config).__name__}."
            )
        if self.config.bounds == "environment" and action_bounds is None:
            raise ValueError("the planner needs action_bounds=(low, high) in environment units, or bounds='none' in its config.")
        if policy is not None:
            policy.check_fits(world_model)
        self.world_model, self.policy = world_model, policy
        self.cost = GoalDistance() if cost is None else cost
        self.action_bounds = None if self.config.bounds == "none" else check_bounds(world_model, action_bounds)
        self._cost_keywords = keywords_of(self.cost)
        self._bf16_copy = BFloat16Copy()
        self._compiled: Callable[..., torch.Tensor] | None = None
        self.set_keys()

    def __getstate__(self) -> dict:
        """Leaves out the compiled rollout, which is bound to this planner; a copy compiles its own."""
        return {**super().__getstate__(), "_compiled": None}

    def _apply_keys(self) -> None:
        keys = self.tensor_keys
        self.in_keys = [keys.latent, keys.goal_latent]
        self.out_keys = [keys.action, keys.plan, keys.plan_cost, *([keys.trace] if self.config.trace else [])]

    @property
    def context(self) -> int:
        """Longest context [E, C, D] that is used, in frames."""
        return 1 if self.config.history == "one_frame" else self.world_model.history

    def block_bounds(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Bounds of a z-scored action block, (low [F * A], high [F * A]), or None."""
        return block_bounds(self.world_model, self.action_bounds)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Plans for the environments of a tensordict and writes the result into it; see the class."""
        require_tensordict("a planner", tensordict)
        keys = self.tensor_keys
        inputs = {key: tensordict.get(key, None) for key in self.in_keys}
        missing = [str(key) for key, value in inputs.items() if value is None]
        if missing:
            raise KeyError(f"the planner reads {keys.latent!r} and {keys.goal_latent!r}; {', '.join(missing)} is missing.")
        seeds, past = tensordict.get(keys.plan_seed, None), tensordict.get(keys.past_action, None)
        result = self.plan(*inputs.values(), seeds, past_action=past)
        tensordict.set(keys.action, result[PLAN][:, 0])
        for name in result.keys():
            tensordict.set(getattr(keys, name, name), result[name])
        return tensordict

    def plan(
        self,
        latent: torch.Tensor,
        goal: torch.Tensor,
        seeds: torch.Tensor | None = None,
        *,
        past_action: torch.Tensor | None = None,
        initial: torch.Tensor | None = None,
        time_to_go: torch.Tensor | None = None,
    ) -> TensorDict:
        """Searches a plan for every environment.

        Args:
            latent (Tensor): [E, D], or a context [E, C, D], oldest frame first.
            goal (Tensor): [E, D].
            seeds (Tensor, optional): [E] int64, identify the random draws. Default: 0, 1, ...
            past_action (Tensor, optional): z-scored blocks executed between the frames of the context [E, C - 1, F * A].
            initial (Tensor, optional): z-scored mean of the first iteration [E, horizon, F * A]. Default: zeros.
            time_to_go (Tensor, optional): blocks until the goal is due [E] int64, given to the cost. Default: the horizon.

        Returns:
            a tensordict with ``plan`` [E, horizon, F * A], z-scored, in the dtype of ``latent``, and ``plan_cost`` [E]. With
            ``config.trace`` also ``trace`` with the ``best_cost`` of all candidates, the mean ``elite_cost`` and the mean
            ``std`` of the elites in every iteration, each [E, iterations], NaN after an early stop.

        Raises:
            ValueError: other shapes, numbers that are not finite, or a world model in train mode.
        """
        inputs = check_inputs(self.world_model, self.config.horizon, latent, goal, seeds, past_action, initial, time_to_go)
        first = max(0, inputs.latent.shape[1] - self.context)
        inputs = inputs._replace(latent=inputs.latent[:, first:], past_action=inputs.past_action[:, first:])
        inputs = inputs.to(torch.promote_types(latent.dtype, torch.float32))  # which the std of a population needs
        if latent.device.type == "cpu":
            keep_freed_memory()
        bf16 = plans_in_bf16(self.world_model, self.config.precision)
        dynamics = self._bf16_copy.of(self.world_model) if bf16 else self.world_model
        self._cost_keywords = keywords_of(self.cost)
        with torch.inference_mode(not self.needs_gradient), torch.no_grad():
            if self.needs_gradient:  # autograd cannot save tensors created in inference mode by the caller
                inputs = inputs.clone()
            groups = inputs.split(self._group_size(inputs.latent))
            result = torch.cat([self._solve(self._problem(group, dynamics)) for group in groups])
        result = result.clone()  # outside the inference mode, so that the user may write into it
        result[PLAN] = result[PLAN].to(latent.dtype)
        if not (result[PLAN].isfinite().all() and result[PLAN_COST].isfinite().all()):
            raise ValueError("the plan or its cost is not finite: did the predictor or the cost diverge?")
        return result

    def _solve(self, problem: Problem) -> TensorDict:
        """The result of the search, with ``config.fallback`` replaced by the initial plan or zero actions where that costs less."""
        result = self._search(problem)
        if self.config.fallback:
            statistics, initial = self.world_model.statistics, problem.initial
            idle = statistics.normalize(torch.zeros_like(statistics.mean)).repeat(self.world_model.frame_skip)  # [F * A]
            options = torch.stack([result[PLAN], initial, problem.clamp(idle.to(initial).expand_as(initial))], dim=1)
            cost, best = problem.cost(options).min(1)  # [e]
            result[PLAN], result[PLAN_COST] = options[torch.arange(len(best), device=best.device), best], cost
        return result

    @abc.abstractmethod
    def _search(self, problem: Problem) -> TensorDict:
        """``plan`` [e, horizon, F * A] and ``plan_cost`` [e] of a group of environments."""

    def _group_size(self, latent: torch.Tensor) -> int:
        """Environments planned side by side."""
        candidates = getattr(self.config, "num_candidates", 1)
        if latent.device.type == "cpu":
            return max(1, ROWS_AT_ONCE // candidates)
        steps = candidates * (self.config.horizon + latent.shape[1] - 1)
        return max(1, rollouts_within(self.world_model, self.config.memory_budget, steps))

    def _problem(self, inputs: PlanInputs, dynamics: LatentWorldModel) -> Problem:
        latent, past_action, goal, initial, time_to_go, seeds = inputs
        bounds, proposals = self.block_bounds(), None
        if self.policy is not None and self.config.num_proposals:
            horizon = self.config.horizon
            proposals = self.policy.rollout(self.world_model, latent, past_action, goal, horizon, bounds=bounds).unsqueeze(1)
        initial = initial if bounds is None else initial.clamp(*bounds)
        generators = [make_generator(self.config.seed, seed, latent.device) for seed in seeds]
        imagined_cost = functools.partial(self._rollout_cost(), dynamics)
        return Problem(latent, past_action, goal, initial, time_to_go, bounds, generators, imagined_cost, proposals)

    def _rollout_cost(self) -> Callable[..., torch.Tensor]:
        if not self.config.compile:
            return self._imagined_cost
        if self._compiled is None:
            mode = {"mode": "reduce-overhead"} if torch.cuda.is_available() else {}
            self._compiled = torch.compile(self._imagined_cost, **mode)
        return self._compiled

    def _imagined_cost(self, dynamics, latent, past_action, goal, time_to_go, action) -> torch.Tensor:
        """Cost [e, K] of candidates [e, K, horizon, F * A]; the other shapes are those of a Problem."""
        context, past = (x.unsqueeze(1).expand(-1, action.shape[1], -1, -1) for x in (latent, past_action))  # [e, K, ...]
        blocks, dtype = torch.cat([past, action], dim=2), predictor_dtype(dynamics, goal.dtype)
        predicted = dynamics.rollout(context.to(dtype), blocks.to(dtype)).to(goal.dtype)  # [e, K, horizon, D]
        with autocast(latent.device, "fp32" if dynamics is self.world_model else "bf16"):
            given = {"action": action, "start": latent[:, -1], "time_to_go": time_to_go}
            cost = call_cost(self.cost, self._cost_keywords, predicted, goal, **given)
        return cost.to(goal.dtype)


def mix_seeds(*seeds: int) -> int:
    """One seed of 63 bits from several numbers, none negative."""
    return int(np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0] >> np.uint64(1))


def make_generator(seed: int, environment: int, device: torch.device) -> torch.Generator:
    """The random draws of one environment, from the seed of the search and the environment's own."""
    return torch.Generator(device).manual_seed(mix_seeds(seed, environment % 2**63))
