"""evaluate.py with every search and every cost, and its errors for invalid plans."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
import utils
from omegaconf import OmegaConf
from results import find_dataset

from torchrl_ficreg import GoalPolicy, InverseDynamicsModel
from torchrl_ficreg.evaluation import StartGoalPairs
from torchrl_ficreg.modules.goal_policy import save_goal_policy
from torchrl_ficreg.trainers import find_checkpoint, load_world_model

RUN = "runs/two_room_cpu_ficreg_seed0"
SMALL = {
    "cem": ["plan.num_candidates=12", "plan.num_elites=4"],
    "icem": ["plan.num_candidates=12", "plan.num_elites=4"],
    "mppi": ["plan.num_candidates=12", "plan.num_elites=4"],
    "gradient": ["plan.num_candidates=3"],
    "shooting": ["plan.num_candidates=40"],
}


@pytest.fixture
def run(execute, tmp_path):
    """``run(folder, "plan=icem")`` is a budget of 10 steps there; its results are written elsewhere."""

    def call(folder, *overrides):
        small = ["budget=10", "record=0", f"output={tmp_path / 'out'}", *overrides]
        if not any(override.startswith("plan.horizon") or override == "plan=policy" for override in overrides):
            small += ["plan.horizon=2"]
            small += [] if any("receding" in override for override in overrides) else ["plan.receding_horizon=2"]
        return execute(folder, "evaluate.py", f"checkpoint={RUN}", *small)

    return call


@pytest.fixture
def evaluate(run, tmp_path):
    """``evaluate(folder, "plan=icem")`` returns the results."""

    def call(folder, *overrides):
        done = run(folder, *overrides)
        assert done.returncode == 0, done.stderr
        latest = max((tmp_path / "out").glob("*/results.json"), key=lambda path: path.stat().st_mtime_ns)
        return json.loads(latest.read_text())

    return call


@pytest.mark.parametrize("search", SMALL)
def test_every_search_can_be_named(trained, evaluate, files, search):
    """Nothing but the results is written, and they tell which search it was."""
    before = files(trained)
    results = evaluate(trained, f"plan={search}", "plan.iterations=1", *SMALL[search])
    assert results["plan"]["search"] == search and results["plan"]["iterations"] == 1
    assert results["policy"]["pairs"] == 4 and results["policy"]["seconds_per_plan"] > 0
    assert files(trained) == before


@pytest.mark.parametrize(
    "wanted",
    [
        {"cost": "path", "effort": 0.1, "consistency": 0.1},
        {"cost": "stay", "stay_discount": 0.5, "time_to_go": 2, "min_time_to_go": 1, "fallback": True, "receding_horizon": 1},
    ],
)
def test_every_cost_can_be_named(trained, evaluate, wanted):
    results = evaluate(trained, *(f"plan.{name}={value}" for name, value in wanted.items()), "plan.iterations=1")
    assert {name: results["plan"][name] for name in wanted} == wanted


def test_settings_can_be_chosen_on_validation_pairs(trained, run, evaluate, tmp_path):
    """As many as the frozen ones, of other episodes; without the dataset there are none."""
    results = {pairs: evaluate(trained, "plan.iterations=1", f"pairs={pairs}") for pairs in ("null", "validation")}
    hashes = {name: row["policy"]["pairs_hash"] for name, row in results.items()}
    assert hashes["null"] != hashes["validation"] and results["validation"]["policy"]["pairs"] == 4
    assert hashes["null"] == StartGoalPairs.load(trained / RUN / "pairs.json").hash
    shutil.copytree(trained / "runs", tmp_path / "runs")
    (line,) = run(tmp_path, "pairs=validation").stderr.splitlines()
    assert line.startswith("error: ") and "two_room" in line


@pytest.mark.parametrize("moved", [False, True])
def test_the_episodes_of_a_run_are_found_from_its_folder(copy, monkeypatch, tmp_path, moved):
    """Wherever a command is started, also after run and episodes were moved together."""
    settings = utils.settings_of_card(load_world_model(find_checkpoint(copy / RUN))[2])
    folder = copy.rename(tmp_path / "moved") if moved else copy
    monkeypatch.chdir(tmp_path)
    assert find_dataset(settings, folder / RUN) == folder / utils.dataset_path(settings)


def test_a_policy_plans_and_proposes(trained, run, evaluate, tmp_path):
    """Where there is none, or an empty folder, one line says how to get one."""
    folder = Path(shutil.copytree(trained, tmp_path / "copy"))
    (folder / RUN / "goal_policy").mkdir()
    (message,) = run(folder, "plan=policy").stderr.splitlines()
    assert re.match("error: no policy in .*goal_policy: run train_policy.py checkpoint=.* first", message)
    assert not (tmp_path / "out").exists()
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
        (["plan.cost=energy"], r"unknown plan.cost 'energy': choose one of \['goal', 'path', 'stay'\]"),
        (["plan.stay_discount=0"], r"plan.stay_discount must lie in \(0, 1\], got 0"),
        (["plan.effort=-1", "plan.consistency=-0.5"], "must be finite and not negative: plan.effort=-1, plan.consistency=-0.5"),
        (["plan.horizon=3", "plan.receding_horizon=1"], "plan.horizon=3 blocks of 5 steps reach .* 10 steps.* most 2"),
        (["plan.num_elites=21"], "num_elites must lie between 2 and num_candidates=20, got 21"),
        (["plan=gradient", "plan.learning_rate=0"], "learning_rate must be positive"),
    ],
)
def test_an_invalid_plan_is_one_line_and_writes_nothing(trained, run, files, tmp_path, overrides, message):
    before = files(trained)
    (line,) = run(trained, *overrides).stderr.splitlines()
    assert re.match(f"error: .*({message})", line), line
    assert files(trained) == before and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("search", "earlier", "stop_std"),
    [
        ("cem", {"std": 1.0, "stop_spread": 0.2, "num_elites": 30}, 0.2),
        ("gradient", {"std": 1.0, "stop_spread": 0.0}, None),
        ("shooting", {"std": 1.0, "stop_spread": 0.0, "num_elites": 2}, 0.0),
        ("policy", {"std": 1.0, "stop_spread": 0.0}, None),
    ],
)
def test_the_plan_of_a_run_made_before_settings_were_renamed_is_read(search, earlier, stop_std):
    config = utils.plan_config(OmegaConf.create({"search": search, "horizon": 4, "receding_horizon": 4, **earlier}))
    assert config.horizon == 4 and getattr(config, "stop_std", None) == stop_std


@pytest.mark.parametrize(("name", "term"), [("effort", "ActionEffort"), ("consistency", "InverseConsistency")])
def test_terms_without_weight_are_not_computed(name, term):
    judge, plan = InverseDynamicsModel(2, 2, 4), {"cost": "path", "effort": 0.0, "consistency": 0.0}
    assert type(utils.make_cost(OmegaConf.create(plan), judge)).__name__ == "PathDistance"
    cost = utils.make_cost(OmegaConf.create({**plan, name: 0.3}), judge.train())
    assert [type(each).__name__ for each in cost.terms] == ["PathDistance", term] and cost.weights == (1.0, 0.3)
    assert cost.scale_free and judge.training == (name == "effort")
