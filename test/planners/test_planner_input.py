"""Claims about bad input to planners: refused before anything is imagined, in words that say what to do."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_ficreg import GoalPolicy, MPCPolicy, PlanConfig
from torchrl_ficreg.planners import SEARCHES

UNIT = ([-1.0, -1.0], [1.0, 1.0])
SIZES = {"num_candidates": 16, "num_elites": 4, "iterations": 2, "horizon": 3, "receding_horizon": 1}


def make(search, world, *, cost=None, policy=None, **settings):
    """A planner of that name; bounds of one in every direction."""
    kind = SEARCHES[search]
    return kind(world, kind.config_class(**{**SIZES, **settings}), action_bounds=UNIT, cost=cost, policy=policy)


class Untouched(nn.Module):
    """A cost that must not be asked."""

    def forward(self, predicted, goal):
        raise AssertionError("planning began")


NAN = torch.full((2, 6), torch.nan)
INF = torch.full((2, 3, 4), torch.inf)


@pytest.mark.parametrize("search", [name for name in SEARCHES if name != "policy"])
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal": torch.zeros(2, 5)}, r"goals \[E, 6\].*got \[2, 1, 6\], \[2, 5\]"),
        ({"goal": torch.zeros(3, 6)}, r"goals \[E, 6\]"),
        ({"latent": torch.zeros(2, 7)}, r"expected latents \[E, 6\]"),
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
    planner = make(search, tiny_world(), cost=Untouched())
    with pytest.raises(ValueError, match=message):
        planner.plan(**{"latent": torch.zeros(2, 6), "goal": torch.zeros(2, 6), **changes})


@pytest.mark.parametrize("search", ["icem", "mppi", "gradient"])
def test_settings_of_another_search_are_refused(linear_world, search):
    kind = SEARCHES[search]
    with pytest.raises(TypeError, match=f"{kind.__name__} takes a {kind.config_class.__name__}, got a PlanConfig"):
        kind(linear_world(), PlanConfig(), action_bounds=UNIT)


@pytest.mark.parametrize(
    ("search", "wrong", "message"),
    [
        ("icem", {"num_elites": 101}, "between 2 and num_candidates=100, got 101"),
        ("icem", {"decay": 0.5}, "decay be at least 1"),
        ("icem", {"momentum": 1.0}, r"momentum lie in \[0, 1\)"),
        ("icem", {"kept_elites": 1.5}, r"kept_elites lie in \[0, 1\]"),
        ("icem", {"noise_beta": -1.0}, "noise_beta must not be negative"),
        ("mppi", {"temperature": 0.0}, "temperature must be positive"),
        ("mppi", {"min_std": 2.0}, "min_std lie between 0 and std=1.0"),
        ("gradient", {"learning_rate": 0.0}, "learning_rate must be positive, got 0.0"),
        ("cem", {"stop_spread": -0.1}, "stop_spread must not be negative"),
        ("cem", {"history": "two"}, "unknown history 'two'"),
        ("cem", {"memory_budget": 0.0}, "memory_budget must be positive"),
    ],
)
def test_impossible_settings_are_refused(search, wrong, message):
    with pytest.raises(ValueError, match=message):
        SEARCHES[search].config_class(**wrong)


def test_policies_that_are_missing_or_of_another_model_are_refused(tiny_world):
    policy = GoalPolicy(latent_dim=6, action_dim=4, hidden_dim=8, depth=1)
    with pytest.raises(ValueError, match="PolicyPlanner needs a policy="):
        make("policy", tiny_world())
    with pytest.raises(ValueError, match="num_proposals above 0"):
        make("policy", tiny_world(), policy=policy, num_proposals=0)
    with pytest.raises(ValueError, match="latents of 5 .* train a policy for this model"):
        make("cem", tiny_world(), policy=GoalPolicy(latent_dim=5, action_dim=4))


def test_a_plain_dict_is_told_to_become_a_tensordict(tiny_world):
    planner = make("cem", tiny_world(), cost=Untouched())
    latent, frame = torch.zeros(2, 6), torch.zeros(2, 3, 16, 16, dtype=torch.uint8)
    with pytest.raises(TypeError, match=r"a planner takes a TensorDict, got a dict: wrap .* TensorDict\(batch"):
        planner({"latent": latent, "goal_latent": latent})
    with pytest.raises(TypeError, match="MPCPolicy takes a TensorDict, got a dict"):
        MPCPolicy(planner)({"pixels": frame, "goal_pixels": frame})
