"""Fast pictures show what matters, need no GL and leave the physics alone."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ogbench", reason="the cube is simulated by ogbench: pip install 'torchrl_ficreg[envs]'")

from torchrl_ficreg.envs import _gl
from torchrl_ficreg.envs._gl import gl_works
from torchrl_ficreg.envs.cube import CubeArm, CubeEnv, render_pixels
from torchrl_ficreg.envs.cube.physics import yaw_rotation
from torchrl_ficreg.envs.cube.raster import _FACE_BITS, _rasterize, _STEPS

SIZE = 64


@pytest.fixture(scope="module")
def arm():
    return CubeArm()


@pytest.fixture(scope="module")
def state(arm):
    return arm.resting(arm_yaw=0.5, cube_position=[0.5, 0.1], cube_yaw=0.4)


def draw(state: np.ndarray, size: int = SIZE) -> np.ndarray:
    return render_pixels(state, size=size, detail="fast").astype(int)


def red_centre(picture: np.ndarray) -> np.ndarray:
    """Row and column of the middle of the red patch, weighted by its redness."""
    weight = np.maximum(picture[0] - 2 * np.maximum(picture[1], picture[2]), 0)
    return np.array([(weight * index).sum() / weight.sum() for index in np.indices(weight.shape)])


@pytest.mark.parametrize(
    ("shift", "axis"), [([0.005, 0, 0], 0), ([0, 0.005, 0], 1)], ids=["towards the camera", "to the right"]
)
def test_half_a_centimetre_shows(shift, axis, state):
    """Half a pixel at this size; the centre of the patch moves by 0.2 to 0.8 pixels along one axis, and little else."""
    moved = state.copy()
    moved[14:17] += shift
    step = red_centre(draw(moved)) - red_centre(draw(state))
    assert 0.2 < step[axis] < 0.8 and abs(step[1 - axis]) < 0.25


def test_what_a_planner_must_see_changes_the_picture_near_it(state):
    """A cube turned by 20 degrees, a lifted one, whose shadow stays below it, and closed fingers."""
    before = draw(state)
    turned, lifted, closed = state.copy(), state.copy(), state.copy()
    turned[17:21] = yaw_rotation(0.4 + np.deg2rad(20))
    lifted[16] = 0.2
    closed[6:14] = [0.8, 0, 0.8, -0.8, 0.8, 0, 0.8, -0.8]
    row, column = red_centre(before).round().astype(int)
    changes = [np.abs(draw(other) - before).sum(0) for other in (turned, lifted, closed)]  # [64, 64] each
    for change, least in zip(changes, (100, 2000, 1000)):
        assert change.sum() > least
    for change in changes[:2]:
        assert change[:, column - 5 : column + 6].sum() > 0.99 * change.sum()
    assert changes[2][row - 5 : row + 6, column - 5 : column + 6].sum() < 0.2 * changes[2].sum()
    away = state.copy()
    away[14:16] = [0.5, -0.2]
    assert (draw(lifted)[:, row, column] < 0.7 * draw(away)[:, row, column]).all()


@pytest.mark.parametrize("size", [1, 15, 96])
def test_any_size_is_a_scaled_picture(size, state):
    picture = draw(state, size)
    assert picture.shape == (3, size, size)
    assert np.abs(picture.mean((1, 2)) - draw(state).mean((1, 2))).max() < (8 if size == 1 else 1.5)


def test_a_size_that_is_no_number_is_refused(state):
    with pytest.raises(ValueError, match="size must be a positive integer, got 0"):
        draw(state, 0)


def test_the_physics_does_not_depend_on_the_pictures(state):
    """Bit for bit, with and without a picture of the goal."""
    kinds = ("fast", "pixel") if gl_works() else ("fast",)
    envs = [CubeEnv(image_size=16, detail=detail) for detail in kinds]
    arm = CubeArm()
    arm.restore(state)
    for env in envs:
        env.reset(options={"state": state, "goal_state": state})
    for action in np.random.default_rng(0).uniform(-1, 1, (5, 5)):
        arm.step(action)
        for env in envs:
            assert np.array_equal(env.step(action)[0]["state"], arm.state)


def test_no_gl_is_opened(monkeypatch, state):
    monkeypatch.setattr(_gl, "_Surface", None)
    monkeypatch.setattr(_gl, "_process", -1)  # as in a process forked from one that had drawn
    env = CubeEnv(image_size=SIZE, detail="fast")
    assert (env.reset(options={"state": state, "goal_state": state})[0]["pixels"] == draw(state)).all()


def test_the_nearest_face_is_drawn_where_it_faces_the_viewer():
    """Two triangles over 4 x 4 cells: one across the lower left half, the other over all of it with the value of x."""
    points = np.array([[0.0, 4, 0, -8, 12, 0], [0, 0, 4, -1, -1, 30], [2, 2, 2, 0, 0, 0]])
    points[2, 3:] = 10 + points[0, 3:]
    faces = np.array([[0, 1, 2], [3, 4, 5]]).T
    keys = _rasterize(points, faces, 4, 4).reshape(4, 4)
    assert (keys & (1 << _FACE_BITS) - 1 == 1).all()
    np.testing.assert_allclose((keys >> _FACE_BITS) / _STEPS, 10 + np.tile(np.arange(4) + 0.5, (4, 1)), atol=1e-4)
    points[2, 3:] -= 10 + 8  # now in front on the right only
    keys = _rasterize(points - points[2].min() * np.array([[0], [0], [1]]), faces, 4, 4).reshape(4, 4)
    rows, columns = np.indices((4, 4)) + 0.5
    assert ((keys & (1 << _FACE_BITS) - 1 == 0) == (rows + columns <= 4)).all()
    assert (_rasterize(points, faces[::-1], 4, 4) == 0).all()
    points[0, 0] = np.nan
    assert (_rasterize(points, faces[:, :1], 4, 4) == 0).all()
