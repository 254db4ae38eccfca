"""What CubeEnv adds to the protocol of all environments: success rules."""

from __future__ import annotations

import numpy as np
from simulators import require_simulator

from torchrl_ficreg.envs.cube import CubeArm, CubeEnv

require_simulator("cube")


def test_success_follows_the_chosen_rule():
    """3.5 cm away is near enough for the published rule alone; so is a cube turned by 45 degrees."""
    arm = CubeArm()
    envs = {rule: CubeEnv(image_size=16, success_on=rule) for rule in ("position", "pose")}
    goal = arm.resting(arm_yaw=0.0, cube_position=[0.5, -0.1], cube_yaw=1.0)
    for y, yaw, by_pose in ((-0.065, 0, False), (-0.1, np.pi / 4, False), (-0.1, np.pi / 2, True)):
        state = arm.resting(arm_yaw=0.0, cube_position=[0.5, y], cube_yaw=1.0 + yaw)
        for rule, expected in (("position", True), ("pose", by_pose)):
            _, info = envs[rule].reset(options={"state": state, "goal_state": goal})
            assert info["success"].item() is expected
            assert envs[rule].step(np.zeros(5))[1:4] == (float(expected), expected, False)
