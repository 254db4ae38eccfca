"""Coarser meshes are the same bodies: corners and edges stay where they are."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ogbench", reason="the cube is simulated by ogbench: pip install 'torchrl_ficreg[envs]'")

from torchrl_ficreg.envs.cube.meshes import cluster_faces


def box(parts):
    """The surface of the unit cube, each side cut into parts x parts squares of two triangles."""
    line = np.linspace(0, 1, parts + 1)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
    corner = np.array([i * (parts + 1) + j for i in range(parts) for j in range(parts)])
    step = parts + 1
    square = np.concatenate([
        np.stack([corner, corner + step, corner + step + 1], 1), np.stack([corner, corner + step + 1, corner + 1], 1)
    ])
    vertices, faces = [], []
    for axis in range(3):
        for side in (0.0, 1.0):
            faces.append(square + sum(map(len, vertices)))
            vertices.append(np.insert(grid, axis, side, axis=1))
    return np.concatenate(vertices), np.concatenate(faces)


def test_a_coarser_box_is_the_same_box():
    """Its corners and edges survive exactly: planes around a vertex decide where it goes."""
    vertices, faces = box(20)
    merged, coarse, kept = cluster_faces(vertices, faces, cell=0.24)
    assert len(coarse) == len(kept) < len(faces) / 10
    assert coarse.max() < len(merged)
    for corner in np.ndindex(2, 2, 2):
        assert np.abs(merged - corner).max(1).min() < 1e-6
    outside = np.abs(merged - 0.5).max(1)
    np.testing.assert_allclose(outside, 0.5, atol=1e-6)


def test_a_tiny_cell_changes_nothing_but_duplicate_vertices():
    vertices, faces = box(4)
    merged, coarse, kept = cluster_faces(vertices, faces, cell=1e-3)
    assert kept.tolist() == list(range(len(faces)))
    np.testing.assert_allclose(merged[coarse], vertices[faces], atol=1e-9)
