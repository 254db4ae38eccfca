"""Claims about what a plan starts from: the real frames and executed blocks before it, the rest of the last plan."""

from __future__ import annotations

import pytest
import torch
from making import make_planner, SEARCHING, UNIT
from tensordict import TensorDict

from torchrl_ficreg import LatentPlanner, MPCPolicy, PlanConfig
from torchrl_ficreg.data import ActionStatistics

STEPS = 2  # raw actions in a block of the tiny world


class Recorded(LatentPlanner):
    """Plans random blocks and keeps every problem that it got, with its plan."""

    def _search(self, problem):
        plan = problem.clamp(0.5 * problem.noise(1)[:, 0])
        self.__dict__.setdefault("problems", []).append((problem, plan))
        return TensorDict({"plan": plan, "plan_cost": plan[:, 0, 0]}, [len(plan)])

    @property
    def contexts(self):
        """C of every problem so far."""
        return [problem.latent.shape[1] for problem, _ in self.problems]


def recorded(world, bounds=UNIT, **settings):
    settings = {"horizon": 3, "receding_horizon": 1, "precision": "fp32", **settings}
    return Recorded(world, PlanConfig(**settings), action_bounds=bounds)


def frames(count, seed=0):
    """Frames of different environments [count, 3, 16, 16]."""
    return torch.randint(0, 256, (count, 3, 16, 16), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


def serve(policy, steps, envs=1, resets=None, seeds=None):
    """New frames at every step; ``resets`` names environments by step. Frames and actions, [steps, E, ...] each."""
    td = TensorDict({"goal_pixels": frames(envs, 999)}, [envs])
    if seeds is not None:
        td["plan_seed"] = torch.tensor(seeds)
    seen, actions = [], []
    for step in range(steps):
        td["pixels"] = frames(envs, step)
        td["is_init"] = torch.tensor([[step == 0 or env in (resets or {}).get(step, ())] for env in range(envs)])
        td = policy(td)
        seen.append(td["pixels"].clone())
        actions.append(td["action"].clone())
    return torch.stack(seen), torch.stack(actions)


@pytest.mark.parametrize("search", SEARCHING)
def test_the_cost_of_a_plan_is_that_of_its_rollout_from_the_context(tiny_world, search):
    """Three real frames and the two blocks between them; without them the same search finds another plan."""
    world = tiny_world()
    context, past, goal = torch.randn(2, 3, 6), torch.randn(2, 2, 4), torch.randn(2, 6)
    result = make_planner(search, world).plan(context, goal, past_action=past)
    with torch.no_grad():
        end = world.rollout(context, torch.cat([past, result["plan"]], dim=1))[:, -1]
    torch.testing.assert_close(result["plan_cost"], (end - goal).square().sum(-1))
    one_frame = make_planner(search, world, history="one_frame")
    other = one_frame.plan(context, goal, past_action=past)
    assert not torch.allclose(other["plan_cost"], result["plan_cost"], rtol=1e-3)
    assert other["plan"].equal(one_frame.plan(context[:, -1], goal)["plan"])


@pytest.mark.parametrize("history", [1, 2, 3])
def test_of_a_longer_context_the_newest_frames_are_taken(tiny_world, history):
    planner = recorded(tiny_world(history=history))
    context, past, goal = torch.randn(2, 5, 6), torch.randn(2, 4, 4), torch.randn(2, 6)
    planner.plan(context, goal, past_action=past)
    assert planner.context == history
    for env, (problem, _) in enumerate(planner.problems):
        assert problem.latent.equal(context[env : env + 1, 5 - history :])
        assert problem.past_action.equal(past[env : env + 1, 5 - history :])


@pytest.mark.parametrize(("receding_horizon", "expected"), [(1, [1, 2, 3, 3, 3, 3]), (2, [1, 3, 3]), (3, [1, 3])])
def test_the_context_grows_frame_by_frame_and_then_slides(tiny_world, receding_horizon, expected):
    """Six blocks. Frames on which no plan was made count as well; those in the middle of a block do not.

    The past blocks are exactly the executed ones, z-scored, although bounds had cut what was planned.
    """
    world = tiny_world()
    world.statistics = ActionStatistics(torch.tensor([0.2, -0.1]), torch.tensor([0.5, 0.3]))
    planner = recorded(world, receding_horizon=receding_horizon)
    seen, actions = serve(MPCPolicy(planner), 6 * STEPS)
    assert planner.contexts == expected
    assert actions.abs().max() <= 1
    with torch.no_grad():
        latent = torch.stack([world.encode(frame) for frame in seen[::STEPS]], dim=1)  # [1, 6, D]
    blocks = world.statistics.normalize(actions[:, 0]).unflatten(0, (6, STEPS)).flatten(1)[None]  # [1, 6, F * A]
    for number, (problem, _) in enumerate(planner.problems):
        now = number * receding_horizon
        first = max(0, now - 2)
        torch.testing.assert_close(problem.latent, latent[:, first : now + 1])
        torch.testing.assert_close(problem.past_action, blocks[:, first:now])


@pytest.mark.parametrize(("sizes", "settings"), [({}, {"history": "one_frame"}), ({"history": 1}, {"history": "context"})])
def test_where_one_frame_is_used_none_is_collected(tiny_world, sizes, settings):
    planner = recorded(tiny_world(**sizes), **settings)
    serve(MPCPolicy(planner), 5 * STEPS)
    assert planner.contexts == [1] * 5
    assert all(problem.past_action.shape == (1, 0, 4) for problem, _ in planner.problems)


def test_a_reset_clears_the_context_and_the_plan_of_one_environment(tiny_world):
    """The environment that was reset starts from one frame and mean actions; the other continues."""
    world = tiny_world()
    planner = recorded(world)
    seen, _ = serve(MPCPolicy(planner), 4 * STEPS, envs=2, resets={2 * STEPS: [1]})
    ages = [(1, 1), (2, 2), (3, 1), (3, 2)]
    assert sorted(planner.contexts) == sorted(age for pair in ages for age in pair)
    starts = {problem.latent.shape[1]: problem.initial for problem, _ in planner.problems[4:6]}  # right after the reset
    assert (starts[1] == 0).all() and (starts[3] != 0).any()
    with torch.no_grad():
        fresh = world.encode(seen[2 * STEPS, 1:])  # [1, D]
    after = [problem.latent for problem, _ in planner.problems[-2:] if problem.latent.shape[1] == 2]
    torch.testing.assert_close(after[0][:, 0], fresh)


def test_a_reset_in_the_middle_of_a_block_drops_that_block(tiny_world):
    """No frame of the new episode follows it."""
    planner = recorded(tiny_world(), receding_horizon=2)
    _, actions = serve(MPCPolicy(planner), 1 + 4 * STEPS, resets={1: [0]})
    assert planner.contexts == [1, 1, 3]
    blocks = actions[1 : 1 + 2 * STEPS, 0].unflatten(0, (2, STEPS)).flatten(1)[None]
    torch.testing.assert_close(planner.problems[-1][0].past_action, blocks)


@pytest.mark.parametrize("receding_horizon", [1, 2])
def test_environments_of_different_ages_act_as_they_do_alone(tiny_world, monkeypatch, receding_horizon):
    """Planned for in groups of one age, each with its own context, whether one by one or side by side."""
    envs, steps, seeds = 4, 6 * STEPS, [8, 3, 5, 1]
    resets = {STEPS: [1], 3 * STEPS: [1, 2], 3 * STEPS + 1: [3]}
    policy = MPCPolicy(make_planner("cem", tiny_world(), receding_horizon=receding_horizon, iterations=1))
    _, together = serve(policy, steps, envs, resets, seeds)
    for env in range(envs):
        td = TensorDict({"goal_pixels": frames(envs, 999)[env : env + 1], "plan_seed": torch.tensor([seeds[env]])}, [1])
        for step in range(steps):
            td["pixels"] = frames(envs, step)[env : env + 1]
            td["is_init"] = torch.tensor([[env in resets.get(step, ())]])
            assert policy(td)["action"].equal(together[step, env : env + 1])
    monkeypatch.setattr(LatentPlanner, "_group_size", lambda self, latent: len(latent))
    torch.testing.assert_close(serve(policy, steps, envs, resets, seeds)[1], together, rtol=1e-3, atol=1e-3)


def test_those_of_one_age_are_planned_for_together(tiny_world, monkeypatch):
    """Four environments, two reset after a block: then two groups of two, until all contexts are full."""
    monkeypatch.setattr(LatentPlanner, "_group_size", lambda self, latent: len(latent))
    planner = recorded(tiny_world())
    serve(MPCPolicy(planner), 4 * STEPS, envs=4, resets={STEPS: [1, 3]})
    shapes = [tuple(problem.latent.shape[:2]) for problem, _ in planner.problems]
    assert shapes == [(4, 1), (2, 1), (2, 2), (2, 2), (2, 3), (4, 3)]


@pytest.mark.parametrize("receding_horizon", [1, 2, 3])
def test_a_search_starts_from_what_was_not_executed(tiny_world, receding_horizon):
    """The last plan moved up by the executed blocks, and mean actions after it."""
    planner = recorded(tiny_world(), receding_horizon=receding_horizon)
    serve(MPCPolicy(planner), 3 * receding_horizon * STEPS)
    assert (planner.problems[0][0].initial == 0).all()
    for (_, last), (problem, _) in zip(planner.problems, planner.problems[1:]):
        rest = last[:, receding_horizon:]
        assert problem.initial[:, : rest.shape[1]].equal(rest)
        assert (problem.initial[:, rest.shape[1] :] == 0).all() and problem.initial.shape == (1, 3, 4)
        assert receding_horizon == 3 or (rest != 0).any()


def test_without_a_warm_start_it_starts_from_mean_actions(tiny_world):
    planner = recorded(tiny_world(), warm_start=False)
    serve(MPCPolicy(planner), 3 * STEPS)
    assert len(planner.problems) == 3
    assert all((problem.initial == 0).all() for problem, _ in planner.problems)


def test_a_search_searches_around_its_initial_plan(linear_world):
    """Candidate 0 of the first iteration is the initial plan: with the optimum given, nothing better is found."""
    initial = torch.full((1, 3, 4), 0.5)
    result = make_planner("shooting", linear_world()).plan(torch.zeros(1, 2), torch.tensor([[3.0, 3.0]]), initial=initial)
    assert result["plan"].equal(initial) and result["plan_cost"].item() == 0
