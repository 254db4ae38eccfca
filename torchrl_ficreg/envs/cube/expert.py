"""An expert that picks the cube up, puts it down at the goal, and does so again until the episode ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from torchrl_ficreg.envs.cube.physics import CubeArm, TIME_STEP


class CubeExpert:
    """OGBench's plan oracle, seeded, with one goal per episode.

    A plan leads the gripper over the cube, down, up, over the goal, down, up and to a random end, with random heights
    and times, and correlated noise on top. Actions track it from the measured pose. When a plan ends, the next begins
    with the same goal: from then on the cube is lifted and put back where it already is. This is how the published
    data were recorded, where 38.4 % of the frames 25 steps apart show the cube within 4 cm of the same place.

    It remembers its plan: one expert records one episode. Apart from that, an action depends on the state alone.

    Args:
        rng: the source of plans and their noise; a fixed one by default, so that equal calls give equal episodes.
            NumPy's global generator, which the oracle draws from, is seeded from it and put back each time.
        env: the :class:`~torchrl_ficreg.envs.cube.env.CubeEnv` it acts in; its simulator answers where the gripper is
            in a state and is left alone otherwise. By default the expert has a simulator of its own.
        noise_std: standard deviation of the noise of the plan, in units of the action.
        noise_smoothing: standard deviation of the Gaussian that smooths the noise in time, in steps.

    Raises:
        ValueError: ``noise_std`` is negative or ``noise_smoothing`` not positive.
        TypeError: ``env`` is no CubeEnv.
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
            state: [41] float64.
            goal_state: [41] float64, of which only the pose of the cube matters.

        Returns:
            [5] float32 in [-1, 1].
        """
        goal = self._arm.measure(goal_state)
        seen = {
            **self._arm.measure(state),
            "time": np.array([self._steps * TIME_STEP]),
            "privileged/target_block": 0,
            "privileged/target_block_pos": goal["privileged/block_0_pos"],
            "privileged/target_block_yaw": goal["privileged/block_0_yaw"],
        }
        if self._steps == 0:
            self._plan(seen)
        action = self._oracle.select_action(None, seen)
        if self._oracle.done:
            # As published: the new plan begins where this action does, so the next one takes its second point.
            self._plan(seen)
        self._steps += 1
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def _plan(self, seen: dict[str, Any]) -> None:
        with _seeded_global_generator(self._rng):
            self._oracle.reset(None, seen)


@contextmanager
def _seeded_global_generator(rng: np.random.Generator) -> Iterator[None]:
    """Lets code that draws from NumPy's global generator draw from a seed of ``rng``, and hides that it did."""
    before = np.random.get_state()
    np.random.seed(rng.integers(2**32, dtype=np.uint32))
    try:
        yield
    finally:
        np.random.set_state(before)
