"""Recording of expert episodes, in one process, in several, and on a Ray cluster.

All randomness of episode i comes from the pair (seed, i). Its bytes therefore do not depend on the process that records
it, on their number, or on interruptions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torchrl import torchrl_logger

from torchrl_ficreg._utils import ONE_THREAD, require
from torchrl_ficreg.data.frames import FrameFormat
from torchrl_ficreg.data.layout import META_FILE
from torchrl_ficreg.data.shards import NUM_SHARDS, SHARD, shard_meta, SHARD_NUMBER
from torchrl_ficreg.data.writer import EpisodeWriter
from torchrl_ficreg.envs._workers import ordered_map
from torchrl_ficreg.envs.base import PixelGoalEnv
from torchrl_ficreg.envs.registry import EnvEntry, Expert, find_entry
from torchrl_ficreg.keys import ACTION, GOAL_STATE, PIXELS, STATE, SUCCESS


def collect_episodes(
    name: str,
    num_episodes: int,
    *,
    seed: int = 0,
    start: int = 0,
    step: int = 1,
    num_workers: int = 2,
    image_size: int = 64,
    max_steps: int = 100,
    stop_at_success: bool = True,
    expert_kwargs: dict[str, Any] | None = None,
    env_kwargs: dict[str, Any] | None = None,
) -> Iterator[dict[str, np.ndarray]]:
    """Records the episodes ``range(start, num_episodes, step)`` of an environment's expert.

    An episode ends after ``max_steps`` actions, and at success if ``stop_at_success``. Row t holds frame t, the state
    of frame t and the action that leads to frame t + 1; the last row has no action and holds zeros::

        pixels   o_0  o_1  ...  o_n        n actions, n + 1 rows
        action   a_0  a_1  ...  0

    Args:
        name (str): an environment of :data:`~torchrl_ficreg.envs.registry.ENVIRONMENTS`, by short name or Gymnasium id.
        num_episodes (int): number of episodes of the whole dataset.
        seed (int, optional): seed of the whole dataset. Default: ``0``.
        start (int, optional): first episode, from 0; the number of episodes already recorded, to resume. Default:
            ``0``.
        step (int, optional): record every ``step``-th episode. Default: ``1``.
        num_workers (int, optional): worker processes, each with one torch thread; 0 records in this process. Workers are
            spawned, so a script needs ``if __name__ == "__main__":``. Default: ``2``.
        image_size (int, optional): height and width of the pictures, in pixels. Default: ``64``.
        max_steps (int, optional): largest number of actions of an episode. Default: ``100``.
        stop_at_success (bool, optional): end an episode when its goal is reached; otherwise all have ``max_steps``
            actions. Default: ``True``.
        expert_kwargs (dict, optional): passed to the expert, for instance ``{"noise_std": 1.0}``. Default: ``None``.
        env_kwargs (dict, optional): passed to the environment. Default: ``None``.

    Returns:
        an iterator over dictionaries of ``pixels`` [L, 3, H, W] uint8, ``action`` [L, A] float32 and ``state`` [L, S]
        float64. At most two episodes per worker are recorded ahead of the consumer. Closing it stops the workers.

    Raises:
        ValueError: an unknown name, or a number out of range. Exceptions of an environment or an expert are raised by
            the iterator.

    Examples:
        >>> episode = next(collect_episodes("two_room", 1, num_workers=0, max_steps=3))
        >>> {key: (value.shape, str(value.dtype)) for key, value in episode.items()}  # doctest: +NORMALIZE_WHITESPACE
        {'pixels': ((4, 3, 64, 64), 'uint8'),
         'action': ((4, 2), 'float32'),
         'state': ((4, 2), 'float64')}
    """
    if not 0 <= start <= num_episodes:
        raise ValueError(f"start must be between 0 and num_episodes ({num_episodes}), got {start}.")
    for word, value, least in (("step", step, 1), ("max_steps", max_steps, 1), ("num_workers", num_workers, 0)):
        if value < least:
            raise ValueError(f"{word} must be at least {least}, got {value}.")
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
    indices = range(start, num_episodes, step)
    if num_workers == 0:
        return (record(index) for index in indices)  # unlike map(), it has a close()
    return ordered_map(record, indices, num_workers=num_workers)


@dataclass
class EpisodeRecorder:
    """Records the i-th episode of a dataset; picklable, and builds its environment in the process that calls it.

    Attributes:
        entry: the environment and its expert.
        seed: seed of the whole dataset.
        max_steps: largest number of actions of an episode.
        stop_at_success: whether reaching the goal ends an episode.
        expert_kwargs: passed to the expert, beside ``rng`` and ``env``.
        env_kwargs: passed to the environment.
    """

    entry: EnvEntry
    seed: int
    max_steps: int
    stop_at_success: bool
    expert_kwargs: dict[str, Any]
    env_kwargs: dict[str, Any]
    _env: PixelGoalEnv | None = field(default=None, init=False, repr=False)

    @property
    def env(self) -> PixelGoalEnv:
        """The environment, built at the first access."""
        if self._env is None:
            self._env = self.entry.load_env()(**self.env_kwargs)
        return self._env

    def begin(self, index: int) -> tuple[PixelGoalEnv, Expert, dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode.

        Args:
            index (int): number of the episode, from 0.

        Returns:
            the environment, a new expert, and the observation and info of the reset.
        """
        task_seed, expert_seed = np.random.SeedSequence(self.seed, spawn_key=(index,)).spawn(2)
        expert = self.entry.load_expert()(rng=np.random.default_rng(expert_seed), env=self.env, **self.expert_kwargs)
        return self.env, expert, *self.env.reset(seed=int(task_seed.generate_state(1)[0]))

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Records one episode.

        Args:
            index (int): number of the episode, from 0.

        Returns:
            the arrays of :func:`collect_episodes`.
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


def collect_on_ray(
    folder: str | Path,
    name: str,
    num_episodes: int,
    *,
    num_tasks: int,
    meta: Mapping[str, Any] | None = None,
    frames: FrameFormat = "raw",
    **settings: Any,
) -> Path:
    """Records a dataset by Ray tasks, each of which writes one shard.

    Task n of W records the episodes n, n + W, ... by :func:`collect_episodes` into ``<folder>/shard-<n>``. Opened by
    :func:`~torchrl_ficreg.data.shards.open_store` or ``OfflineTrajectories``, the folder is the dataset that one process
    records, with the same episodes in the same order. The function can be called again after any interruption: complete
    shards are skipped and the others continued. All machines must see ``folder`` under the same path.

    It uses the Ray session of this process, or starts one by ``ray.init()``, which connects to the cluster that
    ``RAY_ADDRESS`` names.

    Args:
        folder (str or Path): folder of the dataset, created when missing.
        name (str): see :func:`collect_episodes`.
        num_episodes (int): number of episodes of the whole dataset.
        num_tasks (int): number of tasks and shards, at most ``num_episodes``; if shards exist already, their number is
            kept. Each task reserves one CPU.
        meta (Mapping, optional): what the dataset notes about itself, see
            :class:`~torchrl_ficreg.data.EpisodeWriter`. Default: ``None``, the name and the settings.
        frames (str, optional): ``"raw"``, ``"webp"`` or ``"png"``, see :class:`~torchrl_ficreg.data.EpisodeWriter`.
            Default: ``"raw"``.
        **settings: further arguments of :func:`collect_episodes`, such as ``seed``; not ``start``, ``step`` and
            ``num_workers``.

    Returns:
        the folder.

    Raises:
        ImportError: Ray is not installed.
        RuntimeError: a task failed; the episodes recorded before are kept.
        ValueError: an argument out of range, a dataset that is not made of shards, or shards recorded with other
            settings.
    """
    folder = Path(folder).expanduser().absolute()
    if num_tasks < 1 or num_episodes < 1:
        raise ValueError(f"num_tasks and num_episodes must be at least 1, got {num_tasks} and {num_episodes}.")
    collect_episodes(name, num_episodes, num_workers=0, **settings)  # checks the arguments
    if (folder / META_FILE).exists():
        raise ValueError(f"{folder} holds a dataset without shards: continue it without Ray, or give another folder.")
    begun = shard_meta(folder)
    count = min(num_tasks, num_episodes) if begun is None else begun[NUM_SHARDS]
    meta = {"env": name, **settings} if meta is None else meta
    shards = []
    for number in range(count):
        path, noted = folder / SHARD.format(number), {**meta, NUM_SHARDS: count}
        if path.is_symlink():
            raise ValueError(f"{path} is a link, and nothing is written through links: move the shard there.")
        if begun is None or SHARD_NUMBER in begun:  # the first shards ever recorded note no number
            noted[SHARD_NUMBER] = number
        shards.append((path, range(number, num_episodes, count), noted, frames))
    left = [shard for shard in shards if not _is_complete(*shard)]
    if not left:
        return folder
    ray = require("ray", "ray", purpose="recording on Ray", package="Ray")
    session = None if ray.is_initialized() else ray.init()
    record = ray.remote(num_cpus=1, runtime_env={"env_vars": ONE_THREAD})(_record_shard)
    tasks = {record.remote(*shard, name, settings): shard[0] for shard in left}
    waiting = list(tasks)
    try:
        while waiting:
            (task,), waiting = ray.wait(waiting)
            try:
                torchrl_logger.info(f"{tasks[task]} holds its {ray.get(task)} episodes, {len(waiting)} shards to go")
            except ray.exceptions.RayError as error:
                cause = getattr(error, "cause", None) or error
                reason = str(cause).strip().splitlines() or [""]
                raise RuntimeError(
                    f"recording {tasks[task]} failed ({type(cause).__name__}: {reason[0]}): the episodes before are kept, "
                    "call it again to continue."
                ) from error
    finally:
        for task in waiting:
            ray.cancel(task, force=True)
        if session is not None:
            ray.shutdown()
    return folder


def _is_complete(path: Path, episodes: range, meta: Mapping[str, Any], frames: FrameFormat) -> bool:
    if not (path / META_FILE).exists():
        return False
    with EpisodeWriter(path, target_episodes=len(episodes), meta=meta, frames=frames, wait=True) as writer:
        return writer.complete


def _record_shard(
    path: Path, episodes: range, meta: Mapping[str, Any], frames: FrameFormat, name: str, settings: dict[str, Any]
) -> int:
    """Records what a shard lacks, and returns how many episodes it holds."""
    with EpisodeWriter(path, target_episodes=len(episodes), meta=meta, frames=frames, wait=True) as writer:
        rest = episodes[writer.num_episodes :]
        if rest:
            slots = {"start": rest.start, "step": rest.step, "num_workers": 0}
            for episode in collect_episodes(name, rest.stop, **slots, **settings):
                writer.append(episode)
        return writer.num_episodes
