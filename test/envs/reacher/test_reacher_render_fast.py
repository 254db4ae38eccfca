"""Fast pictures of the arm: close to MuJoCo's, at the same place, the same bits every time, and without GL."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from torchrl_ficreg.envs._gl import gl_works
from torchrl_ficreg.envs.reacher import env as env_module, ReacherEnv, tasks
from torchrl_ficreg.envs.reacher.render import empty_scene, render_pixels

needs_simulator = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("mujoco", "dm_control")),
    reason="mujoco or dm_control is not installed: pip install 'torchrl_ficreg[envs]'",
)


def postures(count, seed=0):
    rng = np.random.default_rng(seed)
    return np.stack([tasks.sample_state(rng) for _ in range(count)])


def difference(first, second):
    """Mean absolute difference of grey levels, per picture."""
    return np.abs(first.astype(float) - second).mean((-3, -2, -1))


# ---------------------------------------------------------------------- against MuJoCo's picture


@pytest.fixture(scope="module")
def published():
    """MuJoCo's pictures of 16 postures, by size."""
    if not gl_works():
        pytest.skip("no GL here: apt-get install libegl1 libgl1")
    pictures = {}
    for size in (64, 96):
        env = ReacherEnv(image_size=size)
        pictures[size] = np.stack([env._draw(state) for state in postures(16)])
        env.close()
    return pictures


@needs_simulator
@pytest.mark.parametrize(("size", "mean", "largest"), [(64, 0.18, 0.30), (96, 0.60, 0.70)])
def test_pictures_differ_little_from_the_published_ones(published, size, mean, largest):
    """0.16 over 100 postures at 64 px. At sizes without a stored background its resampling adds 0.1 to 0.7, at the walls."""
    errors = np.abs(render_pixels(postures(16), size=size).astype(float) - published[size])
    assert errors.mean() < mean and errors.mean((1, 2, 3)).max() < largest
    assert (errors > 64).mean() < 1e-4


@needs_simulator
@pytest.mark.parametrize("joint", [0, 1])
def test_nothing_is_displaced_against_the_published_picture(published, joint):
    """0.02 rad more or less, 0.4 px at the finger, make the pictures differ more."""
    differences = []
    for turn in (-0.02, 0.0, 0.02):
        turned = postures(16)
        turned[:, joint] += turn
        differences.append(difference(render_pixels(turned, size=64), published[64]).mean())
    assert np.argmin(differences) == 1


@needs_simulator
def test_the_stored_background_is_mujocos(published):
    """The median of the pictures, but for the surroundings of the root, where the arm is in most of them."""
    errors = np.abs(np.median(published[64], axis=0) - empty_scene(64))
    errors[:, 24:40, 24:40] = 0
    assert errors.max() <= 1


# ---------------------------------------------------------------------- as pictures


@pytest.mark.parametrize("wrist", [0.0, 1.5, -2.9])
def test_links_finger_and_root_are_where_the_angles_say(wrist):
    """Seen from 0.74 m at 45 degrees: x to the right, y up, from the centre; the colours are those of the links."""
    picture = render_pixels(np.array([0.7, wrist]), size=224).astype(int)
    scale = 224 / (2 * 0.74 * np.tan(np.pi / 8))  # px per m
    elbow = 0.12 * np.array([np.cos(0.7), np.sin(0.7)])
    hand = np.array([np.cos(0.7 + wrist), np.sin(0.7 + wrist)])
    for point, color in ((elbow / 2, 0.5), (elbow + 0.08 * hand, 0.5), (elbow + 0.12 * hand, 0.4), (0 * hand, 1.0)):
        red, green, _ = picture[:, int(112 - scale * point[1]), int(112 + scale * point[0])]
        if color == 1.0:
            assert (red, green) == (197, 255)
        else:
            assert red == 255 and green > 255 * color * 1.2  # lit from above


def test_every_posture_shows_an_arm_of_the_same_area():
    """Two links of 12 x 2 px and a finger of 2 x 2 px, folded or not; the darkest part of them is brighter than the floor."""
    states = postures(100)
    states[:40, 1] = np.linspace(-3.09, 3.09, 40)  # as far as the stops yield, and beyond
    shown = (render_pixels(states, size=64)[:, 0].astype(int) - empty_scene(64)[0] > 60).sum((1, 2))
    assert (shown > 20).all() and (shown < 80).all()
    assert (shown[np.abs(states[:, 1]) < 2] > 40).all()


def test_a_picture_changes_the_more_the_farther_a_joint_turns():
    start = postures(20)
    for joint in range(2):
        turned = [difference(render_pixels(start + angle * np.eye(4)[joint]), render_pixels(start)).mean()
                  for angle in (1e-3, 1e-2, 1e-1)]
        assert 0 < turned[0] < 0.05 < turned[1] < 0.3 < turned[2]


def test_velocities_and_full_turns_are_not_drawn():
    states = postures(10)
    still = render_pixels(states)
    assert np.array_equal(render_pixels(states[:, :2]), still)
    assert np.array_equal(render_pixels(states + [0.0, 0.0, 3.0, -7.0]), still)
    assert difference(render_pixels(states + [2 * np.pi * 40, 0.0, 0.0, 0.0]), still).max() < 1e-3  # rounding


def test_a_batch_is_its_pictures_and_the_states_stay_unchanged():
    states = postures(6).reshape(2, 3, 4)
    before = states.copy()
    pictures = render_pixels(states, size=32)
    assert pictures.shape == (2, 3, 3, 32, 32) and pictures.dtype == np.uint8 and np.array_equal(states, before)
    assert np.array_equal(pictures[1, 2], render_pixels(states[1, 2], size=32))
    pictures[:] = 0
    assert render_pixels(states, size=32).any()


@pytest.mark.parametrize("size", [1, 7, 63, 112, 224, 500])
def test_a_picture_of_any_size_shows_the_scene_of_a_large_one(size):
    """Averages over 8 x 8 parts of the view, to 5 grey levels in the mean; 448 is divided by 8, others are not."""
    state = postures(1)[0]
    large, small = (render_pixels(state, size=n).astype(float) for n in (448, size))
    parts = min(size, 8)
    edges = [np.linspace(0, n, parts + 1).round().astype(int) for n in (448, size)]
    means = [
        np.add.reduceat(np.add.reduceat(picture, e[:-1], 1), e[:-1], 2) / np.outer(np.diff(e), np.diff(e))
        for picture, e in zip((large, small), edges, strict=True)
    ]
    assert np.abs(means[0] - means[1]).mean() < (5 if size > 1 else 60)


@pytest.mark.parametrize(
    ("states", "size", "message"),
    [
        (np.zeros(3), 64, r"states must be \[..., 4\] or \[..., 2\], got \(3,\)"),
        (np.array([np.nan, 0.0]), 64, "angles must be finite"),
        (np.zeros(2), 0, "size must be a positive integer, got 0"),
        (np.zeros(2), 1.0, "size must be a positive integer, got 1.0"),
        (np.zeros(2), True, "size must be a positive integer, got True"),
    ],
)
def test_bad_arguments_are_refused(states, size, message):
    """Also when the size is equal to one that was drawn before."""
    render_pixels(np.zeros(2), size=1)
    with pytest.raises(ValueError, match=message):
        render_pixels(states, size=size)


# ---------------------------------------------------------------------- in the environment


@needs_simulator
def test_fast_environments_open_no_gl(monkeypatch):
    """Start, steps, goal and videos show the fast pictures; states are those of the published environment."""
    monkeypatch.setattr(env_module, "OffscreenRenderer", None)
    env = ReacherEnv(detail="fast", image_size=32, shadow_size=512)
    state, goal = postures(2)
    observation, _ = env.reset(options={"state": state, "goal_state": goal})
    assert np.array_equal(observation["goal_pixels"], render_pixels(goal, size=32))
    for _ in range(3):
        assert np.array_equal(observation["pixels"], render_pixels(observation["state"], size=32))
        assert np.array_equal(env.render().transpose(2, 0, 1), observation["pixels"])
        observation = env.step(np.ones(2))[0]
    env.close()


@needs_simulator
def test_an_unknown_detail_is_refused():
    with pytest.raises(ValueError, match="detail must be one of .*'fast', 'published'.*, got 'pixel'"):
        ReacherEnv(detail="pixel")
