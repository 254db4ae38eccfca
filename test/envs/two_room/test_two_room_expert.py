"""The expert passes the door, and with the published noise its episodes resemble the published ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_ficreg.envs.two_room import physics, sample_task, TwoRoomExpert
from torchrl_ficreg.envs.two_room.tasks import is_success, sample_goal


def rows_of_episode(expert, start, goal, collision):
    """Rows (actions + 1) of an episode of at most 100 actions, and whether it reached its goal."""
    position, goal_tensor = torch.from_numpy(start), torch.from_numpy(goal)
    for taken in range(100):
        if is_success(position, goal_tensor):
            return taken + 1, True
        action = torch.from_numpy(expert(position.numpy(), goal))
        position = physics.step(position, action, collision=collision)
    return 101, bool(is_success(position, goal_tensor))


@pytest.mark.parametrize("collision", ["swept", "endpoint"])
def test_without_noise_every_task_is_solved_without_detours(collision):
    """50 of 50 within 100 steps, each within 1.3 times the path through the door plus the turn at the jamb."""
    rng, door = np.random.default_rng(0), np.array([112.0, 49.0])
    for _ in range(50):
        start, goal = sample_task(rng)
        rows, solved = rows_of_episode(TwoRoomExpert(noise_std=0.0), start, goal, collision)
        path = np.linalg.norm(start - door) + np.linalg.norm(door - goal)
        assert solved
        assert rows <= 1.3 * path / 5 + 3


@pytest.mark.parametrize("collision", ["swept", "endpoint"])
def test_with_noise_2_episodes_are_as_long_as_the_published_ones(collision):
    """Published two-room data: mean 92.08 rows, median 101, 40 % of the episodes reach their goal."""
    rng = np.random.default_rng(1)
    expert = TwoRoomExpert(noise_std=2.0, rng=np.random.default_rng(2))
    outcomes = [rows_of_episode(expert, *sample_task(rng), collision) for _ in range(150)]
    rows, solved = np.array(outcomes).T
    assert 86 < rows.mean() < 97 and np.median(rows) > 95 and 0.28 < solved.mean() < 0.56


def test_the_noise_saturates_as_in_the_published_data():
    """Published figures at noise 2: about 63 % of the components at a bound, standard deviation about 0.867."""
    expert = TwoRoomExpert(noise_std=2.0)
    actions = np.stack([expert(np.array([60.0, 150.0]), np.array([60.0, 50.0])) for _ in range(4000)])
    assert actions.dtype == np.float32 and np.abs(actions).max() == 1
    assert abs((np.abs(actions) == 1).mean() - 0.63) < 0.03 and abs(actions[:, 0].std() - 0.85) < 0.04


def test_waypoints_are_the_door_then_the_exit_then_the_goal():
    expert = TwoRoomExpert(noise_std=0.0)
    goal = np.array([160.0, 180.0])
    for state, waypoint in [
        ((60.0, 49.0), (112.0, 49.0)),
        ((101.0, 49.0), (112.0, 49.0)),  # 11 px before the door's centre
        ((102.0, 49.0), (124.5, 63.0)),  # 10 px: leave the corridor at the height nearest to the goal
        ((120.0, 60.0), (124.5, 63.0)),
        ((125.0, 63.0), (160.0, 180.0)),
    ]:
        offset = np.array(waypoint) - state
        np.testing.assert_allclose(expert(np.array(state), goal), offset / np.linalg.norm(offset), rtol=1e-6)
    assert expert(goal, goal).tolist() == [0, 0]


def test_a_goal_farther_than_the_rooms_are_long_is_refused():
    with pytest.raises(ValueError, match="no goal is 500 steps away"):
        sample_goal(np.random.default_rng(0), np.array([60.0, 60.0]), min_steps=500)
