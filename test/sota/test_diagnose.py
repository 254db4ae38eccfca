"""tools/study/diagnose.py on a tiny run: what it writes, what it leaves alone, and its errors."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.evaluation import StartGoalPairs

RUN = "runs/two_room_cpu_ficreg_seed0"
TOOL = Path(__file__).resolve().parents[2] / "tools" / "study" / "diagnose.py"
SMALL = ["num_pairs=2", "candidates=4", "iterations=1", "budget=25", "probe_steps=10"]


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("diagnose", TOOL)
    module = importlib.util.module_from_spec(spec)
    sys.modules["diagnose"] = module  # where its dataclass looks for the types of its fields
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def run(tool, monkeypatch, tmp_path):
    """``run("num_pairs=2")`` diagnoses from a folder that is not the run's; the results are in the folder returned."""

    def call(*settings):
        monkeypatch.setattr(tool, "WINDOWS", 100)
        monkeypatch.setattr(sys, "argv", ["diagnose.py", *settings])
        monkeypatch.chdir(tmp_path)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            tool.main()
        finally:
            torch.set_num_threads(threads)

    return call


def test_a_run_is_diagnosed_without_changing_it(trained, run, files, tmp_path, capsys):
    before = files(trained)
    run(f"run={trained / RUN}", f"output={tmp_path / 'out'}", *SMALL)
    assert files(trained) == before
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["diagnosis.json", "diagnosis.md", "diagnosis.png"]
    result = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert list(result["success"]) == ["model", "latents", "states"]
    assert {row["pairs"] for row in result["success"].values()} == {2}
    assert {row["pairs_hash"] for row in result["success"].values()} == {result["pairs_hash"]}
    assert result["pairs_hash"] != StartGoalPairs.load(trained / RUN / "pairs.json").hash
    for kind in ("ridge", "mlp"):
        assert result["probes"][kind]["agent"]["unit"] == "px" and result["probes"][kind]["agent"]["median"] > 0
    for prediction in (result["prediction"], result["prediction_from_one_frame"]):
        agent = prediction["quantities"]["agent"]
        assert len(prediction["latent_error"]) == len(agent["prediction"]) == result["plan"]["horizon"]
        movement = [depth["median"] for depth in agent["movement"]]
        assert 0 < movement[0] < movement[-1] < 25 * 5 * 2**0.5  # 25 steps of at most 5 px along each axis
    assert result["conclusion"]["sentence"] in (tmp_path / "out" / "diagnosis.md").read_text()
    assert "true dynamics, latents" in capsys.readouterr().out


@pytest.mark.parametrize("plan", [None, {"cost": "stay", "time_to_go": 2, "receding_horizon": 1}], ids=["earlier card", "timed"])
def test_the_oracle_is_optional_and_results_go_into_the_run(copy, run, tool, monkeypatch, plan):
    """Plans are executed to their end, where goals are due, whatever the run did; cards may be older than these settings."""
    read = tool.settings_of_card

    def changed(card):
        settings = read(card)
        for name in ("time_to_go", "min_time_to_go", "fallback", "cost", "stay_discount"):
            del settings.plan[name]
        settings.plan.update(plan or {})
        return settings

    monkeypatch.setattr(tool, "settings_of_card", changed)
    monkeypatch.setattr(tool, "draw", lambda result, target: None)  # which takes longest
    run(f"run={copy / RUN}", "oracle=false", *SMALL)
    result = json.loads((copy / RUN / "diagnosis" / "diagnosis.json").read_text())
    assert list(result["success"]) == ["model"] and result["conclusion"]["losses"] is None
    assert result["plan"]["receding_horizon"] == result["plan"]["horizon"] and result["plan"]["time_to_go"] == 0
    assert "| the run's planner" in (copy / RUN / "diagnosis" / "diagnosis.md").read_text()


def test_rows_of_clips_are_those_of_their_frames(tool):
    """Episodes of different lengths, of which a split holds some; the states name the rows."""
    rng, episodes = np.random.default_rng(0), []
    for number, length in enumerate(rng.integers(8, 20, 12)):
        action, state = rng.normal(size=(length, 1)).astype(np.float32), 100.0 * number + np.arange(length)[:, None]
        action[-1] = 0
        episodes.append({"pixels": np.zeros((length, 3, 4, 4), np.uint8), "action": action, "state": state})
    keys = ("episode", "step", "state")
    data = OfflineTrajectories.from_episodes(episodes, split="train", num_frames=3, frame_skip=2, keys=keys)
    state = torch.cat([data.episode_data(number, keys=("state",))["state"] for number in data.episodes["episode"].tolist()])
    clips = data[torch.arange(len(data))]
    assert state[tool.rows_of(data, clips)].equal(clips["state"])


@pytest.mark.parametrize(
    ("rates", "sentence"),
    [
        ({"model": 0.5, "latents": 0.9, "states": 1.0}, "largest loss is in the predictor: .* 90% .* instead of 50%"),
        ({"model": 0.4, "latents": 0.5, "states": 1.0}, "largest loss is in the encoder: .* 100% .* true states and 50% on latents"),
        ({"model": 0.4, "latents": 0.5, "states": 0.6}, "largest loss is in the planner: .* only 60%"),
        ({"model": 1.0, "latents": 1.0, "states": 1.0}, "100% of the goals are reached"),
        ({"model": 0.4}, "not known"),
    ],
)
def test_the_largest_loss_is_named(tool, rates, sentence):
    conclusion = tool.conclude({name: {"success_rate": rate} for name, rate in rates.items()})
    assert re.search(sentence, conclusion["sentence"])
    if conclusion["losses"]:
        assert sum(conclusion["losses"].values()) == pytest.approx(1 - rates["model"])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["num_pairs=many"], "error: .*num_pairs.*; settings: run, dataset"),
        (["pairs=3"], "error: .*pairs.*; settings: run, dataset"),
        ([], "error: .*run=<run directory>"),
        (["run=nowhere"], "error: no checkpoint at nowhere"),
        (["run={run}", "budget=7"], "error: plan.horizon=5 blocks of 5 steps reach beyond the budget of 7 steps"),
    ],
)
def test_mistakes_are_one_line(trained, run, tmp_path, settings, message):
    with pytest.raises(SystemExit, match=message) as stop:
        run(f"output={tmp_path}", *(setting.format(run=trained / RUN) for setting in settings))
    assert "\n" not in str(stop.value)
