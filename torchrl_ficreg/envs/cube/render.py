"""Pictures of Cube, from the published camera.

With software rendering, the published meshes and shadows dominate the cost of a step: 0.2 s per picture against 1 ms of
physics. The arm has 185,000 faces, twelve for each pixel of a 128 x 128 picture. Unless the published detail is asked
for, pictures are therefore drawn from meshes with cells half a pixel wide and from a coarser shadow map.
"""

from __future__ import annotations

import copy
import functools
import os
import threading
from typing import get_args, Literal, TYPE_CHECKING

import numpy as np

from torchrl_ficreg.envs._gl import import_mujoco, OffscreenRenderer
from torchrl_ficreg.envs.cube.physics import compiled, NUM_POSITIONS

if TYPE_CHECKING:
    import mujoco

Detail = Literal["pixel", "published"]

CAMERA = "front_pixels"
_VIEW_HEIGHT = 0.66  # m, height of the view at the distance of the table's middle
_PUBLISHED_SHADOW = 4096  # width of the shadow map
_SHADOW = 2048  # of pictures larger than _SMALL
_SMALL_SHADOW = 1024
_SMALL = 96
_SLACK = 1e-3  # singular values below this share of the largest are flat directions


def render_pixels(state: np.ndarray, *, size: int = 224, detail: Detail = "pixel") -> np.ndarray:
    """Draws the scene; the first picture of a size opens GL and takes a second or two.

    Args:
        state (np.ndarray): [41] float64.
        size (int, optional): height and width of the picture, in pixels. Default: ``224``.
        detail (str, optional): ``"published"`` for all 185,000 faces and the published shadows; ``"pixel"`` leaves out
            details below half a pixel. On a CPU, ``"pixel"`` is five times as fast at 64 pixels and twice as fast at
            224; the mean absolute difference is below 1 of 255 grey levels. Default: ``"pixel"``.

    Returns:
        [3, size, size] uint8, red, green, blue.

    Raises:
        ValueError: unknown detail, or a size that is not a positive integer.
        ImportError: MuJoCo or ogbench is not installed.
        RuntimeError: GL is missing.
    """
    check_detail(detail)
    # Shared by all environments of a process: 25 of them would open 25 GL contexts with the same meshes. A GL context
    # belongs to a thread and does not survive a fork.
    return _scene_renderer(size, detail, os.getpid(), threading.get_ident()).draw(state)


def check_detail(detail: str) -> None:
    """Refuses an unknown detail.

    Args:
        detail (str): ``"pixel"`` or ``"published"``.

    Raises:
        ValueError: another detail.
    """
    if detail not in get_args(Detail):
        raise ValueError(f"detail must be one of {get_args(Detail)}, got {detail!r}.")


@functools.lru_cache(maxsize=8)
def _scene_renderer(size: int, detail: Detail, process: int, thread: int) -> _SceneRenderer:
    return _SceneRenderer(size, detail)


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


def cluster_faces(vertices: np.ndarray, faces: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Merges all vertices of a grid cell into one, and drops the faces that vanish with it.

    The merged vertex minimizes the area-weighted sum of squared distances from the planes of the adjacent faces,
    starting from the mean vertex (Lindstrom 2000, "Out-of-core simplification of large polygonal models"), so that
    flat parts stay flat and edges sharp. It is clamped to its cell.

    Args:
        vertices (np.ndarray): [V, 3] float, in m.
        faces (np.ndarray): [F, 3] int, corners of the triangles.
        cell (float): edge of the grid's cells, in m.

    Returns:
        the merged vertices [C, 3] float64, the remaining faces [G, 3] int64 as indices into them, and the indices of
        these faces among the old ones, [G] int64.

    Examples:
        >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.01, 0, 0]])
        >>> merged, faces, kept = cluster_faces(corners, np.array([[0, 1, 2], [0, 1, 3]]), cell=0.1)
        >>> len(merged), faces.tolist(), kept.tolist()
        (3, [[0, 2, 1]], [0])
    """
    origin = vertices.min(0)
    cells, cluster = np.unique(np.floor((vertices - origin) / cell).astype(np.int64), axis=0, return_inverse=True)
    cluster = cluster.reshape(-1)  # [V]
    count = len(cells)
    mean = np.stack([np.bincount(cluster, vertices[:, axis], count) for axis in range(3)], 1)  # [C, 3]
    mean /= np.bincount(cluster, minlength=count)[:, None]

    corners = vertices[faces]  # [F, 3, 3]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # [F, 3], twice the area long
    quadric, pull = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for corner in range(3):
        owner = cluster[faces[:, corner]]  # [F]
        gap = np.einsum("fi,fi->f", normal, corners[:, 0] - mean[owner])  # [F]
        np.add.at(quadric, owner, normal[:, :, None] * normal[:, None, :])
        np.add.at(pull, owner, normal * gap[:, None])
    shift = np.einsum("cij,cj->ci", np.linalg.pinv(quadric, rcond=_SLACK, hermitian=True), pull)
    low = origin + cells * cell  # [C, 3]
    merged = np.clip(mean + shift, low, low + cell)

    corner_cells = cluster[faces]  # [F, 3]
    spans = (corner_cells != np.roll(corner_cells, 1, axis=1)).all(1)
    kept = np.flatnonzero(spans)
    # Faces that now coincide: rotated to begin with the smallest corner, equal rows are equal faces.
    first = corner_cells[kept].argmin(1)
    rotated = np.take_along_axis(corner_cells[kept], (first[:, None] + np.arange(3)) % 3, axis=1)
    kept = kept[np.sort(np.unique(rotated, axis=0, return_index=True)[1])]
    return merged, corner_cells[kept], kept
