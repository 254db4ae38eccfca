"""Import of MuJoCo on machines without its GL library.

TorchRL looks for ``mujoco.mjx``, for which Python imports MuJoCo. MuJoCo loads the GL library that ``MUJOCO_GL`` names,
and its import fails if that library is missing or the name is unknown. The package imports this module before TorchRL,
so that MuJoCo is loaded in any case.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from types import ModuleType


def import_without_gl() -> ModuleType:
    """Imports MuJoCo; where its GL library cannot be loaded, without pictures (``MUJOCO_GL=off``).

    Returns:
        the module ``mujoco``.

    Raises:
        ModuleNotFoundError: MuJoCo is not installed.
    """
    wanted = os.environ.get("MUJOCO_GL")
    try:
        return importlib.import_module("mujoco")
    except (AttributeError, ImportError, OSError, RuntimeError):  # PyOpenGL reads an attribute of None without a library
        os.environ["MUJOCO_GL"] = "off"
        try:
            return importlib.import_module("mujoco")
        finally:
            os.environ.pop("MUJOCO_GL") if wanted is None else os.environ.update(MUJOCO_GL=wanted)


if os.environ.get("MUJOCO_GL") is not None and "mujoco" not in sys.modules and importlib.util.find_spec("mujoco"):
    import_without_gl()
