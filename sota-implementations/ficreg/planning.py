"""From the ``plan`` group of a configuration to a planner."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from torch import nn

from torchrl_ficreg import (
    ActionEffort,
    CostSum,
    GoalDistance,
    InverseConsistency,
    InverseDynamicsModel,
    LatentWorldModel,
    MPCPolicy,
    PathDistance,
    PlanConfig,
)
from torchrl_ficreg.modules.goal_policy import CONFIG_FILE, load_goal_policy, WEIGHTS_FILE
from torchrl_ficreg.planners import SEARCHES

POLICY_FOLDER = "goal_policy"  # in a run directory
COSTS = {"goal": GoalDistance, "path": PathDistance}
COST_FIELDS = ("cost", "effort", "consistency")


def plan_config(plan: DictConfig) -> PlanConfig:
    """The settings of the search.

    Raises:
        ValueError: an unknown search or cost, a setting of another search, or one outside its range.
    """
    values = OmegaConf.to_container(plan)
    search = values.pop("search")
    if search not in SEARCHES:
        raise ValueError(f"unknown plan.search {search!r}: choose one of {sorted(SEARCHES)}.")
    if values.get("cost", "goal") not in COSTS:
        raise ValueError(f"unknown plan.cost {values['cost']!r}: choose one of {sorted(COSTS)}.")
    wrong = [f"plan.{name}={values[name]}" for name in COST_FIELDS[1:] if not 0 <= values.get(name, 0.0) < math.inf]
    if wrong:
        raise ValueError(f"must be finite and not negative: {', '.join(wrong)}.")
    settings = {key: value for key, value in values.items() if key not in (*COST_FIELDS, "policy")}
    kind = SEARCHES[search].config_class
    foreign = sorted(settings.keys() - {field.name for field in fields(kind)})
    if foreign:
        raise ValueError(f"plan.search={search} has no {', '.join(foreign)}: choose it by plan={search} instead.")
    return kind(**settings)


def check_horizon(plan: DictConfig, frame_skip: int, budget: int) -> None:
    """Refuses to imagine further ahead than there are steps.

    Raises:
        ValueError: the horizon exceeds the budget.
    """
    if plan.horizon * frame_skip > budget:
        raise ValueError(
            f"plan.horizon={plan.horizon} blocks of {frame_skip} steps reach beyond the budget of {budget} steps: "
            f"set plan.horizon (and plan.receding_horizon) to at most {budget // frame_skip}, or raise the budget."
        )


def check_consistency(plan: DictConfig, config: DictConfig | dict[str, Any]) -> None:
    """Refuses to plan with an inverse model that a run does not train.

    Args:
        plan: the ``plan`` group.
        config: the whole configuration of the run.

    Raises:
        ValueError: ``plan.consistency`` is not zero, and nothing trains the inverse model.
    """
    if not plan.get("consistency", 0.0) > 0:
        return
    method, loss = config["method"], config.get("loss", {})
    weight = {"lewm": 0.0, "pldm": method.get("idm_coeff")}.get(method["name"], loss.get("idm_coeff"))
    if weight == 0:
        raise ValueError(
            f"plan.consistency={plan.consistency} asks the inverse model, which method={method['name']} has not trained "
            "with these settings: give plan.consistency=0.0, or train with idm_coeff > 0 (method=ficreg, for instance)."
        )


def make_cost(plan: DictConfig, inverse_model: InverseDynamicsModel) -> nn.Module:
    """The cost of the ``plan`` group; further terms are weighted relative to the spread of the first."""
    terms, weights = [COSTS[plan.get("cost", "goal")]()], [1.0]
    effort, consistency = plan.get("effort", 0.0), plan.get("consistency", 0.0)
    if effort:
        terms, weights = [*terms, ActionEffort()], [*weights, effort]
    if consistency:
        terms, weights = [*terms, InverseConsistency(inverse_model.eval())], [*weights, consistency]
    return CostSum(terms, weights, scale_free=True) if len(terms) > 1 else terms[0]


def make_policy(
    plan: DictConfig,
    model: LatentWorldModel,
    inverse_model: InverseDynamicsModel,
    bounds: tuple[list[float], list[float]],
    run_dir: Path,
) -> MPCPolicy:
    """The planner of a configuration's ``plan`` group, serving one action per environment step.

    Raises:
        FileNotFoundError: there is no policy where one is wanted.
    """
    folder, policy = plan.get("policy"), None
    if folder is not None:
        folder = run_dir / POLICY_FOLDER if folder == "auto" else Path(folder)
        if not any((folder / name).exists() for name in (CONFIG_FILE, WEIGHTS_FILE)):
            raise FileNotFoundError(f"no policy in {folder}: run train_policy.py checkpoint={run_dir} first.")
        policy = load_goal_policy(folder, model, device=model.action_mean.device)
    planner = SEARCHES[plan.search](
        model, plan_config(plan), action_bounds=bounds, cost=make_cost(plan, inverse_model), policy=policy
    )
    return MPCPolicy(planner)
