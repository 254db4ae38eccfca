"""The arm is dm_control's, number by number and step by step, and its angles compare as the task says."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from simulators import require_simulator

from torchrl_ficreg.envs._gl import import_mujoco
from torchrl_ficreg.envs.reacher import physics, tasks

require_simulator("reacher", pictures=False)


@pytest.fixture(scope="module")
def model():
    return physics.load_model()


def test_the_numbers_of_the_arm(model):
    """Time step, damping, motors and stop from dm_control's file; masses from density 1000 kg/m3 and the shapes."""
    assert (model.nq, model.nv, model.nu) == (2, 2, 2)
    assert model.opt.timestep * physics.CONTROL_STEPS == 0.04 and model.dof_damping.tolist() == [0.01, 0.01]
    assert model.actuator_gear[:, 0].tolist() == [0.05, 0.05]
    assert model.actuator_ctrlrange.tolist() == [[-1.0, 1.0], [-1.0, 1.0]]
    assert model.jnt_limited.tolist() == [0, 1]
    assert model.jnt_range[1].tolist() == pytest.approx([-physics.WRIST_LIMIT, physics.WRIST_LIMIT])
    assert pytest.approx(2.7925268) == physics.WRIST_LIMIT
    ball = 4 / 3 * np.pi * 0.01**3
    capsules = [np.pi * 0.01**2 * length + ball for length in (0.12, 0.10)]
    assert model.body_mass[1:].tolist() == pytest.approx([1000 * volume for volume in (*capsules, ball)])
    assert model.body_mass[1:].round(4).tolist() == [0.0419, 0.0356, 0.0042]
    flags = import_mujoco().mjtDisableBit
    assert model.opt.disableflags & int(flags.mjDSBL_CONTACT)
    assert model.opt.disableflags & int(flags.mjDSBL_WARMSTART)


def test_it_moves_as_in_dm_control(model):
    """1200 control steps, torques beyond +-1 and stops included; the warm start is worth 1e-12 by then."""
    mujoco = import_mujoco()
    stock = importlib.import_module("dm_control.suite.reacher").hard(random=0).physics
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    data.qpos[:] = stock.data.qpos[:] = tasks.sample_state(rng)[:2]
    stock.forward()
    touched = 0
    for _ in range(600):
        data.ctrl[:] = rng.uniform(-1.5, 1.5, size=2) + [0.0, 0.8]  # leans on the wrist's stop
        stock.set_control(data.ctrl)
        stock.step(physics.CONTROL_STEPS)
        mujoco.mj_step(model, data, physics.CONTROL_STEPS)
        touched += abs(data.qpos[1]) > physics.WRIST_LIMIT
        np.testing.assert_allclose(data.qpos, stock.data.qpos, rtol=0, atol=1e-12)
        np.testing.assert_allclose(data.qvel, stock.data.qvel, rtol=0, atol=1e-11)
    assert touched > 0


def test_torques_beyond_the_range_act_as_one(model):
    mujoco = import_mujoco()
    ends = []
    for action in ([1.0, -1.0], [7.0, -1.001]):
        data = mujoco.MjData(model)
        data.ctrl[:] = action
        mujoco.mj_step(model, data, 20)
        ends.append(data.qpos.tolist())
    assert ends[0] == ends[1]


def test_the_stop_yields_less_than_the_slack_to_the_strongest_push(model):
    mujoco = import_mujoco()
    data = mujoco.MjData(model)
    farthest = 0.0
    for _ in range(2000):  # swings the wrist from stop to stop, the shoulder against it
        push = 1.0 if data.qvel[1] >= 0 else -1.0
        data.ctrl[:] = -push, push
        mujoco.mj_step(model, data)
        farthest = max(farthest, abs(data.qpos[1]))
    assert physics.WRIST_LIMIT + 0.1 < farthest < physics.WRIST_LIMIT + physics.WRIST_SLACK < np.pi


def test_starts_are_uniform_and_at_rest():
    """Means 0 and standard deviations of the uniform law, width / sqrt(12), within 4 standard errors."""
    rng = np.random.default_rng(0)
    states = np.stack([tasks.sample_state(rng) for _ in range(4000)])
    assert not states[:, 2:].any()
    bounds = np.array([np.pi, physics.WRIST_LIMIT])
    assert (np.abs(states[:, :2]) <= bounds).all()
    np.testing.assert_allclose(states[:, :2].mean(0), 0, atol=4 * np.pi / np.sqrt(3 * 4000))
    np.testing.assert_allclose(states[:, :2].std(0), bounds / np.sqrt(3), rtol=0.03)


def test_success_is_a_box_of_005_rad_whatever_the_velocity():
    goal = np.array([0.5, -1.0, 0.0, 0.0])
    inside = goal + [0.0499, -0.0499, 9.0, -9.0]
    assert tasks.is_success(inside, goal)
    for joint in (0, 1):
        outside = inside.copy()
        outside[joint] += np.sign(inside[joint] - goal[joint]) * 0.0002
        assert not tasks.is_success(outside, goal)


def test_only_the_shoulder_goes_around_and_only_if_wrapped():
    goal = np.array([3.12, 0.3, 0.0, 0.0])
    for turns in (-3, -1, 1, 2):
        turned = goal + [2 * np.pi * turns + 0.03, 0, 0, 0]  # crosses the seam at pi
        assert tasks.is_success(turned, goal) and not tasks.is_success(turned, goal, wrap=False)
    assert not tasks.is_success(goal + [0, 2 * np.pi, 0, 0], goal)


def test_errors_of_a_batch_are_those_of_its_rows():
    rng = np.random.default_rng(0)
    states, goals = rng.normal(0, 5, (3, 7, 4)), rng.normal(0, 5, (3, 7, 4))
    batch = tasks.joint_error(states, goals)
    assert batch.shape == (3, 7, 2) and (np.abs(batch[..., 0]) <= np.pi).all()
    np.testing.assert_array_equal(batch[1, 2], tasks.joint_error(states[1, 2], goals[1, 2]))
    near = states + rng.normal(0, 0.05, states.shape)
    solved = tasks.is_success(states, near)
    assert 0 < solved.sum() < solved.size and solved[1, 2] == tasks.is_success(states[1, 2], near[1, 2])
