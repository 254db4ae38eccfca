"""The simulation of PushT moves as the published one does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pymunk", reason="PushT needs pymunk")

from torchrl_ficreg.envs._angles import wrap_angle  # noqa: E402
from torchrl_ficreg.envs.push_t.physics import PushTWorld  # noqa: E402

# Made from the published package by test/envs/push_t/golden/make_push_t.py.
GOLDEN = Path(__file__).parent / "golden" / "push_t.npz"
FAR = np.array([100.0, 100.0, 380.0, 300.0, 0.5, 0.0, 0.0])  # a row of pushes to the right stays clear of the block


def roll(world, actions):
    states = []
    for action in actions:
        world.step(action)
        states.append(world.get_state())
    return np.array(states)


# ---------------------------------------------------------------------- the published motion


def test_a_push_moves_agent_and_block_as_the_published_environment_does():
    golden = np.load(GOLDEN)
    world = PushTWorld()
    world.set_state(golden["push_start"])
    world.restore_legacy(golden["push_start"])
    states = roll(world, golden["push_action"])
    assert np.abs(np.diff(golden["push_state"][:, 4])).max() > 0.05  # there is something to compare: it turns
    np.testing.assert_allclose(states, golden["push_state"][1:], rtol=0, atol=1e-6)


def test_legacy_restoration_depends_on_the_previous_scene_as_in_the_published_one():
    """The published reset steps after it put the scene at the goal, and again at the start."""
    golden = np.load(GOLDEN)
    asked, got = golden["restore_asked"], golden["restore_got"]
    world = PushTWorld()
    restored = []
    for goal, start in asked:
        world.set_state(goal)
        world.restore_legacy(goal)
        world.restore_legacy(start)
        restored.append(world.get_state())
    np.testing.assert_allclose(restored, got, rtol=0, atol=1e-9)
    assert np.abs(got - asked[:, 1])[:4, 2:4].max() > 0.5  # px that the block was pushed by an overlap left behind
    np.testing.assert_allclose(got[:, :2], asked[:, 1, :2] + 0.01 * asked[:, 1, 5:], atol=1e-9)


# ---------------------------------------------------------------------- facts


@pytest.mark.parametrize(
    ("actions", "moved"),
    [
        ([[1.0, 0.0]], 29.57),  # from rest
        ([[2.5, 0.0]], 2.5 * 29.57),  # beyond the bounds, not clipped
        ([[1.0, 0.0]] + [[0.0, 0.0]] * 20, 40.7),  # in all: a zero action holds the present position, and so brakes
    ],
)
def test_the_disc_moves_as_far_as_in_the_published_environment(actions, moved):
    world = PushTWorld()
    world.set_state(FAR)
    assert roll(world, actions)[-1, 0] - FAR[0] == pytest.approx(moved, abs=0.02)


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


def test_walls_hold_the_block_but_not_the_disc():
    """A stem 7 px inside the wall is pushed out, up to the overlap of 0.1 px that the solver tolerates."""
    world = PushTWorld()
    world.set_state(np.array([100.0, 100.0, 120.0, 256.0, np.pi / 2, 0.0, 0.0]))  # the stem points left, to x = 0
    face = 5 + 2
    assert roll(world, [[0.0, 0.0]] * 30)[-1, 2] == pytest.approx(face + 120, abs=0.2)
    assert roll(world, [[-1.0, 0.0]] * 6)[-1, 0] < -100


def test_the_block_rests_unless_it_is_touched():
    """It moves under the disc and is still, to the bit, from the first step without a contact."""
    world = PushTWorld()
    world.set_state(np.array([256.0, 100.0, 256.0, 180.0, 0.0, 0.0, 0.0]))  # above the middle of its bar
    pushed = roll(world, [[0.0, 0.5]] * 5)
    assert pushed[-1, 3] > 190
    roll(world, [[0.0, -1.0]] * 2)  # away
    free = roll(world, [[0.0, -0.2]] * 5)
    assert (free[:, 2:5] == free[0, 2:5]).all()


def test_mass_moment_and_centre_of_gravity_are_the_published_ones():
    """The moment is twice that of the bar, 1/12 (120^2 + 30^2) + 15^2 about its edge: a slip, and part of the task."""
    block = PushTWorld().block
    assert block.mass == 1
    assert block.moment == 2 * ((120**2 + 30**2) / 12 + 15**2) == 3000
    assert tuple(block.center_of_gravity) == (0, 45)


# ---------------------------------------------------------------------- angles


def test_angles_are_wrapped_to_one_turn_and_keep_their_bits_inside():
    for angle in (0.0, 1e-300, np.pi, np.nextafter(2 * np.pi, 0)):
        assert wrap_angle(angle, low=0.0) == angle
    assert wrap_angle(2 * np.pi, low=0.0) == wrap_angle(-1e-20, low=0.0) == 0.0
    assert wrap_angle(-0.5, low=0.0) == pytest.approx(2 * np.pi - 0.5)
