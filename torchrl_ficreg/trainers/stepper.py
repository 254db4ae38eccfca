"""One optimisation step: forward under autocast, backward, clip, update."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.trainers import Trainer
from torchrl.trainers.trainers import OptimizationStepper

from torchrl_ficreg.modules.precision import autocast, Precision


class OfflineStepper(OptimizationStepper):
    """Sums every entry of the loss that begins with ``loss`` and takes one step of the trainer's optimiser.

    Args:
        precision: see :func:`~torchrl_ficreg.modules.precision.autocast`.
        clip_norm: largest gradient norm over all parameters.

    Raises:
        FloatingPointError: a loss or a gradient is not finite. No weight is updated; the message names the step, the
            term and the last good checkpoint.
    """

    def __init__(self, precision: Precision = "auto", clip_norm: float = 1.0) -> None:
        self.precision, self.clip_norm = precision, clip_norm

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """Takes one step and returns the detached terms, ``grad_norm`` before clipping and ``learning_rate``."""
        params = [p for group in trainer.optimizer.param_groups for p in group["params"]]
        with autocast(params[0].device, self.precision):
            output = trainer.loss_module(sub_batch)
        terms = {key: value for key, value in output.items() if key.startswith("loss")}
        total = sum(terms.values())
        total.backward()
        grad_norm = nn.utils.clip_grad_norm_(params, self.clip_norm)
        if not torch.isfinite(total.detach() + grad_norm):  # the one host synchronisation of a step
            trainer.optimizer.zero_grad()
            raise FloatingPointError(self._describe(trainer, terms))
        rate = torch.tensor(trainer.optimizer.param_groups[0]["lr"])  # of this update; the schedule moves on afterwards
        trainer.optimizer.step()
        trainer.optimizer.zero_grad()
        detached = {key: value.detach() for key, value in output.items()}
        return TensorDict({**detached, "grad_norm": grad_norm.detach(), "learning_rate": rate})

    @staticmethod
    def _describe(trainer: Trainer, terms: dict[str, torch.Tensor]) -> str:
        bad = [f"{key}={value.item()}" for key, value in terms.items() if not torch.isfinite(value)]
        rotation = trainer.checkpoint_rotation
        last = None if rotation is None else rotation.latest()
        where = f"the last good checkpoint is {last}" if last is not None else "there is no checkpoint yet"
        what = ", ".join(bad) if bad else "the gradient norm, though every loss term is finite"
        return f"step {trainer._optim_count}: not finite: {what}; {where}. Try a smaller learning rate or precision=fp32."
