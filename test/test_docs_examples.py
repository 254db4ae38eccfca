"""The examples of ``own_networks.rst`` run from top to bottom, and give the shapes that the page states."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import dedent

import pytest

PAGE = Path(__file__).resolve().parents[1] / "docs" / "source" / "own_networks.rst"


@pytest.fixture(scope="module")
def names() -> dict:
    """The names that all blocks of the page define."""
    blocks = re.findall(r"^\.\. code-block:: python\n\n((?:    .*\n|\n)+)", PAGE.read_text(encoding="utf-8"), re.M)
    assert len(blocks) >= 6
    found: dict = {"__name__": "own_networks"}
    for block in blocks:
        exec(compile(dedent(block), str(PAGE), "exec"), found)
    return found


def test_networks_train_in_the_loss(names):
    assert {"loss_pred", "loss_sigreg", "loss_idm", "loss_consistency"} <= set(names["terms"].keys())
    for network in (names["encoder"], names["predictor"], names["inverse_model"]):
        assert all(param.grad.abs().sum() > 0 for param in network.parameters())


def test_the_world_model_predicts_and_planners_plan(names):
    assert names["latent"].shape == (8, 16) and names["future"].shape == (8, 4, 16)
    assert [plan.shape for plan in names["plans"]] == [(8, 5, 10), (8, 5, 10)]


def test_the_policy_acts_in_the_environment(names):
    rollout = names["rollout"]
    assert rollout["action"].shape == (2, 6, 2) and rollout["action"].abs().max() <= 1
    moved = (rollout["next", "state"] - rollout["state"]).abs().amax()
    assert 0 < moved <= 0.1 + 1e-6
