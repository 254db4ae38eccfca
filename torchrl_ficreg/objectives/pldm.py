"""The PLDM objective: prediction held up by variance, covariance, time and an inverse model."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule

from torchrl_ficreg.distributed import gather_clips
from torchrl_ficreg.objectives.base import LatentLoss, Reduction, takes_clip
from torchrl_ficreg.objectives.inverse_terms import inverse_error
from torchrl_ficreg.objectives.terms import hinge_std, off_diagonal_covariance, squared_error


_TERMS = ("loss_pred", "loss_var", "loss_cov", "loss_time_sim", "loss_time_var", "loss_time_cov", "loss_idm")


class PLDMLoss(LatentLoss):
    r"""Planning with latent dynamics models (arXiv 2502.14819): seven terms, six weights, no SIGReg.

    .. math:: L_{pred} + \alpha L_{var} + \beta L_{cov} + \gamma L_{time-sim} + \zeta L_{time-var}
              + \nu L_{time-cov} + \mu L_{idm}

    ``loss_pred`` is that of LeWorldModel. ``loss_var`` and ``loss_cov`` are VICReg's hinge on the standard deviation
    and penalty on covariances (arXiv 2105.04906) over the batch, at every time step; ``loss_time_var`` and
    ``loss_time_cov`` the same over the time steps of every clip, from which the mean over the batch is subtracted at every
    time step and no mean over time; ``loss_time_sim`` the squared difference of successive latents; ``loss_idm`` the error
    of an inverse model trained with the encoder. Names and Greek letters are those of appendix C.2 of the LeWorldModel
    paper (arXiv 2603.19312). Normalisation and default weights are those of the published code (stable-worldmodel, the
    baseline of that paper): covariances are squared, as in VICReg, and averaged over the D² - D entries off the diagonal;
    the weights belong to D = 192.

    ====================  =======  =========  =============
    term                  encoder  predictor  inverse model
    ====================  =======  =========  =============
    ``loss_pred``         yes      yes        no
    ``loss_var``          yes      no         no
    ``loss_cov``          yes      no         no
    ``loss_time_sim``     yes      no         no
    ``loss_time_var``     yes      no         no
    ``loss_time_cov``     yes      no         no
    ``loss_idm``          yes      no         yes
    ====================  =======  =========  =============

    The clip is that of :class:`~torchrl_ficreg.LeWMLoss`. Masks apply to the terms on transitions (``loss_pred``,
    ``loss_time_sim``, ``loss_idm``); the statistics see every frame. A term with weight 0 at construction is not
    computed, whatever its weight becomes later.

    On several processes (``torch.distributed`` initialised), with equal shares of the clips, variance and covariance over
    the batch are those of the global batch. Gradients follow the convention of :class:`~torchrl_ficreg.SIGReg`.

    Args:
        encoder, predictor: see :class:`~torchrl_ficreg.LeWMLoss`.
        inverse_model: see :class:`~torchrl_ficreg.FICRegLoss`; used where ``idm_coeff`` is positive.
        var_coeff: alpha, of the variance over the batch.
        cov_coeff: beta, of the covariance over the batch.
        time_sim_coeff: gamma, of temporal similarity.
        time_var_coeff: zeta, of the variance over time; needs clips of 2 frames or more.
        time_cov_coeff: nu, of the covariance over time.
        idm_coeff: mu, of the inverse model; the published weight is 0.
        std_margin: standard deviation asked for.
        reduction: over transitions; the statistics are one number either way.
        num_frames: see :class:`~torchrl_ficreg.LeWMLoss`.

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
        >>> sum(value for key, value in output.items() if key.startswith("loss_")).backward()
        >>> sorted(output.keys())
        ['loss_cov', 'loss_pred', 'loss_time_sim', 'loss_time_var', 'loss_var']
    """

    out_keys = list(_TERMS)
    _networks = ("encoder", "predictor", "inverse_model")
    _schedulable_buffers = frozenset(
        {"var_coeff", "cov_coeff", "time_sim_coeff", "time_var_coeff", "time_cov_coeff", "idm_coeff"}
    )

    def __init__(
        self,
        encoder: TensorDictModule,
        predictor: TensorDictModule,
        inverse_model: TensorDictModule,
        *,
        var_coeff: float = 18.0,
        cov_coeff: float = 12.0,
        time_sim_coeff: float = 0.2,
        time_var_coeff: float = 0.7,
        time_cov_coeff: float = 0.0,
        idm_coeff: float = 0.0,
        std_margin: float = 1.0,
        reduction: Reduction = "mean",
        num_frames: int | None = None,
    ) -> None:
        super().__init__(
            reduction=reduction,
            num_frames=num_frames,
            encoder=encoder,
            predictor=predictor,
            inverse_model=inverse_model,
        )
        coefficients = {
            "var_coeff": var_coeff,
            "cov_coeff": cov_coeff,
            "time_sim_coeff": time_sim_coeff,
            "time_var_coeff": time_var_coeff,
            "time_cov_coeff": time_cov_coeff,
            "idm_coeff": idm_coeff,
        }
        self._register_coefficients(**coefficients)
        if not std_margin > 0:
            raise ValueError(f"std_margin must be positive, got {std_margin}.")
        self.std_margin = std_margin
        used = {f"loss_{name.removesuffix('_coeff')}" for name, value in coefficients.items() if value > 0}
        self.out_keys = [key for key in _TERMS if key == "loss_pred" or key in used]

    @takes_clip
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms; see the class."""
        clip = self._read(tensordict)
        latent = self._encode(clip.pixels)  # [B, T, D]
        before, after = latent[..., :-1, :], latent[..., 1:, :]
        predicted = self._predict(before, clip.action, self.predictor_params)  # [B, T - 1, D]
        over_batch = gather_clips(latent.flatten(0, -3).transpose(0, 1), dim=1)  # [T, B of all processes, D]
        if over_batch.shape[1] < 2:
            raise ValueError("variance and covariance over the batch need at least 2 clips, got 1: use a larger batch.")
        centred = latent - over_batch.mean(1)  # [B, T, D], without the mean of every time step
        pairs = max(latent.shape[-1] - 1, 1)  # entries off the diagonal for each of the D that VICReg divides by
        compute = {
            "loss_var": lambda: hinge_std(over_batch, -2, self.std_margin).mean(),
            "loss_cov": lambda: off_diagonal_covariance(over_batch).mean() / pairs,
            "loss_time_sim": lambda: self._reduce(squared_error(before, after).mean(-1), clip.mask),
            "loss_time_var": lambda: hinge_std(centred, -2, self.std_margin).mean(),
            "loss_time_cov": lambda: off_diagonal_covariance(centred, centre=False).mean() / pairs,
            "loss_idm": lambda: self._reduce(
                inverse_error(self._recover(before, after, self.inverse_model_params), clip.action).mean(-1), clip.mask
            ),
        }
        terms = {"loss_pred": self._reduce(squared_error(predicted, after).mean(-1), clip.mask)}
        for key in self.out_keys[1:]:
            weight: torch.Tensor = getattr(self, key.replace("loss_", "") + "_coeff")
            terms[key] = weight * compute[key]()
        return TensorDict(terms)
