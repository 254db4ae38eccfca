"""The PLDM loss: prediction, variance, covariance, temporal similarity, and an inverse model."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule

from torchrl_ficreg.distributed import all_gather
from torchrl_ficreg.objectives.base import Clip, LatentLoss, Reduction, takes_clip, zero_term
from torchrl_ficreg.objectives.inverse_terms import inverse_error
from torchrl_ficreg.objectives.terms import hinge_std, off_diagonal_covariance, squared_error


_TERMS = ("loss_pred", "loss_var", "loss_cov", "loss_time_sim", "loss_time_var", "loss_time_cov", "loss_idm")


class PLDMLoss(LatentLoss):
    r"""Planning with latent dynamics models (arXiv 2502.14819): seven terms, six weights, no SIGReg.

    .. math:: L_{pred} + \alpha L_{var} + \beta L_{cov} + \gamma L_{time-sim} + \zeta L_{time-var}
              + \nu L_{time-cov} + \mu L_{idm}

    - ``loss_pred`` is that of LeWorldModel.
    - ``loss_var`` and ``loss_cov`` are VICReg's hinge on the standard deviation and penalty on covariances (arXiv 2105.04906)
      over the batch, at each time step.
    - ``loss_time_var`` and ``loss_time_cov`` are the same over the time steps of each clip. From the latents the mean over the
      batch is subtracted at each time step, and no mean over time.
    - ``loss_time_sim`` is the squared difference of successive latents.
    - ``loss_idm`` is the error of an inverse model trained with the encoder.

    Names and Greek letters are those of appendix C.2 of the LeWorldModel paper (arXiv 2603.19312). Normalisation and default
    weights are those of the published code (stable-worldmodel, the baseline of that paper): covariances are squared, as in
    VICReg, and averaged over the D² - D entries off the diagonal. The weights are tuned for D = 192.

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

    Reads the clip of :class:`~torchrl_ficreg.LeWMLoss`; writes the seven terms, already weighted. Masks apply to the terms on
    transitions (``loss_pred``, ``loss_time_sim``, ``loss_idm``); the statistics are those of all frames. A term with weight 0
    at construction is neither computed nor written, whatever its weight becomes later. Where the clip holds ``latent`` in
    place of ``pixels``, the five terms on latents alone are zero.

    On several ranks of a process group, with equal local batches, variance and covariance over the batch are those of the
    global batch. Gradients follow the convention of :class:`~torchrl_ficreg.SIGReg`.

    Args:
        encoder (TensorDictModule): see :class:`~torchrl_ficreg.LeWMLoss`.
        predictor (TensorDictModule): see :class:`~torchrl_ficreg.LeWMLoss`.
        inverse_model (TensorDictModule): see :class:`~torchrl_ficreg.FICRegLoss`; used where ``idm_coeff`` is positive.
        var_coeff (float, optional): alpha, of the variance over the batch. Default: ``18.0``.
        cov_coeff (float, optional): beta, of the covariance over the batch. Default: ``12.0``.
        time_sim_coeff (float, optional): gamma, of temporal similarity. Default: ``0.2``.
        time_var_coeff (float, optional): zeta, of the variance over time. Default: ``0.7``.
        time_cov_coeff (float, optional): nu, of the covariance over time. Default: ``0.0``.
        idm_coeff (float, optional): mu, of the inverse model. Default: ``0.0``, as published.
        std_margin (float, optional): standard deviation below which a dimension is penalised. Default: ``1.0``.
        reduction ("mean", "sum" or "none", optional): over transitions; the statistics are [] in any case. Default: ``"mean"``.
        num_frames (int, optional): see :class:`~torchrl_ficreg.LeWMLoss`. Default: ``None``.
        prediction_steps (int, optional): see :class:`~torchrl_ficreg.LeWMLoss`. Default: ``1``.

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
        prediction_steps: int = 1,
    ) -> None:
        super().__init__(
            reduction=reduction,
            num_frames=num_frames,
            prediction_steps=prediction_steps,
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
        latent = self._encode(clip)  # [B, T, D]; gradient for the encoder
        before, after = latent[..., :-1, :], latent[..., 1:, :]
        rollout = self._rollout(clip, latent, self.prediction_steps)  # for encoder and predictor
        compute = self._latent_terms(clip, latent, before, after)
        compute["loss_idm"] = lambda: self._reduce(
            inverse_error(self._recover(before, after, self.inverse_model_params), clip.action).mean(-1), clip.mask
        )
        terms = {"loss_pred": self._prediction(clip, latent, rollout)}
        for key in self.out_keys[1:]:
            weight: torch.Tensor = getattr(self, key.replace("loss_", "") + "_coeff")
            terms[key] = weight * compute[key]()
        return TensorDict(terms)

    def _latent_terms(
        self, clip: Clip, latent: torch.Tensor, before: torch.Tensor, after: torch.Tensor
    ) -> dict[str, Callable[[], torch.Tensor]]:
        """The terms on latents alone (encoder only), computed when called; zero where latents were given.

        Args:
            clip (Clip): the clip.
            latent (torch.Tensor): [B, T, D].
            before (torch.Tensor): [B, T - 1, D], all latents but the last.
            after (torch.Tensor): [B, T - 1, D], all latents but the first.
        """
        if clip.latent is not None:
            zero = zero_term(latent)
            terms = dict.fromkeys(("loss_var", "loss_cov", "loss_time_var", "loss_time_cov"), lambda: zero)
            return terms | {"loss_time_sim": lambda: self._reduce(zero.expand(clip.action.shape[:-1]), clip.mask)}
        over_batch = all_gather(latent.flatten(0, -3).transpose(0, 1), dim=1)  # [T, B of all ranks, D]
        if over_batch.shape[1] < 2:
            raise ValueError("variance and covariance over the batch need at least 2 clips, got 1: use a larger batch.")
        centred = latent - over_batch.mean(1)  # [B, T, D], without the mean of every time step
        pairs = max(latent.shape[-1] - 1, 1)  # entries off the diagonal for each of the D that VICReg divides by
        return {
            "loss_var": lambda: hinge_std(over_batch, -2, self.std_margin).mean(),
            "loss_cov": lambda: off_diagonal_covariance(over_batch).mean() / pairs,
            "loss_time_sim": lambda: self._reduce(squared_error(before, after).mean(-1), clip.mask),
            "loss_time_var": lambda: hinge_std(centred, -2, self.std_margin).mean(),
            "loss_time_cov": lambda: off_diagonal_covariance(centred, centre=False).mean() / pairs,
        }
