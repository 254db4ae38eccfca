"""Z-scoring of actions, per raw action dimension."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_SMALLEST_STD = 1e-8  # the lower bound of the LeWM recipe; below it a dimension counts as constant


@dataclass(frozen=True, eq=False)
class ActionStatistics:
    """Mean and population standard deviation of each raw action dimension.

    Models take z-scored actions, environments take their own units. The statistics come from training episodes only
    and are stored in a model's checkpoint, so that a model can be used without its dataset.

    Both directions accept single actions and action blocks alike: a last axis of size F * A holds F raw
    actions one after another (time-major), each z-scored with the same A numbers.

    Args:
        mean (Tensor): float32 [A], environment units.
        std (Tensor): float32 [A], environment units, positive. Exactly 1 where the action never changes: that dimension
            is 0 once normalized, and denormalized to its constant value.

    Raises:
        ValueError: ``mean`` and ``std`` are not two equal [A] vectors, finite, with positive ``std``.

    Examples:
        >>> action = torch.tensor([[1.0, 7.0], [5.0, 7.0]])
        >>> statistics = ActionStatistics.from_actions(action)
        >>> statistics.mean, statistics.std, statistics.constant
        (tensor([3., 7.]), tensor([2., 1.]), tensor([False,  True]))
        >>> statistics.normalize(action)
        tensor([[-1.,  0.],
                [ 1.,  0.]])
        >>> statistics.normalize(action.flatten())  # one block of two actions
        tensor([-1.,  0.,  1.,  0.])
    """

    mean: Tensor
    std: Tensor

    def __post_init__(self) -> None:
        if self.mean.ndim != 1 or self.mean.shape != self.std.shape or not self.mean.numel():
            got = f"{tuple(self.mean.shape)} and {tuple(self.std.shape)}"
            raise ValueError(f"mean and std must be two vectors [A] of one size, got {got}.")
        if not (self.mean.isfinite().all() and self.std.isfinite().all() and (self.std > 0).all()):
            raise ValueError(f"mean must be finite and std positive, got {self.mean.tolist()}, {self.std.tolist()}.")

    @classmethod
    def from_actions(cls, action: Tensor) -> ActionStatistics:
        """Measures the statistics, accumulating in float64.

        Args:
            action (Tensor): [N, A] raw actions, without the rows at which no action was taken.

        Raises:
            ValueError: not [N, A] with N >= 1, or not finite.
        """
        if action.ndim != 2 or not len(action):
            raise ValueError(f"action must be [N, A] with at least one row, got {tuple(action.shape)}.")
        action = action.double()  # [N, A]
        if not action.isfinite().all():
            raise ValueError("action holds a NaN or an infinity: leave out the rows at which no action was taken.")
        std, mean = torch.std_mean(action, dim=0, correction=0)  # [A], [A]
        constant, std = std < _SMALLEST_STD, std.float()
        # Exactly 1 is kept for constant dimensions: a measured 1 becomes the next float above it.
        std = torch.where(std == 1, torch.nextafter(std, std + 1), std)
        return cls(mean.float(), torch.where(constant, torch.ones_like(std), std))

    @property
    def action_dim(self) -> int:
        """A."""
        return len(self.mean)

    @property
    def constant(self) -> Tensor:
        """Dimensions that never change in the data, bool [A]: a plan keeps them at their mean.

        These are the dimensions with a std of exactly 1. Where every std is 1, the statistics were not measured but
        leave the units as they are: then no dimension counts as constant.
        """
        ones = self.std == 1  # [A]
        return ones & ~ones.all()

    def normalize(self, action: Tensor) -> Tensor:
        """Environment units to z-scores, ``(action - mean) / std``.

        Args:
            action (Tensor): [..., A], or action blocks [..., F * A].

        Returns:
            as ``action``.
        """
        raw = self._split(action)  # [..., F, A]
        return ((raw - self.mean.to(raw)) / self.std.to(raw)).reshape(action.shape)

    def denormalize(self, action: Tensor) -> Tensor:
        """Z-scores to environment units, ``action * std + mean``.

        Args:
            action (Tensor): [..., A], or action blocks [..., F * A].

        Returns:
            as ``action``.
        """
        raw = self._split(action)  # [..., F, A]
        return (raw * self.std.to(raw) + self.mean.to(raw)).reshape(action.shape)

    def _split(self, action: Tensor) -> Tensor:
        if not action.ndim or action.shape[-1] % self.action_dim:
            want = f"a multiple of {self.action_dim} (the action dimension)"
            raise ValueError(f"the last axis must be {want}, got shape {tuple(action.shape)}.")
        return action.unflatten(-1, (-1, self.action_dim))
