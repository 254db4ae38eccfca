"""train_policy.py on a trained run: a policy beside the checkpoints that fits the model, and mistakes in one line."""

from __future__ import annotations

import json
import re
import shutil

import pytest

from torchrl_ficreg.modules.goal_policy import load_goal_policy
from torchrl_ficreg.trainers import load_world_model

RUN = "runs/two_room_cpu_ficreg_seed0"
SMALL = ["policy.hidden_dim=32", "policy.depth=1", "optim.steps=100", "optim.batch_size=128", "optim.lr=0.01"]
SMALL += ["validation_rows=500"]


@pytest.fixture(scope="module")
def once(trained, execute, files, tmp_path_factory):
    """A copy of the trained run, what it held before, and train_policy.py having run there."""
    folder = shutil.copytree(trained, tmp_path_factory.mktemp("policy") / "copy")
    before = files(folder)
    return folder, before, execute(folder, "train_policy.py", f"checkpoint={RUN}", *SMALL, tiny=False)


def test_a_policy_appears_beside_the_run_and_nothing_else_changes(once, files):
    folder, before, done = once
    assert done.returncode == 0, done.stderr
    assert "R^2 of the actions" in done.stdout and f"{RUN}/goal_policy" in done.stdout
    after = files(folder)
    new = {name.removeprefix(f"{RUN}/goal_policy/") for name in after if name not in before}
    assert new == {"policy.json", "policy.safetensors", "metrics.json"}
    assert all(after[name] == content for name, content in before.items())
    model, _, card = load_world_model(folder / RUN)
    policy = load_goal_policy(folder / RUN / "goal_policy", model)
    assert policy.sizes == {"latent_dim": 16, "action_dim": 10, "hidden_dim": 32, "depth": 1}


def test_the_metrics_say_what_was_measured(once):
    """A hundred steps on sixteen episodes are enough to say more about those than their mean action does."""
    folder, _, _ = once
    metrics = json.loads((folder / RUN / "goal_policy" / "metrics.json").read_text())
    assert set(metrics) == {"train", "validation", "rows", "seconds", "checkpoint", "config", "versions"}
    assert metrics["train"]["r2"] > 0.05
    for part in ("train", "validation"):
        assert metrics[part]["r2"] < 1 and metrics[part]["loss"] > 0
        assert set(metrics[part]["r2_by_blocks"]) <= {str(k) for k in range(1, 11)}
    assert metrics["rows"]["train"] > metrics["rows"]["validation"] > 0
    assert str(folder) not in json.dumps(metrics)


def test_the_same_command_again_trains_nothing_unless_told_to(once, execute, refused, files):
    folder, _, _ = once
    before, line = files(folder), [f"checkpoint={RUN}", *SMALL]
    done = execute(folder, "train_policy.py", *line)
    assert "holds this policy already: overwrite=true" in done.stdout and "R^2 of the actions" in done.stdout
    assert "encode" not in done.stderr
    error = refused("train_policy.py", *line, "optim.steps=3", "policy.depth=2", folder=folder)
    assert re.search("other settings .optim.steps: 100 -> 3, policy.depth: 1 -> 2.: give over", error)
    assert files(folder) == before
    execute(folder, "train_policy.py", *line, "optim.steps=3", "overwrite=true")
    metrics = json.loads((folder / RUN / "goal_policy" / "metrics.json").read_text())
    assert metrics["config"]["optim"]["steps"] == 3
    assert metrics["rows"] == json.loads(before[f"{RUN}/goal_policy/metrics.json"])["rows"]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([f"checkpoint={RUN}", "optim.steps=0", "policy.depth=-1"], "policy.depth=-1: expected at least 1; optim.steps=0: exp"),
        ([f"checkpoint={RUN}", "optim.warmup=1.0"], r"optim.warmup=1.0: expected a number in \[0, 1\)"),
        ([f"checkpoint={RUN}", "max_block=3"], "did you mean 'max_blocks'?"),
        (["checkpoint=runs/nowhere"], "no checkpoint at runs/nowhere"),
        ([f"checkpoint={RUN}", "dataset=nowhere"], "no dataset at .*nowhere"),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(trained, refused, files, overrides, message):
    before = files(trained)
    assert re.search(message, refused("train_policy.py", *overrides, folder=trained))
    assert files(trained) == before
    assert not (trained / RUN / "goal_policy").exists()


@pytest.mark.parametrize("content", ["[]", "{", "{}", '{"config": []}', '{"config": {}, "train": 3}'])
def test_damaged_numbers_of_a_policy_are_one_line(once, refused, content):
    folder, _, _ = once
    path = folder / RUN / "goal_policy" / "metrics.json"
    before = path.read_text()
    path.write_text(content)
    line = refused("train_policy.py", f"checkpoint={RUN}", *SMALL, folder=folder)
    assert re.search("metrics.json (is damaged|is no readable)", line)
    path.write_text(before)
