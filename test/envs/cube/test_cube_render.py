"""The published camera and colours; coarse meshes draw nearly the same picture, and the same state the same bits."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ogbench", reason="the cube is simulated by ogbench: pip install 'torchrl_ficreg[envs]'")

from torchrl_ficreg.envs._gl import gl_works, import_mujoco, OffscreenRenderer
from torchrl_ficreg.envs.cube import CubeArm, render_pixels
from torchrl_ficreg.envs.cube.render import cluster_faces

draws = pytest.mark.skipif(not gl_works(), reason="MuJoCo needs a GL library to draw")


@pytest.fixture(scope="module")
def arm():
    return CubeArm()


@pytest.fixture(scope="module")
def state(arm):
    arm.restore(arm.resting(arm_yaw=0.5, cube_position=[0.45, 0.1], cube_yaw=0.4))
    for _ in range(4):
        arm.step(np.array([1.0, -1.0, -0.5, 0.5, 0.5]))
    return arm.state


def test_camera_and_colours_are_the_published_ones(arm):
    model = arm.model
    camera = model.camera("front_pixels")
    assert camera.pos.tolist() == [1.053, -0.014, 0.639]
    assert camera.fovy.item() == 45
    rotation = np.empty(9)
    import_mujoco().mju_quat2Mat(rotation, camera.quat)
    np.testing.assert_allclose(rotation.reshape(3, 3)[:, 0], [0, 1, 0], atol=1e-3)
    np.testing.assert_allclose(rotation.reshape(3, 3)[:, 1], [-0.628, 0.001, 0.778], atol=1e-3)
    for material in ("ur5e/robotiq/black", "ur5e/robotiq/pad_gray"):
        np.testing.assert_allclose(model.material(material).rgba, [0.61, 0.28, 0.82, 1], atol=1e-6)
    np.testing.assert_allclose(model.geom("object_0").rgba, [0.96, 0.26, 0.33, 1], atol=1e-6)
    assert model.geom("target_object_0").rgba[3] == 0
    np.testing.assert_allclose(model.light("global").diffuse, 0.7, atol=1e-6)
    assert (model.mat_rgba[:, 3] == 1).all()  # the arm is opaque
    grid = model.texture("grid")
    texels = model.tex_data[grid.adr.item() :][: grid.width.item() * grid.height.item() * 3].reshape(-1, 3)
    colours, counts = np.unique(texels, axis=0, return_counts=True)
    checker = colours[np.argsort(-counts)[:2]] / 255
    np.testing.assert_allclose(sorted(checker.tolist()), [[0.08, 0.11, 0.16], [0.15, 0.18, 0.25]], atol=1 / 255)


@draws
@pytest.mark.parametrize("size", [64, 224])
def test_the_cube_is_a_red_patch_where_the_camera_sees_it(size, state):
    """The pinhole projection of its centre, worked out from the published camera, is the middle of the patch."""
    picture = render_pixels(state, size=size).astype(int)
    assert picture.shape == (3, size, size)
    red, green, blue = picture
    rows, columns = np.nonzero((red > 100) & (red > 2 * green) & (red > 2 * blue))
    offset = np.array([0.45, 0.1, 0.02]) - [1.053, -0.014, 0.639]
    right, up = np.array([0, 1, 0]), np.array([-0.628, 0.001, 0.778])
    depth = -offset @ np.cross(right, up)
    focal = size / 2 / np.tan(np.deg2rad(22.5))
    seen = size / 2 + focal / depth * np.array([-(offset @ up), offset @ right])
    np.testing.assert_allclose([rows.mean() + 0.5, columns.mean() + 0.5], seen, atol=size / 60)
    assert 10 < len(rows) * (64 / size) ** 2 < 25  # 0.04 m are 3.5 of 64 pixels at 0.87 m, a little more at an angle


@draws
def test_coarse_meshes_change_less_than_one_grey_level_on_average(state):
    full, coarse = (render_pixels(state, size=64, detail=detail).astype(int) for detail in ("published", "pixel"))
    assert 0 < np.abs(full - coarse).mean() < 1


@draws
def test_a_picture_depends_on_the_positions_alone(state):
    """Bit for bit; and computing accelerations and contacts first, as MuJoCo's own pictures do, changes nothing."""
    picture = render_pixels(state, size=64)
    moving = state.copy()
    moving[21:] = 1.0
    other = CubeArm()
    other.step(np.ones(5))
    assert np.array_equal(render_pixels(moving, size=64), picture)
    mujoco = import_mujoco()
    data = mujoco.MjData(other.model)
    data.qpos[:] = state[:21]
    mujoco.mj_forward(other.model, data)
    renderer = OffscreenRenderer(other.model, 64)
    plain = renderer.draw(data, "front_pixels")
    renderer.close()
    difference = np.abs(plain.astype(int) - render_pixels(state, size=64, detail="published").astype(int))
    assert difference.max() == 0


def test_an_unknown_detail_is_refused(state):
    with pytest.raises(ValueError, match=r"detail must be one of \('pixel', 'published'\), got 'fine'"):
        render_pixels(state, detail="fine")


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
