"""The PLDM objective: prediction held up by variance, covariance, time and an inverse model."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch, TensorDictModule

from torchrl_ficreg.objectives.base import LatentLoss, Reduction
from torchrl_ficreg.objectives.judge import inverse_error
from torchrl_ficreg.objectives.terms import hinge_std, off_diagonal_covariance, squared_error


_TERMS = ("loss_pred", "loss_std", "loss_cov", "loss_sim_t", "loss_std_t", "loss_cov_t", "loss_idm")


class PLDMLoss(LatentLoss):
    r"""Planning with latent dynamics models (arXiv 2502.14819): seven terms, six weights, no SIGReg.

    .. math:: L_{pred} + \alpha L_{std} + \beta L_{cov} + \delta L_{sim,t} + \alpha_t L_{std,t} + \beta_t L_{cov,t}
              + \omega L_{idm}

    ``loss_pred`` is that of LeWorldModel. ``loss_std`` and ``loss_cov`` are VICReg's hinge on the standard deviation
    and penalty on covariances (arXiv 2105.04906) over the batch, at every time step; ``loss_std_t`` and
    ``loss_cov_t`` the same over the time steps of every clip; ``loss_sim_t`` the squared difference of successive
    latents; ``loss_idm`` the error of an inverse model trained with the encoder. Greek letters of the first four
    weights as in stable-worldmodel's description of PLDM.

    ====================  =======  =========  =============
    term                  encoder  predictor  inverse model
    ====================  =======  =========  =============
    ``loss_pred``         yes      yes        no
    ``loss_std``          yes      no         no
    ``loss_cov``          yes      no         no
    ``loss_sim_t``        yes      no         no
    ``loss_std_t``        yes      no         no
    ``loss_cov_t``        yes      no         no
    ``loss_idm``          yes      no         yes
    ====================  =======  =========  =============

    The clip is that of :class:`~torchrl_ficreg.LeWMLoss`. Masks apply to the terms on transitions (``loss_pred``,
    ``loss_sim_t``, ``loss_idm``); the statistics see every frame. A term with weight 0 at construction is not computed.

    Args:
        encoder, predictor: see :class:`~torchrl_ficreg.LeWMLoss`.
        inverse_model: see :class:`~torchrl_ficreg.FICRegLoss`.
        std_coeff: alpha, of the variance over the batch.
        cov_coeff: beta, of the covariance over the batch.
        sim_t_coeff: delta, of temporal similarity.
        std_t_coeff: alpha_t, of the variance over time; needs clips of 2 frames or more.
        cov_t_coeff: beta_t, of the covariance over time.
        idm_coeff: omega, of the inverse model.
        std_margin: standard deviation asked for.
        reduction: over transitions; the statistics are one number either way.

    Raises:
        KeyError, ValueError, TypeError: see :class:`~torchrl_ficreg.LeWMLoss`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import ModelConfig, PLDMLoss, make_world_model
        >>> model, inverse_model = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> loss = PLDMLoss(model.encoder, model.predictor, inverse_model)
        >>> pixels = torch.randint(0, 256, (8, 2, 3, 64, 64), dtype=torch.uint8)
        >>> output = loss(TensorDict({"pixels": pixels, "action": torch.randn(8, 2, 10)}, [8, 2]))
        >>> sum(output.values()).backward()
        >>> sorted(output.keys())
        ['loss_cov', 'loss_idm', 'loss_pred', 'loss_sim_t', 'loss_std', 'loss_std_t']
    """

    out_keys = list(_TERMS)
    _networks = ("encoder", "predictor", "inverse_model")
    _schedulable_buffers = frozenset(
        {"std_coeff", "cov_coeff", "sim_t_coeff", "std_t_coeff", "cov_t_coeff", "idm_coeff"}
    )

    def __init__(
        self,
        encoder: TensorDictModule,
        predictor: TensorDictModule,
        inverse_model: TensorDictModule,
        *,
        std_coeff: float = 1.0,
        cov_coeff: float = 1.0,
        sim_t_coeff: float = 1.0,
        std_t_coeff: float = 1.0,
        cov_t_coeff: float = 0.0,
        idm_coeff: float = 1.0,
        std_margin: float = 1.0,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__(reduction=reduction, encoder=encoder, predictor=predictor, inverse_model=inverse_model)
        coefficients = {
            "std_coeff": std_coeff,
            "cov_coeff": cov_coeff,
            "sim_t_coeff": sim_t_coeff,
            "std_t_coeff": std_t_coeff,
            "cov_t_coeff": cov_t_coeff,
            "idm_coeff": idm_coeff,
        }
        self._register_coefficients(**coefficients)
        if not std_margin > 0:
            raise ValueError(f"std_margin must be positive, got {std_margin}.")
        self.std_margin = std_margin
        used = {f"loss_{name.removesuffix('_coeff')}" for name, value in coefficients.items() if value > 0}
        self.out_keys = [key for key in _TERMS if key == "loss_pred" or key in used]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms; see the class."""
        clip = self._read(tensordict)
        latent = self._encode(clip.pixels)  # [B, T, D]
        before, after = latent[..., :-1, :], latent[..., 1:, :]
        predicted = self._predict(before, clip.action, self.predictor_params)  # [B, T - 1, D]
        over_batch = latent.flatten(0, -3).transpose(0, 1)  # [T, B, D]
        if over_batch.shape[1] < 2:
            raise ValueError("variance and covariance over the batch need at least 2 clips, got 1: use a larger batch.")
        compute = {
            "loss_std": lambda: hinge_std(over_batch, -2, self.std_margin).mean(),
            "loss_cov": lambda: off_diagonal_covariance(over_batch).mean(),
            "loss_sim_t": lambda: self._reduce(squared_error(before, after).mean(-1), clip.mask),
            "loss_std_t": lambda: hinge_std(latent, -2, self.std_margin).mean(),
            "loss_cov_t": lambda: off_diagonal_covariance(latent).mean(),
            "loss_idm": lambda: self._reduce(
                inverse_error(self._recover(before, after, self.inverse_model_params), clip.action).mean(-1), clip.mask
            ),
        }
        terms = {"loss_pred": self._reduce(squared_error(predicted, after).mean(-1), clip.mask)}
        for key in self.out_keys[1:]:
            weight: torch.Tensor = getattr(self, key.replace("loss_", "") + "_coeff")
            terms[key] = weight * compute[key]()
        return TensorDict(terms)
