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


@pytest.fixture(scope="module")
def shares():
    path = Path(__file__).parents[3] / "tools" / "published" / "cube_pair_shares.py"
    spec = importlib.util.spec_from_file_location("cube_pair_shares", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def arm():
    return CubeArm()


def episode(arm, steps, **arguments):
    rng = np.random.default_rng(3)
    state = sample_start(rng, arm)
    goal = sample_goal(rng, state, arm)
    expert = CubeExpert(**arguments)
    arm.restore(state)
    states, actions = [state], []
    for _ in range(steps):
        actions.append(expert(states[-1], goal))
        arm.step(actions[-1].astype(np.float64))
        states.append(arm.state)
    return np.stack(states), np.stack(actions), goal


def test_without_noise_it_carries_the_cube_to_the_goal_and_puts_it_back_there_again(arm):
    """A plan takes 4.4 s, 88 steps, give or take: the second one lifts the cube where it lies."""
    states, actions, goal = episode(arm, 200, noise_std=0.0)
    near = is_success(states, goal)
    assert not near[0]
    assert 50 < near.argmax() < 90
    assert near[100]
    assert near[-1]
    height = states[:, CUBE_POSITION][:, 2]
    assert height[:88].max() > 0.1
    assert height[100:].max() > 0.1
    assert np.abs(actions).max() <= 1


def test_the_global_generator_is_restored_and_has_no_influence(arm):
    np.random.seed(7)
    expected = np.random.random(3)
    runs = []
    for seed, world in ((1, 7), (1, 8), (2, 7)):
        np.random.seed(world)
        runs.append(episode(arm, 100, rng=np.random.default_rng(seed))[1])
        if world == 7:
            assert np.array_equal(np.random.random(3), expected)
    assert runs[0].tobytes() == runs[1].tobytes()
    assert runs[0].tobytes() != runs[2].tobytes()
    assert runs[0].dtype == np.float32


def test_its_environment_does_not_change_its_actions(arm):
    """The same actions with the simulator it acts in and with one of its own."""
    env = CubeEnv(image_size=8)
    own = episode(arm, 30, rng=np.random.default_rng(1))
    given = episode(env.arm, 30, rng=np.random.default_rng(1), env=env)
    assert own[1].tobytes() == given[1].tobytes()


def test_noise_is_added_to_the_plan(arm):
    quiet, noisy = (episode(arm, 60, rng=np.random.default_rng(1), noise_std=noise)[1] for noise in (0.0, 0.1))
    assert np.abs(np.diff(noisy, axis=0)).mean() > 2 * np.abs(np.diff(quiet, axis=0)).mean()


def test_bad_arguments_are_refused():
    import gymnasium

    with pytest.raises(ValueError, match="noise_std must be finite and not negative, got -1"):
        CubeExpert(noise_std=-1)
    with pytest.raises(ValueError, match="noise_smoothing must be finite and positive, got 0"):
        CubeExpert(noise_smoothing=0)
    with pytest.raises(TypeError, match="env must be a CubeEnv, got CartPoleEnv"):
        CubeExpert(env=gymnasium.make("CartPole-v1"))


def check(summary, tolerance):
    for bound, row in summary["shares"].items():
        assert row["ours"] == pytest.approx(row["published"], abs=tolerance), bound
    np.testing.assert_allclose(summary["action_mean"], [0.01, 0, 0, 0, 0.16], atol=0.04)
    np.testing.assert_allclose(summary["action_std"], [0.29, 0.41, 0.64, 0.43, 0.25], atol=0.1)
    assert summary["episodes_that_end_at_the_goal"] >= 0.9


def test_three_episodes_resemble_the_published_data(shares, arm):
    """Shares of 25-step pairs whose cube moved at most 4 / 2 / 1 cm: 38.4 / 33.6 / 30.8 %."""
    records = [shares.record(arm, 0, index) for index in range(3)]
    check(shares.summarize(*map(np.stack, zip(*records, strict=True))), tolerance=0.03)


@pytest.mark.slow
def test_thirty_episodes_have_the_published_shares_within_two_points(shares, arm):
    records = [shares.record(arm, 1, index) for index in range(30)]
    summary = shares.summarize(*map(np.stack, zip(*records, strict=True)))
    check(summary, tolerance=0.02)
    assert max(row["standard_error"] for row in summary["shares"].values()) < 0.01
