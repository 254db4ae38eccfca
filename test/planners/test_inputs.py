"""Claims about bad input and settings: refused before anything is imagined, with what to do."""

from __future__ import annotations

import itertools

import pytest
import torch
from making import make_config, make_planner, SEARCHING
from tensordict import TensorDict

from torchrl_ficreg import GoalDistance, GoalPolicy, MPCPolicy
from torchrl_ficreg.planners import SEARCHES

NAN = torch.full((2, 6), torch.nan)
INF = torch.full((2, 3, 4), torch.inf)


def untouched(predicted, goal):
    """A cost that must not be called."""
    raise AssertionError("planning began")


@pytest.mark.parametrize("search", SEARCHING)
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal": torch.zeros(2, 5)}, r"goals \[E, 6\].*got \[2, 1, 6\], \[2, 5\]"),
        ({"goal": torch.zeros(3, 6)}, r"goals \[E, 6\]"),
        ({"latent": torch.zeros(2, 7)}, r"expected latents \[E, 6\] or \[E, C, 6\]"),
        ({"latent": torch.zeros(6)}, r"expected latents \[E, 6\]"),
        ({"seeds": torch.arange(3)}, r"seeds \[E\] .*\[3\]"),
        ({"latent": NAN}, "there are latents that are not finite"),
        ({"goal": NAN}, "there are goals that are not finite"),
        ({"past_action": torch.zeros(2, 1, 4)}, r"context of 1 frames needs past_action \[2, 0, 4\].*got \[2, 1, 4\]"),
        ({"latent": torch.zeros(2, 3, 6)}, r"context of 3 frames needs past_action \[2, 2, 4\].*got None"),
        ({"latent": torch.zeros(2, 2, 6), "past_action": NAN[:, None, :4]}, "past actions that are not finite"),
        ({"initial": torch.zeros(2, 2, 4)}, r"initial plans \[E, 3, 4\]"),
        ({"initial": INF}, "initial plans that are not finite"),
    ],
)
def test_input_that_makes_no_sense_is_refused_before_planning(tiny_world, search, changes, message):
    planner = make_planner(search, tiny_world(), cost=untouched)
    with pytest.raises(ValueError, match=message):
        planner.plan(**{"latent": torch.zeros(2, 6), "goal": torch.zeros(2, 6), **changes})


def test_a_world_model_in_train_mode_is_refused(tiny_world):
    """Dropout would blur the plans, and imagined latents would change the BatchNorm statistics."""
    world = tiny_world()
    planner = make_planner("cem", world, cost=untouched)
    world.predictor.train()
    with pytest.raises(ValueError, match=r"train mode.*call its eval\(\)"):
        planner.plan(*torch.zeros(2, 1, 6))


@pytest.mark.parametrize("other", ["policy", *SEARCHING])
@pytest.mark.parametrize("search", SEARCHING)
def test_settings_of_another_search_are_refused(linear_world, search, other):
    """Also those of a subclass, which has settings that this search would ignore."""
    kind, (wanted, given) = SEARCHES[search], (SEARCHES[name].config_class for name in (search, other))
    if given is not wanted:
        with pytest.raises(TypeError, match=f"{kind.__name__} takes a {wanted.__name__}, got a {given.__name__}"):
            kind(linear_world(), given(bounds="none"))


@pytest.mark.parametrize(
    ("search", "wrong", "message"),
    [
        ("cem", {"num_elites": 1}, "num_elites must be at least 2, got 1"),
        ("cem", {"num_elites": 17}, "between 2 and num_candidates=16, got 17"),
        ("cem", {"iterations": 0}, "iterations must be at least 1, got 0"),
        ("cem", {"iterations": 2.0}, "iterations must be of type int, got 2.0"),
        ("cem", {"warm_start": 1}, "warm_start must be of type bool, got 1"),
        ("cem", {"seed": True}, "seed must be of type int, got True"),
        ("cem", {"receding_horizon": 6}, "receding_horizon must be at most horizon=3, got 6"),
        ("cem", {"std": 0.0}, "std must be positive, got 0.0"),
        ("cem", {"stop_std": -0.1}, "stop_std must not be negative, got -0.1"),
        *[("cem", {name: float("inf")}, f"{name} must be finite") for name in ("std", "memory_budget", "proposal_std")],
        ("cem", {"std": float("nan")}, "std must be finite, got nan"),
        *[("cem", {name: 10**12}, f"{name} must be at most 1000000") for name in ("num_candidates", "iterations", "horizon")],
        ("cem", {"bounds": "env"}, "unknown bounds 'env': choose 'environment' or 'none'"),
        ("cem", {"history": "two"}, "unknown history 'two': choose 'context' or 'one_frame'"),
        ("cem", {"precision": "fp16"}, "unknown precision 'fp16': choose 'auto' or 'fp32' or 'bf16'"),
        ("cem", {"seed": -1}, "seed must not be negative, got -1"),
        ("cem", {"memory_budget": 0.0}, "memory_budget must be positive"),
        ("icem", {"decay": 0.5}, "decay must be at least 1, got 0.5"),
        ("icem", {"momentum": 1.0}, r"momentum in \[0, 1\), got 0.3 and 1.0"),
        ("icem", {"kept_elites": 1.5}, r"kept_elites must lie in \[0, 1\]"),
        ("icem", {"noise_beta": -1.0}, "noise_beta must not be negative"),
        ("mppi", {"temperature": 0.0}, "temperature must be positive"),
        ("mppi", {"min_std": 2.0}, "min_std must be at most std=1.0, got 2.0"),
        ("gradient", {"learning_rate": 0.0}, "learning_rate must be positive, got 0.0"),
        ("gradient", {"num_candidates": 1}, "num_candidates must be at least 2"),
        ("shooting", {"num_candidates": 1}, "num_candidates must be at least 2"),
    ],
)
def test_impossible_settings_are_refused(search, wrong, message):
    with pytest.raises(ValueError, match=message):
        make_config(search, **wrong)


def test_what_a_search_does_not_use_is_no_setting_of_it():
    for names, searches in ((("num_elites", "stop_std"), ("gradient", "shooting")), (("std",), ("policy",))):
        for name, search in itertools.product(names, searches):
            with pytest.raises(TypeError, match=f"unexpected keyword argument '{name}'"):
                SEARCHES[search].config_class(**{name: 2})


def test_policies_that_are_missing_or_of_another_model_are_refused(tiny_world):
    policy = GoalPolicy(latent_dim=6, action_dim=4, hidden_dim=8, depth=1)
    with pytest.raises(ValueError, match="GoalPolicyPlanner needs a policy="):
        make_planner("policy", tiny_world())
    with pytest.raises(ValueError, match="num_proposals above 0"):
        make_planner("policy", tiny_world(), policy=policy, num_proposals=0)
    with pytest.raises(ValueError, match="latents of 5 .* train a policy for this model"):
        make_planner("cem", tiny_world(), policy=GoalPolicy(latent_dim=5, action_dim=4))


def test_what_is_no_cost_and_costs_without_a_shape_or_a_gradient_are_refused(tiny_world):
    latent, goal = torch.zeros(2, 6), torch.ones(2, 6)
    for cost in (GoalDistance, 3.0):
        with pytest.raises(TypeError, match="a cost is a module or function .predicted, goal. -> .E, K., such as"):
            make_planner("cem", tiny_world(), cost=cost)
    with pytest.raises(ValueError, match=r"to \[E, K\] = \[1, 16\], function returned float"):
        make_planner("cem", tiny_world(), cost=lambda predicted, goal: 3.0).plan(latent, goal)
    with pytest.raises(ValueError, match="the cost has no gradient with respect to the actions"):
        make_planner("gradient", tiny_world(), cost=lambda z, goal: z.detach().mean((-1, -2))).plan(latent, goal)


def test_what_is_no_tensordict_or_lacks_an_entry_is_refused(tiny_world):
    planner = make_planner("cem", tiny_world(), cost=untouched)
    latent, frame = torch.zeros(2, 6), torch.zeros(2, 3, 16, 16, dtype=torch.uint8)
    with pytest.raises(TypeError, match=r"a planner takes a TensorDict, got a dict: wrap .* TensorDict\(batch"):
        planner({"latent": latent, "goal_latent": latent})
    with pytest.raises(TypeError, match="MPCPolicy takes a TensorDict, got a dict"):
        MPCPolicy(planner)({"pixels": frame, "goal_pixels": frame})
    with pytest.raises(KeyError, match="reads 'latent' and 'goal_latent'; goal_latent is missing"):
        planner(TensorDict({"latent": latent}, [2]))
