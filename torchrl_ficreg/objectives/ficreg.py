"""The FICReg loss: consistency of imagined transitions with a frozen inverse dynamics model."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule

from torchrl_ficreg.distributed import all_gather
from torchrl_ficreg.objectives.base import (
    check_steps,
    Clip,
    mean_over_depths,
    Reduction,
    takes_clip,
    with_own_buffers,
)
from torchrl_ficreg.objectives.inverse_terms import (
    inverse_error,
    inverse_model_r2,
    masked_mean,
    Recovered,
    reliability_weight,
)
from torchrl_ficreg.objectives.lewm import LeWMLoss
from torchrl_ficreg.objectives.sigreg import SIGReg
from torchrl_ficreg.objectives.terms import gaussian_nll, squared_error


class FICRegLoss(LeWMLoss):
    r"""Forward-inverse consistency regularisation on top of :class:`LeWMLoss`.

    .. math:: L_{LeWM} + \mu \|h_\psi(\bar z_t, \bar z_{t+1}) - a_t\|^2
              + \gamma \|h_{\bar\psi}(\bar z_t, \hat z_{t+1}) - a_t\|^2

    A bar stands for a detached tensor or frozen weights. The inverse dynamics model h learns to recover the action from real
    transitions. The consistency term asks that the frozen inverse model recover the same action from imagined transitions.

    Which network receives gradient:

    ====================  =======  =========  =============
    term                  encoder  predictor  inverse model
    ====================  =======  =========  =============
    ``loss_pred``         yes      yes        no
    ``loss_sigreg``       yes      no         no
    ``loss_idm``          no       no         yes
    ``loss_consistency``  no       yes        no
    ====================  =======  =========  =============

    Algorithm 1 of the paper, taken literally, does not keep the last row: its one prediction is made from live latents, so that
    the consistency term reaches the encoder through the input of the predictor. ``context="detached"`` keeps the table
    exactly, by a second prediction from detached latents; ``context="live"`` is Algorithm 1 and the authors' code.

    Reads the clip of :class:`LeWMLoss`. Writes ``loss_pred``, ``loss_sigreg``, ``loss_idm`` and ``loss_consistency``, already
    weighted. All random draws of the baseline terms come first, so that under one seed the gradient of the encoder is
    bit-identical to that of :class:`LeWMLoss`.

    The arguments from ``prediction_steps`` on go beyond the paper; their defaults are the paper.

    Args:
        encoder (TensorDictModule): see :class:`LeWMLoss`.
        predictor (TensorDictModule): see :class:`LeWMLoss`.
        inverse_model (TensorDictModule): reads two latents [..., D], writes the action block between them [..., F * A] and,
            optionally, its log-variance or the variance of an ensemble; see :class:`~torchrl_ficreg.InverseDynamicsModel`.
        sigreg (SIGReg, optional): see :class:`LeWMLoss`. Default: ``None``.
        sigreg_coeff (float, optional): lambda, see :class:`LeWMLoss`. Default: ``0.09``.
        idm_coeff (float, optional): mu, weight of the training error of the inverse model. Default: ``0.1``.
        consistency_coeff (float, optional): gamma, weight of the consistency term. Default: ``0.1``.
        context ("detached" or "live", optional): input latents of the prediction, see above. Default: ``"detached"``.
        reduction ("mean", "sum" or "none", optional): see :class:`LeWMLoss`. Default: ``"mean"``.
        num_frames (int, optional): see :class:`LeWMLoss`. Default: ``None``.
        prediction_steps (int, optional): see :class:`LeWMLoss`. Default: ``1``.
        consistency ("mse", "nll" or "trusted", optional): ``"mse"``, the squared error; ``"nll"``, the negative
            log-likelihood under a Gaussian inverse model; ``"trusted"``, the squared error weighted, for each sample and
            action dimension, by :func:`~torchrl_ficreg.objectives.inverse_terms.reliability_weight` of the real transition of
            the same clip. Default: ``"mse"``.
        consistency_target ("action" or "judge", optional): ``"action"``, the one taken; ``"judge"``, the one that the
            inverse model recovers from the *real* transition, so that predictions are not rewarded for holding more of the
            action than real latents do, as at walls and contacts. Default: ``"action"``.
        consistency_steps (int, optional): k; the term also covers the last transition of rollouts 2 to k steps deep. They are
            the rollouts of ``prediction_steps``, with the same mean over depths, from detached latents unless
            ``context="live"``. Default: ``1``.
        diagnostics (bool, optional): also write, detached, the results of
            :func:`~torchrl_ficreg.objectives.inverse_terms.inverse_model_r2` and ``judge_trust``, the mean reliability
            weight, each [F * A]. Default: ``False``.

    Raises:
        KeyError, ValueError, TypeError: see :class:`LeWMLoss`; ValueError also for an unknown choice, for ``"nll"`` without a
            Gaussian inverse model, and for clips of fewer than ``consistency_steps`` + 1 frames.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import FICRegLoss, ModelConfig, make_world_model
        >>> model, inverse_model = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> loss = FICRegLoss(model.encoder, model.predictor, inverse_model)
        >>> pixels = torch.randint(0, 256, (8, 2, 3, 64, 64), dtype=torch.uint8)
        >>> output = loss(TensorDict({"pixels": pixels, "action": torch.randn(8, 2, 10)}, [8, 2]))
        >>> sum(value for key, value in output.items() if key.startswith("loss_")).backward()
        >>> sorted(output.keys())
        ['loss_consistency', 'loss_idm', 'loss_pred', 'loss_sigreg']
    """

    out_keys = ["loss_pred", "loss_sigreg", "loss_idm", "loss_consistency"]
    _networks = ("encoder", "predictor", "inverse_model")
    _schedulable_buffers = frozenset({"idm_coeff", "consistency_coeff"})

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
        reduction: Reduction = "mean",
        num_frames: int | None = None,
        prediction_steps: int = 1,
        consistency: Literal["mse", "nll", "trusted"] = "mse",
        consistency_target: Literal["action", "judge"] = "action",
        consistency_steps: int = 1,
        diagnostics: bool = False,
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
        self._register_coefficients(idm_coeff=idm_coeff, consistency_coeff=consistency_coeff)
        _check_choice("context", context, ("detached", "live"))
        _check_choice("consistency", consistency, ("mse", "nll", "trusted"))
        _check_choice("consistency_target", consistency_target, ("action", "judge"))
        check_steps("consistency_steps", consistency_steps)
        if consistency == "nll" and len(inverse_model.out_keys) < 2:
            raise self._no_likelihood()
        self.context, self.consistency, self.consistency_target = context, consistency, consistency_target
        self.consistency_steps, self.diagnostics = consistency_steps, diagnostics
        if diagnostics:
            self.out_keys = [*self.out_keys, "judge_r2_real", "judge_r2_imagined", "judge_r2_shuffled", "judge_trust"]

    @takes_clip
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms; see the class."""
        clip = self._read(tensordict)
        self._check_depth(clip, "consistency_steps")
        latent = self._encode(clip)  # [B, T, D]; gradient for the encoder
        shares = self.context == "live" or clip.latent is not None  # given latents are detached already
        depth = max(self.prediction_steps, self.consistency_steps if shares else 1)
        rollout = self._rollout(clip, latent, depth)  # T - d predictions of every depth d; for encoder and predictor
        terms = self._baseline_terms(clip, latent, rollout[: self.prediction_steps])
        real = latent.detach()  # no gradient for the encoder from here on, but through the rollout in a live context
        recovered = self._recover(real[..., :-1, :], real[..., 1:, :], self.inverse_model_params)  # for the inverse model
        error = inverse_error(recovered, clip.action).mean(-1)  # [B, T - 1]
        terms["loss_idm"] = self.idm_coeff * self._reduce(error, clip.mask)
        if not shares:
            # With its own buffers: BatchNorm statistics move once a step.
            rollout = self._rollout(clip, real, self.consistency_steps, with_own_buffers(self.predictor_params))
        terms |= self._consistency_terms(clip, real, rollout, recovered.action.detach())
        return TensorDict(terms)

    def _consistency_terms(
        self, clip: Clip, real: torch.Tensor, rollout: list[torch.Tensor], recovered: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """``loss_consistency`` (gradient for the predictor only) and the detached diagnostics.

        Args:
            clip (Clip): the clip.
            real (torch.Tensor): [B, T, D], detached latents.
            rollout (list of torch.Tensor): predictions, from detached latents unless in a live context; see :meth:`_rollout`.
            recovered (torch.Tensor): [B, T - 1, F * A], detached actions recovered from real transitions.
        """
        # With its own buffers: BatchNorm statistics move once a step, by real transitions alone.
        frozen = with_own_buffers(self.inverse_model_params).detach()
        target = clip.action if self.consistency_target == "action" else recovered
        weight = self._weight(recovered, clip.action)
        errors, imagined_actions = [], []
        before = real
        for depth, predicted in enumerate(rollout[: self.consistency_steps]):  # [B, T - 1 - depth, D]
            imagined = self._recover(before[..., :-1, :], predicted, frozen)  # [B, T - 1 - depth, F * A]
            error = self._consistency_error(imagined, target[..., depth:, :], weight[..., depth:, :])
            errors.append(error.mean(-1))
            imagined_actions.append(imagined.action)
            before = predicted.detach()
        error = mean_over_depths(errors, clip.mask)  # [B, T - 1]
        terms = {"loss_consistency": self.consistency_coeff * self._reduce(error, clip.mask)}
        if self.diagnostics:
            terms |= inverse_model_r2(recovered, imagined_actions[0], clip.action, clip.mask)
            mask = None if clip.mask is None else all_gather(clip.mask.flatten())  # [N of all ranks]
            terms["judge_trust"] = masked_mean(all_gather(weight.detach().float().flatten(0, -2)), mask)
        return terms

    def _weight(self, recovered: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Weight of every transition, [B, T - 1, F * A]; ones unless ``consistency="trusted"``."""
        if self.consistency != "trusted":
            return torch.ones_like(action)
        return reliability_weight(squared_error(recovered, action)).to(action.dtype)

    def _consistency_error(self, imagined: Recovered, target: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        """[..., F * A]."""
        if self.consistency == "nll":
            if imagined.log_var is None:
                raise self._no_likelihood()
            return gaussian_nll(imagined.action, imagined.log_var, target)
        error = squared_error(imagined.action, target)
        return weight * error if self.consistency == "trusted" else error

    def _no_likelihood(self) -> ValueError:
        return ValueError(
            f"consistency='nll' needs an inverse model that writes {self.tensor_keys.recovered_action_log_var!r}: use "
            "InverseDynamicsModel(kind='gaussian'), or name its output with loss.set_keys(recovered_action_log_var=...)."
        )


def _check_choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"unknown {name} {value!r}: choose one of {', '.join(map(repr, allowed))}.")
