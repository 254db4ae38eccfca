"""The published camera and colours; coarse meshes draw nearly the same picture, and the same state the same bits."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ogbench", reason="the cube is simulated by ogbench: pip install 'torchrl_ficreg[envs]'")

from torchrl_ficreg.envs._gl import gl_works, import_mujoco, OffscreenRenderer
from torchrl_ficreg.envs.cube import CubeArm, render_pixels

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


@pytest.mark.parametrize("detail", ["fast", pytest.param("pixel", marks=draws)])
@pytest.mark.parametrize("size", [64, 112])
def test_the_cube_is_a_red_patch_where_the_camera_sees_it(size, detail, state):
    """The pinhole projection of its centre, worked out from the published camera, is the middle of the patch."""
    picture = render_pixels(state, size=size, detail=detail).astype(int)
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
def test_the_difference_from_the_published_pictures_is_as_stated(state):
    """In the mean, of 255. The brightness of the whole picture does not change."""
    held = state.copy()
    held[14:17] = [0.45, -0.1, 0.2]  # above its shadow
    for size, states, bounds in ((64, (state, held), {"pixel": 1.0, "fast": 3.5}), (224, (held,), {"fast": 1.7})):
        for one in states:
            full = render_pixels(one, size=size, detail="published").astype(int)
            for detail, bound in bounds.items():
                difference = render_pixels(one, size=size, detail=detail) - full
                assert 0 < np.abs(difference).mean() < bound
                assert abs(difference.mean()) < 0.5


@pytest.mark.parametrize("detail", ["fast", pytest.param("pixel", marks=draws)])
def test_a_picture_depends_on_the_positions_alone(detail, state):
    """Bit for bit, whatever was drawn before."""
    picture = render_pixels(state, size=64, detail=detail)
    moving = state.copy()
    moving[21:] = 1.0
    other = CubeArm()
    other.step(np.ones(5))
    assert not np.array_equal(render_pixels(other.state, size=64, detail=detail), picture)
    assert np.array_equal(render_pixels(moving, size=64, detail=detail), picture)


@draws
def test_accelerations_and_contacts_do_not_show(state):
    """Computing them first, as MuJoCo's own pictures do, changes nothing."""
    other = CubeArm()
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
    with pytest.raises(ValueError, match=r"detail must be one of \('fast', 'pixel', 'published'\), got 'fine'"):
        render_pixels(state, detail="fine")
