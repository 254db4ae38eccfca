"""The simulation of PushT moves as the published one does."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pymunk", reason="PushT needs pymunk")

from torchrl_ficreg.envs._angles import wrap_angle  # noqa: E402
from torchrl_ficreg.envs.push_t.physics import PushTWorld  # noqa: E402

# Made from the published package by test/envs/push_t/golden/make_push_t.py.
GOLDEN = np.load(Path(__file__).parent / "golden" / "push_t.npz")
FAR = np.array([100.0, 100.0, 380.0, 300.0, 0.5, 0.0, 0.0])  # a row of pushes to the right stays clear of the block


@pytest.fixture
def world():
    return PushTWorld()


def roll(world, actions, start=None):
    """States [T, 7] after each action, from a start or from where the world is."""
    states = []
    if start is not None:
        world.set_state(np.asarray(start))
    for action in actions:
        world.step(np.asarray(action))
        states.append(world.get_state())
    return np.array(states)


def test_a_push_moves_agent_and_block_as_the_published_environment_does(world):
    world.set_state(GOLDEN["push_start"])
    world.restore_legacy(GOLDEN["push_start"])
    published = GOLDEN["push_state"]
    assert np.abs(np.diff(published[:, 4])).max() > 0.05  # there is something to compare: it turns
    np.testing.assert_allclose(roll(world, GOLDEN["push_action"]), published[1:], rtol=0, atol=1e-6)


def test_legacy_restoration_depends_on_the_previous_scene_as_in_the_published_one(world):
    """The published reset steps after it put the scene at the goal, and again at the start."""
    asked, got = GOLDEN["restore_asked"], GOLDEN["restore_got"]
    restored = []
    for goal, start in asked:
        world.set_state(goal)
        world.restore_legacy(goal)
        world.restore_legacy(start)
        restored.append(world.get_state())
    np.testing.assert_allclose(restored, got, rtol=0, atol=1e-9)
    assert np.abs(got - asked[:, 1])[:4, 2:4].max() > 0.5  # px that the block was pushed by an overlap left behind
    np.testing.assert_allclose(got[:, :2], asked[:, 1, :2] + 0.01 * asked[:, 1, 5:], atol=1e-9)


@pytest.mark.parametrize(
    ("actions", "moved"),
    [
        ([[1.0, 0.0]], 29.57),  # from rest
        ([[2.5, 0.0]], 2.5 * 29.57),  # beyond the bounds, not clipped
        ([[1.0, 0.0]] + [[0.0, 0.0]] * 20, 40.7),  # in all: a zero action holds the present position, and so brakes
    ],
)
def test_the_disc_moves_as_far_as_in_the_published_environment(world, actions, moved):
    assert roll(world, actions, FAR)[-1, 0] - FAR[0] == pytest.approx(moved, abs=0.02)


@pytest.mark.parametrize("relative", [True, False])
def test_the_disc_follows_the_pd_law(relative):
    """Per substep v <- 0.8 v + (target - p), p <- p + 0.01 v; the target is an offset, or a place in pixels."""
    world = PushTWorld(relative=relative)
    place, velocity = np.array([100.0, 100.0]), np.array([30.0, -20.0])
    world.set_state(np.array([*place, 380.0, 300.0, 0.5, *velocity]))
    action = np.array([0.3, -0.7]) if relative else np.array([130.0, 30.0])
    target = place + 100 * action if relative else action
    for _ in range(10):
        velocity = 0.8 * velocity + (target - place)
        place = place + 0.01 * velocity
    world.step(action)
    np.testing.assert_allclose(world.get_state()[[0, 1, 5, 6]], [*place, *velocity], rtol=1e-12)


def test_walls_hold_the_block_but_not_the_disc(world):
    """A stem 7 px inside the wall is pushed out, up to the overlap of 0.1 px that the solver tolerates."""
    start = [100.0, 100.0, 120.0, 256.0, np.pi / 2, 0.0, 0.0]  # the stem points left, to x = 0
    face = 5 + 2
    assert roll(world, [[0.0, 0.0]] * 30, start)[-1, 2] == pytest.approx(face + 120, abs=0.2)
    assert roll(world, [[-1.0, 0.0]] * 6)[-1, 0] < -100


def test_the_block_rests_unless_it_is_touched(world):
    """It moves under the disc and is still, to the bit, from the first step without a contact."""
    above_the_bar = [256.0, 100.0, 256.0, 180.0, 0.0, 0.0, 0.0]
    assert roll(world, [[0.0, 0.5]] * 5, above_the_bar)[-1, 3] > 190
    roll(world, [[0.0, -1.0]] * 2)  # away
    free = roll(world, [[0.0, -0.2]] * 5)
    assert (free[:, 2:5] == free[0, 2:5]).all()


def test_mass_moment_and_centre_of_gravity_are_the_published_ones(world):
    """The moment is twice that of the bar, 1/12 (120^2 + 30^2) + 15^2 about its edge: a slip, and part of the task."""
    block = world.block
    assert block.moment == 2 * ((120**2 + 30**2) / 12 + 15**2) == 3000
    assert block.mass == 1 and tuple(block.center_of_gravity) == (0, 45)


def test_angles_are_wrapped_to_one_turn_and_keep_their_bits_inside():
    for angle in (0.0, 1e-300, np.pi, np.nextafter(2 * np.pi, 0)):
        assert wrap_angle(angle, low=0.0) == angle
    assert wrap_angle(2 * np.pi, low=0.0) == wrap_angle(-1e-20, low=0.0) == 0.0
    assert wrap_angle(-0.5, low=0.0) == pytest.approx(2 * np.pi - 0.5)


def test_a_missing_simulator_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymunk", None)
    with pytest.raises(ImportError, match=r"PushT needs pymunk: pip install 'torchrl_ficreg\[envs\]'"):
        runpy.run_module("torchrl_ficreg.envs.push_t.physics")
