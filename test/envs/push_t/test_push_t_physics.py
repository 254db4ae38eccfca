"""The world of PushT moves as the published one does, and comes back to any state exactly."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pymunk", reason="PushT needs pymunk")

from torchrl_ficreg.envs.push_t.physics import PushTWorld, wrap  # noqa: E402  # noqa: E402

# Made from the published package by sota-check/make_golden_push_t.py.
GOLDEN = Path(__file__).parent / "golden" / "push_t.npz"
FAR = np.array([100.0, 100.0, 380.0, 300.0, 0.5, 0.0, 0.0])  # a row of pushes to the right stays clear of the block


def roll(world, actions):
    states = []
    for action in actions:
        world.step(action)
        states.append(world.get_state())
    return np.array(states)


def shoving(seed, count=50):
    """Actions that drive the disc through the block and back."""
    rng = np.random.default_rng(seed)
    return rng.normal(0, 0.4, (count, 2)) + 0.5 * np.sin(np.arange(count) / 4)[:, None]


# ---------------------------------------------------------------------- the published motion


def test_a_push_moves_agent_and_block_as_the_published_environment_does():
    golden = np.load(GOLDEN)
    world = PushTWorld()
    world.set_state(golden["push_start"])
    world.restore_legacy(golden["push_start"])
    states = roll(world, golden["push_action"])
    assert np.abs(np.diff(golden["push_state"][:, 4])).max() > 0.05  # there is something to compare: it turns
    np.testing.assert_allclose(states, golden["push_state"][1:], rtol=0, atol=1e-6)


def test_legacy_restoration_leaks_the_previous_scene_as_the_published_one_does():
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


def test_a_unit_action_from_rest_moves_the_disc_29_57_px():
    world = PushTWorld()
    world.set_state(FAR)
    assert roll(world, [[1.0, 0.0]])[0, 0] - FAR[0] == pytest.approx(29.57, abs=0.005)


def test_the_response_to_a_unit_action_sums_to_40_7_px():
    """A zero action holds the place where the disc is, so it brakes what the first one began."""
    world = PushTWorld()
    world.set_state(FAR)
    assert roll(world, [[1.0, 0.0]] + [[0.0, 0.0]] * 20)[-1, 0] - FAR[0] == pytest.approx(40.7, abs=0.05)


def test_a_constant_action_approaches_40_69_px_per_step():
    world = PushTWorld()
    world.set_state(FAR)
    walk = roll(world, [[0.0, -1.0]] * 30)
    assert walk[-1, 1] - walk[-2, 1] == pytest.approx(-40.69, abs=0.005)


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


def test_actions_beyond_one_are_obeyed():
    moved = []
    for size in (1.0, 2.5):
        world = PushTWorld()
        world.set_state(FAR)
        moved.append(roll(world, [[0.0, -size]])[0, 1] - FAR[1])
    assert moved[1] == pytest.approx(2.5 * moved[0])


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


# ---------------------------------------------------------------------- restoration


def test_a_restored_state_has_the_same_bits():
    rng = np.random.default_rng(0)
    world = PushTWorld()
    for _ in range(100):
        state = rng.uniform(0, 512, 7)
        state[4] = rng.uniform(0, 2 * np.pi)
        given = state.copy()
        world.set_state(state)
        assert (world.get_state() == given).all()
        assert (state == given).all()


def test_the_same_state_and_actions_give_the_same_bits_whatever_happened_before():
    start = np.array([200.0, 190.0, 250.0, 250.0, 1.0, 20.0, -30.0])
    world, other = PushTWorld(), PushTWorld()
    world.set_state(start)
    first = roll(world, shoving(0))
    assert np.ptp(first[:, 2]) > 10  # the block moved
    for seed in (1, 2):
        roll(world, shoving(seed))
        world.set_state(start)
        assert (roll(world, shoving(0)) == first).all()
    other.set_state(start)
    assert (roll(other, shoving(0)) == first).all()


def test_a_caller_cannot_reach_into_the_world():
    world = PushTWorld()
    world.set_state(FAR)
    world.get_state()[:] = 0
    assert (world.get_state() == FAR).all()


def test_angles_are_wrapped_to_one_turn_and_keep_their_bits_inside():
    for angle in (0.0, 1e-300, np.pi, np.nextafter(2 * np.pi, 0)):
        assert wrap(angle) == angle
    assert wrap(2 * np.pi) == wrap(-1e-20) == 0.0
    assert wrap(-0.5) == pytest.approx(2 * np.pi - 0.5)


# ---------------------------------------------------------------------- leaving

LEFT_OPEN = """
from torchrl_ficreg.envs import make_env

if __name__ == "__main__":
    env = make_env("push_t", num_envs={num_envs}, num_workers={num_workers}, image_size=8)
    env.rollout(2)
    env.itself = env  # a cycle, so that only the end of the interpreter frees it
"""


@pytest.mark.parametrize(("num_envs", "num_workers"), [(1, None), pytest.param(2, 2, marks=pytest.mark.slow)])
def test_an_environment_left_open_is_silent_at_exit(tmp_path, num_envs, num_workers):
    """pymunk would report an exception from the callback that frees a space."""
    script = tmp_path / "left_open.py"
    script.write_text(LEFT_OPEN.format(num_envs=num_envs, num_workers=num_workers))
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (0, "")
