"""Pictures of the arm and its cube, from the published camera.

Where the CPU draws, the published meshes and shadows are all that a step costs: 0.2 s a picture against 1 ms of
physics. Pictures are therefore drawn from meshes whose cells are half a pixel wide and from a coarser shadow map,
unless the published detail is asked for.
"""

from __future__ import annotations

import copy
import functools
import os
import threading
from typing import get_args, Literal, TYPE_CHECKING

import numpy as np

from torchrl_ficreg.envs.cube.arm import compiled
from torchrl_ficreg.envs.cube.meshes import cluster_faces
from torchrl_ficreg.envs.cube.poses import NUM_POSITIONS
from torchrl_ficreg.envs.gl import import_mujoco, OffscreenRenderer

if TYPE_CHECKING:
    import mujoco

Detail = Literal["pixel", "published"]

CAMERA = "front_pixels"
_VIEW_HEIGHT = 0.66  # m, what the camera sees at the distance of the table's middle
_PUBLISHED_SHADOW = 4096  # width of the shadow map
_SHADOW = 2048  # of pictures larger than _SMALL
_SMALL_SHADOW = 1024
_SMALL = 96


def render(state: np.ndarray, *, size: int = 224, detail: Detail = "pixel") -> np.ndarray:
    """Draws the scene; the first picture of a size opens GL and takes a second or two.

    Args:
        state: [41] float64.
        size: height and width of the picture, in pixels.
        detail: ``"published"`` for all 185,000 faces and the published shadows. ``"pixel"`` leaves out what is
            smaller than half a pixel; a CPU draws 64 pixels five times, 224 pixels twice as fast. The mean absolute
            difference is below 1 of 255 grey levels.

    Returns:
        [3, size, size] uint8, red, green, blue.

    Raises:
        ValueError: unknown detail, or a size that is not a positive integer.
        ImportError: MuJoCo or ogbench is not installed.
        RuntimeError: GL is missing.
    """
    check_detail(detail)
    # One for all environments of a process: 25 of them would open 25 GL contexts with the same meshes. GL belongs to
    # a thread, and does not survive a fork.
    return _painter(size, detail, os.getpid(), threading.get_ident()).draw(state)


def check_detail(detail: str) -> None:
    """Refuses an unknown detail.

    Args:
        detail: to be checked.

    Raises:
        ValueError: it is not one of :data:`Detail`.
    """
    if detail not in get_args(Detail):
        raise ValueError(f"detail must be one of {get_args(Detail)}, got {detail!r}.")


@functools.lru_cache(maxsize=8)
def _painter(size: int, detail: Detail, process: int, thread: int) -> _Painter:
    return _Painter(size, detail)


class _Painter:
    def __init__(self, size: int, detail: Detail) -> None:
        self._mujoco = import_mujoco()
        self._model = copy.copy(compiled().model)
        self._model.vis.quality.shadowsize = _PUBLISHED_SHADOW
        # MuJoCo clears the whole buffer for each picture.
        self._model.vis.global_.offwidth = self._model.vis.global_.offheight = size
        if detail == "pixel":
            self._model.vis.quality.shadowsize = _SMALL_SHADOW if size <= _SMALL else _SHADOW
            _coarsen(self._model, cell=_VIEW_HEIGHT / size / 2)
        self._data = self._mujoco.MjData(self._model)
        self._renderer = OffscreenRenderer(self._model, size)

    def draw(self, state: np.ndarray) -> np.ndarray:
        self._data.qpos[:] = state[:NUM_POSITIONS]
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_camlight(self._model, self._data)
        return self._renderer.draw(self._data, CAMERA)


def _coarsen(model: mujoco.MjModel, cell: float) -> None:
    """Overwrites the meshes of a model with coarser ones; only pictures look at these."""
    for mesh in range(model.nmesh):
        vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        merged, faces, kept = cluster_faces(vertices, model.mesh_face[start : start + count], cell)
        vertices[: len(merged)] = merged
        model.mesh_face[start : start + len(kept)] = faces
        model.mesh_facenormal[start : start + len(kept)] = model.mesh_facenormal[start : start + count][kept]
        model.mesh_facenum[mesh] = len(kept)
