"""Start-goal pairs, drawn once from held-out episodes and frozen in a file."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ficreg._utils import read_json, write_atomic
from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.keys import STATE


@dataclass(frozen=True)
class StartGoalPairs:
    """N start states and, from the same episode some steps later, N goal states.

    Attributes:
        env (str): name of the environment.
        goal_offset (int): environment steps from start to goal.
        seed (int): seed of the draw.
        fingerprint (str): fingerprint of the dataset they were drawn from.
        episode (np.ndarray): episode of each start, int64 [N].
        step (np.ndarray): step of each start in its episode, int64 [N].
        start_state (np.ndarray): full simulator states, float64 [N, S].
        goal_state (np.ndarray): full simulator states, float64 [N, S].

    Raises:
        TypeError: a field of another type.
        ValueError: no pairs, arrays of wrong shapes, negative numbers, or states that are not finite.
    """

    env: str
    goal_offset: int
    seed: int
    fingerprint: str
    episode: np.ndarray
    step: np.ndarray
    start_state: np.ndarray
    goal_state: np.ndarray

    def __post_init__(self) -> None:
        kinds = {"env": str, "fingerprint": str, "goal_offset": int, "seed": int}
        for name, kind in kinds.items():
            value = getattr(self, name)
            if not isinstance(value, kind) or isinstance(value, bool):
                raise TypeError(f"{name} of start-goal pairs must be of type {kind.__name__}, got {str(value)[:40]!r}.")
        if self.goal_offset < 1 or self.seed < 0:
            raise ValueError(
                f"goal_offset must be positive and seed not negative, got {self.goal_offset} and {self.seed}."
            )
        arrays = {"episode": "iu", "step": "iu", "start_state": "iuf", "goal_state": "iuf"}
        for name, dtypes in arrays.items():
            value = getattr(self, name)
            if not isinstance(value, np.ndarray) or value.dtype.kind not in dtypes:
                raise TypeError(f"{name} of start-goal pairs must be an array of numbers, got {str(value)[:40]!r}.")
        shapes = {name: getattr(self, name).shape for name in arrays}
        count, states = shapes["episode"], shapes["start_state"]
        if len(count) != 1 or not count[0] or shapes["step"] != count or len(states) != 2 or states[:1] != count or (
            not states[1] or shapes["goal_state"] != states
        ):
            raise ValueError(
                "start-goal pairs must be episode and step [N], N >= 1, and start_state and goal_state [N, S], got "
                f"{', '.join(f'{name} {list(shape)}' for name, shape in shapes.items())}."
            )
        if min(self.episode.min(), self.step.min()) < 0:
            raise ValueError("episode and step of start-goal pairs must not be negative.")
        if not (np.isfinite(self.start_state).all() and np.isfinite(self.goal_state).all()):
            raise ValueError("start_state and goal_state of start-goal pairs must be finite.")

    def __len__(self) -> int:
        return len(self.episode)

    @property
    def hash(self) -> str:
        """sha256 of all attributes: results with the same hash were measured on the same pairs."""
        return hashlib.sha256(json.dumps(self._content(), sort_keys=True).encode()).hexdigest()

    @classmethod
    def draw(cls, dataset: OfflineTrajectories, env: str, num_pairs: int, goal_offset: int, seed: int) -> StartGoalPairs:
        """Draws pairs uniformly, without replacement, from all starts with a goal in the same episode.

        Args:
            dataset (OfflineTrajectories): held-out episodes with states.
            env (str): name of their environment.
            num_pairs (int): number N of pairs.
            goal_offset (int): environment steps from start to goal.
            seed (int): seed of the draw.

        Raises:
            ValueError: fewer than N legal starts.
        """
        dataset.store.require_state()
        table = dataset.episodes
        starts = (table["length"] - goal_offset).clamp_min(0).numpy()  # legal starts of each episode
        total = int(starts.sum())
        if num_pairs < 1 or goal_offset < 1 or num_pairs > total:
            raise ValueError(
                f"cannot draw {num_pairs} pairs {goal_offset} steps apart: the {dataset.split} episodes have {total} "
                "such starts. Collect more episodes, or ask for fewer pairs."
            )
        picks = np.sort(np.random.default_rng(seed).choice(total, num_pairs, replace=False))
        ends = np.cumsum(starts)
        row = np.searchsorted(ends, picks, side="right")  # [N], row of the episode table
        step = picks - (ends - starts)[row]
        episode = table["episode"].numpy()[row]
        state = {int(e): dataset.episode_data(int(e), keys=(STATE,))[STATE].numpy() for e in episode}
        states = [state[int(e)][[s, s + goal_offset]] for e, s in zip(episode, step)]
        start_state, goal_state = np.stack(states, axis=1)  # each [N, S]
        return cls(env, goal_offset, seed, dataset.fingerprint, episode, step, start_state, goal_state)

    @classmethod
    def frozen(
        cls, path: Path, dataset: OfflineTrajectories, env: str, num_pairs: int, goal_offset: int, seed: int
    ) -> StartGoalPairs:
        """Reads pairs from a file; if it does not exist, draws them and writes it.

        Args:
            path (Path): JSON file, see :meth:`save`.
            dataset (OfflineTrajectories): as for :meth:`draw`.
            env (str): as for :meth:`draw`.
            num_pairs (int): as for :meth:`draw`.
            goal_offset (int): as for :meth:`draw`.
            seed (int): as for :meth:`draw`.

        Raises:
            ValueError: the file belongs to another dataset or another draw, or was changed by hand.
        """
        if not path.exists():
            pairs = cls.draw(dataset, env, num_pairs, goal_offset, seed)
            pairs.save(path)
            return pairs
        pairs = cls.load(path)
        wanted = (env, num_pairs, goal_offset, seed, dataset.fingerprint)
        found = (pairs.env, len(pairs), pairs.goal_offset, pairs.seed, pairs.fingerprint)
        if found != wanted:
            raise ValueError(
                f"{path} holds pairs of another draw or dataset (env, pairs, goal_offset, seed, fingerprint: {found}, "
                f"expected {wanted}): move it away to draw new ones."
            )
        return pairs

    def save(self, path: Path) -> None:
        """Writes the pairs to a JSON file, atomically: several runs may write the same file at once.

        A link in its place is replaced, not followed.
        """
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, json.dumps({**self._content(), "hash": self.hash}, indent=1))

    @classmethod
    def load(cls, path: Path) -> StartGoalPairs:
        """Reads pairs from a file.

        Raises:
            ValueError: it holds no pairs, or its hash does not fit its content.
        """
        try:
            content: dict[str, Any] = read_json(path, "manifest")
            stored = content.pop("hash")
            arrays = {name: np.array(content.pop(name)) for name in ("episode", "step", "start_state", "goal_state")}
            pairs = cls(**content, **arrays)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise ValueError(f"{path} is not a manifest of start-goal pairs ({error!r:.200}): move it away to draw new ones.") from error
        if pairs.hash != stored:
            raise ValueError(f"{path} was changed after it was drawn: its hash does not fit. Move it away to draw again.")
        return pairs

    def _content(self) -> dict[str, Any]:
        # JSON keeps floats exactly: it writes the shortest text that is read back as the same double.
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}
