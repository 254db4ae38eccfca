"""What every latent planner shares: its bounds, its costs, its random draws and its place in TorchRL."""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.modules import SafeModule
from torchrl.modules.planners import MPCPlannerBase

from torchrl_ficreg._device import autocast, keep_freed_memory, uses_bf16
from torchrl_ficreg.keys import ACTION, GOAL_LATENT, LATENT
from torchrl_ficreg.modules.feed import require_tensordict
from torchrl_ficreg.modules.goal_policy import GoalPolicy
from torchrl_ficreg.modules.world_model import LatentWorldModel
from torchrl_ficreg.planners.bounds import block_bounds, check_bounds
from torchrl_ficreg.planners.config import PlanConfig
from torchrl_ficreg.planners.costs import Cost, GoalDistance, wanted_by
from torchrl_ficreg.planners.problem import FastDynamics, make_generator, Problem

ROWS_AT_ONCE = 512  # candidates that keep the cores of a CPU busy
PLAN, PLAN_COST, PLAN_SEED, PAST_ACTION, TRACE = "plan", "plan_cost", "plan_seed", "past_action", "trace"


class LatentPlanner(MPCPlannerBase):
    """Dynamics x cost x search: plans in latent space and never sees an environment.

    Reads ``latent`` [E, D] and ``goal_latent`` [E, D]; ``plan_seed`` [E] int64 names the random draws of each
    environment and defaults to 0, 1, ... A predictor that sees several frames makes use of a context: ``latent``
    [E, C, D] with ``past_action`` [E, C - 1, F * A], the blocks executed between these frames. Writes ``plan``
    [E, horizon, F * A] z-scored, its predicted ``plan_cost`` [E] and, as TorchRL's planners do, the first block as
    ``action`` [E, F * A]; with ``config.trace`` also the ``trace`` of every iteration.

    Every environment draws from a generator of its own, so its plan is the same alone or among fifty, up to the float
    kernels: environments are imagined in groups, on CPUs of 512 candidates in all. With 257 candidates or more, that is
    environment by environment, and a plan on a CPU is the same to the last bit whatever is planned beside it.

    An action component that never changed in the training data stays at its mean in every candidate, as does one whose
    bounds are equal. A model cast to another dtype is rolled out in that dtype, and a predictor of your own network in its
    own, unless ``config.precision`` is ``"bf16"``; the search itself computes in float32, or in float64 for float64 latents.

    Args:
        world_model: the dynamics; put it into ``eval()`` first.
        config: settings, of the kind in ``config_class``.
        action_bounds: (low [A], high [A]) in environment units; needed unless ``config.bounds`` is ``"none"``.
        cost: module from predictions [E, K, T, D] and goals [E, D] to costs [E, K], see
            :mod:`torchrl_ficreg.planners.costs`; :class:`~torchrl_ficreg.GoalDistance` when None.
        policy: proposes ``config.num_proposals`` of the first candidates.

    Raises:
        ValueError: bounds are missing or have another shape than the model's actions, or the policy does not fit.
        TypeError: settings of another search.
    """

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
        # MPCPlannerBase.__init__ wants an environment to imagine in; the world model takes its place.
        SafeModule.__init__(self, world_model, in_keys=[LATENT, GOAL_LATENT], out_keys=[ACTION, PLAN, PLAN_COST])
        self.config = self.config_class() if config is None else config
        if not isinstance(self.config, self.config_class):
            raise TypeError(
                f"{type(self).__name__} takes a {self.config_class.__name__}, got a {type(self.config).__name__}."
            )
        self.cost = GoalDistance() if cost is None else cost
        self.policy = policy
        if policy is not None:
            policy.check_fits(world_model)
        self.action_bounds = self._check_bounds(action_bounds)
        self._fast = FastDynamics()
        self._wanted = wanted_by(self.cost)
        self._compiled: Callable[..., torch.Tensor] | None = None

    def __getstate__(self) -> dict:
        """Without the compiled rollout, which is bound to this very planner; a copy compiles its own."""
        return {**super().__getstate__(), "_compiled": None}

    @property
    def world_model(self) -> LatentWorldModel:
        """The dynamics."""
        return self.module

    def _check_bounds(self, bounds) -> tuple[torch.Tensor, torch.Tensor] | None:
        if self.config.bounds == "none":
            return None
        if bounds is None:
            raise ValueError(
                "the planner needs action_bounds=(low, high) in environment units, or PlanConfig(bounds='none')."
            )
        return check_bounds(self.world_model, bounds)

    def block_bounds(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Bounds of a z-scored action block, (low [F * A], high [F * A]), or None."""
        return block_bounds(self.world_model, self.action_bounds)

    @property
    def context(self) -> int:
        """The longest context [E, C, D] that is made use of, in frames."""
        return 1 if self.config.history == "one_frame" else self.world_model.history

    def planning(self, td: TensorDictBase) -> torch.Tensor:
        """The first block [E, F * A] of the plan for what td holds, which is left as it is."""
        return self._plan_from(td)[PLAN][:, 0]

    def forward(self, tensordict: TensorDictBase, tensordict_out: TensorDictBase | None = None) -> TensorDictBase:
        """See the class."""
        result = self._plan_from(tensordict)
        written = (result[PLAN][:, 0], result[PLAN], result[PLAN_COST])
        tensordict_out = self._write_to_tensordict(tensordict, written, tensordict_out)
        return tensordict_out.update(result.exclude(PLAN, PLAN_COST))

    def _plan_from(self, td: TensorDictBase) -> TensorDict:
        """What :meth:`plan` returns for what td holds."""
        require_tensordict("a planner", td)
        missing = [key for key in (LATENT, GOAL_LATENT) if td.get(key, None) is None]
        if missing:
            raise KeyError(f"the planner reads {LATENT!r} and {GOAL_LATENT!r}; {', '.join(missing)} is missing.")
        return self.plan(
            td.get(LATENT), td.get(GOAL_LATENT), td.get(PLAN_SEED, None), past_action=td.get(PAST_ACTION, None)
        )

    def plan(
        self,
        latent: torch.Tensor,
        goal: torch.Tensor,
        seeds: torch.Tensor | None = None,
        *,
        past_action: torch.Tensor | None = None,
        initial: torch.Tensor | None = None,
    ) -> TensorDict:
        """Searches a plan for every environment.

        Args:
            latent: [E, D], or a context [E, C, D] with the present last.
            goal: [E, D].
            seeds: [E] int64, names of the random draws.
            past_action: z-scored blocks executed between the frames of the context [E, C - 1, F * A].
            initial: mean of the first iteration, z-scored [E, horizon, F * A]; zeros when None.

        Returns:
            ``plan`` [E, horizon, F * A], z-scored, in the dtype of ``latent``, and ``plan_cost`` [E], the cost
            predicted for it. With ``config.trace`` also, under ``trace``, of every iteration (NaN after an early stop):
            the ``best_cost`` of all candidates, the mean ``elite_cost`` and their mean standard deviation ``spread``,
            each [E, iterations].

        Raises:
            ValueError: other shapes, numbers that are not finite, or a world model in train mode.
        """
        if latent.ndim == 2:
            latent = latent.unsqueeze(1)  # [E, 1, D]
        if past_action is None and latent.ndim == 3 and latent.shape[1] == 1:
            past_action = latent.new_zeros(len(latent), 0, self.world_model.block_dim)
        seeds = list(range(len(latent))) if seeds is None else torch.as_tensor(seeds, device="cpu").long().flatten().tolist()
        if initial is None:
            initial = latent.new_zeros(len(latent), self.config.horizon, self.world_model.block_dim)
        self._check_inputs(latent, goal, seeds, past_action, initial)
        first = max(0, latent.shape[1] - self.context)
        latent, past_action, given = latent[:, first:], past_action[:, first:], latent.dtype
        # Means and deviations of a population need float32 whatever the model computes in.
        working = torch.promote_types(given, torch.float32)
        latent, past_action, goal, initial = (x.to(working) for x in (latent, past_action, goal, initial))
        group = self._group_size(latent)
        if latent.device.type == "cpu":
            keep_freed_memory()
        self._wanted = wanted_by(self.cost)
        dynamics = self._fast.of(self.world_model) if self._wants_bf16_copy() else self.world_model
        with torch.inference_mode(not self.needs_gradient), torch.no_grad():
            if self.needs_gradient:  # autograd keeps no tensor that was made in an inference mode outside
                latent, past_action, goal, initial = (x.clone() for x in (latent, past_action, goal, initial))
            results = [
                self._search(self._problem(dynamics, *(x[i : i + group] for x in (latent, past_action, goal, initial, seeds))))
                for i in range(0, len(latent), group)
            ]
        result = torch.cat(results).clone()  # outside the inference mode, so that the user may write into it
        result[PLAN] = result[PLAN].to(given)
        if not (result[PLAN].isfinite().all() and result[PLAN_COST].isfinite().all()):
            raise ValueError("planning gave numbers that are not finite: did the predictor diverge, or the cost?")
        return result

    def _check_inputs(self, latent, goal, seeds, past_action, initial) -> None:
        model, horizon = self.world_model, self.config.horizon
        if model.encoder.training or model.predictor.training:
            raise ValueError("the world model is in train mode, where dropout blurs every plan: call its eval().")
        envs, width, block = len(latent), model.latent_dim, model.block_dim
        if (
            latent.ndim != 3
            or envs < 1
            or latent.shape[-1] != width
            or goal.shape != (envs, width)
            or len(seeds) != envs
            or initial.shape != (envs, horizon, block)
        ):
            raise ValueError(
                f"expected latents [E, {width}] or [E, C, {width}], goals [E, {width}], seeds [E] and initial plans "
                f"[E, {horizon}, {block}], got {list(latent.shape)}, {list(goal.shape)}, [{len(seeds)}] and "
                f"{list(initial.shape)}."
            )
        if past_action is None or past_action.shape != (envs, latent.shape[1] - 1, block):
            raise ValueError(
                f"a context of {latent.shape[1]} frames needs past_action [{envs}, {latent.shape[1] - 1}, {block}], the "
                f"z-scored blocks executed between them, got {None if past_action is None else list(past_action.shape)}."
            )
        for name, value in (("latents", latent), ("goals", goal), ("past actions", past_action), ("initial plans", initial)):
            if not value.isfinite().all():
                raise ValueError(f"there are {name} that are not finite: did training diverge, or is a frame damaged?")

    def _candidates(self) -> int:
        """Most action sequences that are imagined at once for an environment."""
        return self.config.num_candidates

    def _group_size(self, latent: torch.Tensor) -> int:
        """Environments planned for side by side."""
        if latent.device.type == "cpu":
            return max(1, ROWS_AT_ONCE // self._candidates())
        width = sum(layer.out_features for layer in self.world_model.predictor.modules() if isinstance(layer, nn.Linear))
        rows = self._candidates() * (self.config.horizon + latent.shape[1] - 1)
        return max(1, int(self.config.memory_budget * 2**30 / (4 * rows * max(1, width))))

    def _problem(self, dynamics, latent, past_action, goal, initial, seeds) -> Problem:
        bounds = self.block_bounds()
        problem = Problem(
            latent,
            past_action,
            goal,
            initial if bounds is None else initial.clamp(*bounds),
            bounds,
            [make_generator(self.config.seed, seed, latent.device) for seed in seeds],
            functools.partial(self._rollout_cost(), dynamics),
        )
        if self.policy is not None and self.config.num_proposals:
            problem.proposals = self.policy.imagine(
                self.world_model, latent, past_action, goal, self.config.horizon, bounds=bounds
            ).unsqueeze(1)  # [e, 1, horizon, F * A]
        return problem

    def _wants_bf16_copy(self) -> bool:
        """Whether rollouts run in a bfloat16 copy of the predictor.

        Left to choose, a network of the user's own is not cast, as it may not bear the rounding, nor is one that its user cast.
        """
        precision, predictor = self.config.precision, self.world_model.predictor
        if precision == "auto" and not (
            hasattr(predictor, "imagine") and _dtype_of(predictor, torch.empty(0)) == torch.float32
        ):
            precision = "fp32"
        return uses_bf16(self.world_model.action_mean.device, precision)

    def _rollout_cost(self) -> Callable[..., torch.Tensor]:
        if not self.config.compile:
            return self._imagined_cost
        if self._compiled is None:
            mode = {"mode": "reduce-overhead"} if torch.cuda.is_available() else {}
            self._compiled = torch.compile(self._imagined_cost, **mode)
        return self._compiled

    def _imagined_cost(self, dynamics, latent, past_action, goal, action) -> torch.Tensor:
        """Cost [e, K] of candidates [e, K, horizon, F * A]; the other shapes are those of a Problem."""
        candidates = action.shape[1]
        start = latent.unsqueeze(1).expand(-1, candidates, -1, -1)  # [e, K, C, D]
        past = past_action.unsqueeze(1).expand(-1, candidates, -1, -1)  # [e, K, C - 1, F * A]
        blocks = torch.cat([past, action], dim=2)
        dtype = _dtype_of(dynamics.predictor, start)
        predicted = dynamics.rollout(start.to(dtype), blocks.to(dtype)).to(goal.dtype)  # [e, K, horizon, D]
        extra = {"action": action, "start": latent[:, -1]}
        with autocast(latent.device, "fp32" if dynamics is self.world_model else "bf16"):
            cost = self.cost(predicted, goal, **{name: extra[name] for name in self._wanted})
        shape = getattr(cost, "shape", type(cost).__name__)
        if shape != action.shape[:2]:
            raise ValueError(
                f"a cost maps predictions {list(predicted.shape)} and goals {list(goal.shape)} to [E, K] = "
                f"{list(action.shape[:2])}, {type(self.cost).__name__} returned {shape if isinstance(shape, str) else list(shape)}."
            )
        return cost.to(goal.dtype)

    @abc.abstractmethod
    def _search(self, problem: Problem) -> TensorDict:
        """``plan`` [e, horizon, F * A] and ``plan_cost`` [e] of a group of environments."""


def _dtype_of(module: nn.Module, default: torch.Tensor) -> torch.dtype:
    """Dtype of a module's floating-point parameters, that of ``default`` where it has none."""
    return next((p.dtype for p in module.parameters() if p.is_floating_point()), default.dtype)
