"""Diagnostics of a loss: gradient norms per network and term, and collapse of the latents."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torchrl.objectives.common import LossModule

from torchrl_ficreg.distributed import gather_clips
from torchrl_ficreg.objectives.sigreg import SIGReg


def gradient_flow(loss: LossModule, clip: TensorDictBase) -> dict[str, dict[str, float]]:
    """Gradient norm of every loss term at every network.

    Nothing is accumulated into ``.grad``. Random layers and BatchNorm statistics are used and moved as by one call of
    the loss.

    Args:
        loss: a loss whose networks were registered with ``convert_to_functional``.
        clip: what the loss reads.

    Returns:
        ``{term: {network: norm}}``; exactly 0.0 where no gradient arrives.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import FICRegLoss, ModelConfig, gradient_flow, make_world_model
        >>> model, inverse_model = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> loss = FICRegLoss(model.encoder, model.predictor, inverse_model)
        >>> pixels = torch.randint(0, 256, (8, 2, 3, 64, 64), dtype=torch.uint8)
        >>> flow = gradient_flow(loss, TensorDict({"pixels": pixels, "action": torch.randn(8, 2, 10)}, [8, 2]))
        >>> flow["loss_consistency"]["encoder"], flow["loss_consistency"]["inverse_model"]
        (0.0, 0.0)
    """
    networks = {
        name.removesuffix("_params"): [p for p in params.parameters() if p.requires_grad]
        for name, params in loss.named_children()
        if name.endswith("_params") and not name.startswith("target_")
    }
    terms = {key: value.sum() for key, value in loss(clip).items() if key.startswith("loss")}
    table: dict[str, dict[str, float]] = {}
    for term, value in terms.items():
        table[term] = {}
        for name, params in networks.items():
            reachable = bool(params) and value.requires_grad  # not so where networks are frozen
            grads = torch.autograd.grad(value, params, retain_graph=True, allow_unused=True) if reachable else ()
            squares = [grad.float().square().sum() for grad in grads if grad is not None]
            table[term][name] = torch.stack(squares).sum().sqrt().item() if squares else 0.0
    return table


GAUSSIAN_FLOOR = 1.0527  # value of SIGReg on N(0, I): the integral of (1 - exp(-t^2)) exp(-t^2 / 2) over [-3, 3]
COLLAPSE = 0.40205  # value per sample when all latents are zero


@dataclass(frozen=True)
class LatentHealth:
    """Two numbers about a batch of latents.

    Attributes:
        floor_ratio: SIGReg over its value on a Gaussian: 1 is as good as it gets, 0.38 B is collapse.
        effective_rank: exponential of the entropy of the covariance spectrum (Roy and Vetterli, 2007), from 1 to D.
        dims: D.
        samples: B, of one time step.
    """

    floor_ratio: float
    effective_rank: float
    dims: int
    samples: int

    @property
    def alarm(self) -> str | None:
        """One line that says what is wrong, or None."""
        if not math.isfinite(self.floor_ratio):
            return "the latents are not finite: lower the learning rate, and look for NaN in the clips."
        collapsed = self.samples * COLLAPSE / GAUSSIAN_FLOOR
        # Among a handful of samples collapse cannot be told from chance.
        if self.samples >= 8 and self.floor_ratio > max(2.0, 0.5 * collapsed):
            return (
                f"the latents are close to collapse: SIGReg is {self.floor_ratio:.0f} times its floor, {collapsed:.0f} "
                "is a single point. Raise sigreg_coeff or lower the learning rate."
            )
        if self.effective_rank < max(1.5, 0.1 * min(self.dims, self.samples)) and self.dims > 1:
            return (
                f"the latents use {self.effective_rank:.1f} of {self.dims} dimensions: raise sigreg_coeff, or lower "
                "latent_dim."
            )
        return None


@torch.no_grad()
def latent_health(latent: torch.Tensor, sigreg: SIGReg | None = None) -> LatentHealth:
    """Measures a batch of latents; on several processes, which must all ask, the global batch of their equal shares.

    Args:
        latent: [T, B, D], or [B, D].
        sigreg: the regulariser to measure with; a default one when None. It is used in eval mode and left as it was.

    Examples:
        >>> _ = torch.manual_seed(0)
        >>> health = latent_health(torch.randn(4, 512, 64))
        >>> 0.8 < health.floor_ratio < 1.2, health.effective_rank > 60, health.alarm
        (True, True, None)
        >>> latent_health(torch.zeros(512, 16)).alarm is None
        False
    """
    sigreg = SIGReg().to(latent.device) if sigreg is None else sigreg
    training = sigreg.training
    try:
        value = sigreg.eval()(latent).item()
    finally:
        sigreg.train(training)
    latent = gather_clips(latent.float(), dim=-2)  # SIGReg above has seen all processes' latents on its own
    flat = latent.flatten(0, -2)  # [N, D]
    samples = latent.shape[-2] if sigreg.unit == "time" else len(flat)
    if not flat.isfinite().all():
        return LatentHealth(math.nan, math.nan, flat.shape[1], samples)
    spectrum = torch.linalg.svdvals(flat - flat.mean(0)).square()
    share = spectrum / spectrum.sum().clamp_min(1e-12)
    entropy = -(share * share.clamp_min(1e-12).log()).sum()
    return LatentHealth(value / GAUSSIAN_FLOOR, entropy.exp().item(), flat.shape[1], samples)
