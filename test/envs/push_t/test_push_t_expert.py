"""The expert of PushT reaches its targets, and its data resemble the published ones in their statistics."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pymunk", reason="PushT needs pymunk: pip install 'torchrl_ficreg[envs]'")

from torchrl_ficreg.envs._angles import wrap_angle
from torchrl_ficreg.envs.push_t import expert as pushes, geometry, sample_state
from torchrl_ficreg.envs.push_t.expert import PushTExpert, REACH
from torchrl_ficreg.envs.push_t.geometry import AGENT_RADIUS, part_distances, WINDOW
from torchrl_ficreg.envs.push_t.physics import PushTWorld
from torchrl_ficreg.envs.push_t.tasks import is_success


def clearance(points):
    """Distance of places [..., 2] in the block's frame from the T, negative inside."""
    return np.minimum(*part_distances(points[..., 0], points[..., 1]))


def gap(state):
    """Distance between the disc's edge and the T."""
    return clearance(geometry.to_block(state[2:5], state[:2])) - AGENT_RADIUS


def play(expert, start, goal, steps):
    """States [steps + 1, 7] and actions [steps, 2]."""
    world = PushTWorld()
    world.set_state(start)
    states, actions = [start], []
    for _ in range(steps):
        actions.append(expert(states[-1], goal))
        world.step(actions[-1].astype(np.float64))
        states.append(world.get_state())
    return np.stack(states), np.stack(actions)


def episode(index, steps=150, **options):
    rng = np.random.default_rng((3, index))
    start, goal = sample_state(rng), sample_state(rng)
    return *play(PushTExpert(rng=rng, **options), start, goal, steps), goal


@pytest.fixture(scope="module")
def recorded():
    return [episode(index) for index in range(20)]


def test_actions_are_as_large_as_the_published_ones_and_predict_the_motion_of_the_disc(recorded):
    """Published: mean 0, standard deviation 0.2 per component, correlation with the displacement 0.995."""
    states, actions = (np.concatenate(part) for part in zip(*[(s[:-1], a) for s, a, _ in recorded]))
    moves = np.concatenate([np.diff(s[:, :2], axis=0) for s, _, _ in recorded])
    assert actions.dtype == np.float32 and actions.shape == (3000, 2)
    assert np.isfinite(actions).all() and np.abs(actions).max() <= 1
    assert np.abs(actions.mean(0)).max() < 0.02 and np.abs(actions.std(0) - 0.2).max() < 0.02
    assert np.corrcoef(actions.ravel(), moves.ravel())[0, 1] > 0.97
    assert (np.abs(states[:, :2] - WINDOW / 2).max(1) < WINDOW / 2).mean() > 0.99


def test_the_disc_touches_every_face_and_the_block_moves_and_turns_both_ways_in_most_windows_of_25_steps(recorded):
    starts, ends = (np.concatenate([s[part] for s, _, _ in recorded]) for part in (slice(-25), slice(25, None)))
    shift = np.linalg.norm(ends[:, 2:4] - starts[:, 2:4], axis=1)
    turn = np.degrees(wrap_angle(ends[:, 4] - starts[:, 4]))
    assert (shift > 10).mean() > 0.7 and (turn > 10).mean() > 0.25 and (turn < -10).mean() > 0.25
    assert np.quantile(shift, 0.99) < 200
    assert np.mean([is_success(*pair) for pair in zip(starts, ends)]) < 0.01
    states = np.concatenate([s for s, _, _ in recorded])
    touching = states[np.array([gap(state) for state in states]) < 0.5]
    assert 0.25 < len(touching) / len(states) < 0.5  # a third of the time
    x, y = np.stack([geometry.to_block(state[2:5], state[:2]) for state in touching]).T
    for face in (y < 0, x > 60, x < -60, (y > 30) & (x > 31), (y > 30) & (x < -31), y > 120, np.abs(x) < 31):
        assert face.mean() > 0.02


def test_goals_anywhere_are_reached_within_an_episode_without_other_targets():
    """Block within 20 px and 20 degrees after 150 steps; measured over 100 goals: 95 %."""
    arrivals = []
    for index in range(12):
        states, _, goal = episode(index, goal_share=1.0, random_share=0.0, free_share=0.0)
        arrivals.append(any(is_success(state, goal, success_on="block") for state in states))
    assert sum(arrivals) >= 10


class RecordingExpert(PushTExpert):
    """Keeps the positions and poses during each path around the T."""

    def __init__(self, **options):
        super().__init__(**options)
        self.paths = []

    def _go_around(self, contact):
        path = []
        for place in super()._go_around(contact):
            path.append((self._agent, self._pose))
            yield place
        self.paths.append([*path, (self._agent, self._pose)])


def test_paths_around_the_block_do_not_move_it():
    steps, still = 0, 0
    for index in range(10):
        rng = np.random.default_rng((4, index))
        expert = RecordingExpert(rng=rng)
        play(expert, sample_state(rng), sample_state(rng), 150)
        for path in expert.paths:
            poses = np.stack([pose for _, pose in path])
            shift = np.abs(np.diff(poses[:, :2], axis=0)).sum()  # px that the block moved on the whole path
            assert shift < 12
            steps, still = steps + 1, still + (shift < 2)
    assert steps > 40 and still / steps > 0.9


def test_paths_keep_their_clearance_and_are_no_longer_than_needed():
    rng = np.random.default_rng(0)
    around = 0
    for _ in range(200):
        pose = np.array([256.0, 256.0, rng.uniform(0, 2 * np.pi)])
        start, end = (geometry.nearest_clear(rng.uniform((-120, -60), (120, 180))) for _ in range(2))
        paths = geometry.Paths(pose, geometry.to_window(pose, start))
        way = geometry.to_block(pose, np.stack(paths.waypoints(end)))
        np.testing.assert_allclose(way[[0, -1]], [start, end], atol=1e-9)
        fine = np.linspace(way[:-1], way[1:], 50).reshape(-1, 2)
        assert clearance(fine).min() > geometry.CLEARANCE - 1e-5
        length = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
        assert length == pytest.approx(paths.lengths(end[None])[0])
        if geometry.is_clear_line(start, end):
            assert len(way) == 2 and length == pytest.approx(np.linalg.norm(end - start))
        around += len(way) > 2
    assert around > 50


def test_paths_avoid_the_outside_of_the_window():
    """From one side of the stem to the other: past its foot where there is room, else around the whole bar."""
    right, left = np.array([45.0, 80.0]), np.array([-45.0, 80.0])
    for block_y, turns in [(200.0, {120}), (370.0, {0, 30})]:
        pose = np.array([256.0, block_y, 0.0])
        way = geometry.to_block(pose, np.stack(geometry.Paths(pose, geometry.to_window(pose, right)).waypoints(left)))
        beside = geometry.CLEARANCE + geometry.MARGIN
        assert {round(y - beside if y > 0 else y + beside) for y in way[1:-1, 1]} == turns


def test_a_push_takes_the_block_where_the_quasi_static_model_says():
    """6 px along the normal at every contact: the simulated block lags behind by less than 0.6 px and 0.4 degrees."""
    world, pose = PushTWorld(), np.array([250.0, 240.0, 0.7])
    for contact, (point, normal) in enumerate(zip(pushes.POINTS, pushes.NORMALS)):
        inward = geometry.rotation(pose[2]) @ normal
        disc = geometry.to_window(pose, point - AGENT_RADIUS * normal)
        world.set_state(np.array([*disc, *pose, 0, 0]))
        world.step(0.2 * inward)
        state = world.get_state()
        expected = pushes.pushed(pose, contact, np.linalg.norm(state[:2] - disc))
        np.testing.assert_allclose(state[2:4], expected[:2], atol=0.6, err_msg=f"{point}")
        assert state[4] == pytest.approx(expected[2], abs=np.radians(0.4)), point
        centers = [geometry.to_window(place, geometry.CENTER) for place in (pose, expected)]
        assert np.linalg.norm(centers[1] - centers[0]) > 1.5


def test_the_speed_of_a_constant_action_is_that_of_the_physics():
    world = PushTWorld()
    world.set_state(np.array([-5000.0, 0, 256, 256, 0, 0, 0]))
    for _ in range(60):
        before = world.get_state()[0]
        world.step(np.array([1.0, 0.0]))
    assert world.get_state()[0] - before == pytest.approx(REACH, abs=0.01)


@pytest.mark.parametrize("agent", [(256.0, 300.0), (256.0, 258.0), (300.0, 312.0), (-150.0, 80.0), (700.0, 700.0)])
def test_it_starts_anywhere_in_the_block_or_outside_of_the_window(agent):
    start = np.array([*agent, 256.0, 256.0, 0.3, 0.0, 0.0])
    states, actions = play(PushTExpert(rng=np.random.default_rng(0)), start, start, 120)
    assert np.isfinite(states).all() and np.abs(actions).max() <= 1
    assert np.abs(states[60:, :2] - WINDOW / 2).max() < WINDOW / 2
    assert np.linalg.norm(states[-1, 2:4] - states[20, 2:4]) > 5
