"""Diagnostics of a loss: gradient norms for each term and network, and collapse of the latents."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torchrl.objectives.common import LossModule

from torchrl_ficreg.distributed import all_gather
from torchrl_ficreg.objectives.sigreg import SIGReg


def gradient_flow(loss: LossModule, clip: TensorDictBase) -> dict[str, dict[str, float]]:
    """Norm of the gradient of each loss term with respect to the parameters of each network.

    Nothing is accumulated into ``.grad``. BatchNorm statistics and random state change as by one call of the loss.

    Args:
        loss (LossModule): one whose networks were registered with ``convert_to_functional``.
        clip (TensorDictBase): input of the loss.

    Returns:
        dict[str, dict[str, float]]: ``{term: {network: norm}}``; exactly 0.0 where a network receives no gradient.

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


_SIGREG_OF_GAUSSIAN = 1.0527  # on N(0, I): the integral of (1 - exp(-t^2)) exp(-t^2 / 2) over [-3, 3]
_SIGREG_OF_COLLAPSE = 0.40205  # for each sample, where all latents are zero


@dataclass(frozen=True)
class LatentHealth:
    """Measures of collapse of a batch of latents.

    Attributes:
        floor_ratio: SIGReg over its value on a Gaussian: 1 for a Gaussian, 0.38 B for collapse to a point.
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
        """A warning of one line, or None for healthy latents."""
        if not math.isfinite(self.floor_ratio):
            return "the latents are not finite: lower the learning rate, and look for NaN in the clips."
        collapsed = self.samples * _SIGREG_OF_COLLAPSE / _SIGREG_OF_GAUSSIAN
        # With fewer samples, collapse is within the variance of the statistic.
        if self.samples >= 8 and self.floor_ratio > max(2.0, 0.5 * collapsed):
            return (
                f"the latents are close to collapse: SIGReg is {self.floor_ratio:.0f} times its value on a "
                f"Gaussian, a single point gives {collapsed:.0f}. Raise sigreg_coeff or lower the learning rate."
            )
        if self.effective_rank < max(1.5, 0.1 * min(self.dims, self.samples)) and self.dims > 1:
            return (
                f"the latents use {self.effective_rank:.1f} of {self.dims} dimensions: raise sigreg_coeff, or lower "
                "latent_dim."
            )
        return None


@torch.no_grad()
def latent_health(latent: torch.Tensor, sigreg: SIGReg | None = None) -> LatentHealth:
    """Measures a batch of latents; on several ranks the global batch, of equal local batches. All ranks must call it.

    Args:
        latent (torch.Tensor): [T, B, D], or [B, D].
        sigreg (SIGReg, optional): used in eval mode and not modified. Default: ``None``, a new :class:`SIGReg`.

    Returns:
        LatentHealth: its :attr:`~LatentHealth.alarm` is None for healthy latents.

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
    latent = all_gather(latent.float(), dim=-2)  # after SIGReg, which is global itself
    flat = latent.flatten(0, -2)  # [N, D]
    samples = latent.shape[-2] if sigreg.unit == "time" else len(flat)
    if not flat.isfinite().all():
        return LatentHealth(math.nan, math.nan, flat.shape[1], samples)
    spectrum = torch.linalg.svdvals(flat - flat.mean(0)).square()
    fraction = spectrum / spectrum.sum().clamp_min(1e-12)
    entropy = -(fraction * fraction.clamp_min(1e-12).log()).sum()
    return LatentHealth(value / _SIGREG_OF_GAUSSIAN, entropy.exp().item(), flat.shape[1], samples)
