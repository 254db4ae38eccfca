"""The key contract: the only names that travel between collection, training and planning.

A *stored step* is one row of an episode on disk; a *clip* is a strided sub-trajectory cut out of it.
Every module of the package takes these names as defaults and none of them invents another.
"""

from __future__ import annotations

import numpy as np

PIXELS = "pixels"  # [3, H, W] uint8, the frame before the action
ACTION = "action"  # [A] float32, environment units; zero at the last step, where no action was taken
STATE = "state"  # [S] float64, enough to restore the simulator exactly
EPISODE = "episode"  # [] int64, from 1, so that an unwritten row (0) is recognisable
STEP = "step"  # [] int64, from 0
DONE = ("next", "done")  # [1] bool, last step of its episode
MASK = "mask"  # clip only: [B, T] bool, false where an action block leaves its episode

LATENT = "latent"
PREDICTED_LATENT = "predicted_latent"
RECOVERED_ACTION = "recovered_action"
GOAL_LATENT = "goal_latent"
GOAL_PIXELS = "goal_pixels"
SUCCESS = "success"


def check_episode(episode: dict[str, np.ndarray]) -> int:
    """Checks one recorded episode against the key contract.

    Args:
        episode: arrays ``pixels`` [L, 3, H, W] uint8, ``action`` [L, A] float32 and ``state`` [L, S] float64
            (S = 0 where there is none), where row t holds the frame, the action that leads from it, and the state it was drawn from.

    Returns:
        L, the number of steps.

    Raises:
        KeyError: a key is missing or unknown.
        TypeError: a value is not a numpy array.
        ValueError: a shape (an empty one too), a dtype, a non-finite value, or an action at the last step.
    """
    expected = {PIXELS: (4, np.uint8), ACTION: (2, np.float32), STATE: (2, np.float64)}
    if set(episode) != set(expected):
        missing, surplus = sorted(set(expected) - set(episode)), sorted(set(episode) - set(expected))
        raise KeyError(f"an episode holds exactly {sorted(expected)}: missing {missing}, not wanted {surplus}.")
    for key, value in episode.items():
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{key!r} must be a numpy array, got a {type(value).__name__}: convert it before writing.")
    lengths = {key: len(value) for key, value in episode.items()}
    if len(set(lengths.values())) != 1 or min(lengths.values()) < 2:
        raise ValueError(f"an episode needs at least 2 steps, equally many of each key, got {lengths}.")
    for key, (ndim, dtype) in expected.items():
        value = episode[key]
        if value.ndim != ndim or value.dtype != dtype:
            want = f"{ndim}-d {np.dtype(dtype).name}"
            raise ValueError(f"{key!r} must be {want}, got {value.ndim}-d {value.dtype}: convert it before writing.")
        if not value.size and (key != STATE or value.shape[1:] != (0,)):  # data without a simulator have no state
            raise ValueError(f"{key!r} must hold at least one number per step, got shape {value.shape}.")
        if key != PIXELS and not np.isfinite(value).all():
            raise ValueError(f"{key!r} holds a NaN or an infinity: drop those steps before writing.")
    if episode[PIXELS].shape[1] != 3:
        raise ValueError(f"'pixels' must be [L, 3, H, W], got {episode[PIXELS].shape}: move the channel axis first.")
    if np.any(episode[ACTION][-1]):
        raise ValueError("the last step leads nowhere: its action must be zero, or the actions are shifted by one.")
    return len(episode[PIXELS])
