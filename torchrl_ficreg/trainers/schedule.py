"""How the learning rate goes."""

from __future__ import annotations

import math


class WarmupCosine:
    """Factor of the learning rate: linear from 0 over the warm-up, then a cosine to 0 at the last step.

    Args:
        steps: of the whole schedule, which a run may leave before its end.
        warmup: share of them in which the factor rises.

    Examples:
        >>> factor = WarmupCosine(steps=100, warmup=0.1)
        >>> factor(0), factor(9), round(factor(100), 6)
        (0.1, 1.0, 0.0)
    """

    def __init__(self, steps: int, warmup: float) -> None:
        self.steps, self.rise = steps, max(1, round(warmup * steps))

    def __call__(self, step: int) -> float:
        """Factor of the update after ``step`` updates."""
        if step < self.rise:
            return (step + 1) / self.rise
        return 0.5 * (1 + math.cos(math.pi * (step - self.rise) / max(1, self.steps - self.rise)))
