"""Simplification of triangle meshes."""

from __future__ import annotations

import numpy as np

_SLACK = 1e-3  # singular values below this share of the largest are flat directions


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
