"""The FICReg objective: a frozen inverse dynamics model judges imagined transitions."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch, TensorDictModule
from torch import nn

from torchrl_ficreg.objectives.lewm import _call, _Clip, LeWMLoss
from torchrl_ficreg.objectives.sigreg import SIGReg
from torchrl_ficreg.objectives.terms import squared_error


class FICRegLoss(LeWMLoss):
    r"""Forward-inverse consistency regularisation on top of :class:`LeWMLoss`.

    .. math:: L_{LeWM} + \mu \|h_\psi(\bar z_t, \bar z_{t+1}) - a_t\|^2
              + \gamma \|h_{\bar\psi}(\bar z_t, \hat z_{t+1}) - a_t\|^2

    A bar stands for a detached tensor or frozen weights. The inverse dynamics model h learns on real transitions
    which action was taken; frozen, it then asks of every imagined transition that the same action be recoverable.

    Who receives gradient:

    ====================  =======  =========  =============
    term                  encoder  predictor  inverse model
    ====================  =======  =========  =============
    ``loss_pred``         yes      yes        no
    ``loss_sigreg``       yes      no         no
    ``loss_idm``          no       no         yes
    ``loss_consistency``  no       yes        no
    ====================  =======  =========  =============

    Algorithm 1 of the paper, taken literally, breaks the last row: its one prediction is made from live latents, so the
    consistency term reaches the encoder through the predictor's input. ``context="detached"`` keeps the table exactly,
    by a second prediction from detached latents; ``context="live"`` is Algorithm 1 to the letter.

    The clip is that of :class:`LeWMLoss`. All random draws of the baseline terms come first, so that under one seed
    the encoder's gradient equals that of :class:`LeWMLoss` to the last bit.

    Args:
        encoder, predictor: see :class:`LeWMLoss`.
        inverse_model: reads two latents [..., D], writes the action block between them [..., F * A].
        sigreg, sigreg_coeff, reduction: see :class:`LeWMLoss`.
        idm_coeff: mu, weight of the inverse model's own loss.
        consistency_coeff: gamma, weight of the judgement on imagined transitions.
        context: ``"detached"`` or ``"live"``, see above.

    Raises:
        KeyError, ValueError, TypeError: see :class:`LeWMLoss`; ValueError for an unknown context.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import FICRegLoss, ModelConfig, make_world_model
        >>> model, inverse_model = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> loss = FICRegLoss(model.encoder, model.predictor, inverse_model)
        >>> pixels = torch.randint(0, 256, (8, 2, 3, 64, 64), dtype=torch.uint8)
        >>> output = loss(TensorDict({"pixels": pixels, "action": torch.randn(8, 2, 10)}, [8, 2]))
        >>> sum(output.values()).backward()
        >>> sorted(output.keys())
        ['loss_consistency', 'loss_idm', 'loss_pred', 'loss_sigreg']
    """

    out_keys = ["loss_pred", "loss_sigreg", "loss_idm", "loss_consistency"]
    _networks = ("encoder", "predictor", "inverse_model")
    _schedulable_buffers = frozenset({"idm_coeff", "consistency_coeff"})

    inverse_model: TensorDictModule
    inverse_model_params: TensorDictParams
    target_inverse_model_params: TensorDictParams

    def __init__(
        self,
        encoder: TensorDictModule,
        predictor: TensorDictModule,
        inverse_model: TensorDictModule,
        *,
        sigreg: SIGReg | None = None,
        sigreg_coeff: float = 0.09,
        idm_coeff: float = 0.1,
        consistency_coeff: float = 0.1,
        context: Literal["detached", "live"] = "detached",
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__(encoder, predictor, sigreg=sigreg, sigreg_coeff=sigreg_coeff, reduction=reduction)
        if context not in ("detached", "live"):
            raise ValueError(f"unknown context {context!r}: choose 'detached' or 'live'.")
        self.context = context
        self.convert_to_functional(inverse_model, "inverse_model")
        self.register_coeff_buffer("idm_coeff", idm_coeff)
        self.register_coeff_buffer("consistency_coeff", consistency_coeff)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms; see the class."""
        clip = _Clip.read(tensordict, self.tensor_keys)
        latent, predicted = self._encode_and_predict(clip)
        terms = self._baseline_terms(clip, latent, predicted)
        real = latent.detach()  # [B, T, D]: nothing below reaches the encoder, except predicted in a live context
        if self.context == "detached":
            predicted = self._predict(real[..., :-1, :], clip.action, _with_own_buffers(self.predictor_params))
        recovered = self._recover(real[..., :-1, :], real[..., 1:, :], self.inverse_model_params)
        judged = self._recover(real[..., :-1, :], predicted, self.inverse_model_params.detach())
        terms["loss_idm"] = self.idm_coeff * self._reduce(squared_error(recovered, clip.action), clip)
        terms["loss_consistency"] = self.consistency_coeff * self._reduce(squared_error(judged, clip.action), clip)
        return TensorDict(terms)

    def _recover(self, latent: torch.Tensor, next_latent: torch.Tensor, params: TensorDictBase) -> torch.Tensor:
        """Action blocks [B, T - 1, F * A] that lead from latent to next_latent [B, T - 1, D]."""
        return _call(self.inverse_model, params, latent, next_latent)


def _with_own_buffers(params: TensorDictParams) -> TensorDictBase:
    """The same parameters beside copies of the buffers, so that BatchNorm statistics move once a step, not twice."""
    return params.apply(lambda value: value if isinstance(value, nn.Parameter) else value.clone())
