"""What networks, costs, planners and environments of your own must offer. Nothing has to inherit from these classes.

T frames, latents of width D, z-scored blocks of F environment actions [A], E environments, K candidates, N imagined blocks.
"""

from __future__ import annotations

from typing import Any, Protocol

from tensordict import TensorDict, TensorDictBase
from torch import Tensor


class Network(Protocol):
    """A TensorDictModule; ``in_keys`` and ``out_keys`` of any name, see :func:`~torchrl_ficreg.modules.feed.arrange`."""

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Reads ``in_keys`` and writes ``out_keys``, both lists of NestedKey."""


class Encoder(Network, Protocol):
    """``pixels`` [..., 3, H, W], uint8 or floating in 0..1 -> ``latent`` [..., D]; every frame by itself."""


class Predictor(Network, Protocol):
    """``latent`` [..., T, D] and ``action`` [..., T, F * A] -> ``predicted_latent`` [..., T, D], row t from rows up to t.

    D, F * A and the largest T are attributes ``latent_dim``, ``action_dim`` and ``history``, or arguments of LatentWorldModel.
    """


class InverseModel(Network, Protocol):
    """``latent`` and ``("next", "latent")`` [..., T, D] -> ``recovered_action`` [..., T, F * A]."""


class WorldModel(Protocol):
    """What planners and MPCPolicy ask of a ``nn.Module``; ``LatentWorldModel`` offers it for any encoder and predictor."""

    latent_dim: int  # D
    block_dim: int  # F * A
    history: int  # H, most latents that are taken into account
    frame_skip: int  # F
    statistics: Any  # ActionStatistics, mean and std [A] of environment actions

    def encode(self, pixels: Tensor) -> Tensor:
        """Frames [..., 3, H, W] -> latents [..., D]."""

    def rollout(self, latent: Tensor, action: Tensor) -> Tensor:  # optional method of a Predictor too
        """Context [..., C, D] and blocks [..., C - 1 + N, F * A] -> predictions [..., N, D]."""


class Cost(Protocol):
    """Costs of candidates, lower is better; ``action``, ``start`` and ``time_to_go`` may be left out of the signature."""

    def __call__(self, predicted: Tensor, goal: Tensor, *, action: Tensor, start: Tensor, time_to_go: Tensor) -> Tensor:
        """Predicted [E, K, T, D], goal [E, D], action [E, K, T, F * A], start [E, D], time_to_go [E] -> [E, K]."""


class Planner(Protocol):
    """What MPCPolicy asks. Keywords: ``past_action`` [E, C - 1, F * A], ``initial`` [E, horizon, F * A], ``time_to_go`` [E]."""

    world_model: WorldModel
    config: Any  # with ``horizon``, ``receding_horizon``, ``warm_start`` as a PlanConfig; ``time_to_go`` is given if it has one
    context: int  # most frames C of a context
    action_bounds: tuple[Tensor, Tensor] | None  # (low [A], high [A]) in environment units

    def plan(self, latent: Tensor, goal: Tensor, seeds: Tensor | None = None, **context: Tensor | None) -> TensorDict:
        """Latents [E, D] or [E, C, D], goals [E, D], seeds [E] -> ``plan`` [E, horizon, F * A], ``plan_cost`` [E]."""


class Environment(Protocol):
    """A Gymnasium environment with actions [A], as subclasses of PixelGoalEnv are."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """``pixels``, ``goal_pixels`` [3, size, size] uint8 and ``state``, ``goal_state`` [S], which options may set."""

    def step(self, action: Any) -> tuple[dict, float, bool, bool, dict]:
        """Action in environment units -> observation, reward, terminated, truncated, info with ``success`` [1] bool."""
