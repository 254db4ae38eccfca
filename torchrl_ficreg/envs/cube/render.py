"""Pictures of Cube, from the published camera.

With software rendering, the published meshes and shadows dominate the cost of a step: 0.2 s per picture against 1 ms of
physics. The arm has 185,000 faces, twelve for each pixel of a 128 x 128 picture. Unless the published detail is asked
for, pictures are therefore drawn from meshes with cells half a pixel wide and from a coarser shadow map, or without
MuJoCo by :mod:`torchrl_ficreg.envs.cube.raster`.
"""

from __future__ import annotations

import copy
import functools
import os
import threading
from typing import get_args, Literal, TYPE_CHECKING

import numpy as np

from torchrl_ficreg.envs._gl import import_mujoco, OffscreenRenderer
from torchrl_ficreg.envs.cube.meshes import cluster_faces
from torchrl_ficreg.envs.cube.physics import compiled, NUM_POSITIONS
from torchrl_ficreg.envs.cube.raster import FastScene

if TYPE_CHECKING:
    import mujoco

Detail = Literal["fast", "pixel", "published"]

CAMERA = "front_pixels"
_VIEW_HEIGHT = 0.66  # m, height of the view at the distance of the table's middle
_PUBLISHED_SHADOW = 4096  # width of the shadow map
_SHADOW = 2048  # of pictures larger than _SMALL
_SMALL_SHADOW = 1024
_SMALL = 96


def render_pixels(state: np.ndarray, *, size: int = 224, detail: Detail = "pixel") -> np.ndarray:
    """Draws the scene; the first picture of a size takes a second or two.

    Args:
        state (np.ndarray): [41] float64.
        size (int, optional): height and width of the picture, in pixels. Default: ``224``.
        detail (str, optional): ``"published"`` for all 185,000 faces and the published shadows; ``"pixel"`` leaves out
            details below half a pixel. On a CPU, ``"pixel"`` is five times as fast at 64 pixels and twice as fast at
            224; the mean absolute difference is below 1 of 255 grey levels. ``"fast"`` is drawn without GL by
            :mod:`torchrl_ficreg.envs.cube.raster`, and differs by 2.8 at 64 pixels and by 1.3 at 224. It takes 2.2 ms at 64
            pixels, ``"pixel"`` 32 ms. Default: ``"pixel"``.

    Returns:
        [3, size, size] uint8, red, green, blue.

    Raises:
        ValueError: unknown detail, or a size that is not a positive integer.
        ImportError: MuJoCo or ogbench is not installed.
        RuntimeError: GL is missing, which ``"fast"`` does not need.
    """
    check_detail(detail)
    # Shared by all environments of a process: 25 of them would open 25 GL contexts with the same meshes. A GL context
    # belongs to a thread and does not survive a fork.
    return _scene_renderer(size, detail, os.getpid(), threading.get_ident()).draw(state)


def check_detail(detail: str) -> None:
    """Refuses an unknown detail.

    Args:
        detail (str): ``"fast"``, ``"pixel"`` or ``"published"``.

    Raises:
        ValueError: another detail.
    """
    if detail not in get_args(Detail):
        raise ValueError(f"detail must be one of {get_args(Detail)}, got {detail!r}.")


@functools.lru_cache(maxsize=8)
def _scene_renderer(size: int, detail: Detail, process: int, thread: int) -> _SceneRenderer | FastScene:
    return FastScene(compiled().model, CAMERA, size) if detail == "fast" else _SceneRenderer(size, detail)


class _SceneRenderer:
    """Draws pictures of one size and detail, from a copy of the model."""

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
    """Overwrites the meshes of a model with coarser ones, which affects pictures only."""
    for mesh in range(model.nmesh):
        vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        merged, faces, kept = cluster_faces(vertices, model.mesh_face[start : start + count], cell)
        vertices[: len(merged)] = merged
        model.mesh_face[start : start + len(kept)] = faces
        model.mesh_facenormal[start : start + len(kept)] = model.mesh_facenormal[start : start + count][kept]
        model.mesh_facenum[mesh] = len(kept)
