"""Expert of Cube: picks the cube up and puts it down at the goal, repeatedly until the episode ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from torchrl_ficreg.envs.cube.physics import CubeArm, TIME_STEP


class CubeExpert:
    """OGBench's plan oracle, seeded, with one goal per episode.

    A plan moves the gripper over the cube, down, up, over the goal, down, up and to a random end, with random heights
    and times and temporally correlated noise. Actions track it from the measured pose. When a plan ends, the next
    begins with the same goal: the cube is then lifted and put down at the same place. The published data were recorded
    in this way; in 38.4 % of their frame pairs 25 steps apart the cube is within 4 cm of the same place.

    One object records one episode: it keeps its plan. Otherwise an action depends on the state alone.

    Args:
        rng (np.random.Generator, optional): source of plans and their noise. NumPy's global generator, which the oracle
            draws from, is seeded from it and restored each time. Default: ``np.random.default_rng(0)``.
        env (CubeEnv, optional): the environment it acts in, whose simulator computes the gripper's pose at a state and
            is not changed. Default: ``None``, a simulator of its own.
        noise_std (float, optional): standard deviation of the noise of the plan, in units of the action. Default:
            ``0.1``.
        noise_smoothing (float, optional): standard deviation of the Gaussian that smooths the noise in time, in steps.
            Default: ``0.5``.

    Raises:
        ValueError: ``noise_std`` is negative or ``noise_smoothing`` not positive.
        TypeError: ``env`` is not a CubeEnv.
        ImportError: MuJoCo or ogbench is not installed.

    Examples:
        >>> from torchrl_ficreg.envs.cube.tasks import sample_goal, sample_start
        >>> arm, rng = CubeArm(), np.random.default_rng(0)
        >>> start = sample_start(rng, arm)
        >>> action = CubeExpert(rng=rng)(start, sample_goal(rng, start, arm))
        >>> action.shape, str(action.dtype)
        ((5,), 'float32')
    """

    def __init__(
        self,
        *,
        rng: np.random.Generator | None = None,
        env: Any = None,
        noise_std: float = 0.1,
        noise_smoothing: float = 0.5,
    ) -> None:
        if not 0 <= noise_std < np.inf:
            raise ValueError(f"noise_std must be finite and not negative, got {noise_std}.")
        if not 0 < noise_smoothing < np.inf:
            raise ValueError(f"noise_smoothing must be finite and positive, got {noise_smoothing}.")
        arm = CubeArm() if env is None else getattr(env.unwrapped, "arm", None)
        if not isinstance(arm, CubeArm):
            raise TypeError(f"env must be a CubeEnv, got {type(env.unwrapped).__name__}.")
        from ogbench.manipspace.oracles.plan.cube_plan import CubePlanOracle

        self._arm = arm
        self._rng = np.random.default_rng(0) if rng is None else rng
        self._oracle = CubePlanOracle(env=arm.ogbench, noise=noise_std, noise_smoothing=noise_smoothing)
        self._steps = 0

    def __call__(self, state: np.ndarray, goal_state: np.ndarray) -> np.ndarray:
        """Chooses the next action.

        Args:
            state (np.ndarray): [41] float64.
            goal_state (np.ndarray): [41] float64, of which the pose of the cube is used.

        Returns:
            [5] float32 in [-1, 1].
        """
        goal = self._arm.measure(goal_state)
        observation = {
            **self._arm.measure(state),
            "time": np.array([self._steps * TIME_STEP]),
            "privileged/target_block": 0,
            "privileged/target_block_pos": goal["privileged/block_0_pos"],
            "privileged/target_block_yaw": goal["privileged/block_0_yaw"],
        }
        if self._steps == 0:
            self._plan(observation)
        action = self._oracle.select_action(None, observation)
        if self._oracle.done:
            # As published: the new plan begins at the state of this action, so the next action takes its second point.
            self._plan(observation)
        self._steps += 1
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def _plan(self, observation: dict[str, Any]) -> None:
        with _seeded_global_generator(self._rng):
            self._oracle.reset(None, observation)


@contextmanager
def _seeded_global_generator(rng: np.random.Generator) -> Iterator[None]:
    """Seeds NumPy's global generator from ``rng`` within the context and restores its state afterwards."""
    before = np.random.get_state()
    np.random.seed(rng.integers(2**32, dtype=np.uint32))
    try:
        yield
    finally:
        np.random.set_state(before)
