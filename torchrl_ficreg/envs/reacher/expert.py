"""Expert of Reacher: random torques, and computed torques that reach joint angles."""

from __future__ import annotations

from typing import get_args, Literal

import numpy as np

from torchrl_ficreg.envs.base import PixelGoalEnv
from torchrl_ficreg.envs.reacher import tasks

Kind = Literal["random", "reach", "goal"]

MAX_TORQUE = 0.05  # N m at action 1
DAMPING = 0.01  # N m s
# Of the arm about the shoulder with the wrist at a right angle; of the cosine term; of the hand about the wrist; kg m2.
INERTIA = (9.758101e-4, 2.739469e-4, 1.886736e-4)
STIFFNESS = 15.0  # 1/s, of the critically damped approach
PATIENCE = 50  # actions after which a target that noise keeps out of reach is replaced


def reach_torque(state: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Computed torque: the joint error e decays by e'' + 2 w e' + w^2 e = 0 as long as the motors are strong enough.

    With M the inertia matrix, c the centrifugal and Coriolis torques and d the damping::

        torque = M (w^2 e - 2 w v) + c + d v

    Args:
        state (np.ndarray): [4], angles in rad and velocities in rad/s.
        target (np.ndarray): [2] or [4], the angles to reach; the shoulder takes the shorter direction.

    Returns:
        [2] float64, the action; beyond +-1 where the motors are too weak.

    Examples:
        >>> (reach_torque(np.zeros(4), np.array([0.1, 0.0])) > 0).tolist()
        [True, True]
    """
    velocity = state[2:]
    wanted = STIFFNESS**2 * tasks.joint_error(state, target) - 2 * STIFFNESS * velocity  # rad/s2
    torque = inertia_matrix(state[1]) @ wanted + coriolis(state[1], velocity) + DAMPING * velocity
    return torque / MAX_TORQUE


def inertia_matrix(wrist: float) -> np.ndarray:
    """The arm's inertia about its joints.

    Args:
        wrist (float): angle of the wrist in rad.

    Returns:
        [2, 2] float64, kg m2.
    """
    both, bent, hand = INERTIA
    cross = hand + bent * np.cos(wrist)
    return np.array([[both + 2 * bent * np.cos(wrist), cross], [cross, hand]])


def coriolis(wrist: float, velocity: np.ndarray) -> np.ndarray:
    """Centrifugal and Coriolis torques.

    Args:
        wrist (float): angle of the wrist in rad.
        velocity (np.ndarray): [2], rad/s.

    Returns:
        [2] float64, N m.
    """
    swing = INERTIA[1] * np.sin(wrist)
    shoulder, relative = velocity
    return swing * np.array([-(2 * shoulder + relative) * relative, shoulder**2])


class ReacherExpert:
    """Records data of the arm, by one of three policies.

    ``"random"``: uniform torques, as in the published data, whose actions have standard deviation 1 / sqrt(3).
    ``"reach"``: computed torque plus Gaussian noise, clipped, towards joint angles that are drawn at random, and drawn
    anew once they are reached or after 50 actions. ``"goal"``: the same towards the episode's goal.

    Args:
        rng (np.random.Generator, optional): source of actions, targets and noise. Default:
            ``np.random.default_rng(0)``.
        env (ReacherEnv, optional): not used; part of the :class:`~torchrl_ficreg.envs.registry.Expert` protocol.
            Default: ``None``.
        kind (str, optional): ``"random"``, ``"reach"`` or ``"goal"``. Default: ``"random"``.
        noise_std (float, optional): standard deviation of the noise of the two reaching kinds, in actions. Default:
            ``0.3``.

    Raises:
        ValueError: an unknown kind, or a noise that is negative or not finite.

    Examples:
        >>> expert = ReacherExpert(kind="goal", noise_std=0.0)
        >>> expert(np.zeros(4), np.array([1.0, 0.0, 0.0, 0.0])).tolist()
        [1.0, 1.0]
    """

    def __init__(
        self,
        *,
        rng: np.random.Generator | None = None,
        env: PixelGoalEnv | None = None,
        kind: Kind = "random",
        noise_std: float = 0.3,
    ) -> None:
        if kind not in get_args(Kind):
            raise ValueError(f"kind must be one of {get_args(Kind)}, got {kind!r}.")
        if not 0 <= noise_std < np.inf:
            raise ValueError(f"noise_std must be finite and not negative, got {noise_std}.")
        self.kind = kind
        self.noise_std = noise_std
        self._rng = np.random.default_rng(0) if rng is None else rng
        self._target: np.ndarray | None = None
        self._tried = 0

    def __call__(self, state: np.ndarray, goal_state: np.ndarray) -> np.ndarray:
        """Chooses the next action.

        Args:
            state (np.ndarray): [4], angles in rad and velocities in rad/s.
            goal_state (np.ndarray): [4]; only ``kind="goal"`` reads it.

        Returns:
            [2] float32 in [-1, 1].
        """
        if self.kind == "random":
            return self._rng.uniform(-1.0, 1.0, size=2).astype(np.float32)
        target = goal_state if self.kind == "goal" else self._own_target(state)
        action = reach_torque(state, target) + self._rng.normal(0.0, self.noise_std, size=2)
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def _own_target(self, state: np.ndarray) -> np.ndarray:
        if self._target is None or self._tried == PATIENCE or tasks.is_success(state, self._target):
            self._target, self._tried = tasks.sample_state(self._rng), 0
        self._tried += 1
        return self._target
