"""Physics of Reacher: the two-joint arm of dm_control, as a MuJoCo model.

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

from torchrl_ficreg.envs._gl import how_to_install, import_mujoco

if TYPE_CHECKING:
    import mujoco

CONTROL_STEPS = 2  # of 0.02 s each, per action
WRIST_LIMIT = math.radians(160.0)
WRIST_SLACK = 0.3  # rad past its limit that the soft stop may yield; the largest measured value is 0.16
CAMERA = "fixed"  # number 0: above the root, looking down


def load_model() -> mujoco.MjModel:
    """Compiles the arm from dm_control's XML file, without loading dm_control or GL.

    The model differs from the file in two settings. The target, which a task of joint angles does not use, is
    transparent. And the solver's warm start is off: it is a hidden state, worth 1e-15 rad at the wrist's stop, without
    which the next state is a function of state and action alone, bit for bit.

    Returns:
        a new model: two joints, two motors, cameras ``fixed`` and ``hand``.

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
