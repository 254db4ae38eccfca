"""The joint inverse loss: prediction, and an inverse model trained together with the encoder."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule

from torchrl_ficreg.objectives.base import Reduction, takes_clip
from torchrl_ficreg.objectives.inverse_terms import inverse_error
from torchrl_ficreg.objectives.lewm import LeWMLoss
from torchrl_ficreg.objectives.sigreg import SIGReg


class JointInverseLoss(LeWMLoss):
    r"""Latent prediction with an inverse model whose error trains the encoder too, with or without SIGReg.

    .. math:: \|g_\phi(z_{1:t}, a_t) - z_{t+1}\|^2 + \lambda \, \mathrm{SIGReg}(Z)
              + \mu \|h_\psi(z_t, z_{t+1}) - a_t\|^2

    As in ICM (arXiv 1705.05363), PLDM (arXiv 2502.14819) and sensorimotor world models (SMWM, arXiv 2606.20104). Latents only
    have to keep what the actions change, and the inverse loss alone can prevent their collapse (``sigreg_coeff=0``, SMWM).
    It is the baseline of FICReg, in which the encoder receives no gradient of this term.

    ====================  =======  =========  =============
    term                  encoder  predictor  inverse model
    ====================  =======  =========  =============
    ``loss_pred``         yes      yes        no
    ``loss_sigreg``       yes      no         no
    ``loss_idm``          **yes**  no         yes
    ====================  =======  =========  =============

    Reads the clip of :class:`~torchrl_ficreg.LeWMLoss`; writes ``loss_pred``, ``loss_sigreg`` and ``loss_idm``, already
    weighted. With ``sigreg_coeff=0`` at construction the regularizer is not computed and ``loss_sigreg`` not written.

    Args:
        encoder (TensorDictModule): see :class:`~torchrl_ficreg.LeWMLoss`.
        predictor (TensorDictModule): see :class:`~torchrl_ficreg.LeWMLoss`.
        inverse_model (TensorDictModule): see :class:`~torchrl_ficreg.FICRegLoss`.
        sigreg (SIGReg, optional): see :class:`~torchrl_ficreg.LeWMLoss`. Default: ``None``.
        sigreg_coeff (float, optional): lambda, see :class:`~torchrl_ficreg.LeWMLoss`. Default: ``0.09``.
        idm_coeff (float, optional): mu; SMWM tunes it from 0.1 to 30 by task. Default: ``1.0``.
        reduction ("mean", "sum" or "none", optional): see :class:`~torchrl_ficreg.LeWMLoss`. Default: ``"mean"``.
        num_frames (int, optional): see :class:`~torchrl_ficreg.LeWMLoss`. Default: ``None``.
        prediction_steps (int, optional): see :class:`~torchrl_ficreg.LeWMLoss`. Default: ``1``.

    Raises:
        KeyError, ValueError, TypeError: see :class:`~torchrl_ficreg.LeWMLoss`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import JointInverseLoss, ModelConfig, make_world_model
        >>> model, inverse_model = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> loss = JointInverseLoss(model.encoder, model.predictor, inverse_model, sigreg_coeff=0.0)
        >>> pixels = torch.randint(0, 256, (8, 2, 3, 64, 64), dtype=torch.uint8)
        >>> output = loss(TensorDict({"pixels": pixels, "action": torch.randn(8, 2, 10)}, [8, 2]))
        >>> sum(value for key, value in output.items() if key.startswith("loss_")).backward()
        >>> sorted(output.keys())
        ['loss_idm', 'loss_pred']
    """

    out_keys = ["loss_pred", "loss_sigreg", "loss_idm"]
    _networks = ("encoder", "predictor", "inverse_model")
    _schedulable_buffers = frozenset({"idm_coeff"})

    def __init__(
        self,
        encoder: TensorDictModule,
        predictor: TensorDictModule,
        inverse_model: TensorDictModule,
        *,
        sigreg: SIGReg | None = None,
        sigreg_coeff: float = 0.09,
        idm_coeff: float = 1.0,
        reduction: Reduction = "mean",
        num_frames: int | None = None,
        prediction_steps: int = 1,
    ) -> None:
        super().__init__(
            encoder,
            predictor,
            sigreg=sigreg,
            sigreg_coeff=sigreg_coeff,
            reduction=reduction,
            num_frames=num_frames,
            prediction_steps=prediction_steps,
            inverse_model=inverse_model,
        )
        self._register_coefficients(idm_coeff=idm_coeff)
        self._compares_clips = sigreg_coeff > 0
        self.out_keys = ["loss_pred", "loss_sigreg", "loss_idm"] if sigreg_coeff > 0 else ["loss_pred", "loss_idm"]

    @takes_clip
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms; see the class."""
        clip = self._read(tensordict)
        latent = self._encode(clip)  # [B, T, D]; gradient for the encoder
        rollout = self._rollout(clip, latent, self.prediction_steps)  # for encoder and predictor
        recovered = self._recover(latent[..., :-1, :], latent[..., 1:, :], self.inverse_model_params)
        terms = {"loss_pred": self._prediction(clip, latent, rollout)}
        if self._compares_clips:
            terms["loss_sigreg"] = self.sigreg_coeff * self._regularizer(clip, latent)
        error = inverse_error(recovered, clip.action).mean(-1)  # [B, T - 1]
        terms["loss_idm"] = self.idm_coeff * self._reduce(error, clip.mask)
        return TensorDict(terms)
