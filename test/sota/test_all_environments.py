"""train.py runs its whole path on every environment: data, training, planning, report, each of it tiny."""

from __future__ import annotations

import json

import imageio.v3 as imageio
import pytest

from torchrl_ficreg.envs._gl import gl_works

ACTION_DIM = {"push_t": 2, "reacher": 2, "cube": 5}
EPISODES, STEPS = 10, 36
SHORT = [f"env.data.episodes={EPISODES}", f"env.data.max_steps={STEPS}", "env.goal_offset=10", "env.budget=11"]
SHORT += ["plan.horizon=2", "plan.receding_horizon=2", "evaluation.num_pairs=2", "evaluation.record=1"]
SHORT += ["loss.prediction_steps=2", "refine.epochs=1", "refine.prediction_steps=3", "refine.batch_size=16"]
SHORT += ["model.keypoint_channels=[4,8,8]"]


@pytest.mark.parametrize("env", ACTION_DIM)
def test_the_whole_path(env, execute, tmp_path):
    if env != "push_t" and not gl_works():
        pytest.skip("MuJoCo has no GL to draw with: apt-get install libegl1 libgl1")
    workers = 2 if env == "push_t" else 0  # processes are started in one of the three
    done = execute(tmp_path, "train.py", f"env={env}", f"evaluation.num_workers={workers}", *SHORT)
    assert done.returncode == 0, done.stderr
    (run,) = (tmp_path / "runs").iterdir()
    results = json.loads((run / "results.json").read_text())
    assert run.name == f"{env}_cpu_ficreg_seed0"
    for policy in ("policy", "random"):
        assert results[policy]["pairs"] == 2 and 0 <= results[policy]["success_rate"] <= 1
    frames = imageio.imread(run / "episodes.gif")
    assert frames.ndim == 4 and frames.std() > 5
    (data,) = (tmp_path / "data").iterdir()
    header = json.loads((data / "meta.json").read_text())
    assert header["shapes"]["action"] == [ACTION_DIM[env]]
    lengths = [json.loads(line)["length"] for line in (data / "episodes.jsonl").read_text().splitlines()]
    assert lengths == [STEPS + 1] * EPISODES, "episodes of these environments do not end at success"
