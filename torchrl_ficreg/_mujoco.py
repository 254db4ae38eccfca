"""Lets TorchRL be imported where MuJoCo is installed and its GL library is not.

TorchRL looks for ``mujoco.mjx``, for which Python imports MuJoCo, which loads the library that ``MUJOCO_GL`` names and
fails where it is missing, or where the name is none. Imported before TorchRL, this module leaves MuJoCo loaded either way.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys


def load() -> None:
    """Imports MuJoCo where ``MUJOCO_GL`` asks for something special; at worst without pictures."""
    wanted = os.environ.get("MUJOCO_GL")
    if wanted is None or "mujoco" in sys.modules or importlib.util.find_spec("mujoco") is None:
        return
    try:
        importlib.import_module("mujoco")
    except (AttributeError, ImportError, OSError, RuntimeError):  # PyOpenGL trips over a None without its library
        os.environ["MUJOCO_GL"] = "off"
        try:
            importlib.import_module("mujoco")
        finally:
            os.environ["MUJOCO_GL"] = wanted


load()
