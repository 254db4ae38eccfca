"""What CubeEnv adds to the protocol of all environments: success rules, illegal states."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ogbench", reason="the cube is simulated by ogbench: pip install 'torchrl_ficreg[envs]'")

from torchrl_ficreg.envs._gl import gl_works
from torchrl_ficreg.envs.cube import CubeArm, CubeEnv

pytestmark = pytest.mark.skipif(not gl_works(), reason="MuJoCo needs a GL library to draw")

SIZE = 16


@pytest.fixture(scope="module")
def scene():
    arm = CubeArm()
    poses = {"state": ([0.4, 0.1], 0.2), "goal_state": ([0.5, -0.1], 1.0)}
    return {
        key: arm.resting(arm_yaw=0.0, cube_position=position, cube_yaw=yaw)
        for key, (position, yaw) in poses.items()
    }


def test_success_follows_the_chosen_rule(scene):
    """3.5 cm away is near enough for the published rule alone; so is a cube turned by 45 degrees."""
    arm = CubeArm()
    shifted = arm.resting(arm_yaw=0.0, cube_position=[0.5, -0.065], cube_yaw=1.0)
    turned = arm.resting(arm_yaw=0.0, cube_position=[0.5, -0.1], cube_yaw=1.0 + np.pi / 4)
    quarter = arm.resting(arm_yaw=0.0, cube_position=[0.5, -0.1], cube_yaw=1.0 + np.pi / 2)
    for state, by_pose in ((shifted, False), (turned, False), (quarter, True)):
        for rule, expected in (("position", True), ("pose", by_pose)):
            env = CubeEnv(image_size=SIZE, success_on=rule)
            _, info = env.reset(options={"state": state, "goal_state": scene["goal_state"]})
            assert info["success"].item() is expected
            _, reward, terminated, truncated, _ = env.step(np.zeros(5))
            assert (reward, terminated, truncated) == (float(expected), expected, False)


def test_illegal_states_are_refused_and_say_why(scene):
    env = CubeEnv(image_size=SIZE)
    flat, sunk = scene["state"].copy(), scene["state"].copy()
    flat[17:21] = 0.0
    sunk[16] = -0.1
    for state, message in (
        (flat, "quaternion of the cube, of length 1, but have length 0"),
        (sunk, "the cube is below the floor"),
        (np.zeros(28), r"must have shape \(41,\), got \(28,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            env.reset(options={"state": state})


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match=r"success_on must be one of \('position', 'pose'\), got 'colour'"):
        CubeEnv(success_on="colour")
    with pytest.raises(ValueError, match="detail must be one of"):
        CubeEnv(detail="fine")
