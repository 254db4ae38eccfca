"""Time spent in training."""

from __future__ import annotations

import time


class Clock:
    """Wall time spent in training, over all lives of a run."""

    def __init__(self) -> None:
        self._before, self._began = 0.0, None

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return self._before + (time.perf_counter() - self._began if self._began is not None else 0.0)

    def start(self) -> None:
        """Begins to count."""
        self._began = time.perf_counter()

    def stop(self) -> None:
        """Ceases to count."""
        self._before, self._began = self.seconds, None

    def state_dict(self) -> dict[str, float]:
        """The seconds so far."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Continues from there."""
        self._before = float(state_dict["seconds"])
