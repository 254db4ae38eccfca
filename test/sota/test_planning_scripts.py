"""evaluate.py with every search and every cost, and what it says about a plan that cannot be."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from torchrl_ficreg import GoalPolicy, InverseDynamicsModel
from torchrl_ficreg.modules.goal_policy import save_goal_policy
from torchrl_ficreg.trainers import load_world_model

SCRIPTS = Path(__file__).resolve().parents[2] / "sota-implementations" / "ficreg"
RUN = "runs/two_room_cpu_ficreg_seed0"
SMALL = {
    "cem": ["plan.num_candidates=12", "plan.num_elites=4"],
    "icem": ["plan.num_candidates=12", "plan.num_elites=4"],
    "mppi": ["plan.num_candidates=12", "plan.num_elites=4"],
    "gradient": ["plan.num_candidates=3"],
    "shooting": ["plan.num_candidates=40"],
}


@pytest.fixture
def modules(monkeypatch):
    """Imports a module of the scripts into this process: a new one for every search would be slow."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    yield importlib.import_module
    for name in ("evaluate", "train", "planning", "cli", "utils", "run_dir", "episodes"):
        sys.modules.pop(name, None)


@pytest.fixture
def evaluate(modules, monkeypatch, tmp_path):
    """``evaluate(folder, "plan=icem")`` is a budget of 10 steps there; returns what it wrote elsewhere."""

    def run(folder, *overrides):
        small = ["budget=10", "record=0", f"output={tmp_path / 'out'}", *overrides]
        if not any(override.startswith("plan.horizon") or override == "plan=policy" for override in overrides):
            small += ["plan.horizon=2"]
            small += [] if any("receding" in override for override in overrides) else ["plan.receding_horizon=2"]
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", ["evaluate.py", f"checkpoint={RUN}", *small])
        modules("evaluate").main()
        latest = max((tmp_path / "out").glob("*/results.json"), key=lambda path: path.stat().st_mtime_ns)
        return json.loads(latest.read_text())

    return run


@pytest.mark.parametrize("search", SMALL)
def test_every_search_can_be_named(trained, evaluate, files, search):
    """Nothing but the results is written, and they tell which search it was."""
    before = files(trained)
    results = evaluate(trained, f"plan={search}", "plan.iterations=1", *SMALL[search])
    assert results["plan"]["search"] == search and results["plan"]["iterations"] == 1
    assert results["policy"]["pairs"] == 4 and results["policy"]["seconds_per_plan"] > 0
    assert files(trained) == before


@pytest.mark.parametrize("horizon", [1, 2])
def test_it_may_plan_again_after_every_block(trained, evaluate, capsys, horizon):
    """The outcome belongs to the settings: given again it is the same."""
    overrides = ["plan.receding_horizon=1", f"plan.horizon={horizon}", "plan.iterations=1"]
    first = evaluate(trained, *overrides)
    assert first["plan"]["receding_horizon"] == 1 and first["plan"]["num_candidates"] == 20
    second = evaluate(trained, *overrides, "num_envs=3")
    assert second["policy"]["first_success_step"] == first["policy"]["first_success_step"]
    assert "success" in capsys.readouterr().out


def test_every_cost_can_be_named(trained, evaluate):
    results = evaluate(trained, "plan.cost=path", "plan.effort=0.1", "plan.consistency=0.1", "plan.iterations=1")
    wanted = {"cost": "path", "effort": 0.1, "consistency": 0.1}
    assert {name: results["plan"][name] for name in wanted} == wanted


def test_a_policy_plans_and_proposes(trained, modules, evaluate, tmp_path):
    """Where there is none, or an empty folder, one line says how to get one."""
    folder = Path(shutil.copytree(trained, tmp_path / "copy"))
    (folder / RUN / "goal_policy").mkdir()
    with pytest.raises(SystemExit) as caught:
        evaluate(folder, "plan=policy")
    message = str(caught.value)
    assert re.match("error: no policy in .*goal_policy: run train_policy.py checkpoint=.* first", message)
    assert "\n" not in message and not (tmp_path / "out").exists()
    model, _, _ = load_world_model(folder / RUN)
    policy = GoalPolicy(model.latent_dim, model.block_dim, hidden_dim=8, depth=1)
    save_goal_policy(policy, folder / RUN / "goal_policy", model)
    assert evaluate(folder, "plan=policy")["plan"]["search"] == "policy"
    assert evaluate(folder, "plan.policy=auto", "plan.iterations=1")["plan"]["policy"] == "auto"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["plan=dreamer"], r"plan=dreamer is unknown: choose one of \['cem', 'gradient', 'icem', 'mppi', 'policy'"),
        (["plan.search=dreamer"], "unknown plan.search 'dreamer': choose one of"),
        (["plan=icem", "plan.search=cem"], "plan.search=cem has no decay, kept_elites, .*: choose it by plan=cem"),
        (["plan.cost=energy"], r"unknown plan.cost 'energy': choose one of \['goal', 'path'\]"),
        (["plan.effort=-1", "plan.consistency=-0.5"], "must be finite and not negative: plan.effort=-1, plan.consistency=-0.5"),
        (["plan.horizon=3", "plan.receding_horizon=1"], "plan.horizon=3 blocks of 5 steps reach .* 10 steps.* most 2"),
        (["plan.num_elites=21"], "num_elites must lie between 2 and num_candidates=20, got 21"),
        (["plan.receding_horizon=3"], "receding_horizon at most horizon"),
        (["plan.noise_beta=1"], "no field 'plan.noise_beta'"),
        (["plan=icem", "plan.noise_beta=-1"], "noise_beta must not be negative"),
        (["plan=gradient", "plan.learning_rate=0"], "learning_rate must be positive"),
    ],
)
def test_a_plan_that_cannot_be_is_one_line_and_writes_nothing(trained, evaluate, files, tmp_path, overrides, message):
    before = files(trained)
    with pytest.raises(SystemExit) as caught:
        evaluate(trained, *overrides)
    assert re.match(f"error: .*({message})", str(caught.value)), caught.value
    assert "\n" not in str(caught.value)
    assert files(trained) == before and not (tmp_path / "out").exists()


def test_training_refuses_a_horizon_beyond_the_budget_before_it_begins(modules, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py", "plan.horizon=11"])
    with pytest.raises(SystemExit, match="plan.horizon=11 blocks of 5 steps reach beyond the budget of 50 steps"):
        modules("train").main()
    assert not list(tmp_path.iterdir())


def test_terms_without_weight_are_not_computed(modules):
    """The judge is asked only where its doubts count."""
    planning = modules("planning")
    judge = InverseDynamicsModel(2, 2, 4)
    plan = OmegaConf.create({"cost": "path", "effort": 0.0, "consistency": 0.0})
    assert type(planning.make_cost(plan, judge)).__name__ == "PathDistance"
    plan.effort = 0.3
    cost = planning.make_cost(plan, judge)
    assert [type(term).__name__ for term in cost.terms] == ["PathDistance", "ActionEffort"]
    assert cost.weights == (1.0, 0.3) and cost.scale_free
    plan.effort, plan.consistency = 0.0, 0.2
    cost = planning.make_cost(plan, judge.train())
    assert [type(term).__name__ for term in cost.terms] == ["PathDistance", "InverseConsistency"]
    assert cost.weights == (1.0, 0.2) and not judge.training


def test_results_of_others_that_cannot_be_shown_are_left_out_of_the_table(trained, modules, evaluate, tmp_path, capsys):
    """Whatever is found in their place, the evaluation at hand is shown and written."""
    whole = evaluate(trained, "plan=cem", "plan.iterations=1")
    out = tmp_path / "out"
    wrong = [[], None, 3, {}, {**whole, "plan": []}, {**whole, "policy": None}, {**whole, "method": "a\nb"}, {**whole, "pairs": 1}]
    wrong[-1].pop("budget")
    wrong += [{**whole, "policy": {**whole["policy"], key: None}} for key in ("success_interval", "success_rate", "pairs")]
    texts = [json.dumps(results) for results in wrong] + ["", "{", "[" * 10**5, '{"policy": ' * 500 + "1" + "}" * 500, "1e999"]
    for number, text in enumerate(texts):
        (out / f"odd{number}").mkdir()
        (out / f"odd{number}" / "results.json").write_text(text)
    (out / "fifo").mkdir()
    os.mkfifo(out / "fifo" / "results.json")
    found = modules("evaluate").read_others(out, "mine")
    lines = capsys.readouterr().out.splitlines()
    assert list(found.values()) == [whole]
    assert len([line for line in lines if line.startswith("left out of the table")]) == len(texts) + 1
    modules("evaluate").show({"mine": whole, **found})
