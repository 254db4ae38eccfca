"""The LeWorldModel loss: prediction of the next latent, and SIGReg."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule

from torchrl_ficreg.objectives.base import Clip, LatentLoss, Reduction, takes_clip, zero_term
from torchrl_ficreg.objectives.sigreg import SIGReg


class LeWMLoss(LatentLoss):
    r"""LeWorldModel: end-to-end latent prediction with a Gaussian regularizer (arXiv 2603.19312).

    .. math:: \|g_\phi(z_{1:t}, a_t) - z_{t+1}\|^2 + \lambda \, \mathrm{SIGReg}(Z), \qquad z = f_\theta(o)

    No stop-gradient: the target trains the encoder too.

    ====================  =======  =========
    term                  encoder  predictor
    ====================  =======  =========
    ``loss_pred``         yes      yes
    ``loss_sigreg``       yes      no
    ====================  =======  =========

    With ``prediction_steps`` = k, predictions are up to k steps deep. A rollout starts from every frame s, as in planning: its
    context are the real latents up to s, then it is fed with its own predictions, and the predictor reads the last H of both, H
    its attribute ``history`` (all, if it has none). With :math:`\hat z^{(d)}_t` the prediction of latent t, d steps deep, from
    s = t - d,

    .. math:: L_{pred} = \frac{1}{T - 1} \sum_{t=1}^{T-1} \frac{1}{\min(k, t)} \sum_{d=1}^{\min(k, t)}
              \|\hat z^{(d)}_t - z_t\|^2

    (means over dimensions). The table holds for every depth: gradient flows through all d steps to the predictor
    (backpropagation through time), and to the encoder through the context and the target. With a mask, a prediction counts if
    all transitions from s to t do, and the inner mean is over those. Clips need k + 1 frames; with H + k, a rollout of k steps starts from a
    whole history. They may be longer than H + 1 frames for any k.

    In train mode, BatchNorm layers of the predictor normalise by the batch at depth 1, where their running statistics move, and
    by the running statistics at greater depth, as in planning. Normalised by the batch, a shift or a scale that all deep
    predictions share would not reach the loss.

    Reads a clip [B, T]:

    - ``pixels`` [B, T, 3, H, W];
    - ``action`` [B, T, F * A], z-scored blocks; block k leads from frame k to k + 1, the last one is not used;
    - ``mask`` [B, T] or [B, T, 1] bool, optional: where false, the transition, its action and the frame it leads to are left
      out of every term. That frame still counts in the statistics of BatchNorm layers;
    - or, in place of ``pixels``, ``latent`` [B, T, D] of a frozen encoder. The encoder is then not called and receives no
      gradient, and ``loss_sigreg`` is zero: see :class:`~torchrl_ficreg.objectives.base.LatentLoss`.

    Two other layouts of TorchRL are read as clips: flat slices [B * T], given ``num_frames``, and transitions [B] with
    ``("next", "pixels")`` or ``("next", "latent")``, which are clips of two frames. By keyword:
    ``loss(pixels=, action=, mask=, next_pixels=, latent=, next_latent=)``. ``in_keys`` lists ``pixels`` and ``action`` only:
    where entries are selected by it, add the mask.

    Networks are fed by the names of their ``in_keys``, in any order: ``latent`` or the output of the encoder, ``action``,
    and for an inverse model ``next_latent`` or ``("next", "latent")``. The last part of a nested key counts, and so do the
    names of :meth:`set_keys`. Keys of other names are fed by position, in the order of the arguments below.

    Writes a new tensordict: ``loss_pred`` and ``loss_sigreg``, already weighted. The sum of all entries that begin with
    ``loss_`` is the objective.

    To call it with other parameters, use ``with TensorDict(params).unflatten_keys(".").to_module(loss)``, where ``params``
    holds all names of ``loss.named_parameters()``. :func:`torch.func.functional_call` raises an error, as it does not replace
    them. :func:`torch.vmap` over data needs ``eval()`` where networks hold BatchNorm or dropout, as for any module;
    values are not checked there.

    Args:
        encoder (TensorDictModule): reads ``pixels``, writes ``latent`` [..., D].
        predictor (TensorDictModule): reads ``latent`` and ``action``, writes ``predicted_latent``.
        sigreg (SIGReg, optional): the regularizer. Default: ``None``, a new :class:`SIGReg`.
        sigreg_coeff (float, optional): lambda, tuned for a batch of 128 clips. Default: ``0.09``.
        reduction ("mean", "sum" or "none", optional): over transitions; the regularizer is [] in any case. Default: ``"mean"``.
        num_frames (int, optional): T of flat slices [B * T], as a ``SliceSampler`` samples them. Default: ``None``, clips are
            [B, T].
        prediction_steps (int, optional): k, depth of the deepest rollouts, see above. Default: ``1``, the paper.
        **networks (TensorDictModule): further networks of a subclass.

    Raises:
        KeyError: the clip lacks a key.
        ValueError: an unknown reduction, a negative coefficient, ``prediction_steps`` below 1, networks whose inputs cannot be
            told apart, a clip of fewer than ``prediction_steps`` + 1 frames, a batch of one clip, clips that go on after
            ``("next", "done")``, or widths that do not fit the networks.
        TypeError: pixels that are neither uint8 nor floating, a plain dict instead of a tensordict, or a network that is no
            TensorDictModule.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import LeWMLoss, ModelConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> loss = LeWMLoss(model.encoder, model.predictor)
        >>> pixels = torch.randint(0, 256, (8, 2, 3, 64, 64), dtype=torch.uint8)
        >>> output = loss(TensorDict({"pixels": pixels, "action": torch.randn(8, 2, 10)}, [8, 2]))
        >>> sum(value for key, value in output.items() if key.startswith("loss_")).backward()
        >>> sorted(output.keys())
        ['loss_pred', 'loss_sigreg']
    """

    out_keys = ["loss_pred", "loss_sigreg"]
    _networks = ("encoder", "predictor")
    _compares_clips = True
    _schedulable_buffers = frozenset({"sigreg_coeff"})

    def __init__(
        self,
        encoder: TensorDictModule,
        predictor: TensorDictModule,
        *,
        sigreg: SIGReg | None = None,
        sigreg_coeff: float = 0.09,
        reduction: Reduction = "mean",
        num_frames: int | None = None,
        prediction_steps: int = 1,
        **networks: TensorDictModule,
    ) -> None:
        super().__init__(
            reduction=reduction,
            num_frames=num_frames,
            prediction_steps=prediction_steps,
            encoder=encoder,
            predictor=predictor,
            **networks,
        )
        self.sigreg = SIGReg() if sigreg is None else sigreg
        self._register_coefficients(sigreg_coeff=sigreg_coeff)

    @takes_clip
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms; see the class."""
        clip = self._read(tensordict)
        latent = self._encode(clip)  # [B, T, D]; gradient for the encoder
        rollout = self._rollout(clip, latent, self.prediction_steps)  # gradient for both
        return TensorDict(self._baseline_terms(clip, latent, rollout))

    def _baseline_terms(
        self, clip: Clip, latent: torch.Tensor, rollout: list[torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        """``loss_pred`` (gradient for encoder and predictor) and ``loss_sigreg`` (for the encoder only)."""
        return {
            "loss_pred": self._prediction(clip, latent, rollout),
            "loss_sigreg": self.sigreg_coeff * self._regularizer(clip, latent),
        }

    def _regularizer(self, clip: Clip, latent: torch.Tensor) -> torch.Tensor:
        """The regularizer [] on the unmasked latents [B, T, D]; zero, without a draw, where they were given."""
        if clip.latent is not None:
            return zero_term(latent)
        mask = clip.frame_mask  # [B, T] or None
        mask = mask if mask is None else mask.flatten(0, -2).transpose(0, 1)  # [T, B]
        return self.sigreg(latent.flatten(0, -3).transpose(0, 1), mask)  # [T, B, D]
