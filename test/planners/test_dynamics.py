"""Claims about the dynamics of a plan: in bfloat16 or not, the world model stays as it is; a user's own predictor plans."""

from __future__ import annotations

from typing import get_type_hints

import pytest
import torch
from making import make_planner, SEARCHING
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from torchrl_ficreg import (
    CausalPredictor,
    GoalDistance,
    GoalPolicy,
    GoalPolicyPlanner,
    LatentWorldModel,
    MPCPolicy,
    PlanConfig,
)
from torchrl_ficreg.data import ActionStatistics
from torchrl_ficreg.planners.dynamics import plans_in_bf16, rollouts_within
from torchrl_ficreg.protocols import WorldModel

SEARCH = {"num_candidates": 32, "num_elites": 6, "iterations": 5}


def snapshot(world):
    """Name, identity, dtype and bytes of every parameter and buffer."""
    tensors = [*world.named_parameters(), *world.named_buffers()]
    return [(name, id(value), value.dtype, value.detach().numpy().tobytes()) for name, value in tensors]


@pytest.mark.parametrize("error", [ValueError("no such goal"), KeyboardInterrupt(), torch.OutOfMemoryError("full")])
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_planning_changes_nothing_in_the_world_model(tiny_world, precision, error):
    """Not a bit, not a dtype, not even which objects its parameters are; nor does an error or an interruption of the search.

    The next plan is that of a planner without an error before it.
    """
    world, (latent, goal), calls = tiny_world(), torch.randn(2, 2, 6), []

    def cost(predicted, goal):
        calls.append(len(calls))
        if len(calls) == 3:
            raise error
        return GoalDistance()(predicted, goal)

    before = snapshot(world)
    expected = make_planner("cem", world, **SEARCH | {"precision": precision}).plan(latent, goal)["plan"]
    assert snapshot(world) == before
    planner = make_planner("cem", world, cost=cost, **SEARCH | {"precision": precision})
    with pytest.raises(type(error)):
        planner.plan(latent, goal)
    assert snapshot(world) == before and all(param.requires_grad and param.grad is None for param in world.parameters())
    assert planner.plan(latent, goal)["plan"].equal(expected)


def test_weights_trained_further_are_planned_with(tiny_world):
    """The bfloat16 copy is brought up to date for every plan: no stale weights between two of them."""
    world, (latent, goal) = tiny_world(), torch.randn(2, 1, 6)
    planner = make_planner("cem", world, **SEARCH, precision="bf16")
    before = planner.plan(latent, goal)["plan_cost"]
    with torch.no_grad():
        for param in world.predictor.parameters():
            param.mul_(1.5)
    assert not planner.plan(latent, goal)["plan_cost"].equal(before)


class Own(nn.Module):
    """A network with nothing but the tensors that it maps: no linear layer, and nothing that could be bfloat16."""

    def __init__(self):
        super().__init__()
        self.mix = nn.Bilinear(6, 4, 6)

    def forward(self, latent, action):
        if latent.dtype != torch.float32:
            raise TypeError("float32 only")
        return latent + 0.1 * self.mix(latent, action)


def sized(module):
    """A TensorDictModule that says how large its network is."""
    module.history, module.latent_dim, module.action_dim = 2, 6, 4
    return module


def own_predictors():
    """By name, a plain network in a TensorDictModule, and a sequence of two modules with a hidden entry."""
    torch.manual_seed(0)
    yield "module", sized(TensorDictModule(Own(), ["latent", "action"], ["predicted_latent"]))
    double = TensorDictModule(lambda action: 2 * action, ["action"], ["doubled"])
    step = TensorDictModule(Own(), ["latent", "doubled"], ["predicted_latent"])
    yield "sequence", sized(TensorDictSequential(double, step))


@pytest.mark.usefixtures("fast_bf16")
@pytest.mark.parametrize("search", SEARCHING)
@pytest.mark.parametrize("kind", ["module", "sequence"])
def test_a_users_own_predictor_plans(tiny_world, search, kind):
    """Better than standing still; left to choose, the planner does not cast it to bfloat16."""
    world = LatentWorldModel(tiny_world().encoder, dict(own_predictors())[kind], frame_skip=2).eval()
    context, past, goal = torch.randn(3, 2, 6), torch.randn(3, 1, 4), torch.randn(3, 6)
    result = make_planner(search, world, iterations=5, precision="auto").plan(context, goal, past_action=past)
    with torch.no_grad():
        idle, cost = (
            (world.rollout(context, torch.cat([past, plan], dim=1))[:, -1] - goal).square().sum(-1)
            for plan in (torch.zeros_like(result["plan"]), result["plan"])
        )
    torch.testing.assert_close(result["plan_cost"], cost)
    assert (cost < idle).all()


@pytest.mark.usefixtures("fast_bf16")
def test_only_a_float32_predictor_of_the_package_is_cast_by_default(tiny_world, fast_bf16):
    model = tiny_world()
    assert plans_in_bf16(model, "auto") == fast_bf16 and isinstance(model.predictor, CausalPredictor)
    assert not plans_in_bf16(model.double(), "auto") and plans_in_bf16(model, "bf16")


def test_memory_is_estimated_for_any_network(tiny_world):
    """Fewer rollouts the longer and the wider they are; a network without parameters is no exception."""
    model, wide = tiny_world(), tiny_world(predictor_mlp_dim=64)
    assert rollouts_within(model, 1.0, 10) > rollouts_within(model, 1.0, 20) > rollouts_within(wide, 1.0, 20) > 0
    assert rollouts_within(model, 1e-9, 10) == 0
    identity = sized(TensorDictModule(lambda latent, action: latent, ["latent", "action"], ["predicted_latent"]))
    assert rollouts_within(LatentWorldModel(model.encoder, identity, frame_skip=2), 1.0, 10) > 0


class OwnWorld(nn.Module):
    """A world model with what ``protocols.WorldModel`` lists and nothing else: each action moves the latent by itself."""

    latent_dim, block_dim, history, frame_skip = 2, 4, 1, 2

    def __init__(self):
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))
        self.statistics = ActionStatistics(torch.zeros(2), torch.ones(2))

    def encode(self, pixels):
        return self.scale * pixels[..., :2, 0, 0]

    def rollout(self, latent, action):
        moves = action[..., latent.shape[-2] - 1 :, :].unflatten(-1, (2, 2)).sum(-2)  # [..., N, D]
        return latent[..., -1:, :] + self.scale * moves.cumsum(-2)


@pytest.mark.parametrize("precision", ["auto", "fp32", "bf16"])
@pytest.mark.parametrize("search", SEARCHING)
def test_a_world_model_of_ones_own_needs_no_predictor(search, precision):
    world, goal = OwnWorld().eval(), torch.tensor([[2.0, -1.0]])
    assert {*get_type_hints(WorldModel), "encode", "rollout"} <= {*dir(world)}
    planner = make_planner(search, world, precision=precision, num_candidates=64, iterations=10)
    pixels = goal[..., None, None].expand(1, 2, 3, 3)
    action = MPCPolicy(planner)(TensorDict({"pixels": 0 * pixels, "goal_pixels": pixels}, [1]))["action"]
    assert action.shape == (1, 2) and (action.abs() <= 1).all()
    assert planner.plan(torch.zeros(1, 2), goal)["plan_cost"].item() < goal.square().sum().item() / 2
    assert world.scale.dtype == torch.float32


def test_a_goal_policy_acts_in_a_world_model_of_ones_own():
    world, policy, goal = OwnWorld().eval(), GoalPolicy(2, 4).eval(), torch.randn(3, 2)
    config = PlanConfig(horizon=3, receding_horizon=1, bounds="none")
    plan = GoalPolicyPlanner(world, config, policy=policy).plan(goal, 0 * goal)
    with torch.no_grad():
        latents = torch.cat([goal.unsqueeze(1), world.rollout(goal.unsqueeze(1), plan["plan"])], dim=1)
        expected = policy.module(latents[:, :-1], 0 * latents[:, :-1])
    torch.testing.assert_close(plan["plan"], expected)
