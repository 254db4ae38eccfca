"""The LeWorldModel objective: predict the next latent, keep the latents Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch, TensorDictModule
from tensordict.utils import NestedKey
from torchrl.objectives.common import LossModule

from torchrl_ficreg.data import schema
from torchrl_ficreg.objectives.sigreg import SIGReg
from torchrl_ficreg.objectives.terms import squared_error


class LeWMLoss(LossModule):
    r"""LeWorldModel: end-to-end latent prediction with a Gaussian regulariser (arXiv 2603.19312).

    .. math:: \|g_\phi(z_{1:t}, a_t) - z_{t+1}\|^2 + \lambda \, \mathrm{SIGReg}(Z), \qquad z = f_\theta(o)

    No stop-gradient: the target trains the encoder too.

    Reads a clip [B, T]: ``pixels`` [B, T, 3, H, W], ``action`` [B, T, F * A] (z-scored blocks; block k leads from
    frame k to k + 1, the last one is not used) and, where there is one, ``mask`` [B, T] bool (false where a block is
    not to be trusted; its transition is left out and its action never read).

    Writes a new tensordict: ``loss_pred`` and ``loss_sigreg``, already weighted, whose plain sum is the objective.

    Args:
        encoder: reads ``pixels``, writes ``latent`` [..., D].
        predictor: reads ``latent`` and ``action``, writes ``predicted_latent``.
        sigreg: the regulariser; a default :class:`SIGReg` when None.
        sigreg_coeff: lambda. 0.09 belongs to a batch of 128 clips.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over transitions; the regulariser is one number either way.

    Raises:
        KeyError: the clip lacks a key.
        ValueError: an unknown reduction, a clip of one frame, or widths the networks were not built for.
        TypeError: pixels that are neither uint8 nor floating.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import LeWMLoss, ModelConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> loss = LeWMLoss(model.encoder, model.predictor)
        >>> pixels = torch.randint(0, 256, (8, 2, 3, 64, 64), dtype=torch.uint8)
        >>> output = loss(TensorDict({"pixels": pixels, "action": torch.randn(8, 2, 10)}, [8, 2]))
        >>> sum(output.values()).backward()
        >>> sorted(output.keys())
        ['loss_pred', 'loss_sigreg']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the clip that :meth:`set_keys` can rename.

        Attributes:
            pixels: [B, T, 3, H, W] uint8 or floating.
            action: [B, T, F * A], z-scored.
            mask: [B, T] bool, optional.
        """

        pixels: NestedKey = schema.PIXELS
        action: NestedKey = schema.ACTION
        mask: NestedKey = schema.MASK

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_pred", "loss_sigreg"]
    _networks: tuple[str, ...] = ("encoder", "predictor")
    _schedulable_buffers = frozenset({"sigreg_coeff"})

    encoder: TensorDictModule
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    predictor: TensorDictModule
    predictor_params: TensorDictParams
    target_predictor_params: TensorDictParams

    def __init__(
        self,
        encoder: TensorDictModule,
        predictor: TensorDictModule,
        *,
        sigreg: SIGReg | None = None,
        sigreg_coeff: float = 0.09,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"unknown reduction {reduction!r}: choose 'mean', 'sum' or 'none'.")
        self.reduction = reduction
        self.convert_to_functional(encoder, "encoder")
        self.convert_to_functional(predictor, "predictor")
        self.sigreg = SIGReg() if sigreg is None else sigreg
        self.register_coeff_buffer("sigreg_coeff", sigreg_coeff)
        self._set_in_keys()

    def _set_in_keys(self) -> None:
        self.in_keys = [self.tensor_keys.pixels, self.tensor_keys.action]

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        self._set_in_keys()

    def train(self, mode: bool = True) -> LeWMLoss:
        """Switches the networks too: they are not children of a functional loss."""
        super().train(mode)
        for name in self._networks:
            if name in self.__dict__:
                self.__dict__[name].train(mode)
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms; see the class."""
        clip = _Clip.read(tensordict, self.tensor_keys)
        latent, predicted = self._encode_and_predict(clip)
        return TensorDict(self._baseline_terms(clip, latent, predicted))

    def _encode_and_predict(self, clip: _Clip) -> tuple[torch.Tensor, torch.Tensor]:
        """Latents [B, T, D] and predictions of all but the first [B, T - 1, D]."""
        latent = _call(self.encoder, self.encoder_params, clip.pixels)
        return latent, self._predict(latent[..., :-1, :], clip.action, self.predictor_params)

    def _predict(self, latent: torch.Tensor, action: torch.Tensor, params: TensorDictBase) -> torch.Tensor:
        """Next latents [B, T - 1, D] from latents and action blocks [B, T - 1, ...]."""
        return _call(self.predictor, params, latent, action)

    def _baseline_terms(self, clip: _Clip, latent: torch.Tensor, predicted: torch.Tensor) -> dict[str, torch.Tensor]:
        """``loss_pred`` (encoder and predictor receive gradient) and ``loss_sigreg`` (encoder only)."""
        spread = self.sigreg(latent.flatten(0, -3).transpose(0, 1))  # [B, T, D] -> [T, B, D]
        return {
            "loss_pred": self._reduce(squared_error(predicted, latent[..., 1:, :]), clip),
            "loss_sigreg": self.sigreg_coeff * spread,
        }

    def _reduce(self, term: torch.Tensor, clip: _Clip) -> torch.Tensor:
        """[B, T - 1] -> as the reduction says, without masked transitions."""
        if clip.mask is None:
            return self._reduce_loss(term)
        kept = torch.where(clip.mask, term, 0.0)
        if self.reduction == "none":
            return kept
        return kept.sum() / (clip.mask.sum().clamp_min(1) if self.reduction == "mean" else 1)


class _Clip:
    """The tensors of a clip that a loss reads, checked once at the door.

    Attributes:
        pixels: [B, T, 3, H, W].
        action: [B, T - 1, F * A], the blocks between the frames; zero where masked.
        mask: [B, T - 1] bool, or None.
    """

    def __init__(self, pixels: torch.Tensor, action: torch.Tensor, mask: torch.Tensor | None) -> None:
        self.pixels, self.action, self.mask = pixels, action, mask

    @classmethod
    def read(cls, tensordict: TensorDictBase, keys: LeWMLoss._AcceptedKeys) -> _Clip:
        pixels, action = (_require(tensordict, key) for key in (keys.pixels, keys.action))
        if pixels.ndim < 5 or pixels.shape[-4] < 2:
            raise ValueError(
                f"a loss needs clips of at least 2 frames, pixels [B, T, 3, H, W] with T >= 2, "
                f"got {list(pixels.shape)}: sample longer clips (num_frames)."
            )
        if action.shape[:-1] != pixels.shape[:-3]:
            raise ValueError(
                f"every frame has an action block: expected action {[*pixels.shape[:-3], 'F * A']}, "
                f"got {list(action.shape)}."
            )
        mask = tensordict.get(keys.mask, None)
        action = action[..., :-1, :]
        if mask is not None:
            if mask.shape != pixels.shape[:-3] or mask.dtype != torch.bool:
                raise ValueError(
                    f"a mask says of every action block whether to trust it: expected {list(pixels.shape[:-3])} bool, "
                    f"got {list(mask.shape)} {mask.dtype}."
                )
            mask = mask[..., :-1]
            action = torch.where(mask.unsqueeze(-1), action, 0.0)
        return cls(pixels, action, mask)


def _require(tensordict: TensorDictBase, key: NestedKey) -> torch.Tensor:
    value = tensordict.get(key, None)
    if value is None:
        present = ", ".join(str(name) for name in tensordict.keys(True, True))
        raise KeyError(f"the clip has no {key!r}, only {present}: rename it, or name it with loss.set_keys(...).")
    return value


def _call(module: TensorDictModule, params: TensorDictBase, *inputs: torch.Tensor) -> torch.Tensor:
    """Feeds a TensorDictModule, with these parameters, by its own keys and returns what it writes first."""
    tensordict = TensorDict(dict(zip(module.in_keys, inputs)), batch_size=inputs[0].shape[:1])
    with params.to_module(module, preserve_module_state=False) as swap:
        try:
            return module(tensordict).get(module.out_keys[0])
        except Exception:
            swap.__exit__(None, None, None)  # tensordict itself leaves the module with these parameters
            raise
