"""The arm of dm_control's reacher, as a MuJoCo model, and how its joint angles compare.

Two links in the plane, seen from above; angles in radians, counter-clockwise::

                     o finger          state = [shoulder, wrist, their velocities in rad/s]
                    /
                   / 0.12 m            shoulder: turns without limit
       root o-----o                    wrist:    within +-160 degrees, relative to the arm
             0.12 m  wrist             motors:   0.05 N m at action 1; damping 0.01 N m s
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_ficreg.envs._gl import how_to_install, import_mujoco

if TYPE_CHECKING:
    import mujoco

CONTROL_STEPS = 2  # of 0.02 s each, per action
WRIST_LIMIT = math.radians(160.0)
WRIST_SLACK = 0.3  # rad past its limit that the soft stop may yield; 0.16 is the most that we have seen
TOLERANCE = 0.05  # rad per joint, within which a goal is reached
CAMERA = "fixed"  # number 0: above the root, looking down


def load_model() -> mujoco.MjModel:
    """Compiles the arm from dm_control's own file, without loading dm_control or GL.

    Two things differ from the file. The target, which has no part in a task of joint angles, is transparent. And the
    solver starts each step afresh: its warm start is a memory outside the state, worth 1e-15 rad at the wrist's stop,
    and without it the state and the action alone decide the next state, bit for bit.

    Returns:
        a model of one's own: two joints, two motors, cameras ``fixed`` and ``hand``.

    Raises:
        ImportError: MuJoCo or dm_control is not installed.
    """
    mujoco = import_mujoco()
    spec = importlib.util.find_spec("dm_control")
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(f"dm_control is not installed: {how_to_install('dm_control')}.")
    file = Path(spec.submodule_search_locations[0]) / "suite" / "reacher.xml"
    model = mujoco.MjModel.from_xml_path(str(file))
    model.material("target").rgba[3] = 0.0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
    return model


def sample_state(rng: np.random.Generator) -> np.ndarray:
    """Draws an arm at rest: the shoulder uniformly over the circle, the wrist uniformly within its limits.

    Args:
        rng: the source of randomness.

    Returns:
        [4] float64.

    Examples:
        >>> sample_state(np.random.default_rng(0)).round(3).tolist()
        [0.861, -1.286, 0.0, 0.0]
    """
    return np.array([rng.uniform(-np.pi, np.pi), rng.uniform(-WRIST_LIMIT, WRIST_LIMIT), 0.0, 0.0])


def joint_error(state: np.ndarray, goal_state: np.ndarray, *, wrap: bool = True) -> np.ndarray:
    """The way of both joints from a state to a goal.

    Args:
        state: [..., 4] or [..., 2] float, angles first.
        goal_state: as ``state``.
        wrap: take the shoulder's shorter way around the circle; the wrist cannot go around.

    Returns:
        [..., 2] float64, goal minus state, in rad.

    Examples:
        >>> joint_error(np.array([3.0, 0.5]), np.array([-3.0, 0.0])).round(3).tolist()
        [0.283, -0.5]
    """
    error = np.array(goal_state[..., :2] - state[..., :2], dtype=np.float64)
    if wrap:
        error[..., 0] = (error[..., 0] + np.pi) % (2 * np.pi) - np.pi
    return error


def is_success(state: np.ndarray, goal_state: np.ndarray, *, wrap: bool = True) -> np.ndarray:
    """Tells where each joint is within 0.05 rad of its goal; velocities do not count.

    Args:
        state: [..., 4] or [..., 2] float, angles first.
        goal_state: as ``state``.
        wrap: see :func:`joint_error`; False is the published rule.

    Returns:
        [...] bool.

    Examples:
        >>> turned = np.array([2 * np.pi, 0.0])
        >>> bool(is_success(turned, np.zeros(2))), bool(is_success(turned, np.zeros(2), wrap=False))
        (True, False)
    """
    return (np.abs(joint_error(state, goal_state, wrap=wrap)) < TOLERANCE).all(-1)
