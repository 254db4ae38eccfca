"""The arm is the published one, number by number and step by step, and its steps depend on state and action alone."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ogbench", reason="the cube is simulated by ogbench: pip install 'torchrl_ficreg[envs]'")

from torchrl_ficreg.envs.cube import CubeArm, physics as arm_module, sample_goal, sample_start
from torchrl_ficreg.envs.cube.physics import ARM, CUBE_POSITION, CUBE_ROTATION, GRIPPER


@pytest.fixture(scope="module")
def arm():
    return CubeArm()


@pytest.fixture(scope="module")
def start(arm):
    return arm.resting(arm_yaw=0.0, cube_position=[0.5, 0.2], cube_yaw=0.4)


def gripper(arm):
    return arm.measure(arm.state)["proprio/effector_pos"]


def travel(arm, start, action, steps):
    arm.restore(start)
    before = gripper(arm)
    for _ in range(steps):
        arm.step(np.array(action, dtype=np.float64))
    return gripper(arm) - before


def test_the_model_is_the_published_one(arm):
    """21 positions, 20 velocities, 7 motors; 25 substeps of 2 ms; a cube of 4 cm and 79.4 g; impratio 10."""
    model = arm.model
    assert (model.nq, model.nv, model.nu, model.na) == (21, 20, 7, 0)
    assert (model.opt.timestep, arm.ogbench._n_steps, model.opt.impratio) == (0.002, 25, 10)
    assert model.opt.integrator == 3  # implicitfast
    assert model.geom("object_0").size.tolist() == [0.02] * 3
    assert model.body("object_0").mass.item() == pytest.approx(0.0794, abs=5e-5)
    assert arm.ogbench.action_high.tolist() == [0.05, 0.05, 0.05, 0.3, 1.0]
    assert arm.ogbench._workspace_bounds.tolist() == [[0.25, -0.35, 0.02], [0.6, 0.35, 0.35]]
    assert model.actuator_gainprm[:6, 0].tolist() == [4500, 4500, 4500, 2000, 2000, 500]


def test_steps_are_the_published_ones(arm, start):
    """200 random actions, beyond the bounds too: the stock environment visits the same states up to 1e-6."""
    from ogbench.manipspace.envs.cube_env import CubeEnv as StockEnv

    stock = StockEnv("single", ob_type="states", mode="data_collection", visualize_info=False)
    stock.reset(seed=1)
    for bound in (1, 2):
        actions = np.random.default_rng(0).uniform(-bound, bound, (100, 5)) - [0, 0, 0.3, 0, 0]
        arm.restore(start)
        stock.reset(seed=1)
        stock.set_state(start[:21], start[21:])
        for action in actions:
            arm.step(action)
            stock.step(action)
            theirs = np.concatenate([stock.data.qpos, stock.data.qvel])
            np.testing.assert_allclose(arm.state, theirs, rtol=0, atol=1e-6)


def test_actions_beyond_the_bounds_are_not_clipped(arm, start):
    """Published measurement: 4 actions along x move the arm 0.0845 m, those of three times the size 0.152 m."""
    assert np.linalg.norm(travel(arm, start, [1, 0, 0, 0, 0], 4)) == pytest.approx(0.0845, abs=2e-4)
    assert np.linalg.norm(travel(arm, start, [3, 0, 0, 0, 0], 4)) == pytest.approx(0.152, abs=2e-4)


def test_the_gripper_stays_in_its_workspace(arm, start):
    for sign in (1, -1):
        travel(arm, start, [3 * sign, 3 * sign, 3 * sign, 0, 0], 40)
        low, high = np.array([[0.25, -0.35, 0.02], [0.6, 0.35, 0.35]])
        assert (gripper(arm) > low - 0.005).all() and (gripper(arm) < high + 0.005).all()


def test_a_zero_action_targets_the_measured_pose(arm, start):
    """Motors are sent to where the joints just were. So the servos' lag stays, and gravity pulls the arm down."""
    travel(arm, start, [3, 0, 0, 0, 0], 2)
    joints, previous_targets = arm.state[ARM], arm.ogbench.data.ctrl[:6].copy()
    arm.step(np.zeros(5))
    assert np.abs(previous_targets - joints).max() > 0.15
    np.testing.assert_allclose(arm.ogbench.data.ctrl[:6], joints, atol=0.04)
    sag = travel(arm, start, [0, 0, 0, 0, 0], 20)
    assert -0.05 < sag[2] < -0.01 and np.abs(sag[:2]).max() < 0.01


def test_the_last_number_closes_the_gripper_and_a_resting_cube_rests(arm, start):
    travel(arm, start, [0, 0, 0, 0, 1], 10)
    assert arm.measure(arm.state)["proprio/gripper_opening"].item() > 0.9
    travel(arm, arm.state, [0, 0, 0, 0, -1], 10)
    assert arm.measure(arm.state)["proprio/gripper_opening"].item() < 0.1
    assert np.abs(arm.state[CUBE_POSITION] - start[CUBE_POSITION]).max() < 1e-3


def test_measuring_does_not_change_the_simulation(arm, start):
    arm.restore(start)
    assert arm.state.tobytes() == start.tobytes()
    copy = start.copy()
    arm.step(np.ones(5))
    moved = arm.state
    arm.measure(start)
    sample_start(np.random.default_rng(0), arm)
    assert arm.state.tobytes() == moved.tobytes() and start.tobytes() == copy.tobytes()


def test_starts_cover_the_published_ranges(arm):
    """Cube and target in [0.3, 0.55] x [-0.3, 0.3] and at any angle, the open gripper at (0.425, 0, 0.275)."""
    rng = np.random.default_rng(0)
    starts = np.stack([sample_start(rng, arm) for _ in range(100)])
    goals = np.stack([sample_goal(rng, state, arm) for state in starts])
    for states in (starts, goals):
        position = states[:, CUBE_POSITION]
        np.testing.assert_allclose(position.min(0), [0.3, -0.3, 0.02], atol=0.02)
        np.testing.assert_allclose(position.max(0), [0.55, 0.3, 0.02], atol=0.02)
        assert (position[:, :2] >= [0.3, -0.3]).all() and (position[:, :2] <= [0.55, 0.3]).all()
        assert states[:, CUBE_ROTATION][:, 0].min() < -0.9  # yaws reach 2 pi
        assert not states[:, GRIPPER].any() and not states[:, 21:].any()
    seen = [arm.measure(state) for state in starts]
    positions = np.stack([one["proprio/effector_pos"] for one in seen])
    np.testing.assert_allclose(positions, np.broadcast_to([0.425, 0, 0.275], positions.shape), atol=2e-4)
    yaws = np.array([one["proprio/effector_yaw"].item() for one in seen])
    assert yaws.min() < -2.8 and yaws.max() > 2.8
    after = [arm.measure(goal)["proprio/effector_yaw"].item() for goal in goals]
    np.testing.assert_allclose(np.cos(after - yaws), 1, atol=1e-6)  # the goal's arm is turned as the start's


def test_a_process_compiles_once(monkeypatch):
    """Two models, scene and kinematics, for any number of arms and resets."""
    from ogbench.manipspace.envs.cube_env import CubeEnv as StockEnv

    calls = []
    stock_compile = StockEnv.compile_model_and_data
    monkeypatch.setattr(StockEnv, "compile_model_and_data", lambda self: (calls.append(self), stock_compile(self)))
    arm_module.compiled.cache_clear()
    arms = [CubeArm() for _ in range(3)]
    for one in arms:
        one.restore(sample_start(np.random.default_rng(0), one))
        one.step(np.ones(5))
    assert len(calls) == 1 and arms[0].model is arms[2].model
