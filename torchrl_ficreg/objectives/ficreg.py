"""The FICReg objective: a frozen inverse dynamics model judges imagined transitions."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule

from torchrl_ficreg.distributed import gather_clips
from torchrl_ficreg.modules.inverse import LOG_VAR
from torchrl_ficreg.objectives.base import Clip, Reduction, takes_clip, with_own_buffers
from torchrl_ficreg.objectives.inverse_terms import inverse_error, judge_report, mean_where, Recovered, trust
from torchrl_ficreg.objectives.lewm import LeWMLoss
from torchrl_ficreg.objectives.sigreg import SIGReg
from torchrl_ficreg.objectives.terms import gaussian_nll, squared_error


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
    by a second prediction from detached latents; ``context="live"`` is Algorithm 1 to the letter, and what the authors' code
    does.

    The clip is that of :class:`LeWMLoss`. All random draws of the baseline terms come first, so that under one seed
    the encoder's gradient equals that of :class:`LeWMLoss` to the last bit.

    The arguments from ``consistency`` on go beyond the paper; their defaults are the paper.

    Args:
        encoder, predictor: see :class:`LeWMLoss`.
        inverse_model: reads two latents [..., D], writes the action block between them [..., F * A] and, where it
            knows, how sure it is; see :class:`~torchrl_ficreg.InverseDynamicsModel`.
        sigreg, sigreg_coeff, reduction, num_frames: see :class:`LeWMLoss`.
        idm_coeff: mu, weight of the inverse model's own loss.
        consistency_coeff: gamma, weight of the judgement on imagined transitions.
        context: ``"detached"`` or ``"live"``, see above.
        consistency: ``"mse"``; ``"nll"``, the likelihood under a Gaussian judge; or ``"trusted"``, the squared error
            weighted, for every sample and action dimension, by how well the judge does on the real transition of the
            same clip (:func:`~torchrl_ficreg.objectives.inverse_terms.trust`): where it cannot tell, it does not push.
        consistency_target: ``"action"``, the one taken, or ``"judge"``, what the judge recovers from the *real*
            transition: predictions are then not rewarded for carrying more of the action than reality does, as at
            walls and contacts.
        consistency_steps: k; also judges imagined transitions 2 to k steps deep, each fed by predictions.
        diagnostics: also write, detached and no part of the objective, ``judge_r2_real``, ``judge_r2_imagined`` and
            ``judge_r2_shuffled`` [F * A] (:func:`~torchrl_ficreg.objectives.inverse_terms.judge_report`) and ``judge_trust``
            [F * A], the mean weight.

    Raises:
        KeyError, ValueError, TypeError: see :class:`LeWMLoss`; ValueError for an unknown choice, for ``"nll"`` without
            a Gaussian judge, and for clips of fewer than ``consistency_steps`` + 1 frames.

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
            inverse_model=inverse_model,
        )
        self._register_coefficients(idm_coeff=idm_coeff, consistency_coeff=consistency_coeff)
        _check("context", context, ("detached", "live"))
        _check("consistency", consistency, ("mse", "nll", "trusted"))
        _check("consistency_target", consistency_target, ("action", "judge"))
        if not (isinstance(consistency_steps, int) and consistency_steps >= 1):
            raise ValueError(f"consistency_steps must be a positive whole number, got {consistency_steps}.")
        if consistency == "nll" and LOG_VAR not in inverse_model.out_keys:
            raise ValueError(
                f"consistency='nll' needs a judge that writes {LOG_VAR!r}: InverseDynamicsModel(kind='gaussian')."
            )
        self.context, self.consistency, self.consistency_target = context, consistency, consistency_target
        self.consistency_steps, self.diagnostics = consistency_steps, diagnostics
        if diagnostics:
            self.out_keys = [*self.out_keys, "judge_r2_real", "judge_r2_imagined", "judge_r2_shuffled", "judge_trust"]

    @takes_clip
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms; see the class."""
        clip = self._read(tensordict)
        latent = self._encode(clip.pixels)  # [B, T, D]
        predicted = self._predict(latent[..., :-1, :], clip.action, self.predictor_params)  # [B, T - 1, D]
        terms = self._baseline_terms(clip, latent, predicted)
        real = latent.detach()  # nothing below reaches the encoder, except predicted in a live context
        recovered = self._recover(real[..., :-1, :], real[..., 1:, :], self.inverse_model_params)
        error = inverse_error(recovered, clip.action).mean(-1)  # [B, T - 1]
        terms["loss_idm"] = self.idm_coeff * self._reduce(error, clip.mask)
        terms |= self._judge(clip, real, predicted, recovered.action.detach())
        return TensorDict(terms)

    def _judge(
        self, clip: Clip, real: torch.Tensor, predicted: torch.Tensor, recovered: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """``loss_consistency`` (predictor only) and, if asked for, the detached report.

        Args:
            clip: the clip.
            real: detached latents [B, T, D].
            predicted: live predictions [B, T - 1, D], used in a live context.
            recovered: detached actions recovered from the real transitions [B, T - 1, F * A].
        """
        # With buffers of its own: BatchNorm statistics of the judge are those of real transitions alone.
        frozen = with_own_buffers(self.inverse_model_params).detach()
        params = with_own_buffers(self.predictor_params)
        if self.context == "detached":
            predicted = self._predict(real[..., :-1, :], clip.action, params)
        target = clip.action if self.consistency_target == "action" else recovered
        weight = self._weight(recovered, clip.action)
        total, count = None, None
        before, mask = real[..., :-1, :], clip.mask  # [B, T - 1, ...]
        verdict = None
        for step in range(self._steps(clip)):
            if step:  # one more step deep, from one frame further on
                before = predicted[..., :-1, :].detach()
                predicted = self._predict(predicted[..., :-1, :], clip.action[..., step:, :], params)
                mask = None if mask is None else mask[..., 1:] & mask[..., :-1]
            judged = self._recover(before, predicted, frozen)  # [B, T - 1 - step, F * A]
            verdict = judged.action if verdict is None else verdict
            error = self._consistency_error(judged, target[..., step:, :], weight[..., step:, :]).mean(-1)
            error, seen = _select(error, mask)
            pad = (step, 0)  # transitions near the start are not reached by deep steps
            error, seen = (torch.nn.functional.pad(value, pad) for value in (error, seen))  # [B, T - 1]
            total, count = (error, seen) if total is None else (total + error, count + seen)
        terms = {"loss_consistency": self.consistency_coeff * self._reduce(total / count.clamp_min(1), clip.mask)}
        if self.diagnostics:
            terms |= judge_report(recovered, verdict, clip.action, clip.mask)
            counted = None if clip.mask is None else gather_clips(clip.mask.flatten())  # [N of all processes]
            terms["judge_trust"] = mean_where(gather_clips(weight.detach().float().flatten(0, -2)), counted)
        return terms

    def _steps(self, clip: Clip) -> int:
        if clip.action.shape[-2] < self.consistency_steps:
            raise ValueError(
                f"consistency_steps={self.consistency_steps} needs clips of {self.consistency_steps + 1} frames, got "
                f"{clip.action.shape[-2] + 1}: sample longer clips (num_frames)."
            )
        return self.consistency_steps

    def _weight(self, recovered: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Weight of the judgement on every transition, [B, T - 1, F * A]; ones unless it is ``"trusted"``."""
        if self.consistency != "trusted":
            return torch.ones_like(action)
        return trust(squared_error(recovered, action)).to(action.dtype)

    def _consistency_error(self, judged: Recovered, target: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        """[..., F * A]."""
        if self.consistency == "nll":
            return gaussian_nll(judged.action, judged.log_var, target)
        error = squared_error(judged.action, target)
        return weight * error if self.consistency == "trusted" else error


def _select(error: torch.Tensor, mask: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Errors with masked ones selected away, and 1 where one counts; both [B, N]."""
    if mask is None:
        return error, torch.ones_like(error)
    return torch.where(mask, error, 0.0), mask.to(error.dtype)


def _check(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"unknown {name} {value!r}: choose one of {', '.join(map(repr, allowed))}.")
