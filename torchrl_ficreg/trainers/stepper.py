"""One optimization step: forward under autocast, backward, clipping, update; with DDP, accumulation and compilation."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.objectives.common import LossModule
from torchrl.trainers import Trainer
from torchrl.trainers.trainers import OptimizationStepper

from torchrl_ficreg._device import autocast, Precision
from torchrl_ficreg._torchrl_compat import step_count
from torchrl_ficreg.distributed import all_reduce_mean, planned_world_size, rank, world_size


class OfflineStepper(OptimizationStepper):
    """Sums all entries of the loss whose key begins with ``loss`` and takes one step of the trainer's optimizer.

    The trainer must have an attribute ``distributed_loss``, a :class:`DistributedLoss`.

    Args:
        precision (str, optional): see :func:`~torchrl_ficreg._device.autocast`. Default: ``"auto"``.
        clip_norm (float, optional): largest norm of the gradient of all parameters. Default: ``1.0``.
        log_norms_at (Callable[[int], bool], optional): whether to compute the gradient norm of each network at a step,
            besides the norm over all parameters. Default: at no step.
        accumulate (int, optional): equal micro-batches that a batch is split into (gradient accumulation), to save
            memory. Statistics over clips (SIGReg, BatchNorm) are those of a micro-batch. SIGReg is proportional to the
            number of clips, so its share of the gradient is divided by ``accumulate``: multiply ``sigreg_coeff`` by
            ``accumulate`` to keep the effective lambda. Default: ``1``.

    Raises:
        FloatingPointError: a loss or a gradient is not finite. No weight is updated. The message names the step, the
            term and the last good checkpoint.
    """

    def __init__(
        self,
        precision: Precision = "auto",
        clip_norm: float = 1.0,
        log_norms_at: Callable[[int], bool] = lambda step: False,
        accumulate: int = 1,
    ) -> None:
        self.precision = precision
        self.clip_norm = clip_norm
        self.log_norms_at = log_norms_at
        self.accumulate = accumulate

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """Takes one step.

        Args:
            trainer (Trainer): the trainer.
            sub_batch (TensorDictBase): clips [B, T] of this rank.

        Returns:
            the detached entries of the loss, averaged over micro-batches and ranks, ``grad_norm`` [] before clipping,
            ``learning_rate`` [], and where ``log_norms_at`` says so ``grad_norm_encoder`` [] and so on for every network.
        """
        step = step_count(trainer)
        params = trainer.optimizer.param_groups[0]["params"]
        outputs = [
            self._backward(trainer, clips, step * self.accumulate + number, params[0].device)
            for number, clips in enumerate(sub_batch.chunk(self.accumulate))
        ]
        output = {key: torch.stack([part[key] for part in outputs]).mean(0) for key in outputs[0]}
        norms = network_grad_norms(trainer.loss_module) if self.log_norms_at(step) else {}
        grad_norm = nn.utils.clip_grad_norm_(params, self.clip_norm)
        output = all_reduce_mean(output)
        terms = _terms(output)
        if not torch.isfinite(sum(terms.values()) + grad_norm):  # the one host synchronization of a step
            trainer.optimizer.zero_grad()
            raise FloatingPointError(_describe(trainer, terms))
        learning_rate = torch.tensor(trainer.optimizer.param_groups[0]["lr"])  # before the schedule's next step
        trainer.optimizer.step()
        trainer.optimizer.zero_grad()
        return TensorDict({**output, **norms, "grad_norm": grad_norm.detach(), "learning_rate": learning_rate})

    def _backward(
        self, trainer: Trainer, clips: TensorDictBase, number: int, device: torch.device
    ) -> dict[str, torch.Tensor]:
        """Adds the gradient of a micro-batch; returns the detached entries of the loss."""
        with autocast(device, self.precision):
            output = trainer.distributed_loss(clips, number)
        (sum(_terms(output).values()) / self.accumulate).backward()
        return {key: value.detach() for key, value in output.items()}


def _terms(output: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {key: value for key, value in output.items() if key.startswith("loss")}


def _describe(trainer: Trainer, terms: dict[str, torch.Tensor]) -> str:
    bad = [f"{key}={value.item()}" for key, value in terms.items() if not torch.isfinite(value)]
    rotation = trainer.checkpoint_rotation
    last = None if rotation is None else rotation.latest()
    where = f"the last good checkpoint is {last}" if last is not None else "there is no checkpoint yet"
    what = ", ".join(bad) if bad else "the gradient norm, though every loss term is finite"
    return f"step {step_count(trainer)}: not finite: {what}; {where}. Try a smaller learning rate or precision=fp32."


def network_grad_norms(loss_module: LossModule) -> dict[str, torch.Tensor]:
    """Gradient norm of each network of a functional loss, ``grad_norm_encoder`` [] and so on."""
    norms = {}
    for name, params in loss_module.named_children():
        grads = [p.grad for p in params.parameters() if p.grad is not None] if name.endswith("_params") else []
        if grads:
            norms[f"grad_norm_{name.removesuffix('_params')}"] = nn.utils.get_total_norm(grads)
    return norms


class DistributedLoss:
    """A loss under distributed data parallel training (DDP); with one process, the loss itself.

    All ranks hold all weights, and gradients are averaged over ranks. The losses of this package are means over clips,
    or statistics of the global batch whose gradients follow the same convention, so the average is the gradient of the
    global batch. All ranks must get the same number of clips; masks may leave them different numbers of transitions.

    Args:
        loss_module (LossModule): on its device, with the same weights on all ranks.
        compile (bool, optional): compile encoder, predictor and terms together, by ``torch.compile``. Default: ``False``.
    """

    def __init__(self, loss_module: LossModule, compile: bool = False) -> None:
        self._seed = torch.initial_seed()
        self._call: nn.Module = _AsDictionary(loss_module)
        if compile:
            self._call.compile()
        if world_size() > 1:
            # Buffers are not broadcast: BatchNorm statistics and SIGReg's counter are equal on all ranks. A static graph
            # allows for networks that get no gradient because their coefficient is zero.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FutureWarning)  # the new name of an argument needs torch 2.13
                self._call = nn.parallel.DistributedDataParallel(
                    self._call, broadcast_buffers=False, gradient_as_bucket_view=True, static_graph=True
                )

    def __call__(self, clips: TensorDictBase, number: int) -> dict[str, torch.Tensor]:
        """The entries of the loss for this rank's clips [B, T].

        Args:
            clips (TensorDictBase): the clips.
            number (int): of the micro-batch, counted from the start of the run. It seeds the dropout of ranks above 0,
                so that a run resumed from rank 0's random state continues as an unbroken one.
        """
        if rank():  # the same seed on all ranks would drop the same units
            torch.manual_seed((1_000_003 * self._seed + 65_537 * number + rank()) % 2**63)
        return self._call(clips)


class _AsDictionary(nn.Module):
    """Returns a dict, in which DDP finds the tensors."""

    def __init__(self, loss_module: LossModule) -> None:
        super().__init__()
        self.loss_module = loss_module

    def forward(self, clips: TensorDictBase) -> dict[str, torch.Tensor]:
        return dict(self.loss_module(clips).items())


def check_batch_size(batch_size: int) -> None:
    """Checks, before the process group exists, that the ranks can split a batch equally.

    Args:
        batch_size (int): clips of one step over all ranks.

    Raises:
        ValueError: they cannot, or a rank would get a single clip.

    Examples:
        >>> check_batch_size(128)
    """
    ranks = planned_world_size()
    if batch_size % ranks or 0 < batch_size < 2 * ranks:
        raise ValueError(
            f"optim.batch_size={batch_size} counts the clips of all {ranks} processes: give a multiple of {ranks}, and "
            "at least 2 for each."
        )
