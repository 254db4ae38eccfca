"""Success measured while training, for the learning curve and for keeping the best checkpoint."""

from __future__ import annotations

import signal
from collections.abc import Callable

from tensordict import TensorDictBase
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_ficreg.trainers.checkpoint import SUCCESS
from torchrl_ficreg.trainers.distributed import is_main
from torchrl_ficreg.trainers.hooks import MetricsTable
from torchrl_ficreg.trainers.rng import RandomState
from torchrl_ficreg.trainers.signals import exit_on_signal, Preempted, told_to_stop

_UNKNOWN = -1.0  # below every rate: TorchRL's rotation wants a number from every checkpoint


class SuccessRate(TrainerHookBase):
    """Evaluates the model every few steps, in eval mode, before the checkpoint of that step is written.

    Where several processes train, the main one evaluates and the others wait. Random states are left as they were
    found, so that a run with evaluation trains as one without.

    SIGTERM and SIGINT end an evaluation at once, and its rate stays unknown: the checkpoint of the step comes after it,
    and who sent the signal may not wait long. The signal then does what it does in training, see
    :class:`stop_on_signal`.

    Args:
        evaluate: returns numbers, ``success_rate`` in [0, 1] among them.
        interval: steps between evaluations.
        table: where they are written, as a row of the split ``"evaluation"``.
    """

    def __init__(self, evaluate: Callable[[], dict[str, float]], interval: int, table: MetricsTable) -> None:
        self.evaluate, self.interval, self.table = evaluate, interval, table
        self._latest = (0, _UNKNOWN)  # step, rate

    def __call__(self, batch: TensorDictBase) -> dict[str, float] | None:
        """Called after every step."""
        trainer, step = self._trainer, self._trainer._optim_count
        if step % self.interval or not is_main() or told_to_stop(trainer):
            return None
        state, stopped = RandomState(next(trainer.loss_module.parameters()).device), None
        before = state.state_dict()
        trainer.loss_module.eval()
        try:
            with exit_on_signal(signal.SIGTERM, signal.SIGINT):
                numbers = {key: float(value) for key, value in self.evaluate().items()}
        except Preempted as stop:
            stopped = stop.signal
        finally:
            trainer.loss_module.train()
            state.load_state_dict(before)
        if stopped is not None:
            signal.raise_signal(stopped)
            return None
        self._latest = (step, numbers[SUCCESS])
        self.table.write_validation(step, numbers, split="evaluation")
        return {f"evaluation_{key}": value for key, value in numbers.items()}

    def metadata(self, trainer: Trainer) -> dict[str, float]:
        """For the manifest of a checkpoint: the rate of these very weights, -1 where it was not measured."""
        step, rate = self._latest
        return {SUCCESS: rate if step == trainer._optim_count else _UNKNOWN}

    def forget(self) -> None:
        """To be called when the weights have been changed by something else than the trainer."""
        self._latest = (0, _UNKNOWN)

    def register(self, trainer: Trainer, name: str = "success_rate") -> None:
        """Registers after each step; from now on the rotation keeps the best checkpoint besides the latest."""
        self._trainer = trainer
        trainer.register_op("post_steps_log", self)
        if trainer.checkpoint_rotation is not None:
            trainer.checkpoint_metadata = self.metadata
            trainer.checkpoint_rotation.keep_best = (SUCCESS, "max")
