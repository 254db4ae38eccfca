"""Two cubes are alike up to the 24 rotations of a cube, and success is measured in metres and degrees."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from torchrl_ficreg.envs.cube.physics import CUBE_POSITION, CUBE_ROTATION, STATE_SIZE, yaw_rotation
from torchrl_ficreg.envs.cube.tasks import cube_angle, is_success


def matrix(quaternion):
    w, x, y, z = quaternion
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def symmetries():
    """All signed permutation matrices of determinant 1."""
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        rotation = np.zeros((3, 3))
        rotation[range(3), order] = signs
        if np.linalg.det(rotation) > 0:
            yield rotation


def quaternions(count, seed=0):
    draws = np.random.default_rng(seed).normal(size=(count, 4))
    return draws / np.linalg.norm(draws, axis=-1, keepdims=True)


def lying(x=0.4, y=0.0, z=0.02, yaw=0.0):
    state = np.zeros(STATE_SIZE)
    state[CUBE_POSITION], state[CUBE_ROTATION] = (x, y, z), yaw_rotation(np.deg2rad(yaw))
    return state


def test_the_angle_is_the_smallest_over_the_24_rotations():
    """Against brute force: the angle of R1^T R2 S is arccos((trace - 1) / 2), S running over the group."""
    group = list(symmetries())
    assert len(group) == 24
    first, second = quaternions(300), quaternions(300, seed=1)
    angles = cube_angle(first, second)
    for one, other, angle in zip(first, second, angles, strict=True):
        relative = matrix(one).T @ matrix(other)
        expected = min(np.arccos(np.clip((np.trace(relative @ s) - 1) / 2, -1, 1)) for s in group)
        assert angle == pytest.approx(expected, abs=1e-7)
    assert np.rad2deg(angles.max()) < 62.8  # the covering radius of the group


def test_the_angle_is_symmetric_blind_to_signs_and_takes_any_batch_shape():
    first, second = quaternions(12).reshape(3, 4, 4), quaternions(12, seed=1).reshape(3, 4, 4)
    angles = cube_angle(first, second)
    assert angles.shape == (3, 4)
    np.testing.assert_allclose(cube_angle(second, first), angles, atol=1e-7)
    np.testing.assert_allclose(cube_angle(-first, second), angles, atol=1e-7)
    np.testing.assert_allclose(cube_angle(first[1, 2], second)[1, 2], angles[1, 2])
    np.testing.assert_allclose(cube_angle(first, first), 0, atol=1e-7)


def test_a_cube_on_the_floor_repeats_every_quarter_turn():
    found = [cube_angle(yaw_rotation(0.3), yaw_rotation(0.3 + np.deg2rad(yaw))) for yaw in (14, 45, 76, 90, 180, 300)]
    np.testing.assert_allclose(np.rad2deg(found), [14, 45, 14, 0, 0, 30], atol=1e-5)


def test_the_published_rule_is_four_centimetres_in_three_dimensions_however_turned():
    assert is_success(lying(yaw=45), lying(x=0.4399)) and not is_success(lying(), lying(x=0.4401))
    assert not is_success(lying(), lying(x=0.43, z=0.05))  # 3 cm along and 3 cm up
    assert is_success(np.stack([lying(), lying(x=0.5)]), lying()).tolist() == [True, False]


@pytest.mark.parametrize(("x", "yaw", "reached"), [
    (0.4299, 0, True), (0.4301, 0, False), (0.4, 14.9, True), (0.4, 15.1, False), (0.4, 104.9, True), (0.4, 45, False),
])
def test_the_pose_rule_is_three_centimetres_and_fifteen_degrees(x, yaw, reached):
    assert is_success(lying(x=x, yaw=yaw), lying(), success_on="pose") == reached
