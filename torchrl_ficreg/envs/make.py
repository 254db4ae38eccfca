"""TorchRL environments by name, with the keys of the package."""

from __future__ import annotations

import functools
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from torchrl.data import Binary, Composite
from torchrl.envs import EnvBase, GymWrapper, SerialEnv
from torchrl.envs.gym_like import default_info_dict_reader

from torchrl_ficreg.envs.base import PixelGoalEnv
from torchrl_ficreg.envs.batched import WorkerGroupsEnv
from torchrl_ficreg.envs.registry import find_entry
from torchrl_ficreg.keys import STATE, SUCCESS

_TORCHRL_STATE = "observation"  # what GymWrapper calls an observation named "state"


class GoalGymWrapper(GymWrapper):
    """A :class:`~torchrl_ficreg.envs.base.PixelGoalEnv` as a TorchRL environment, with the keys of the package.

    Root keys: ``pixels`` and ``goal_pixels`` [3, H, W] uint8, ``state`` and ``goal_state`` [S] float64, ``success``
    [1] bool, at resets too. ``GymWrapper`` renames an observation called ``state``; this class keeps its name.

    Args:
        env (gymnasium.Env): a :class:`~torchrl_ficreg.envs.base.PixelGoalEnv`, wrapped or not.
        **kwargs: of ``GymWrapper``.

    Raises:
        TypeError: another kind of environment.
    """

    def __init__(self, env: gymnasium.Env, **kwargs: Any) -> None:
        if not isinstance(env.unwrapped, PixelGoalEnv):
            raise TypeError(f"expected a PixelGoalEnv, got {type(env.unwrapped).__name__}: subclass PixelGoalEnv.")
        super().__init__(env=env, **kwargs)
        spec = Composite({SUCCESS: Binary(n=1, shape=(1,), dtype=torch.bool)})
        self.set_info_dict_reader(default_info_dict_reader([SUCCESS], spec=spec))

    def _make_specs(self, env: gymnasium.Env, batch_size: torch.Size | None = None) -> None:
        super()._make_specs(env, batch_size)
        specs = dict(self.observation_spec.items())
        specs[STATE] = specs.pop(_TORCHRL_STATE)
        self.observation_spec = Composite(specs, shape=self.observation_spec.shape)

    def read_obs(self, observations: dict[str, Any]) -> dict[str, torch.Tensor]:
        """Converts the arrays of an observation to tensors under the same names; contiguous ones are not copied."""
        return {key: torch.from_numpy(np.ascontiguousarray(value)) for key, value in observations.items()}


def make_env(
    name: str = "two_room",
    num_envs: int = 1,
    *,
    image_size: int = 64,
    terminate_on_success: bool = True,
    max_episode_steps: int | None = None,
    num_workers: int | None = None,
    seed: int | None = None,
    **env_kwargs: Any,
) -> EnvBase:
    """Builds one environment or a batch of environments.

    A batch is reset to given states by one dictionary per environment::

        env.reset(list_of_kwargs=[{"options": {"state": s, "goal_state": g}} for s, g in pairs])

    Args:
        name (str, optional): a short name of :data:`~torchrl_ficreg.envs.registry.ENVIRONMENTS` (``"two_room"``,
            ``"push_t"``, ``"reacher"``, ``"cube"``), or any Gymnasium id of a
            :class:`~torchrl_ficreg.envs.base.PixelGoalEnv`. Default: ``"two_room"``.
        num_envs (int, optional): 1 for an environment without batch dimension, more for one of batch size [num_envs].
            Default: ``1``.
        image_size (int, optional): height and width of the pictures, in pixels. Default: ``64``.
        terminate_on_success (bool, optional): end an episode once its goal is reached. Default: ``True``.
        max_episode_steps (int, optional): number of steps after which an episode is truncated. Default: ``None``, no
            limit.
        num_workers (int, optional): W processes with one thread each, among which the environments of a batch are
            divided evenly; the results are the same bit for bit. Use one process per core when drawing is slow. A
            script then needs ``if __name__ == "__main__":``. A single environment is always in this process. Default:
            ``None``, the batch is stepped in this process.
        seed (int, optional): seeds the environments' draws; each environment of a batch has a seed of its own derived
            from it. Default: ``None``.
        **env_kwargs: of the environment's constructor.

    Returns:
        the environment; root keys as in :class:`GoalGymWrapper`.

    Raises:
        ValueError: an unknown name, or a number out of range.
        TypeError: the environment is not a :class:`~torchrl_ficreg.envs.base.PixelGoalEnv`.

    Examples:
        >>> env = make_env("two_room", num_envs=2, seed=0)
        >>> env.rollout(3, break_when_any_done=False)["pixels"].shape
        torch.Size([2, 3, 3, 64, 64])
    """
    counts = {"num_envs": num_envs, "num_workers": num_workers, "seed": seed, "max_episode_steps": max_episode_steps}
    for word, value in counts.items():
        if (value is not None or word == "num_envs") and (not isinstance(value, int) or isinstance(value, bool)):
            raise ValueError(f"{word} must be an integer, got {value!r}.")
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}.")
    if num_workers is not None and not 1 <= num_workers <= num_envs:
        raise ValueError(f"num_workers must be None or in 1..num_envs ({num_envs}), got {num_workers}.")
    if seed is not None and seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}.")
    if max_episode_steps is not None and max_episode_steps < 1:
        raise ValueError(f"max_episode_steps must be at least 1, or None for no limit, got {max_episode_steps}.")
    create = functools.partial(
        _make_single,
        _gym_spec(name),
        max_episode_steps,
        image_size=image_size,
        terminate_on_success=terminate_on_success,
        **env_kwargs,
    )
    if num_envs == 1:
        env = create()
    elif num_workers is None:
        env = SerialEnv(num_envs, create)
    else:
        env = WorkerGroupsEnv(num_envs, create, num_workers)
    if seed is not None:
        env.set_seed(seed)
    return env


def _make_single(gym_spec: EnvSpec, max_episode_steps: int | None, **kwargs: Any) -> GoalGymWrapper:
    limit = -1 if max_episode_steps is None else max_episode_steps  # Gymnasium's None means the id's own limit
    return GoalGymWrapper(gymnasium.make(gym_spec, max_episode_steps=limit, disable_env_checker=True, **kwargs))


def _gym_spec(name: str) -> EnvSpec:
    """The whole spec, not the id: a worker process does not have the ids that the caller registered."""
    return gymnasium.spec(name if name in gymnasium.registry else find_entry(name).gym_id)
