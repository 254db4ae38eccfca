"""The expert is OGBench's plan oracle, reproducible, and its data are the published ones in distribution."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("ogbench", reason="the cube is simulated by ogbench: pip install 'torchrl_ficreg[envs]'")

from torchrl_ficreg.envs.cube import CubeArm, CubeEnv, CubeExpert, sample_goal, sample_start
from torchrl_ficreg.envs.cube.physics import CUBE_POSITION
from torchrl_ficreg.envs.cube.tasks import is_success

SCRIPT = Path(__file__).parents[3] / "tools" / "published" / "cube_pair_shares.py"
SPEC = importlib.util.spec_from_file_location("cube_pair_shares", SCRIPT)
shares = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(shares)


@pytest.fixture(scope="module")
def arm():
    return CubeArm()


def episode(arm, steps, **arguments):
    rng = np.random.default_rng(3)
    state = sample_start(rng, arm)
    goal = sample_goal(rng, state, arm)
    return *shares.play(arm, CubeExpert(**arguments), state, goal, steps), goal


def test_without_noise_it_carries_the_cube_to_the_goal_and_puts_it_back_there_again(arm):
    """A plan takes 4.4 s, 88 steps, give or take: the second one lifts the cube where it lies."""
    states, actions, goal = episode(arm, 200, noise_std=0.0)
    near = is_success(states, goal)
    assert not near[0] and 50 < near.argmax() < 90
    assert near[100]
    assert near[-1]
    height = states[:, CUBE_POSITION][:, 2]
    assert height[:88].max() > 0.1 and height[100:].max() > 0.1 and np.abs(actions).max() <= 1


def test_the_global_generator_is_restored_and_has_no_influence(arm):
    runs = []
    for world in (7, 8):
        np.random.seed(world)
        expected = np.random.random(3)
        np.random.seed(world)
        runs.append(episode(arm, 100, rng=np.random.default_rng(1))[1])
        assert np.array_equal(np.random.random(3), expected)
    assert runs[0].tobytes() == runs[1].tobytes()


def test_its_environment_does_not_change_its_actions(arm):
    """The same actions with the simulator it acts in and with one of its own."""
    env = CubeEnv(image_size=8)
    own = episode(arm, 30, rng=np.random.default_rng(1))
    given = episode(env.arm, 30, rng=np.random.default_rng(1), env=env)
    assert own[1].tobytes() == given[1].tobytes()


def test_noise_is_added_to_the_plan(arm):
    quiet, noisy = (episode(arm, 60, rng=np.random.default_rng(1), noise_std=noise)[1] for noise in (0.0, 0.1))
    assert np.abs(np.diff(noisy, axis=0)).mean() > 2 * np.abs(np.diff(quiet, axis=0)).mean()


def check(summary, tolerance):
    for bound, row in summary["shares"].items():
        assert row["ours"] == pytest.approx(row["published"], abs=tolerance), bound
    np.testing.assert_allclose(summary["action_mean"], [0.01, 0, 0, 0, 0.16], atol=0.04)
    np.testing.assert_allclose(summary["action_std"], [0.29, 0.41, 0.64, 0.43, 0.25], atol=0.1)
    assert summary["episodes_that_end_at_the_goal"] >= 0.9


def test_three_episodes_resemble_the_published_data(arm):
    """Shares of 25-step pairs whose cube moved at most 4 / 2 / 1 cm: 38.4 / 33.6 / 30.8 %."""
    check(shares.summarize(*shares.record(arm, 0, range(3))), tolerance=0.03)


@pytest.mark.slow
def test_thirty_episodes_have_the_published_shares_within_two_points(arm):
    summary = shares.summarize(*shares.record(arm, 1, range(30)))
    check(summary, tolerance=0.02)
    assert max(row["standard_error"] for row in summary["shares"].values()) < 0.01
