"""A last phase on frozen latents: what the encoder still moved under the predictor's feet now stands still."""

from __future__ import annotations

import time

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives.common import LossModule
from tqdm import trange

from torchrl_ficreg._device import autocast, Precision
from torchrl_ficreg.data.latents import LatentClips
from torchrl_ficreg.keys import ACTION, LATENT, PIXELS
from torchrl_ficreg.modules.world_model import LatentWorldModel
from torchrl_ficreg.trainers.offline import WarmupCosine


class LatentsAsFrames(TensorDictModule):
    """An encoder for losses that are given latents in place of frames: ``pixels`` [..., D, 1, 1] -> ``latent`` [..., D].

    Examples:
        >>> import torch
        >>> LatentsAsFrames()(pixels=torch.zeros(8, 2, 16, 1, 1)).shape
        torch.Size([8, 2, 16])
    """

    def __init__(self) -> None:
        super().__init__(nn.Flatten(-3), in_keys=[PIXELS], out_keys=[LATENT])


class NoRegularizer(nn.Module):
    """Takes the place of a SIGReg where no encoder could answer it: zero, at no cost.

    Examples:
        >>> import torch
        >>> NoRegularizer()(torch.randn(2, 8, 16))
        tensor(0.)
    """

    def forward(self, latent: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Latents [T, B, D] -> 0 []."""
        return latent.new_zeros(())


def on_frozen_latents(world_model: LatentWorldModel) -> LatentWorldModel:
    """The same predictor behind an encoder that takes latents for frames; build the loss of a refinement with it."""
    return LatentWorldModel(
        LatentsAsFrames(),
        world_model.predictor,
        frame_skip=world_model.frame_skip,
        statistics=world_model.statistics,
    )


class Refinement:
    """Trains everything but the encoder on latents computed once.

    While an encoder learns, its predictor chases moving targets. With the encoder frozen every frame is encoded a single
    time, a step costs a fraction, and the prediction error falls further. AdamW with warm-up and a cosine to zero.

    It is a component of a checkpoint (``state_dict``), so that a resumed run knows whether it was done.

    Args:
        steps: optimisation steps; 0 does nothing.
        batch_size: clips.
        lr, weight_decay, clip_norm, precision: see :class:`~torchrl_ficreg.trainers.OfflineTrainer`.
        seed: of the draws.

    Raises:
        ValueError: a setting outside its range.
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
        self.steps, self.batch_size, self.lr, self.weight_decay = steps, batch_size, lr, weight_decay
        self.clip_norm, self.precision, self.seed = clip_norm, precision, seed
        self.done, self.seconds = steps == 0, 0.0

    def run(self, loss_module: LossModule, clips: LatentClips, *, progress_bar: bool = True) -> None:
        """Takes all steps.

        Args:
            loss_module: built on :func:`on_frozen_latents`; terms that only an encoder could lower go along unused.
            clips: what to train on.
            progress_bar: show one.

        Raises:
            FloatingPointError: a loss or gradient stopped being finite.
        """
        params = [p for p in loss_module.train().parameters() if p.requires_grad]
        device = params[0].device
        optimizer = torch.optim.AdamW(params, lr=self.lr, weight_decay=self.weight_decay, fused=device.type != "mps")
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, WarmupCosine(self.steps, 0.01))
        generator, began = torch.Generator().manual_seed(self.seed), time.perf_counter()
        with trange(self.steps, desc="refine", unit="step", disable=not progress_bar, dynamic_ncols=True) as bar:
            for step in bar:
                batch = clips.sample(self.batch_size, generator=generator)
                frames = batch[LATENT][..., None, None]  # [B, T, D, 1, 1]
                with autocast(device, self.precision):
                    output = loss_module(batch.select(ACTION).set(PIXELS, frames))
                terms = {key: value for key, value in output.items() if key.startswith("loss")}
                sum(terms.values()).backward()
                norm = nn.utils.clip_grad_norm_(params, self.clip_norm)
                if not norm.isfinite():
                    raise FloatingPointError(f"refinement step {step}: not finite. Try a smaller refine.lr.")
                optimizer.step()
                optimizer.zero_grad()
                schedule.step()
                if step % 50 == 0:
                    shown = {key.removeprefix("loss_"): f"{value.item():.3f}" for key, value in terms.items()}
                    bar.set_postfix(shown, refresh=False)
        self.done, self.seconds = True, time.perf_counter() - began

    def state_dict(self) -> dict[str, bool | float]:
        """Whether it was done, and how long that took."""
        return {"done": self.done, "seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, bool | float]) -> None:
        """Takes over both."""
        self.done, self.seconds = bool(state_dict["done"]), float(state_dict["seconds"])
