"""Planning with the true dynamics: candidates are executed in the simulator.

Beside the success rate of a world model, it separates the losses of the predictor, the encoder and the search.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg.data import ActionStatistics
from torchrl_ficreg.envs.base import PixelGoalEnv
from torchrl_ficreg.envs.registry import find_entry
from torchrl_ficreg.evaluation.probes import measure_states, state_quantities
from torchrl_ficreg.keys import ACTION, GOAL_STATE, LATENT, PIXELS, PLAN, PREDICTED_LATENT, STATE
from torchrl_ficreg.modules.world_model import LatentWorldModel
from torchrl_ficreg.planners import ICEMConfig, LatentICEMPlanner, LatentPlanner, MPCPolicy
from torchrl_ficreg.planners.base import Problem
from torchrl_ficreg.planners.inputs import PlanInputs


class Simulator(nn.Module):
    """An environment as a predictor, whose latents are simulator states.

    Args:
        name (str): short name of an environment of the package, or its Gymnasium id.
        statistics (ActionStatistics): of the z-scored action blocks.
        frame_skip (int): F, environment actions in one action block.
        image_size (int, optional): height and width of the frames, in pixels. Default: ``64``.
        env_kwargs (dict, optional): further arguments of the environment. Default: ``None``.
        on_sequence (callable, optional): called without arguments after each executed sequence. Default: ``None``.

    Attributes:
        env: the environment, which is never reset; its state changes with every call.

    Examples:
        >>> statistics = ActionStatistics(torch.zeros(2), torch.ones(2))
        >>> simulator = Simulator("two_room", statistics, frame_skip=5)
        >>> start = torch.tensor([[[60.0, 112.0]]], dtype=torch.float64)
        >>> simulator.rollout(start, torch.tensor([[[0.0, 1.0] * 5, [0.0, 0.0] * 5]]))
        tensor([[[ 60., 137.],
                 [ 60., 137.]]], dtype=torch.float64)
    """

    history = 1

    def __init__(
        self,
        name: str,
        statistics: ActionStatistics,
        *,
        frame_skip: int,
        image_size: int = 64,
        env_kwargs: dict[str, Any] | None = None,
        on_sequence: Callable[[], object] | None = None,
    ) -> None:
        super().__init__()
        kwargs = {**(env_kwargs or {}), "image_size": image_size}
        if find_entry(name) is find_entry("reacher"):
            kwargs["stop_within_action"] = False  # which would need a goal
        self.env: PixelGoalEnv = find_entry(name).load_env()(**kwargs)
        self.statistics = ActionStatistics(statistics.mean.double().cpu(), statistics.std.double().cpu())
        self.frame_skip, self.on_sequence = frame_skip, on_sequence
        self.latent_dim = self.env.state_space.shape[0]
        self.action_dim = frame_skip * self.env.action_space.shape[0]

    def forward(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """States [..., T, S] and z-scored blocks [..., T, F * A] -> the state after each block [..., T, S]."""
        rows = self.rollout(latent.reshape(-1, 1, latent.shape[-1]), action.reshape(-1, 1, action.shape[-1]))
        return rows.reshape(latent.shape)

    def rollout(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """States after each block of some sequences.

        Args:
            latent (Tensor): states [N, C, S]; the last one is the start.
            action (Tensor): z-scored blocks [N, C - 1 + H, F * A]; the first C - 1 are not used.

        Returns:
            states [N, H, S], float64.
        """
        blocks = action[:, latent.shape[1] - 1 :]  # [N, H, F * A]
        raw = self.statistics.denormalize(blocks.double().cpu()).float()  # environments take float32
        raw = raw.unflatten(-1, (self.frame_skip, -1)).numpy().astype(np.float64)  # [N, H, F, A]
        start = latent[:, -1].double().cpu().numpy()  # [N, S]
        states = np.empty((*raw.shape[:2], start.shape[-1]))
        for row, sequence in enumerate(raw):
            self.env._set_state(start[row])
            for number, block in enumerate(sequence):
                for single in block:
                    self.env._step_physics(single)
                states[row, number] = self.env._get_state()
            if self.on_sequence is not None:
                self.on_sequence()
        return torch.from_numpy(states).to(latent.device)

    def draw(self, state: torch.Tensor) -> torch.Tensor:
        """Frames [N, 3, H, W] uint8 of states [N, S]."""
        return torch.from_numpy(np.stack([self.env._draw(row) for row in state.double().cpu().numpy()]))


class DrawnGoalDistance(nn.Module):
    """Squared distance of the latents of the last state and of the goal state, both drawn and encoded.

    Args:
        model (LatentWorldModel): whose encoder is used, in eval mode.
        simulator (Simulator): draws the frames.
    """

    def __init__(self, model: LatentWorldModel, simulator: Simulator) -> None:
        super().__init__()
        self.model, self.simulator = [model], simulator  # a list: the model is no sub-module, so it keeps its dtype

    def encode(self, state: torch.Tensor) -> torch.Tensor:
        """States [..., S] -> latents [..., D]."""
        model, rows = self.model[0], state.reshape(-1, state.shape[-1])
        parts = [model.encode(self.simulator.draw(part).to(model.action_mean.device)) for part in rows.split(256)]
        return torch.cat(parts).float().reshape(*state.shape[:-1], -1)

    def forward(self, predicted: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """States [E, K, T, S] and goal states [E, S] -> [E, K]."""
        latent, goal_latent = self.encode(predicted[:, :, -1]), self.encode(goal)  # [E, K, D], [E, D]
        return (latent - goal_latent.unsqueeze(1)).square().sum(-1).to(predicted)


class StateDistance(nn.Module):
    """Squared distance of the last state from the goal state, in units of the tolerances of the success rule.

    Args:
        env (str): short name of an environment of the package, or its Gymnasium id.

    Examples:
        >>> states = torch.tensor([[[[60.0, 112.0]], [[84.0, 80.0]]]])  # [1, 2, 1, 2]
        >>> StateDistance("two_room")(states, torch.tensor([[60.0, 80.0]])).tolist()
        [[4.0, 2.25]]
    """

    def __init__(self, env: str) -> None:
        super().__init__()
        self.env = env
        self.quantities = [quantity for quantity in state_quantities(env) if quantity.tolerance is not None]

    def forward(self, predicted: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """States [E, K, T, S] and goal states [E, S] -> [E, K]."""
        reached, wanted = measure_states(self.env, predicted[:, :, -1]), measure_states(self.env, goal.unsqueeze(1))
        errors = [q.error(reached[q.name], wanted[q.name]) / q.tolerance for q in self.quantities]  # each [E, K]
        return torch.stack(errors).square().sum(0).to(predicted)


class _OraclePlanner(LatentICEMPlanner):
    """iCEM that begins at the plan of another planner, which plans with a world model on frames of the states."""

    def __init__(self, *args: Any, guide: LatentPlanner | None, encode: Callable[..., torch.Tensor], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.guide, self.encode_state = [guide], encode

    @property
    def sequences_per_plan(self) -> int:
        """Action sequences that are executed for a plan of one environment."""
        return sum(self._population()) + 1

    def _problem(self, inputs: PlanInputs, dynamics: LatentWorldModel) -> Problem:
        problem, (guide,) = super()._problem(inputs, dynamics), self.guide
        if guide is not None:
            latent, goal = self.encode_state(inputs.latent[:, -1]), self.encode_state(inputs.goal)
            plan = guide.plan(latent, goal, torch.tensor(inputs.seeds))[PLAN]
            problem.initial = problem.clamp(plan.to(problem.initial))
        return problem


def oracle_policy(
    simulator: Simulator,
    model: LatentWorldModel,
    config: ICEMConfig,
    *,
    action_bounds: tuple[Sequence[float], Sequence[float]],
    cost: nn.Module | None = None,
    guide: LatentPlanner | None = None,
) -> MPCPolicy:
    """A policy that plans by iCEM with the true dynamics. It reads ``state`` and ``goal_state`` instead of frames.

    Its planner executes ``planner.sequences_per_plan`` action sequences for a plan of one environment.

    Args:
        simulator (Simulator): executes the candidates.
        model (LatentWorldModel): its encoder gives the latents of drawn states; in eval mode.
        config (ICEMConfig): settings of the search.

    Keyword Args:
        action_bounds (tuple): (low [A], high [A]) in environment units.
        cost (nn.Module, optional): a cost of state trajectories, such as :class:`StateDistance`. Default:
            :class:`DrawnGoalDistance` of ``model``.
        guide (LatentPlanner, optional): planner of the same horizon, from whose plans the search starts. As long as elites
            are kept, no plan costs more than the guide's. Default: ``None``, the search starts at mean actions.

    Raises:
        ValueError: the guide has another horizon.
    """
    if guide is not None and guide.config.horizon != config.horizon:
        raise ValueError(f"the guide plans {guide.config.horizon} blocks, the oracle {config.horizon}: give both one horizon.")
    drawn = DrawnGoalDistance(model, simulator)
    states = LatentWorldModel(
        TensorDictModule(nn.Identity(), [PIXELS], [LATENT]),
        TensorDictModule(simulator, [LATENT, ACTION], [PREDICTED_LATENT]),
        frame_skip=simulator.frame_skip,
        statistics=simulator.statistics,
    )
    planner = _OraclePlanner(
        states.double().eval(),
        config,
        action_bounds=action_bounds,
        cost=drawn if cost is None else cost,
        guide=guide,
        encode=drawn.encode,
    )
    policy = MPCPolicy(planner)
    policy.set_keys(pixels=STATE, goal_pixels=GOAL_STATE)
    return policy
