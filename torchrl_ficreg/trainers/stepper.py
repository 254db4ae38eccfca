"""One optimisation step: forward under autocast, backward, clip, update."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.trainers import Trainer
from torchrl.trainers.trainers import OptimizationStepper

from torchrl_ficreg.modules.precision import autocast, Precision
from torchrl_ficreg.trainers.distributed import average


class OfflineStepper(OptimizationStepper):
    """Sums every entry of the loss that begins with ``loss`` and takes one step of the trainer's optimiser.

    Args:
        precision: see :func:`~torchrl_ficreg.modules.precision.autocast`.
        clip_norm: largest gradient norm over all parameters.
        norms_due: says at which step the gradient norms of the single networks are wanted besides the norm of all.
        accumulate: equal parts of a batch that go through the networks one after another before the one update, to save
            memory. Statistics over clips (SIGReg, BatchNorm) are those of a part, not of the batch. SIGReg grows with the
            number of clips, so accumulation divides its share in the gradient: multiply ``sigreg_coeff`` by ``accumulate``
            to keep the effective lambda.

    Raises:
        FloatingPointError: a loss or a gradient is not finite. No weight is updated; the message names the step, the
            term and the last good checkpoint.
    """

    def __init__(
        self,
        precision: Precision = "auto",
        clip_norm: float = 1.0,
        norms_due: Callable[[int], bool] = lambda step: False,
        accumulate: int = 1,
    ) -> None:
        self.precision, self.clip_norm, self.norms_due, self.accumulate = precision, clip_norm, norms_due, accumulate

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """Takes one step and returns the detached terms, ``grad_norm`` before clipping and ``learning_rate``.

        Where they are due, ``grad_norm_encoder`` and so on for every network, before clipping too.
        """
        parts = sub_batch.chunk(self.accumulate)
        outputs = [self._backward(trainer, part, number) for number, part in enumerate(parts)]
        output = {key: torch.stack([part[key] for part in outputs]).mean(0) for key in outputs[0]}
        norms = module_norms(trainer) if self.norms_due(trainer._optim_count) else {}
        grad_norm = trainer.parallel.clip(self.clip_norm)
        output = average(output)
        terms = _terms(output)
        if not torch.isfinite(sum(terms.values()) + grad_norm):  # the one host synchronisation of a step
            trainer.optimizer.zero_grad()
            raise FloatingPointError(self._describe(trainer, terms))
        rate = torch.tensor(trainer.optimizer.param_groups[0]["lr"])  # of this update; the schedule moves on afterwards
        trainer.optimizer.step()
        trainer.optimizer.zero_grad()
        trainer.parallel.updated()
        return TensorDict({**output, **norms, "grad_norm": grad_norm.detach(), "learning_rate": rate})

    def _backward(self, trainer: Trainer, clips: TensorDictBase, number: int) -> dict[str, torch.Tensor]:
        """Adds a part's share to the gradients; the detached output of the loss."""
        device = trainer.optimizer.param_groups[0]["params"][0].device
        with autocast(device, self.precision):
            output = trainer.parallel(clips, trainer._optim_count * self.accumulate + number)
        (sum(_terms(output).values()) / self.accumulate).backward()
        return {key: value.detach() for key, value in output.items()}

    @staticmethod
    def _describe(trainer: Trainer, terms: dict[str, torch.Tensor]) -> str:
        bad = [f"{key}={value.item()}" for key, value in terms.items() if not torch.isfinite(value)]
        rotation = trainer.checkpoint_rotation
        last = None if rotation is None else rotation.latest()
        where = f"the last good checkpoint is {last}" if last is not None else "there is no checkpoint yet"
        what = ", ".join(bad) if bad else "the gradient norm, though every loss term is finite"
        return f"step {trainer._optim_count}: not finite: {what}; {where}. Try a smaller learning rate or precision=fp32."


def _terms(output: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {key: value for key, value in output.items() if key.startswith("loss")}


def module_norms(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Norm of the gradient of each network of a functional loss, ``grad_norm_encoder`` [] and so on."""
    norms = {}
    for name, params in trainer.loss_module.named_children():
        norm = trainer.parallel.grad_norm(params.parameters()) if name.endswith("_params") else None
        if norm is not None:
            norms[f"grad_norm_{name.removesuffix('_params')}"] = norm
    return norms
