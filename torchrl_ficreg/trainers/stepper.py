"""One optimisation step: forward under autocast, backward, clip, update."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard
from torch.distributed.tensor import distribute_tensor, DTensor
from torchrl.objectives.common import LossModule
from torchrl.trainers import Trainer
from torchrl.trainers.trainers import OptimizationStepper

from torchrl_ficreg._device import autocast, Precision
from torchrl_ficreg.distributed import average, launched, rank, together, world_size


Strategy = Literal["ddp", "fsdp"]


class ReplicatedLoss:
    """Every process holds all weights; gradients are averaged over processes (DDP). One process: the loss as it is.

    The losses of the collection are means over clips, or statistics of the global batch whose gradients follow the
    same convention, so the average of gradients is the gradient of the whole batch. That needs equal shares; masks may
    leave more transitions on one process than on another.

    Args:
        loss_module: on its device, the same weights on every process.
        compile: by ``torch.compile``, encoder, predictor and terms together.

    Attributes:
        params: what the optimiser holds.
    """

    def __init__(self, loss_module: LossModule, compile: bool = False) -> None:
        self.loss_module = loss_module
        self.params = [p for p in loss_module.parameters() if p.requires_grad]
        self._seed = torch.initial_seed()
        loss = _AsDictionary(loss_module)
        if compile:
            loss.compile()
        self._call = self._wrap(loss)

    def _wrap(self, loss: nn.Module) -> nn.Module:
        if not together():
            return loss
        # Buffers: BatchNorm statistics and SIGReg's counter are the same everywhere by construction. A static graph
        # allows for networks that a coefficient of zero leaves without gradient.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # its new name does not exist before torch 2.13
            return nn.parallel.DistributedDataParallel(
                loss, broadcast_buffers=False, gradient_as_bucket_view=True, static_graph=True
            )

    def __call__(self, batch: TensorDictBase, step: int) -> dict[str, torch.Tensor]:
        """The output of the loss on this process's share of a batch, ready for a backward pass."""
        if rank():
            # Without it all processes would drop the same units. A function of the step, so that a run resumed from
            # the main process's random state goes on as an unbroken one.
            torch.manual_seed((1_000_003 * self._seed + 65_537 * step + rank()) % 2**63)
        return self._call(batch)

    def clip(self, largest: float) -> torch.Tensor:
        """Scales the gradients down to a norm of at most ``largest`` and returns their norm before, []."""
        return nn.utils.clip_grad_norm_(self.params, largest)

    def updated(self) -> None:
        """To be called after each update of :attr:`params`."""

    def restored(self, optimizer: torch.optim.Optimizer) -> None:
        """To be called after weights and moments were loaded."""

    def finished(self, optimizer: torch.optim.Optimizer) -> None:
        """To be called by all processes before they part: what comes after must not need them."""

    def grad_norm(self, params: Iterable[nn.Parameter]) -> torch.Tensor | None:
        """Norm of the gradient of some parameters of the loss, []; None where they have none."""
        grads = [p.grad for p in params if p.grad is not None]
        return nn.utils.get_total_norm(grads) if grads else None

    @contextmanager
    def whole(self, optimizer: torch.optim.Optimizer) -> Iterator[None]:
        """Inside, the optimiser's moments are whole tensors, as a checkpoint wants them. Entered by all processes."""
        yield


class ShardedLoss(ReplicatedLoss):
    """Every process holds its piece of gradients and moments, and of the weights that the optimiser sees (FSDP2).

    The whole loss is one unit: a frozen judge needs weights that carry no gradient, which hooks on single networks would
    put back. So the weights are gathered once a step, right after the update: between steps the loss and its networks
    are complete on every process, and checkpoints, validation and evaluation need no care. Saved are half the gradients
    and moments on two processes, seven eighths on eight.

    Args:
        loss_module: as above. Its parameters, and those of its networks, become other objects.
        compile: as above.
    """

    def _wrap(self, loss: nn.Module) -> nn.Module:
        if any(not p.requires_grad for p in self.loss_module.parameters()):
            raise ValueError("strategy='fsdp' shards trained weights only: freeze none, or use strategy='ddp'.")
        for parameter in self.params:  # FSDP2 takes no other layout
            parameter.data = parameter.data.contiguous()
        flat = _Flat(loss, self.params)
        mesh = init_device_mesh(self.params[0].device.type, (world_size(),))
        fully_shard(flat, mesh=mesh, reshard_after_forward=False)
        before, self.params = self.params, list(flat.parameters())
        flat.unshard()
        self._whole = list(flat.parameters())  # the same objects at every step
        _replace(self.loss_module, dict(zip(before, self._whole, strict=True)))
        return flat

    def clip(self, largest: float) -> torch.Tensor:
        """As above."""
        return super().clip(largest).full_tensor()

    def updated(self) -> None:
        """Gathers the new weights."""
        self._call.unshard()

    def restored(self, optimizer: torch.optim.Optimizer) -> None:
        """Keeps of loaded weights and moments this process's piece."""
        with torch.no_grad():
            for piece, whole in zip(self.params, self._whole, strict=True):
                piece.to_local().copy_(_piece(whole, piece).to_local())
        for parameter, state in optimizer.state.items():
            for key, value in state.items():
                if value.shape == parameter.shape and not isinstance(value, DTensor):
                    state[key] = _piece(value, parameter)

    def finished(self, optimizer: torch.optim.Optimizer) -> None:
        """Makes the moments whole for good."""
        for state in optimizer.state.values():
            state.update({key: value.full_tensor() for key, value in state.items() if isinstance(value, DTensor)})

    def grad_norm(self, params: Iterable[nn.Parameter]) -> torch.Tensor | None:
        """As above."""
        pieces = dict(zip(self._whole, self.params, strict=True))
        norm = super().grad_norm(pieces[p] for p in params)
        return None if norm is None else norm.full_tensor()

    @contextmanager
    def whole(self, optimizer: torch.optim.Optimizer) -> Iterator[None]:
        """As above."""
        kept = {parameter: dict(state) for parameter, state in optimizer.state.items()}
        self.finished(optimizer)
        try:
            yield
        finally:
            for parameter, state in kept.items():
                optimizer.state[parameter].update(state)


def check_processes(strategy: Strategy, batch_size: int) -> None:
    """Finds mistakes before processes meet, and before anything is written.

    Args:
        strategy: of the training.
        batch_size: clips of one step over all processes.

    Raises:
        ValueError: an unknown strategy, or a batch that the processes cannot share equally.

    Examples:
        >>> check_processes("ddp", 128)
    """
    if strategy not in ("ddp", "fsdp"):
        raise ValueError(f"unknown distributed.strategy {strategy!r}: choose 'ddp' or 'fsdp'.")
    ranks = max(world_size(), int(os.environ["WORLD_SIZE"]) if launched() else 1)
    if batch_size % ranks or 0 < batch_size < 2 * ranks:
        raise ValueError(
            f"optim.batch_size={batch_size} counts the clips of all {ranks} processes: give a multiple of {ranks}, and "
            "at least 2 for each."
        )


def parallelise(loss_module: LossModule, strategy: Strategy = "ddp", compile: bool = False) -> ReplicatedLoss:
    """The loss as this process shall call it.

    Raises:
        ValueError: an unknown strategy, or weights that FSDP cannot shard.
    """
    check_processes(strategy, 0)
    kind = ShardedLoss if strategy == "fsdp" and together() else ReplicatedLoss
    return kind(loss_module, compile)


class _AsDictionary(nn.Module):
    """Returns a dictionary, among whose values DDP and FSDP find the tensors."""

    def __init__(self, loss_module: LossModule) -> None:
        super().__init__()
        self.loss_module = loss_module

    def forward(self, batch: TensorDictBase) -> dict[str, torch.Tensor]:
        return dict(self.loss_module(batch).items())


class _Flat(nn.Module):
    """Holds the parameters of a functional loss as its own: tensordicts of parameters are beyond FSDP's reach."""

    def __init__(self, loss: nn.Module, params: list[nn.Parameter]) -> None:
        super().__init__()
        self.__dict__["loss"] = loss  # not a child
        for number, parameter in enumerate(params):
            self.register_parameter(f"p{number}", parameter)

    def forward(self, batch: TensorDictBase) -> dict[str, torch.Tensor]:
        return self.loss(batch)


def _replace(loss_module: LossModule, new: dict[nn.Parameter, nn.Parameter]) -> None:
    """Puts other parameters into the networks of a functional loss, and into the loss itself."""
    for name, _ in list(loss_module.named_children()):
        network = loss_module.__dict__.get(name.removesuffix("_params"))
        if not name.endswith("_params") or network is None:
            continue
        for module in network.modules():
            module._parameters.update({key: new[p] for key, p in module._parameters.items() if p is not None})
        setattr(loss_module, name, TensorDict.from_module(network, as_module=True))
    left = [p for p in loss_module.parameters() if p in new]
    if left:
        raise ValueError(f"strategy='fsdp' cannot reach {len(left)} parameters of this loss: use strategy='ddp'.")


def _piece(whole: torch.Tensor, like: DTensor) -> DTensor:
    """This process's piece of a tensor that all processes hold."""
    return distribute_tensor(whole.detach(), like.device_mesh, like.placements, src_data_rank=None)


class OfflineStepper(OptimizationStepper):
    """Sums every entry of the loss that begins with ``loss`` and takes one step of the trainer's optimiser.

    Args:
        precision: see :func:`~torchrl_ficreg._device.autocast`.
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
