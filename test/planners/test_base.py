"""All searches reach the optimum of a linear-quadratic world; a plan depends on nothing but latent, goal, settings and seed."""

from __future__ import annotations

import pytest
import torch
from making import make_planner, SEARCHING
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg import ActionEffort, CostSum, GoalDistance, GoalPolicy, LatentPlanner, LatentWorldModel
from torchrl_ficreg.planners import SEARCHES

EFFORT, HORIZON = 8.0, 4
OPTIMAL = {
    "cem": {"num_candidates": 400, "num_elites": 40, "iterations": 20},
    "icem": {"num_candidates": 400, "num_elites": 40, "iterations": 20, "noise_beta": 0.5, "decay": 1.05},
    "mppi": {"num_candidates": 400, "num_elites": 80, "iterations": 20, "min_std": 0.01},
    "gradient": {"num_candidates": 4, "iterations": 150, "learning_rate": 0.1},
}
FAST = {"num_candidates": 24, "num_elites": 5, "iterations": 4, "num_proposals": 4}
STOP = 0.7  # where some of the tiny world's searches stop early and others do not


def make(search, world, **settings):
    """A planner with small settings."""
    return make_planner(search, world, **{**FAST, **settings})


@pytest.fixture
def policy():
    torch.manual_seed(1)
    return GoalPolicy(latent_dim=6, action_dim=4, hidden_dim=16, depth=2).eval()


@pytest.mark.parametrize("default", [torch.float64, torch.bfloat16, "meta"])
@pytest.mark.parametrize("search", SEARCHING)
def test_the_default_dtype_and_device_of_a_script_change_no_plan(tiny_world, search, default):
    """The meta device stands for a GPU: it has no numbers to plan with."""
    world, latent, goal = tiny_world(), torch.randn(2, 6), torch.randn(2, 6)
    expected = make(search, world).plan(latent, goal)
    try:
        torch.set_default_device("meta" if default == "meta" else None)
        torch.set_default_dtype(torch.float32 if default == "meta" else default)
        result = make(search, world).plan(latent, goal)
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)
    torch.testing.assert_close(result.to_dict(), expected.to_dict(), rtol=0, atol=0)


@pytest.mark.usefixtures("fast_bf16")
@pytest.mark.parametrize("search", SEARCHING)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
def test_a_cost_gets_tensors_of_one_dtype_and_its_value_has_it(tiny_world, search, dtype):
    """float64 for float64 latents, else float32."""
    seen = set()

    def cost(predicted, goal, action, start):
        seen.update(tensor.dtype for tensor in (predicted, goal, action, start))
        return torch.einsum("ektd,ed->ek", predicted, goal - start) + action.sum((-1, -2))

    world, latent, goal = tiny_world().to(dtype), torch.randn(2, 6).to(dtype), torch.randn(2, 6).to(dtype)
    result = make(search, world, cost=cost, precision="auto").plan(latent, goal)
    assert seen == {result["plan_cost"].dtype} == {torch.promote_types(dtype, torch.float32)}
    assert result["plan"].dtype == dtype


class Linear(nn.Module):
    """z' = A z + B u in three dimensions, driven by two: nothing like the plane of the other tests."""

    history, latent_dim, action_dim = 1, 3, 2

    def __init__(self):
        super().__init__()
        self.register_buffer("free", torch.tensor([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.2], [0.0, -0.2, 0.8]]))  # A
        self.register_buffer("driven", torch.tensor([[1.0, 0.0], [0.2, 0.5], [0.0, 1.0]]))  # B

    def forward(self, latent, action):
        return latent @ self.free.T + action @ self.driven.T


@pytest.fixture
def quadratic_world():
    encoder = TensorDictModule(nn.Identity(), ["pixels"], ["latent"])
    predictor = TensorDictModule(Linear(), ["latent", "action"], ["predicted_latent"])
    return LatentWorldModel(encoder, predictor, frame_skip=1).eval()


def closed_form(latent, goal, low=-torch.inf, high=torch.inf):
    """Best actions [E, H, 2] and their costs [E]: |M u - (g - A^H z)|^2 + EFFORT mean(u^2), low <= u <= high."""
    network, number = Linear().double(), 2 * HORIZON
    powers = [torch.linalg.matrix_power(network.free, k) for k in range(HORIZON + 1)]
    way = torch.cat([powers[HORIZON - 1 - t] @ network.driven for t in range(HORIZON)], dim=1)  # M [3, H * 2]
    rows = torch.cat([way, (EFFORT / number) ** 0.5 * torch.eye(number, dtype=torch.float64)])  # [3 + H * 2, H * 2]
    missing = goal.double() - latent.double() @ powers[HORIZON].T
    target = torch.cat([missing, missing.new_zeros(len(goal), number)], dim=1)  # [E, 3 + H * 2]
    action = torch.linalg.lstsq(rows, target.T).solution.T  # [E, H * 2]
    if torch.isfinite(torch.as_tensor(high)):
        step = 1 / torch.linalg.matrix_norm(rows, 2) ** 2
        for _ in range(4000):  # projected gradient: a convex problem in a box
            action = (action - step * (action @ rows.T - target) @ rows).clamp(low, high)
    cost = (action @ rows.T - target).square().sum(1)
    return action.unflatten(1, (HORIZON, 2)).float(), cost.float()


@pytest.fixture
def solve(quadratic_world, monkeypatch):
    """``solve(search, latent, goal, **settings)``: distance at the end and effort, four blocks ahead."""
    monkeypatch.setattr("torchrl_ficreg.planners.base.ROWS_AT_ONCE", 512)
    cost = CostSum([GoalDistance(), ActionEffort()], [1.0, EFFORT])

    def solve(search, latent, goal, **settings):
        settings = {**OPTIMAL.get(search, {}), "horizon": HORIZON, **settings}
        return make(search, quadratic_world, cost=cost, **settings).plan(latent, goal)

    return solve


@pytest.fixture
def tasks():
    """Starts and goals [5, 3] a few units apart."""
    generator = torch.Generator().manual_seed(0)
    return torch.randn(5, 3, generator=generator), 2 * torch.randn(5, 3, generator=generator)


@pytest.mark.parametrize("bounds", ["none", "environment"])
@pytest.mark.parametrize("search", OPTIMAL)
def test_the_optimum_of_a_linear_quadratic_world_is_reached(solve, tasks, search, bounds):
    """Within 0.1 % of the cost, and within 0.03 z-scores of the only best actions.

    With bounds, goals are three times as far: four of five need some full actions, none needs nothing else.
    """
    latent, goal = tasks[0], tasks[1] * (1 if bounds == "none" else 3)
    action, lowest = closed_form(latent, goal, *(() if bounds == "none" else (-1.0, 1.0)))
    full = action.abs() == 1
    assert full.any((1, 2)).sum() == (0 if bounds == "none" else 4) and not full.all((1, 2)).any()
    result = solve(search, latent, goal, bounds=bounds)
    assert bounds == "none" or result["plan"].abs().max() <= 1
    torch.testing.assert_close(result["plan_cost"], lowest, rtol=1e-3, atol=0)
    assert (result["plan_cost"] >= lowest * (1 - 1e-5)).all()
    torch.testing.assert_close(result["plan"], action, rtol=0, atol=0.03)
    torch.testing.assert_close(result["plan"][full], action[full], rtol=0, atol=0.01)


def test_random_shooting_is_better_than_doing_nothing_and_worse_than_the_optimum(solve, tasks):
    _, lowest = closed_form(*tasks)
    cost = solve("shooting", *tasks, bounds="none", num_candidates=200)["plan_cost"]
    idle = (tasks[1] - tasks[0] @ torch.linalg.matrix_power(Linear().free, HORIZON).T).square().sum(1)
    assert (cost < idle).all() and (cost > lowest + 0.01).all()


@pytest.mark.parametrize(("settings", "proposals"), [({}, False), ({"stop_std": STOP}, True), ({"precision": "bf16"}, False)])
@pytest.mark.parametrize("search", SEARCHES)
def test_a_plan_is_the_same_alone_among_others_and_in_any_order(tiny_world, policy, search, settings, proposals):
    """To the last bit, however long the others search."""
    planner = make(search, tiny_world(), policy=policy if proposals or search == "policy" else None, **settings)
    latent, goal, seeds = torch.randn(4, 6), torch.randn(4, 6), torch.tensor([3, 1, 4, 15])
    together, order = planner.plan(latent, goal, seeds), torch.randperm(4)
    shuffled = planner.plan(latent[order], goal[order], seeds[order])
    alone = torch.cat([planner.plan(latent[row], goal[row], seeds[row]) for row in torch.arange(4).split(1)])
    for key in ("plan", "plan_cost"):
        assert shuffled[key].equal(together[key][order]) and alone[key].equal(together[key])


@pytest.mark.parametrize("stop_std", [0.0, STOP])
@pytest.mark.parametrize("search", SEARCHES)
def test_side_by_side_the_plans_are_those_of_one_by_one(tiny_world, policy, monkeypatch, search, stop_std):
    """As on a GPU: a group is one batch, in which some stop before others."""
    planner = make(search, tiny_world(), policy=policy, stop_std=stop_std, trace=True, iterations=6)
    generator = torch.Generator().manual_seed(0)
    latent, goal = torch.randn(2, 7, 6, generator=generator)
    single = planner.plan(latent, goal)
    monkeypatch.setattr(LatentPlanner, "_group_size", lambda self, latent: len(latent))
    grouped = planner.plan(latent, goal)
    torch.testing.assert_close(grouped["plan"], single["plan"], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(grouped["plan_cost"], single["plan_cost"], rtol=1e-3, atol=1e-3)
    if search != "policy":
        for key, value in single["trace"].items():
            torch.testing.assert_close(grouped["trace", key], value, rtol=1e-2, atol=1e-3, equal_nan=True)
    if getattr(planner.config, "stop_std", 0):
        assert len(single["trace", "std"].isnan().sum(1).unique()) > 1, "they all stopped together"


@pytest.mark.parametrize(("candidates", "groups"), [(16, [7]), (100, [5, 2]), (257, [1] * 7)])
def test_few_candidates_share_calls_on_a_cpu(tiny_world, monkeypatch, candidates, groups):
    """Up to 512 candidates at once, and the same plans up to the float kernels."""
    planner = make("cem", tiny_world(), num_candidates=candidates, iterations=2)
    latent, goal = torch.randn(2, 7, 6)
    alone = planner.plan(latent, goal)
    monkeypatch.setattr("torchrl_ficreg.planners.base.ROWS_AT_ONCE", 512)
    sizes, search = [], planner._search
    monkeypatch.setattr(planner, "_search", lambda problem: (sizes.append(len(problem.goal)), search(problem))[1])
    torch.testing.assert_close(planner.plan(latent, goal)["plan"], alone["plan"], rtol=1e-3, atol=1e-4)
    assert sizes == groups


@pytest.mark.parametrize("search", SEARCHING)
def test_every_iteration_can_be_traced(tiny_world, search):
    latent, goal = torch.randn(2, 3, 6)
    result = make(search, tiny_world(), trace=True).plan(latent, goal)
    plain = make(search, tiny_world()).plan(latent, goal)
    trace = result["trace"]
    assert set(trace.keys()) == {"best_cost", "elite_cost", "std"} and trace.batch_size == (3,)
    assert all(value.shape == (3, 4) and value.isfinite().all() for value in trace.values())
    assert (trace["best_cost"] <= trace["elite_cost"]).all()
    assert set(plain.keys()) == {"plan", "plan_cost"} and plain["plan"].equal(result["plan"])


@pytest.mark.parametrize("search", ["cem", "icem"])
def test_an_early_stop_ends_the_search_and_the_trace(quadratic_world, tasks, search):
    """The plan is that of as many iterations as were run, and what is missing in the trace is NaN."""
    whole = make(search, quadratic_world, trace=True, iterations=20, num_candidates=100).plan(*tasks)
    config = {"trace": True, "num_candidates": 100, "stop_std": 0.1}
    for row, (latent, goal) in enumerate(zip(*tasks)):
        seed = torch.tensor([row])
        result = make(search, quadratic_world, iterations=20, **config).plan(latent[None], goal[None], seed)
        run = int(result["trace", "std"].isfinite().sum())
        assert 1 < run < 20 and result["trace", "std"][0, run:].isnan().all()
        torch.testing.assert_close(result["trace", "std"][0, :run], whole["trace", "std"][row, :run])
        assert result["trace", "std"][0, run - 1] < 0.1


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode, torch.enable_grad])
@pytest.mark.parametrize("search", SEARCHES)
def test_the_gradient_mode_of_the_user_changes_nothing(tiny_world, policy, search, mode):
    """Latents may come with a graph, the world model is left without gradients, and a result may be written into.

    Whoever asks for a trace gets the entries among ``out_keys``, which hold a trace where there are iterations.
    """
    world = tiny_world()
    planner = make(search, world, policy=policy, trace=True)
    latent, goal = torch.randn(2, 3, 6)
    expected = planner.plan(latent, goal)["plan"]
    with mode():
        seen, wanted = latent * 1, goal * 1
        if mode is torch.enable_grad:
            seen, wanted = seen.requires_grad_(), wanted.requires_grad_()
        result = planner.plan(seen, wanted)
        written = planner(TensorDict({"latent": seen, "goal_latent": wanted}, [3]))
    assert result["plan"].equal(expected)
    assert seen.grad is None and all(param.grad is None for param in [*world.parameters(), *policy.parameters()])
    assert set(written.keys()) == {"latent", "goal_latent", *planner.out_keys}
    assert ("trace" in planner.out_keys) == ("trace" in result.keys()) == (search != "policy")
    for value in result.values(True, True):
        assert not value.requires_grad
        if mode is not torch.inference_mode:
            assert not value.is_inference()
            value.add_(1.0)


@pytest.mark.parametrize("search", SEARCHING)
def test_in_bfloat16_it_finds_better_than_standing_still(tiny_world, search):
    """The cost that it reports is that of the plan, but for rounding."""
    world, (latent, goal) = tiny_world(), torch.randn(2, 3, 6)
    result = make(search, world, precision="bf16").plan(latent, goal)
    with torch.no_grad():
        idle, cost = (
            (world.rollout(latent[:, None], plan)[:, -1] - goal).square().sum(-1)
            for plan in (torch.zeros_like(result["plan"]), result["plan"])
        )
    torch.testing.assert_close(result["plan_cost"], cost, rtol=0.1, atol=0.1)
    assert (cost < idle).all() and result["plan"].dtype == torch.float32


@pytest.mark.slow
def test_compiled_it_plans_the_same(tiny_world):
    latent, goal = torch.randn(2, 3, 6)
    plain, compiled = (make("cem", tiny_world(), iterations=2, compile=on).plan(latent, goal) for on in (False, True))
    torch.testing.assert_close(compiled["plan"], plain["plan"], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(compiled["plan_cost"], plain["plan_cost"], rtol=1e-3, atol=1e-3)
