"""Planners for tests, made from the name of a search."""

from __future__ import annotations

from dataclasses import fields

from torchrl_ficreg.planners import SEARCHES

UNIT = ([-1.0, -1.0], [1.0, 1.0])
SEARCHING = [name for name in SEARCHES if name != "policy"]
SIZES = {"num_candidates": 16, "num_elites": 4, "iterations": 2, "horizon": 3, "receding_horizon": 1, "precision": "fp32"}


def make_config(search, **settings):
    """The settings of a search, on top of ``SIZES``; those that it does not have are left out."""
    kind = SEARCHES[search].config_class
    known = {field.name for field in fields(kind)}
    return kind(**{name: value for name, value in {**SIZES, **settings}.items() if name in known})


def make_planner(search, world, *, action_bounds=UNIT, cost=None, policy=None, **settings):
    """A planner for actions in two dimensions, by default between -1 and 1."""
    return SEARCHES[search](world, make_config(search, **settings), action_bounds=action_bounds, cost=cost, policy=policy)
