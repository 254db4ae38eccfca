"""Trains predictor and inverse dynamics model further, on latents of the frozen encoder."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.objectives.common import LossModule

from torchrl_ficreg._device import Precision
from torchrl_ficreg.data.latents import LatentClips
from torchrl_ficreg.trainers.hooks import Progress
from torchrl_ficreg.trainers.offline import OfflineTrainer


class Refinement:
    """Trains everything but the encoder on latents that are computed once.

    While the encoder learns, the targets of the predictor move. With a frozen encoder every frame is encoded once, a step
    takes a fraction of the time, and the prediction error decreases further. :class:`OfflineTrainer` takes the steps:
    AdamW with warm-up and a cosine to zero.

    Register it as a component of a checkpoint (it has a ``state_dict``), so that a resumed run knows whether it is done.

    Args:
        steps (int): optimization steps. 0 is done at once.

    Keyword Args:
        batch_size (int, optional): clips per step. Default: ``256``.
        lr (float, optional): peak learning rate. Default: ``1e-3``.
        weight_decay (float, optional): see :class:`OfflineTrainer`. Default: ``1e-3``.
        clip_norm (float, optional): see :class:`OfflineTrainer`. Default: ``1.0``.
        precision (str, optional): see :class:`OfflineTrainer`. Default: ``"auto"``.
        seed (int, optional): of the sampled clips. Default: ``0``.

    Attributes:
        done (bool): whether all steps were taken.
        seconds (float): time that they took.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(
        self,
        steps: int,
        *,
        batch_size: int = 256,
        lr: float = 1e-3,
        weight_decay: float = 1e-3,
        clip_norm: float = 1.0,
        precision: Precision = "auto",
        seed: int = 0,
    ) -> None:
        if steps < 0 or batch_size < 2 or not lr > 0:
            raise ValueError(
                "a refinement needs steps of at least 0, a batch_size of at least 2 and a positive lr, got "
                f"{steps}, {batch_size} and {lr}."
            )
        self.steps = steps
        self.batch_size = batch_size
        self.optim = {"lr": lr, "weight_decay": weight_decay, "clip_norm": clip_norm, "precision": precision}
        self.seed = seed
        self.done = steps == 0
        self.seconds = 0.0

    def run(self, loss_module: LossModule, clips: LatentClips, *, progress_bar: bool = True) -> None:
        """Takes all steps.

        Args:
            loss_module (LossModule): loss on the networks. Given latents, it leaves the encoder out.
            clips (LatentClips): clips of latents.
            progress_bar (bool, optional): show a progress bar. Default: ``True``.

        Raises:
            FloatingPointError: a loss or a gradient is not finite.
        """
        buffer = _SampledClips(clips, self.steps, self.batch_size, self.seed)
        trainer = OfflineTrainer(loss_module, buffer, epochs=1, log_interval=self.steps, progress_bar=False, **self.optim)
        if progress_bar:
            Progress(self.steps, 50, "refine").register(trainer)
        try:
            trainer.train()
        except FloatingPointError as error:
            raise FloatingPointError(f"refinement, {error}") from error
        self.done = True
        self.seconds = trainer.clock.seconds

    def state_dict(self) -> dict[str, bool | float]:
        """``done`` and ``seconds``."""
        return {"done": self.done, "seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, bool | float]) -> None:
        """Restores both."""
        self.done = bool(state_dict["done"])
        self.seconds = float(state_dict["seconds"])


class _SampledClips:
    """A :class:`~torchrl_ficreg.trainers.stream.ClipBuffer` that samples with replacement, one epoch long."""

    def __init__(self, clips: LatentClips, batches: int, batch_size: int, seed: int) -> None:
        self.clips = clips
        self.batches_per_epoch = batches
        self.batch_size = batch_size
        self.num_frames = clips.num_frames
        self.generator = torch.Generator().manual_seed(seed)

    def __len__(self) -> int:
        return self.batches_per_epoch * self.batch_size

    def sample(self) -> TensorDictBase:
        return self.clips.sample(self.batch_size, generator=self.generator)
