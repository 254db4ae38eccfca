"""Recording expert episodes, reproducibly and on as many processes as there are.

Everything random about episode i comes from the pair (seed, i). Episodes may therefore be recorded by any process, in
any order and in several sittings: their bytes are the same, and the generator yields them in order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchrl_ficreg.data.schema import ACTION, PIXELS, STATE, SUCCESS
from torchrl_ficreg.envs.base import GOAL_STATE, GoalEnv
from torchrl_ficreg.envs.registry import EnvEntry, Expert, find_entry
from torchrl_ficreg.envs.workers import ordered_map


def collect_episodes(
    name: str,
    num_episodes: int,
    *,
    seed: int = 0,
    start: int = 0,
    num_workers: int = 2,
    image_size: int = 64,
    max_steps: int = 100,
    stop_at_success: bool = True,
    expert_kwargs: dict[str, Any] | None = None,
    env_kwargs: dict[str, Any] | None = None,
) -> Iterator[dict[str, np.ndarray]]:
    """Records the episodes ``start`` to ``num_episodes - 1`` of an environment's expert.

    An episode ends after ``max_steps`` actions, and at success where that is asked for. Row t holds frame t, the state
    it was drawn from and the action that leads to frame t + 1; the last row has no action and holds zeros::

        pixels   o_0  o_1  ...  o_n        n actions, n + 1 rows
        action   a_0  a_1  ...  0

    Args:
        name: an environment of :data:`~torchrl_ficreg.envs.registry.ENVIRONMENTS`, by short name or Gymnasium id.
        num_episodes: size of the whole data set.
        seed: of the whole data set.
        start: number of episodes already there, to resume a recording.
        num_workers: worker processes, each with one torch thread; 0 records in this process. Workers are spawned, so
            a script needs the usual ``if __name__ == "__main__":``.
        image_size: height and width of the pictures, in pixels.
        max_steps: most actions of an episode.
        stop_at_success: end an episode when its goal is reached; else all have ``max_steps`` actions.
        expert_kwargs: passed to the expert, for instance ``{"noise_std": 1.0}``.
        env_kwargs: passed to the environment.

    Returns:
        an iterator over dictionaries of ``pixels`` [L, 3, H, W] uint8, ``action`` [L, A] float32 and ``state`` [L, S]
        float64. At most two episodes per worker are recorded ahead of the consumer. Closing it stops the workers.

    Raises:
        ValueError: an unknown name, or a number out of range. What an environment or an expert raises while
            recording is raised by the iterator.

    Examples:
        >>> episode = next(collect_episodes("two_room", 1, num_workers=0, max_steps=3))
        >>> {key: (value.shape, str(value.dtype)) for key, value in episode.items()}  # doctest: +NORMALIZE_WHITESPACE
        {'pixels': ((4, 3, 64, 64), 'uint8'),
         'action': ((4, 2), 'float32'),
         'state': ((4, 2), 'float64')}
    """
    if not 0 <= start <= num_episodes:
        raise ValueError(f"start must be between 0 and num_episodes ({num_episodes}), got {start}.")
    if max_steps < 1:
        raise ValueError(f"max_steps must be at least 1, got {max_steps}.")
    if num_workers < 0:
        raise ValueError(f"num_workers must be at least 0, got {num_workers}.")
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}.")
    record = EpisodeRecorder(
        entry=find_entry(name),
        seed=seed,
        max_steps=max_steps,
        stop_at_success=stop_at_success,
        expert_kwargs=dict(expert_kwargs or {}),
        env_kwargs={"image_size": image_size, **(env_kwargs or {})},
    )
    indices = range(start, num_episodes)
    if num_workers == 0:
        return (record(index) for index in indices)  # unlike map(), it can be closed like the other
    return ordered_map(record, indices, num_workers=num_workers)


@dataclass
class EpisodeRecorder:
    """Records the i-th episode of a data set; picklable, and builds its environment where it is first called.

    Attributes:
        entry: where the environment and its expert are found.
        seed: of the whole data set.
        max_steps: most actions of an episode.
        stop_at_success: whether a reached goal ends an episode.
        expert_kwargs: passed to the expert, beside ``rng`` and ``env``.
        env_kwargs: passed to the environment.
    """

    entry: EnvEntry
    seed: int
    max_steps: int
    stop_at_success: bool
    expert_kwargs: dict[str, Any]
    env_kwargs: dict[str, Any]
    _env: GoalEnv | None = field(default=None, init=False, repr=False)

    @property
    def env(self) -> GoalEnv:
        """The environment, built when it is first asked for."""
        if self._env is None:
            self._env = self.entry.load_env()(**self.env_kwargs)
        return self._env

    def begin(self, index: int) -> tuple[GoalEnv, Expert, dict[str, np.ndarray], dict[str, Any]]:
        """Sets an episode up: the environment, a new expert, and the observation and info of the start."""
        task_seed, expert_seed = np.random.SeedSequence(self.seed, spawn_key=(index,)).spawn(2)
        expert = self.entry.load_expert()(rng=np.random.default_rng(expert_seed), env=self.env, **self.expert_kwargs)
        return self.env, expert, *self.env.reset(seed=int(task_seed.generate_state(1)[0]))

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Records one episode.

        Args:
            index: of the episode, from 0.

        Returns:
            the arrays described at :func:`collect_episodes`.
        """
        env, expert, observation, info = self.begin(index)
        pixels, states, actions = [observation[PIXELS]], [observation[STATE]], []
        while len(actions) < self.max_steps and not (self.stop_at_success and info[SUCCESS].item()):
            action = expert(observation[STATE], observation[GOAL_STATE])
            observation, _, _, _, info = env.step(action)
            actions.append(action)
            pixels.append(observation[PIXELS])
            states.append(observation[STATE])
        actions.append(np.zeros(env.action_space.shape))
        return {
            PIXELS: np.stack(pixels),
            ACTION: np.stack(actions).astype(np.float32),
            STATE: np.stack(states),
        }
