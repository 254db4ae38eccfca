"""Base class of the losses: how a clip becomes loss terms.

With B clips of T frames, latents of D and action blocks of F * A dimensions, every ``forward`` takes these steps::

    step     method      result                                                       gradient
    read     _read       frames [B, T, 3, H, W], action [B, T - 1, F * A],            none
                         mask [B, T - 1]; checked: keys, shapes, dtypes, values
    encode   _encode     latents [B, T, D]                                            encoder
    predict  _rollout    predicted latents [B, T - d, D] of frames d to T - 1, for    predictor, and its input latents
                         every depth d up to prediction_steps
    recover  _recover    recovered actions [B, T - 1, F * A]                          inverse model, and its input latents
    terms    terms.py,   error of each transition [B, T - 1], or a statistic of all   as their inputs
             sigreg.py   latents []
    reduce   _reduce     [], or [B, T - 1] with reduction="none"                      as its input

Detached latents and parameters receive no gradient. A subclass calls the methods, multiplies each term by its coefficient, and
documents which network receives gradient from which term.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import dispatch, TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.objectives.common import LossModule

from torchrl_ficreg._device import in_autocast
from torchrl_ficreg._torchrl_compat import BatchNorm
from torchrl_ficreg.distributed import all_reduce_sum, world_size
from torchrl_ficreg.keys import (
    ACTION,
    LATENT,
    MASK,
    NEXT_LATENT,
    PIXELS,
    PREDICTED_LATENT,
    RECOVERED_ACTION,
    RECOVERED_ACTION_LOG_VAR,
    RECOVERED_ACTION_VARIANCE,
)
from torchrl_ficreg.modules.feed import choose_output, feed, read_output, require_module
from torchrl_ficreg.modules.layers import check_finite, has_values
from torchrl_ficreg.objectives.inverse_terms import Recovered
from torchrl_ficreg.objectives.terms import squared_error

Reduction = Literal["mean", "sum", "none"]

# Decorates ``forward`` of a loss: it takes a tensordict, or its entries by position or by keyword, optional ones included.
takes_clip = dispatch(source="_call_keys")

# Inputs of each network, and the field of _AcceptedKeys that names its output.
_SIGNATURES = {
    "encoder": ((PIXELS,), "latent"),
    "predictor": ((LATENT, ACTION), "predicted_latent"),
    "inverse_model": ((LATENT, NEXT_LATENT), "recovered_action"),
}


class LatentLoss(LossModule):
    """Base of the losses on clips. A subclass writes :meth:`forward` and the table of which network receives gradient.

    Networks are fed by the names of their ``in_keys``: see :func:`~torchrl_ficreg.modules.feed.arrange`. They are
    functional, as in TorchRL's losses: their parameters are children of the loss, the modules are not. Coefficients are
    buffers: assigning ``loss.sigreg_coeff = 0.1`` neither recompiles nor rebuilds anything.

    A clip that holds ``latent`` [B, T, D] and no ``pixels`` is one of a frozen encoder. The encoder is then not called and
    receives no gradient. The given latents are detached, and the terms that depend on latents alone (SIGReg, variance,
    covariance, temporal similarity) are zero, as no parameter could change them; no random direction is drawn for them.

    Args:
        reduction ("mean", "sum" or "none"): over transitions.
        num_frames (int, optional): T of flat slices [B * T]. Default: ``None``, clips are [B, T].
        prediction_steps (int, optional): k, depth of the rollouts of ``loss_pred``; see
            :class:`~torchrl_ficreg.LeWMLoss`. Default: ``1``.
        **networks (TensorDictModule): by name, among ``encoder``, ``predictor`` and ``inverse_model``.

    Raises:
        ValueError: an unknown reduction, ``num_frames`` below 2, ``prediction_steps`` below 1, or a network with another
            number of ``in_keys``.
        TypeError: a network that is no TensorDictModule.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can rename.

        Attributes:
            pixels: of the clip, [B, T, 3, H, W] uint8 or floating.
            action: of the clip, [B, T, F * A], z-scored; also what predictor and inverse model may call it.
            mask: of the clip, [B, T] or [B, T, 1] bool, optional.
            latent: of the clip, [B, T, D] floating, where it holds no ``pixels``; output of the encoder where that has several;
                also what predictor and inverse model may call it.
            predicted_latent: output of the predictor where that has several, [B, T - 1, D].
            recovered_action: output of the inverse model where that has several, [B, T - 1, F * A].
            recovered_action_log_var: optional output of the inverse model, from a Gaussian head.
            recovered_action_variance: optional output of the inverse model, among the members of an ensemble.
        """

        pixels: NestedKey = PIXELS
        action: NestedKey = ACTION
        mask: NestedKey = MASK
        latent: NestedKey = LATENT
        predicted_latent: NestedKey = PREDICTED_LATENT
        recovered_action: NestedKey = RECOVERED_ACTION
        recovered_action_log_var: NestedKey = RECOVERED_ACTION_LOG_VAR
        recovered_action_variance: NestedKey = RECOVERED_ACTION_VARIANCE

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
        self,
        *,
        reduction: Reduction,
        num_frames: int | None = None,
        prediction_steps: int = 1,
        **networks: TensorDictModule,
    ) -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"unknown reduction {reduction!r}: choose 'mean', 'sum' or 'none'.")
        if num_frames is not None and not (isinstance(num_frames, int) and num_frames >= 2):
            raise ValueError(f"num_frames must be a whole number of at least 2 frames, got {num_frames!r}.")
        check_steps("prediction_steps", prediction_steps)
        self.reduction, self.num_frames, self.prediction_steps = reduction, num_frames, prediction_steps
        self._networks = tuple(networks)
        for name, module in networks.items():
            require_module(name, module)
            self.convert_to_functional(module, name)
        for name, module in networks.items():  # by number only: set_keys may still name the inputs
            inputs = _SIGNATURES[name][0]
            if len(module.in_keys) != len(inputs):
                raise ValueError(
                    f"the {name} must read {len(inputs)} entries, it reads {module.in_keys}: wrap it accordingly."
                )
        self._set_in_keys()

    def _register_coefficients(self, **values: float) -> None:
        for name, value in values.items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be finite and not negative, got {value}.")
            self.register_coeff_buffer(name, value)

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        self.in_keys = [keys.pixels, keys.action]
        # in_keys are required entries; a call by keyword accepts the optional ones too, and latents in place of pixels.
        self._call_keys = [*self.in_keys, keys.mask, _next(keys.pixels), keys.latent, _next(keys.latent)]

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
            TypeError: with ``remove_duplicate=False``, as :func:`torch.func.functional_call` passes it: that function
                replaces no parameter of a functional loss.
        """
        if not remove_duplicate:
            raise TypeError(
                "torch.func.functional_call does not reach the parameters of a TorchRL loss: write `with "
                "TensorDict(params).unflatten_keys('.').to_module(loss): loss(clip)` instead."
            )
        return super().named_parameters(prefix, recurse)

    # Steps of a forward pass

    def _read(self, tensordict: TensorDictBase) -> Clip:
        """A clip in the dtype of the networks; raises what :func:`read_clip` does."""
        clip = read_clip(tensordict, self.tensor_keys, self.num_frames)
        self._check_size(clip)
        self._check_depth(clip, "prediction_steps")
        if clip.latent is not None:
            dtype = next((param.dtype for param in self.predictor_params.parameters()), clip.latent.dtype)
            clip = clip._replace(latent=clip.latent.to(dtype))
        if clip.action.dtype == torch.float32:
            return clip
        dtype = next((param.dtype for param in self.parameters()), clip.action.dtype)
        return clip._replace(action=clip.action.to(dtype))  # as frames are

    def _check_size(self, clip: Clip) -> None:
        """Refuses a batch that is too small, with a message in numbers of clips."""
        transitions = clip.action.shape[:-1]  # [..., T - 1]
        clips = math.prod(transitions[:-1])
        if self._compares_clips and clip.latent is None and clips < 2:
            raise ValueError(f"the regularizer compares clips: it needs at least 2 clips, got {clips}: use a larger batch.")
        if self.training and math.prod(transitions) < 2 and world_size() == 1:
            called = [name for name in self._networks if name != "encoder" or clip.latent is None]
            layers = [module for name in called for module in self.__dict__[name].modules()]
            if any(isinstance(layer, BatchNorm) for layer in layers):
                raise ValueError(
                    "BatchNorm in train mode needs at least 2 clips, or one of 3 frames, got 1 transition: use a larger batch."
                )

    def _encode(self, clip: Clip) -> torch.Tensor:
        """Frames [B, T, 3, H, W] -> latents [B, T, D], with gradient for the encoder; given latents as they are."""
        return self._run_encoder(clip.pixels, self.encoder_params) if clip.latent is None else clip.latent

    def _run_encoder(self, pixels: torch.Tensor, params: TensorDictBase) -> torch.Tensor:
        latent, _ = self._run("encoder", params, pixels)
        if latent.shape[:-1] != pixels.shape[:-3]:
            raise ValueError(
                f"the encoder must map pixels [B, T, 3, H, W] to latents [B, T, D], got {list(pixels.shape)} to "
                f"{list(latent.shape)}."
            )
        return latent

    def _check_depth(self, clip: Clip, name: str) -> None:
        """Refuses clips that are too short for the depth that an attribute of the loss gives."""
        steps, transitions = getattr(self, name), clip.action.shape[-2]
        if steps > transitions:
            raise ValueError(
                f"{name}={steps} needs clips of {steps + 1} frames, got {transitions + 1}: sample longer clips (num_frames)."
            )

    def _rollout(
        self, clip: Clip, latent: torch.Tensor, steps: int, params: TensorDictBase | None = None
    ) -> list[torch.Tensor]:
        """Predictions 1 to ``steps`` deep from every frame; those of depth d are [B, T - d, D], of frames d to T - 1.

        As in planning, a rollout has a real context, here all frames of the clip up to its start, is fed with its own
        predictions, and the predictor reads the last H of both. See :meth:`~torchrl_ficreg.LatentWorldModel.rollout`.

        Args:
            clip (Clip): the clip.
            latent (torch.Tensor): [B, T, D].
            steps (int): the largest depth.
            params (TensorDictBase, optional): of the predictor, at depth 1. Default: ``None``, those of the loss, so that
                running statistics move. Deeper predictions read these, as plans do, and leave them as they are.
        """
        action, frames = clip.action, latent.unbind(-2)  # T latents [B, D]
        rollout = [self._predict(latent[..., :-1, :], action, self.predictor_params if params is None else params)]
        if steps > 1:
            # Copies, which the next forward pass leaves as they are: the backward pass of this one reads them.
            params = with_own_buffers(self.predictor_params)
            history = self._history("predictor", len(frames) - 1)
            paths = [frames[: start + 1] for start in range(len(frames) - 1)]  # context and predictions of each start
        for depth in range(2, steps + 1):
            paths = [(*path, last) for path, last in zip(paths, rollout[-1].unbind(-2))][: len(frames) - depth]
            # Short windows are filled up with frames that follow: a causal predictor does not see them.
            windows = torch.stack([torch.stack((*path, *frames[len(path) : history])[-history:], -2) for path in paths])
            first = [max(0, len(path) - history) for path in paths]
            blocks = torch.stack([action[..., row : row + history, :] for row in first])  # [T - depth, B, H, F * A]
            with running_statistics(self.__dict__["predictor"]):
                predicted = self._predict(windows.flatten(0, -3), blocks.flatten(0, -3), params)  # [(T - depth) * B, H, D]
            ends = [min(len(path), history) - 1 for path in paths]
            rows = predicted.unflatten(0, windows.shape[:-2]).unbind(0)  # T - depth results [B, H, D]
            last = [row[..., end, :] for row, end in zip(rows, ends)]
            rollout.append(torch.stack(last, dim=-2))  # [B, T - depth, D]
        return rollout

    def _predict(self, latent: torch.Tensor, action: torch.Tensor, params: TensorDictBase) -> torch.Tensor:
        """Latents and action blocks [..., T, ...] -> next latents [..., T, D], each from the last H latents up to it."""
        if not in_autocast(latent.device):
            action = action.to(latent.dtype)  # networks may compute in another dtype than the data
        length = self._history("predictor", latent.shape[-2])
        inputs = _split(latent, length), _split(action, length)
        return _join(self._run("predictor", params, *inputs)[0], latent.shape[:-1])

    def _history(self, name: str, tokens: int) -> int:
        """How many of so many latents a network reads at once: its attribute ``history`` if it has one, else all."""
        history = getattr(self.__dict__[name], "history", None)
        return tokens if history is None else min(history, tokens)

    def _recover(self, latent: torch.Tensor, next_latent: torch.Tensor, params: TensorDictBase) -> Recovered:
        """Latents and next latents [B, T - 1, D] -> the actions between them by the inverse model, [B, T - 1, F * A]."""
        length = self._history("inverse_model", latent.shape[-2])
        inputs = _split(latent, length), _split(next_latent, length)
        action, written = self._run("inverse_model", params, *inputs)
        log_var = written.get(self.tensor_keys.recovered_action_log_var, None)
        outputs = (action, log_var, written.get(self.tensor_keys.recovered_action_variance, None))
        return Recovered(*(value if value is None else _join(value, latent.shape[:-1]) for value in outputs))

    def _prediction(self, clip: Clip, latent: torch.Tensor, rollout: list[torch.Tensor]) -> torch.Tensor:
        """Error of the predictions of :meth:`_rollout`, reduced; the error of a transition is its mean over depths."""
        errors = [squared_error(predicted, latent[..., depth:, :]).mean(-1) for depth, predicted in enumerate(rollout, 1)]
        return self._reduce(mean_over_depths(errors, clip.mask), clip.mask)

    def _reduce(self, term: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
        """[B, T - 1] -> [], or [B, T - 1] without reduction. Masked transitions are replaced, never multiplied, by zero.

        On several ranks a mean divides by the mean count of transitions per rank, so that its average over ranks is the
        mean over the transitions of the global batch, however many each mask leaves.
        """
        if mask is not None:
            term = torch.where(mask, term, 0.0)
        if self.reduction == "none":
            return term
        if self.reduction == "sum":
            return term.sum()
        if mask is None:
            return term.mean()
        count = all_reduce_sum(mask.sum()).clamp_min(1)  # [], of all ranks
        return term.sum() * world_size() / count

    def _run(self, name: str, params: TensorDictBase, *inputs: torch.Tensor) -> tuple[torch.Tensor, TensorDictBase]:
        """Output of a network for its inputs, in the order of ``_SIGNATURES``, and everything that it read and wrote."""
        module, (roles, key) = self.__dict__[name], _SIGNATURES[name]
        keys = self.tensor_keys
        latent = choose_output(self.encoder, keys.latent)
        names = {LATENT: (keys.latent,) if latent is None else (keys.latent, latent), ACTION: (keys.action,)}
        tensordict = feed(name, module, dict(zip(roles, inputs)), names, inputs[0].shape[:1])
        written = call(module, params, tensordict)
        return read_output(module, written, getattr(keys, key)), written

    @torch.no_grad()
    def peek(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Latents [T, B, D] of a clip in the current mode; random state and running statistics stay as they are."""
        frames = read_frames(tensordict, self.tensor_keys, self.num_frames)
        if holds_latents(tensordict, self.tensor_keys):
            latent = frames
        else:
            with torch.random.fork_rng():
                latent, _ = self._run("encoder", with_own_buffers(self.encoder_params), frames)
        return latent.flatten(0, -3).transpose(0, 1)


class Clip(NamedTuple):
    """The tensors of a clip; either ``pixels`` or ``latent`` is None.

    Attributes:
        pixels: [..., T, 3, H, W], the frames.
        latent: [..., T, D], given in place of the frames; detached.
        action: [..., T - 1, F * A], the blocks between the frames; zero where masked.
        mask: [..., T - 1] bool, true where a transition counts; None where all do.
    """

    pixels: torch.Tensor | None
    latent: torch.Tensor | None
    action: torch.Tensor
    mask: torch.Tensor | None

    @property
    def frame_mask(self) -> torch.Tensor | None:
        """[..., T] bool, true where a frame counts: the first, and those that an unmasked transition leads to."""
        if self.mask is None:
            return None
        return torch.cat([torch.ones_like(self.mask[..., :1]), self.mask], dim=-1)


def read_clip(
    tensordict: TensorDictBase, keys: LatentLoss._AcceptedKeys, num_frames: int | None = None
) -> Clip:
    """Reads and checks a clip.

    Floating pixels and given latents are checked for NaN in eager mode, on every device: one would stay in the running
    statistics of BatchNorm. Masks, actions and ``("next", "done")`` are checked on the CPU and in eager mode only. On an
    accelerator the check would wait for the device, and in a compiled graph break it: there a wholly masked batch gives terms
    of zero, actions that are not finite give terms that are not, and clips that cross an end are not detected.

    Args:
        tensordict (TensorDictBase): the clip; not modified. Its entries, by their name in ``keys``:

            - ``pixels``: [..., T, 3, H, W] with T >= 2; [B * T, 3, H, W] with ``num_frames``; or [B, 3, H, W], where
              ``("next", pixels)`` holds the frames that the transitions lead to.
            - ``latent``: read where there are no pixels; with [D] in place of [3, H, W].
            - ``action``: [..., T, F * A], the last block is not used; [B, F * A] for transitions.
            - ``mask``: [..., T] or [..., T, 1] bool, optional.
        keys (LatentLoss._AcceptedKeys): names of the entries.
        num_frames (int, optional): T of flat slices. Default: ``None``.

    Raises:
        KeyError: a key is missing.
        TypeError: an entry is no tensor, or actions or latents are not floating.
        ValueError: shapes that do not fit, no transition left by the mask, values that are not finite, or clips that go on
            after ``("next", "done")``.
    """
    frames, blocks = read_frames(tensordict, keys, num_frames), require(tensordict, keys.action)
    if not blocks.is_floating_point():
        raise TypeError(f"actions must be floating, z-scored numbers, got {blocks.dtype}: convert them.")
    mask = tensordict.get(keys.mask, None)
    latents = holds_latents(tensordict, keys)
    steps = frames.shape[:-1] if latents else frames.shape[:-3]  # [..., T]
    transitions = _is_transitions(tensordict, keys, num_frames)
    lead = steps[:-1] if transitions else steps  # of actions and masks: one for two frames, or one for each frame
    if num_frames is not None and blocks.ndim == 2:
        blocks = _fold(blocks, num_frames, keys.action)
        mask = mask if mask is None else _fold(mask, num_frames, keys.mask)
    if blocks.shape[:-1] != lead:
        raise ValueError(f"every frame has an action block: expected action {[*lead, 'F * A']}, got {list(blocks.shape)}.")
    if mask is not None:
        if mask.shape not in (lead, (*lead, 1)) or mask.dtype != torch.bool:
            raise ValueError(
                f"a mask has one entry for each action block: expected {list(lead)} bool, got {list(mask.shape)} {mask.dtype}."
            )
        mask = mask.reshape(lead)
    if transitions:
        blocks, mask = blocks.unsqueeze(-2), mask if mask is None else mask.unsqueeze(-1)
    else:
        blocks, mask = blocks[..., :-1, :], mask if mask is None else mask[..., :-1]
    if mask is not None:
        blocks = torch.where(mask.unsqueeze(-1), blocks, 0.0)
    if latents:
        _check_latents(frames, keys.latent)
    else:
        check_finite(frames)
    if blocks.device.type == "cpu" and has_values(blocks):
        _check_values(blocks, mask)
        _check_ends(tensordict.get(("next", "done"), None), blocks.shape[:-1], mask)
    return Clip(None, frames.detach(), blocks, mask) if latents else Clip(frames, None, blocks, mask)


def read_frames(
    tensordict: TensorDictBase, keys: LatentLoss._AcceptedKeys, num_frames: int | None = None
) -> torch.Tensor:
    """Frames [..., T, 3, H, W], or latents [..., T, D], of clips, flat slices or transitions; see :func:`read_clip`."""
    latents = holds_latents(tensordict, keys)
    key, dims = (keys.latent, 1) if latents else (keys.pixels, 3)
    name, shape = ("latents", "D") if latents else ("pixels", "3, H, W")
    frames = require(tensordict, key)
    if 0 in frames.shape:
        raise ValueError(f"the batch of clips is empty, {name} are {list(frames.shape)}: sample at least one clip.")
    if _is_transitions(tensordict, keys, num_frames):
        following = require(tensordict, _next(key))
        if following.shape != frames.shape:
            raise ValueError(
                f"{_next(key)} must have the shape of {key!r}, got {list(following.shape)} for {list(frames.shape)}."
            )
        return torch.stack([frames, following], dim=-1 - dims)
    if num_frames is not None and frames.ndim == 1 + dims:
        frames = _fold(frames, num_frames, key)
    if frames.ndim < 2 + dims or frames.shape[-1 - dims] < 2:
        raise ValueError(
            f"a loss needs clips of at least 2 frames, {name} [B, T, {shape}] with T >= 2, got {list(frames.shape)}: "
            "build the loss with num_frames=T for the flat slices of a SliceSampler, else sample longer clips."
        )
    if num_frames is not None and frames.shape[-1 - dims] != num_frames:
        raise ValueError(f"the loss has num_frames={num_frames}, the clips have {frames.shape[-1 - dims]} frames.")
    return frames


def holds_latents(tensordict: TensorDictBase, keys: LatentLoss._AcceptedKeys) -> bool:
    """Whether a clip holds latents in place of pixels."""
    return tensordict.get(keys.pixels, None) is None and tensordict.get(keys.latent, None) is not None


def _is_transitions(tensordict: TensorDictBase, keys: LatentLoss._AcceptedKeys, num_frames: int | None) -> bool:
    """Whether the batch holds single steps and the frames they lead to, TorchRL's layout, instead of clips."""
    key, dims = (keys.latent, 1) if holds_latents(tensordict, keys) else (keys.pixels, 3)
    frames = require(tensordict, key)
    single = num_frames is None and (frames.ndim == 1 + dims or frames.ndim > 1 + dims and frames.shape[-1 - dims] == 1)
    return single and tensordict.get(_next(key), None) is not None


def _next(key: NestedKey) -> NestedKey:
    return unravel_key(("next", key))


def _fold(value: torch.Tensor, num_frames: int, key: NestedKey) -> torch.Tensor:
    """[B * T, ...] -> [B, T, ...]."""
    if len(value) % num_frames:
        raise ValueError(
            f"{key!r} holds {len(value)} steps, not a multiple of num_frames={num_frames}: sample slices of that length "
            "(SliceSampler, strict_length=True)."
        )
    return value.unflatten(0, (-1, num_frames))


def _check_latents(latent: torch.Tensor, key: NestedKey) -> None:
    if not latent.is_floating_point():
        raise TypeError(f"{key!r} of a clip must be floating, got {latent.dtype}: give the output of the encoder.")
    if has_values(latent) and not latent.isfinite().all():
        raise ValueError(f"{key!r} {list(latent.shape)} holds a NaN or an infinity: drop those clips.")


def _check_values(blocks: torch.Tensor, mask: torch.Tensor | None) -> None:
    if mask is not None and not all_reduce_sum(mask.sum()):  # one rank alone may have none
        raise ValueError("the mask leaves no transition of the batch to learn from: sample other clips.")
    if not blocks.isfinite().all():
        bad = (~blocks.isfinite().all(-1)).sum().item()
        raise ValueError(
            f"{bad} of {blocks[..., 0].numel()} action blocks hold a NaN or an infinity: set their mask to false, or "
            "drop them from the dataset."
        )


def _check_ends(done: torch.Tensor | None, transitions: torch.Size, mask: torch.Tensor | None) -> None:
    """Refuses clips that go on after an end of [..., T, 1], as a ``SliceSampler`` writes it, where there is one."""
    lead = (*transitions[:-1], transitions[-1] + 1)  # [..., T]
    if done is None or done.numel() != math.prod(lead):
        return
    over = done.reshape(lead)[..., :-1].bool()  # [..., T - 1]; that of the last frame leads out of the clip
    over = over if mask is None else over & mask
    if over.any():
        raise ValueError(
            f"{over.sum().item()} transitions lead past ('next', 'done') into another trajectory: give the loss the "
            "num_frames of the slices (SliceSampler, strict_length=True), or set their mask to false."
        )


def require(tensordict: TensorDictBase, key: NestedKey) -> torch.Tensor:
    """The entry of a clip.

    Raises:
        KeyError: it is missing.
        TypeError: it is no tensor.
    """
    value = tensordict.get(key, None)
    if value is None:
        present = ", ".join(str(name) for name in tensordict.keys(True, True))
        raise KeyError(f"the clip has no {key!r}, only {present}: rename it, or name it with loss.set_keys(...).")
    if not isinstance(value, torch.Tensor):
        raise TypeError(
            f"{key!r} of the clip is no tensor but a {type(value).__name__}: a loss takes a TensorDict, no plain dict or "
            "list: wrap it as TensorDict(batch, batch_size=[B])."
        )
    return value


def call(module: TensorDictModule, params: TensorDictBase, tensordict: TensorDictBase) -> TensorDictBase:
    """Calls a TensorDictModule with other parameters.

    Args:
        module (TensorDictModule): has its own parameters again afterwards, after an error too.
        params (TensorDictBase): parameters and buffers of this call.
        tensordict (TensorDictBase): inputs; see :func:`~torchrl_ficreg.modules.feed.feed`.

    Returns:
        TensorDictBase: inputs and outputs.
    """
    swap = params.to_module(module, preserve_module_state=False)
    swap.__enter__()
    # Not a with statement: after an Exception tensordict would leave the module with these parameters, and it replaces any
    # other, such as the KeyboardInterrupt or SystemExit of a signal handler, by an error of its own.
    try:
        return module(tensordict)
    finally:
        swap.__exit__(None, None, None)


def with_own_buffers(params: TensorDictParams) -> TensorDictBase:
    """The same parameters with copies of the buffers: a second call in a step does not move BatchNorm statistics again."""
    return params.apply(lambda value: value if isinstance(value, nn.Parameter) else value.clone())


@contextmanager
def running_statistics(module: nn.Module) -> Iterator[None]:
    """Context: BatchNorm layers in train mode normalise by their running statistics, which stay as they are."""
    layers = [layer for layer in module.modules() if isinstance(layer, BatchNorm) and layer.training]
    for layer in layers:
        layer.training = False
    try:
        yield
    finally:
        for layer in layers:
            layer.training = True


def mean_over_depths(errors: list[torch.Tensor], mask: torch.Tensor | None) -> torch.Tensor:
    """Mean error of every transition over the rollouts that reach it through unmasked transitions alone.

    Args:
        errors (list of torch.Tensor): of the predictions of depth d = 1, 2, ..., each [..., T - d]: rollouts of that depth
            end with the transitions d - 1 to T - 2.
        mask (torch.Tensor or None): [..., T - 1] bool, true where a transition counts.

    Returns:
        torch.Tensor: [..., T - 1]; any value where masked.
    """
    total = errors[0]
    if len(errors) == 1:
        return total
    count, counts = torch.ones_like(total), mask
    for depth, error in enumerate(errors[1:], 1):
        if mask is not None:
            counts = counts[..., 1:] & mask[..., :-depth]  # [..., T - 1 - depth], that the rollout from that start counts
            error = torch.where(counts, error, 0.0)
        reached = torch.ones_like(error) if mask is None else counts.to(error.dtype)
        pad = (depth, 0)  # deep rollouts do not end with the first transitions
        total, count = total + torch.nn.functional.pad(error, pad), count + torch.nn.functional.pad(reached, pad)
    return total / count


def check_steps(name: str, value: int) -> None:
    """Refuses a depth of rollouts that is no positive whole number."""
    if not (isinstance(value, int) and value >= 1):
        raise ValueError(f"{name} must be a positive whole number, got {value}.")


def _split(value: torch.Tensor, length: int) -> torch.Tensor:
    """[..., T, C] -> all windows of so many rows, [(T - length + 1) * ..., length, C]; unchanged where T = length."""
    if value.shape[-2] == length:
        return value
    return value.unfold(-2, length, 1).movedim(-3, 0).transpose(-1, -2).flatten(0, -3)


def _join(windows: torch.Tensor, steps: torch.Size) -> torch.Tensor:
    """Results for the windows of [..., T, D] -> [*steps, C], steps = [..., T]: all rows of the first, the last of the others."""
    if windows.shape[:-1] == steps:
        return windows
    windows = windows.unflatten(0, (-1, *steps[:-1]))  # [T - length + 1, ..., length, C]
    return torch.cat([windows[0], windows[1:, ..., -1, :].movedim(0, -2)], dim=-2)


def zero_term(latent: torch.Tensor) -> torch.Tensor:
    """Zero [], at least float32: the value of a term on given latents alone."""
    return latent.new_zeros((), dtype=torch.promote_types(latent.dtype, torch.float32))
