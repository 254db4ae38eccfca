"""What every loss of the collection shares: its keys, its networks, its reduction."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import dispatch, TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.objectives.common import LossModule

from torchrl_ficreg.data import schema
from torchrl_ficreg.modules.collectives import num_processes, sum_over_processes
from torchrl_ficreg.modules.feed import choose_output, feed, NEXT_LATENT, require_module
from torchrl_ficreg.modules.inverse import LOG_VAR, SPREAD
from torchrl_ficreg.modules.precision import in_autocast
from torchrl_ficreg.objectives.clip import call, Clip, output, read_clip, read_frames
from torchrl_ficreg.objectives.judge import Recovered

Reduction = Literal["mean", "sum", "none"]

# ``forward`` of a loss, which takes a tensordict, or its entries by position or by keyword, the optional ones too.
takes_clip = dispatch(source="_call_keys")

# What each network is fed with, and the key of _AcceptedKeys that names what the loss takes from it.
_SIGNATURES = {
    "encoder": ((schema.PIXELS,), "latent"),
    "predictor": ((schema.LATENT, schema.ACTION), "predicted_latent"),
    "inverse_model": ((schema.LATENT, NEXT_LATENT), "recovered_action"),
}


class LatentLoss(LossModule):
    """Base of the losses on clips. A subclass writes :meth:`forward` and its table of who receives gradient.

    Networks are fed by the names of their ``in_keys``: see :func:`~torchrl_ficreg.modules.feed.arrange`. They are
    functional, as in TorchRL's losses: their parameters are children of the loss, they themselves are not. Coefficients
    are buffers: ``loss.sigreg_coeff = 0.1`` neither recompiles nor rebuilds anything.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can rename.

        Attributes:
            pixels: [B, T, 3, H, W] uint8 or floating.
            action: [B, T, F * A], z-scored.
            mask: [B, T] or [B, T, 1] bool, optional.
            latent, predicted_latent, recovered_action: what to take from a network that writes several entries.
            latent, action: also what the predictor and the inverse model may call their inputs.
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
    _compares_clips = False  # whether a term is a statistic over the clips of the local batch

    encoder: TensorDictModule
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    predictor: TensorDictModule
    predictor_params: TensorDictParams
    target_predictor_params: TensorDictParams
    inverse_model: TensorDictModule
    inverse_model_params: TensorDictParams
    target_inverse_model_params: TensorDictParams

    def __init__(
        self, *, reduction: Reduction, num_frames: int | None = None, **networks: TensorDictModule
    ) -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"unknown reduction {reduction!r}: choose 'mean', 'sum' or 'none'.")
        if num_frames is not None and not (isinstance(num_frames, int) and num_frames >= 2):
            raise ValueError(f"num_frames must be a whole number of at least 2 frames, got {num_frames!r}.")
        self.reduction, self.num_frames = reduction, num_frames
        self._networks = tuple(networks)
        for name, module in networks.items():
            require_module(name, module)
            self.convert_to_functional(module, name)
        self._check_networks()
        self._set_in_keys()

    def _register_coefficients(self, **values: float) -> None:
        for name, value in values.items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be finite and not negative, got {value}.")
            self.register_coeff_buffer(name, value)

    def _check_networks(self) -> None:
        """Numbers of inputs only: :meth:`set_keys` may still name them."""
        for name in self._networks:
            module, inputs = self.__dict__[name], _SIGNATURES[name][0]
            if len(module.in_keys) != len(inputs):
                raise ValueError(
                    f"the {name} must read {len(inputs)} entries, it reads {module.in_keys}: wrap it accordingly."
                )

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        self.in_keys = [keys.pixels, keys.action]
        # Optional entries are no in_keys, which are promised to be there; by keyword they can be given all the same.
        self._call_keys = [*self.in_keys, keys.mask, unravel_key(("next", keys.pixels))]

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

    def named_parameters(
        self, prefix: str = "", recurse: bool = True, remove_duplicate: bool = True
    ) -> Iterator[tuple[str, nn.Parameter]]:
        """As TorchRL's.

        Raises:
            TypeError: with ``remove_duplicate=False``, as :func:`torch.func.functional_call` asks, which replaces no
                parameter of a functional loss.
        """
        if not remove_duplicate:
            raise TypeError(
                "torch.func.functional_call does not reach the parameters of a TorchRL loss: write `with "
                "TensorDict(params).unflatten_keys('.').to_module(loss): loss(clip)` instead."
            )
        return super().named_parameters(prefix, recurse)

    def _read(self, tensordict: TensorDictBase) -> Clip:
        keys = self.tensor_keys
        clip = read_clip(tensordict, keys.pixels, keys.action, keys.mask, self.num_frames)
        self._check_size(*clip.pixels.shape[:-3])
        if clip.action.dtype == torch.float32:
            return clip
        dtype = next((param.dtype for param in self.parameters()), clip.action.dtype)
        return clip._replace(action=clip.action.to(dtype))  # as frames are

    def _check_size(self, *lead: int) -> None:
        """Whether the batch [..., T] is large enough, told in clips, before a layer tells it in channels."""
        clips = math.prod(lead[:-1])
        if self._compares_clips and clips < 2:
            raise ValueError(f"the regulariser compares clips: it needs at least 2 clips, got {clips}: use a larger batch.")
        if self.training and clips * (lead[-1] - 1) < 2 and num_processes() == 1:
            layers = [module for name in self._networks for module in self.__dict__[name].modules()]
            if any(isinstance(layer, nn.modules.batchnorm._BatchNorm) for layer in layers):
                raise ValueError(
                    "BatchNorm in train mode needs at least 2 clips, or one of 3 frames, got 1 transition: use a larger batch."
                )

    def _run(self, name: str, params: TensorDictBase, *inputs: torch.Tensor) -> tuple[torch.Tensor, TensorDictBase]:
        """What a network writes for its inputs, in the order of ``_SIGNATURES``: its own entry, and everything."""
        module, (roles, key) = self.__dict__[name], _SIGNATURES[name]
        keys = self.tensor_keys
        latent = choose_output(self.encoder, keys.latent)
        names = {schema.LATENT: (keys.latent,) if latent is None else (keys.latent, latent), schema.ACTION: (keys.action,)}
        tensordict = feed(name, module, dict(zip(roles, inputs)), names, inputs[0].shape[:1])
        written = call(module, params, tensordict)
        return output(module, written, getattr(keys, key)), written

    def _encode(self, pixels: torch.Tensor) -> torch.Tensor:
        """Frames [B, T, 3, H, W] -> latents [B, T, D]."""
        latent, _ = self._run("encoder", self.encoder_params, pixels)
        if latent.shape[:-1] != pixels.shape[:-3]:
            raise ValueError(
                f"the encoder must map pixels [B, T, 3, H, W] to latents [B, T, D], got {list(pixels.shape)} to "
                f"{list(latent.shape)}."
            )
        return latent

    @torch.no_grad()
    def peek(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Latents [T, B, D] of a clip as training sees them; random state and running statistics stay as they are."""
        pixels = read_frames(tensordict, self.tensor_keys.pixels, self.num_frames)
        with torch.random.fork_rng():
            latent, _ = self._run("encoder", with_own_buffers(self.encoder_params), pixels)
        return latent.flatten(0, -3).transpose(0, 1)

    def _predict(self, latent: torch.Tensor, action: torch.Tensor, params: TensorDictBase) -> torch.Tensor:
        """Latents and action blocks [B, T - 1, ...] -> next latents [B, T - 1, D]."""
        if not in_autocast(latent.device):
            action = action.to(latent.dtype)  # networks may compute in another dtype than the data
        return self._run("predictor", params, latent, action)[0]

    def _recover(self, latent: torch.Tensor, next_latent: torch.Tensor, params: TensorDictBase) -> Recovered:
        """What the inverse model says led from latent to next_latent [B, T - 1, D]."""
        action, written = self._run("inverse_model", params, latent, next_latent)
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
