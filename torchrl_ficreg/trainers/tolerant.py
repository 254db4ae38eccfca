"""A logger whose loss a run survives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torchrl import torchrl_logger
from torchrl.record.loggers import Logger


class TolerantLogger:
    """Passes every call on to a TorchRL logger until one fails, then warns once and passes on no more.

    A server that cannot be reached, or a full disk below its files, must not end a training of days: ``metrics.csv``
    has the same numbers. Nor does a checkpoint depend on a logger: this one has no state, so that a run may continue
    with another logger or none.

    Args:
        logger: any; what is not a method is read from it as before.

    Attributes:
        lost: whether it has failed.

    Examples:
        >>> class Server:
        ...     def log_scalar(self, name, value, step=None):
        ...         raise ConnectionError("no route to host")
        >>> logger = TolerantLogger(Server())
        >>> logger.log_scalar("loss", 0.5)
        >>> logger.lost
        True
    """

    state_dict = load_state_dict = None

    def __init__(self, logger: Logger) -> None:
        self._logger, self.lost = logger, False

    @classmethod
    def around(cls, logger: Logger | TolerantLogger | None) -> TolerantLogger | None:
        """Makes a logger tolerant that is not yet."""
        return logger if logger is None or isinstance(logger, cls) else cls(logger)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._logger, name)
        return self._guard(value) if callable(value) and not name.startswith("_") else value

    def attempt(self, work: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Calls a function that talks to the logger's backend under the same rule; None once it is lost."""
        if self.lost:
            return None
        try:
            return work(*args, **kwargs)
        except Exception as error:  # of any kind: what a backend raises is its own affair
            self.lost = True
            torchrl_logger.warning(
                f"{type(self._logger).__name__} is lost ({type(error).__name__}: {error}): the run goes on without it."
            )

    def _guard(self, method: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args, **kwargs: self.attempt(method, *args, **kwargs)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._logger!r})"
