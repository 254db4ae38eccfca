"""What every loss of the collection shares: its keys, its networks, its reduction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn
from torchrl.objectives.common import LossModule

from torchrl_ficreg.data import schema
from torchrl_ficreg.modules.collectives import num_processes, sum_over_processes
from torchrl_ficreg.modules.inverse import LOG_VAR, SPREAD
from torchrl_ficreg.objectives.clip import call, check_module, Clip, output, read_clip, require
from torchrl_ficreg.objectives.judge import Recovered

Reduction = Literal["mean", "sum", "none"]

# What each network is fed with, and the key of _AcceptedKeys that names what the loss takes from it.
_SIGNATURES = {
    "encoder": (1, "latent"),
    "predictor": (2, "predicted_latent"),
    "inverse_model": (2, "recovered_action"),
}


class LatentLoss(LossModule):
    """Base of the losses on clips. A subclass writes :meth:`forward` and its table of who receives gradient.

    Networks are functional, as in TorchRL's losses: their parameters are children of the loss, they themselves are
    not. Coefficients are buffers: ``loss.sigreg_coeff = 0.1`` neither recompiles nor rebuilds anything.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can rename.

        Attributes:
            pixels: [B, T, 3, H, W] uint8 or floating.
            action: [B, T, F * A], z-scored.
            mask: [B, T] bool, optional.
            latent, predicted_latent, recovered_action: what to take from a network that writes several entries.
        """

        pixels: NestedKey = schema.PIXELS
        action: NestedKey = schema.ACTION
        mask: NestedKey = schema.MASK
        latent: NestedKey = schema.LATENT
        predicted_latent: NestedKey = schema.PREDICTED_LATENT
        recovered_action: NestedKey = schema.RECOVERED_ACTION

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _networks: tuple[str, ...] = ()

    encoder: TensorDictModule
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    predictor: TensorDictModule
    predictor_params: TensorDictParams
    target_predictor_params: TensorDictParams
    inverse_model: TensorDictModule
    inverse_model_params: TensorDictParams
    target_inverse_model_params: TensorDictParams

    def __init__(self, *, reduction: Reduction, **networks: TensorDictModule) -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"unknown reduction {reduction!r}: choose 'mean', 'sum' or 'none'.")
        self.reduction = reduction
        self._networks = tuple(networks)
        for name, module in networks.items():
            self.convert_to_functional(module, name)
        self._check_networks()
        self._set_in_keys()

    def _register_coefficients(self, **values: float) -> None:
        for name, value in values.items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be finite and not negative, got {value}.")
            self.register_coeff_buffer(name, value)

    def _check_networks(self) -> None:
        for name in self._networks:
            num_inputs, key = _SIGNATURES[name]
            check_module(name, self.__dict__[name], num_inputs, getattr(self.tensor_keys, key))

    def _set_in_keys(self) -> None:
        self.in_keys = [self.tensor_keys.pixels, self.tensor_keys.action]

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """Called by ``set_keys``."""
        self._set_in_keys()

    def train(self, mode: bool = True) -> LatentLoss:
        """Switches the networks too: they are not children of a functional loss."""
        super().train(mode)
        for name in self._networks:
            if name in self.__dict__:
                self.__dict__[name].train(mode)
        return self

    def _read(self, tensordict: TensorDictBase) -> Clip:
        keys = self.tensor_keys
        clip = read_clip(tensordict, keys.pixels, keys.action, keys.mask)
        if clip.action.dtype == torch.float32:
            return clip
        return clip._replace(action=clip.action.to(next(self.parameters()).dtype))  # as frames are

    def _encode(self, pixels: torch.Tensor) -> torch.Tensor:
        """Frames [B, T, 3, H, W] -> latents [B, T, D]."""
        written = call(self.encoder, self.encoder_params, pixels)
        latent = output(self.encoder, written, self.tensor_keys.latent)
        if latent.shape[:-1] != pixels.shape[:-3]:
            raise ValueError(
                f"the encoder must map pixels [B, T, 3, H, W] to latents [B, T, D], got {list(pixels.shape)} to "
                f"{list(latent.shape)}."
            )
        return latent

    @torch.no_grad()
    def peek(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Latents [T, B, D] of a clip as training sees them; random state and running statistics stay as they are."""
        pixels = require(tensordict, self.tensor_keys.pixels)
        with torch.random.fork_rng():
            written = call(self.encoder, with_own_buffers(self.encoder_params), pixels)
        return output(self.encoder, written, self.tensor_keys.latent).flatten(0, -3).transpose(0, 1)

    def _predict(self, latent: torch.Tensor, action: torch.Tensor, params: TensorDictBase) -> torch.Tensor:
        """Latents and action blocks [B, T - 1, ...] -> next latents [B, T - 1, D]."""
        written = call(self.predictor, params, latent, action)
        return output(self.predictor, written, self.tensor_keys.predicted_latent)

    def _recover(self, latent: torch.Tensor, next_latent: torch.Tensor, params: TensorDictBase) -> Recovered:
        """What the inverse model says led from latent to next_latent [B, T - 1, D]."""
        written = call(self.inverse_model, params, latent, next_latent)
        action = output(self.inverse_model, written, self.tensor_keys.recovered_action)
        return Recovered(action, written.get(LOG_VAR, None), written.get(SPREAD, None))

    def _reduce(self, term: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
        """[B, T - 1] -> as the reduction says. Masked transitions are selected away, never multiplied by zero.

        On several processes a mean is taken over the mean count of transitions, so that its average over processes is
        the mean over the transitions of the global batch, however the masks are shared out.
        """
        if mask is not None:
            term = torch.where(mask, term, 0.0)
        if self.reduction == "none":
            return term
        if self.reduction == "sum":
            return term.sum()
        if mask is None:
            return term.mean()
        count = sum_over_processes(mask.sum()).clamp_min(1)  # [], of all processes
        return term.sum() * num_processes() / count


def with_own_buffers(params: TensorDictParams) -> TensorDictBase:
    """The same parameters beside copies of the buffers, so that BatchNorm statistics move once a step, not twice."""
    return params.apply(lambda value: value if isinstance(value, nn.Parameter) else value.clone())
