"""Expert of TwoRoom: the scripted policy that recorded the published data."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchrl_ficreg.envs.two_room.physics import TWO_ROOM

if TYPE_CHECKING:
    from torchrl_ficreg.envs.two_room.env import TwoRoomEnv

SWITCH_DISTANCE = 10.5  # px from the door centre at which the agent turns to the goal


class TwoRoomExpert:
    """Moves to the door, then to the goal, with Gaussian noise on every action.

    Each action is the unit vector towards the current waypoint plus noise, clipped to [-1, 1]. The waypoint is the
    goal in the same room and the centre of the door otherwise, until the agent is within 10.5 px of it. From there
    the published policy moves straight to the goal, along the jamb if necessary; this one first leaves the corridor at
    the height nearest to the goal, because a jamb admits only the component along it.

    Args:
        noise_std (float, optional): standard deviation of the noise per component, in actions. With the published
            value, 2.0, 63 % of the components are at a bound. Default: ``2.0``.
        rng (np.random.Generator, optional): source of the noise. Default: ``np.random.default_rng(0)``.
        env (TwoRoomEnv, optional): the environment whose geometry is used. Default: ``None``, the default geometry.

    Raises:
        ValueError: ``noise_std`` is negative or not finite.

    Examples:
        >>> expert = TwoRoomExpert(noise_std=0.0)
        >>> expert(np.array([60.0, 149.0]), np.array([60.0, 49.0])).tolist()
        [0.0, -1.0]
    """

    def __init__(
        self,
        *,
        noise_std: float = 2.0,
        rng: np.random.Generator | None = None,
        env: TwoRoomEnv | None = None,
    ) -> None:
        if not 0 <= noise_std < np.inf:
            raise ValueError(f"noise_std must be finite and not negative, got {noise_std}.")
        self.noise_std = noise_std
        self.geometry = TWO_ROOM if env is None else env.geometry
        self._rng = np.random.default_rng(0) if rng is None else rng

    def __call__(self, state: np.ndarray, goal_state: np.ndarray) -> np.ndarray:
        """Chooses the next action.

        Args:
            state (np.ndarray): [2], x and y of the agent.
            goal_state (np.ndarray): [2], x and y of the goal.

        Returns:
            [2] float32 in [-1, 1].
        """
        offset = self._waypoint(state, goal_state) - state
        distance = np.linalg.norm(offset)
        action = offset / distance if distance > 0 else offset
        if self.noise_std > 0:
            action = action + self._rng.normal(0.0, self.noise_std, size=2)
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def _waypoint(self, state: np.ndarray, goal: np.ndarray) -> np.ndarray:
        geometry = self.geometry
        door = np.array([geometry.wall_center, geometry.door_center])
        goes_right = goal[0] > geometry.wall_center
        same_half = goes_right == (state[0] > geometry.wall_center)
        if not same_half and np.linalg.norm(door - state) >= SWITCH_DISTANCE:
            return door
        in_corridor = geometry.face_left < state[0] < geometry.face_right
        goal_in_room = not geometry.face_left <= goal[0] <= geometry.face_right
        if in_corridor and goal_in_room:
            exit_x = geometry.rest_right if goes_right else geometry.rest_left
            drawn = geometry.door_half_extent
            return np.array([exit_x, np.clip(goal[1], door[1] - drawn, door[1] + drawn)])
        return goal
