"""What a checkpoint knows about the second phase of a run, the training on latents of the frozen encoder."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass
class Refinement:
    """Whether the second phase of a run is done: predictor and inverse model trained on latents of the frozen encoder.

    While the encoder learns, the targets of the predictor move. With a frozen encoder every frame is encoded once, a step
    takes a fraction of the time, and the prediction error decreases further. The steps are those of another
    :class:`OfflineTrainer`, on an :class:`~torchrl_ficreg.data.OfflineTrajectories` with ``latent=``, in a folder of its
    own. This record is a component of the checkpoints of the first phase.

    Args:
        done (bool, optional): whether all steps were taken. Default: ``False``.
        seconds (float, optional): time that they took. Default: ``0.0``.

    Examples:
        >>> record = Refinement()
        >>> record.load_state_dict({"done": True, "seconds": 60.0})
        >>> record
        Refinement(done=True, seconds=60.0)
    """

    done: bool = False
    seconds: float = 0.0

    def state_dict(self) -> dict[str, bool | float]:
        """``done`` and ``seconds``."""
        return asdict(self)

    def load_state_dict(self, state_dict: dict[str, bool | float]) -> None:
        """Restores both."""
        self.done = bool(state_dict["done"])
        self.seconds = float(state_dict["seconds"])
