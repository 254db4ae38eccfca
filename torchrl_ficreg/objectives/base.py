"""What every loss of the collection shares: its keys, its networks, its reduction."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import dispatch, TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.objectives.common import LossModule

from torchrl_ficreg._device import in_autocast
from torchrl_ficreg.distributed import num_processes, sum_over_processes
from torchrl_ficreg.keys import ACTION, LATENT, MASK, PIXELS, PREDICTED_LATENT, RECOVERED_ACTION
from torchrl_ficreg.modules.feed import choose_output, feed, NEXT_LATENT, require_module
from torchrl_ficreg.modules.inverse import LOG_VAR, SPREAD
from torchrl_ficreg.modules.layers import check_finite, has_values
from torchrl_ficreg.objectives.inverse_terms import Recovered


class Clip(NamedTuple):
    """The tensors of a clip.

    Attributes:
        pixels: [..., T, 3, H, W].
        action: [..., T - 1, F * A], the blocks between the frames; zero where masked.
        mask: [..., T - 1] bool, true where a transition counts; None where all do.
    """

    pixels: torch.Tensor
    action: torch.Tensor
    mask: torch.Tensor | None

    @property
    def frame_mask(self) -> torch.Tensor | None:
        """[..., T] bool, true where a frame counts: the first, and those a counted transition leads to."""
        if self.mask is None:
            return None
        return torch.cat([torch.ones_like(self.mask[..., :1]), self.mask], dim=-1)


def read_clip(
    tensordict: TensorDictBase,
    pixels: NestedKey,
    action: NestedKey,
    mask: NestedKey,
    num_frames: int | None = None,
) -> Clip:
    """Reads and checks a clip.

    Floating pixels are looked at in eager mode, on every device: a NaN would stay in the running statistics of BatchNorm.
    Masks, actions and ``("next", "done")`` are looked at on the CPU and in eager mode only, where it costs next to nothing.
    On an accelerator it would hold up the queue, and in a compiled graph break it: there a wholly masked batch gives terms
    of zero, actions that are not finite give terms that are not, and clips that go on after an end are not noticed.

    Args:
        tensordict: left as it is.
        pixels: key of [..., T, 3, H, W], T >= 2; of [B * T, 3, H, W] with ``num_frames``; or of [B, 3, H, W], where
            ``("next", pixels)`` holds the frames that the transitions lead to.
        action: key of [..., T, F * A], the last block is not used; [B, F * A] for transitions.
        mask: key of [..., T] or [..., T, 1] bool; may be missing.
        num_frames: T of flat slices.

    Raises:
        KeyError: a key is missing.
        TypeError: an entry is no tensor, or actions are not floating.
        ValueError: shapes that do not fit, no transition left by the mask, pixels or actions that are not finite, or clips
            that go on after ``("next", "done")``.
    """
    frames, blocks = read_frames(tensordict, pixels, num_frames), require(tensordict, action)
    if not blocks.is_floating_point():
        raise TypeError(f"actions must be floating, z-scored numbers, got {blocks.dtype}: convert them.")
    trusted = tensordict.get(mask, None)
    lead = frames.shape[:-3]  # [..., T]
    if is_transitions(tensordict, pixels, num_frames):
        lead = frames.shape[:-4]  # one action block for two frames
    elif num_frames is not None and blocks.ndim == 2:
        blocks = _fold(blocks, num_frames, action)
        trusted = trusted if trusted is None else _fold(trusted, num_frames, mask)
    if blocks.shape[:-1] != lead:
        raise ValueError(f"every frame has an action block: expected action {[*lead, 'F * A']}, got {list(blocks.shape)}.")
    if trusted is not None:
        if trusted.shape not in (lead, (*lead, 1)) or trusted.dtype != torch.bool:
            raise ValueError(
                f"a mask says of every action block whether to trust it: expected {list(lead)} bool, got "
                f"{list(trusted.shape)} {trusted.dtype}."
            )
        trusted = trusted.reshape(lead)
    if lead == frames.shape[:-3]:
        blocks, trusted = blocks[..., :-1, :], trusted if trusted is None else trusted[..., :-1]
    else:
        blocks, trusted = blocks.unsqueeze(-2), trusted if trusted is None else trusted.unsqueeze(-1)
    if trusted is not None:
        blocks = torch.where(trusted.unsqueeze(-1), blocks, 0.0)
    check_finite(frames)
    if blocks.device.type == "cpu" and has_values(blocks):
        _check_values(blocks, trusted)
        _check_ends(tensordict.get(("next", "done"), None), blocks.shape[:-1], trusted)
    return Clip(frames, blocks, trusted)


def read_frames(tensordict: TensorDictBase, pixels: NestedKey, num_frames: int | None = None) -> torch.Tensor:
    """The frames [..., T, 3, H, W] of a clip, of flat slices or of transitions; see :func:`read_clip`."""
    frames = require(tensordict, pixels)
    if 0 in frames.shape:
        raise ValueError(f"the batch of clips is empty, pixels are {list(frames.shape)}: sample at least one clip.")
    if is_transitions(tensordict, pixels, num_frames):
        following = require(tensordict, _next(pixels))
        if following.shape != frames.shape:
            raise ValueError(
                f"{_next(pixels)} must have the shape of {pixels!r}, got {list(following.shape)} for {list(frames.shape)}."
            )
        return torch.stack([frames, following], dim=-4)
    if num_frames is not None and frames.ndim == 4:
        frames = _fold(frames, num_frames, pixels)
    if frames.ndim < 5 or frames.shape[-4] < 2:
        raise ValueError(
            f"a loss needs clips of at least 2 frames, pixels [B, T, 3, H, W] with T >= 2, got {list(frames.shape)}: "
            "build the loss with num_frames=T for the flat slices of a SliceSampler, else sample longer clips."
        )
    if num_frames is not None and frames.shape[-4] != num_frames:
        raise ValueError(f"the loss has num_frames={num_frames}, the clips have {frames.shape[-4]} frames.")
    return frames


def is_transitions(tensordict: TensorDictBase, pixels: NestedKey, num_frames: int | None) -> bool:
    """Whether the batch holds single steps and the frames they lead to, TorchRL's layout, instead of clips."""
    frames = require(tensordict, pixels)
    single = num_frames is None and (frames.ndim == 4 or frames.ndim > 4 and frames.shape[-4] == 1)
    return single and tensordict.get(_next(pixels), None) is not None


def _next(key: NestedKey) -> NestedKey:
    return unravel_key(("next", key))


def _fold(value: torch.Tensor, num_frames: int, key: NestedKey) -> torch.Tensor:
    """[B * T, ...] -> [B, T, ...]."""
    if len(value) % num_frames:
        raise ValueError(
            f"{key!r} holds {len(value)} steps, which are no whole slices of num_frames={num_frames}: sample slices of that "
            "length (SliceSampler, strict_length=True)."
        )
    return value.unflatten(0, (-1, num_frames))


def _check_values(blocks: torch.Tensor, mask: torch.Tensor | None) -> None:
    if mask is not None and not sum_over_processes(mask.sum()):  # one process may well have none
        raise ValueError("the mask leaves no transition of the batch to learn from: sample other clips.")
    if not blocks.isfinite().all():
        bad = (~blocks.isfinite().all(-1)).sum().item()
        raise ValueError(
            f"{bad} of {blocks[..., 0].numel()} action blocks hold a NaN or an infinity: set their mask to false, or "
            "drop them from the dataset."
        )


def _check_ends(done: torch.Tensor | None, transitions: torch.Size, mask: torch.Tensor | None) -> None:
    """Refuses clips that go on after an end, if they say where one is: [..., T, 1], as a ``SliceSampler`` writes it."""
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
    """Calls a TensorDictModule with these parameters.

    Args:
        module: left as it is, after an error too.
        params: its parameters and buffers for this call.
        tensordict: what it reads; see :func:`~torchrl_ficreg.modules.feed.feed`.

    Returns:
        what it read and wrote.
    """
    swap = params.to_module(module, preserve_module_state=False)
    swap.__enter__()
    # Not a with statement: after an Exception tensordict leaves the module with these parameters, and for any other, such
    # as the KeyboardInterrupt or SystemExit of a signal handler, it puts an error of its own in the place of that one.
    try:
        return module(tensordict)
    finally:
        swap.__exit__(None, None, None)


def output(module: TensorDictModule, tensordict: TensorDictBase, key: NestedKey) -> torch.Tensor:
    """The entry ``key`` that a module wrote, or its only one, whatever that is called.

    Raises:
        KeyError: it wrote several, and none has that name.
    """
    chosen = choose_output(module, key)
    if chosen is None:
        raise KeyError(
            f"no {key!r} among {module.out_keys}, what the network writes: see loss.set_keys(...), or select the right one "
            "with selected_out_keys of a TensorDictSequential."
        )
    return tensordict.get(chosen)


Reduction = Literal["mean", "sum", "none"]

# ``forward`` of a loss, which takes a tensordict, or its entries by position or by keyword, the optional ones too.
takes_clip = dispatch(source="_call_keys")

# What each network is fed with, and the key of _AcceptedKeys that names what the loss takes from it.
_SIGNATURES = {
    "encoder": ((PIXELS,), "latent"),
    "predictor": ((LATENT, ACTION), "predicted_latent"),
    "inverse_model": ((LATENT, NEXT_LATENT), "recovered_action"),
}


class LatentLoss(LossModule):
    """Base of the losses on clips. A subclass writes :meth:`forward` and its table of who receives gradient.

    Networks are fed by the names of their ``in_keys``: see :func:`~torchrl_ficreg.modules.feed.arrange`. They are
    functional, as in TorchRL's losses: their parameters are children of the loss, they themselves are not. Coefficients
    are buffers: ``loss.sigreg_coeff = 0.1`` neither recompiles nor rebuilds anything.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can rename.

        Attributes:
            pixels: [B, T, 3, H, W] uint8 or floating.
            action: [B, T, F * A], z-scored.
            mask: [B, T] or [B, T, 1] bool, optional.
            latent, predicted_latent, recovered_action: what to take from a network that writes several entries.
            latent, action: also what the predictor and the inverse model may call their inputs.
        """

        pixels: NestedKey = PIXELS
        action: NestedKey = ACTION
        mask: NestedKey = MASK
        latent: NestedKey = LATENT
        predicted_latent: NestedKey = PREDICTED_LATENT
        recovered_action: NestedKey = RECOVERED_ACTION

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
        self, *, reduction: Reduction, num_frames: int | None = None, **networks: TensorDictModule
    ) -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"unknown reduction {reduction!r}: choose 'mean', 'sum' or 'none'.")
        if num_frames is not None and not (isinstance(num_frames, int) and num_frames >= 2):
            raise ValueError(f"num_frames must be a whole number of at least 2 frames, got {num_frames!r}.")
        self.reduction, self.num_frames = reduction, num_frames
        self._networks = tuple(networks)
        for name, module in networks.items():
            require_module(name, module)
            self.convert_to_functional(module, name)
        self._check_networks()
        self._set_in_keys()

    def _register_coefficients(self, **values: float) -> None:
        for name, value in values.items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be finite and not negative, got {value}.")
            self.register_coeff_buffer(name, value)

    def _check_networks(self) -> None:
        """Numbers of inputs only: :meth:`set_keys` may still name them."""
        for name in self._networks:
            module, inputs = self.__dict__[name], _SIGNATURES[name][0]
            if len(module.in_keys) != len(inputs):
                raise ValueError(
                    f"the {name} must read {len(inputs)} entries, it reads {module.in_keys}: wrap it accordingly."
                )

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        self.in_keys = [keys.pixels, keys.action]
        # Optional entries are no in_keys, which are promised to be there; by keyword they can be given all the same.
        self._call_keys = [*self.in_keys, keys.mask, unravel_key(("next", keys.pixels))]

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
            TypeError: with ``remove_duplicate=False``, as :func:`torch.func.functional_call` asks, which replaces no
                parameter of a functional loss.
        """
        if not remove_duplicate:
            raise TypeError(
                "torch.func.functional_call does not reach the parameters of a TorchRL loss: write `with "
                "TensorDict(params).unflatten_keys('.').to_module(loss): loss(clip)` instead."
            )
        return super().named_parameters(prefix, recurse)

    def _read(self, tensordict: TensorDictBase) -> Clip:
        keys = self.tensor_keys
        clip = read_clip(tensordict, keys.pixels, keys.action, keys.mask, self.num_frames)
        self._check_size(*clip.pixels.shape[:-3])
        if clip.action.dtype == torch.float32:
            return clip
        dtype = next((param.dtype for param in self.parameters()), clip.action.dtype)
        return clip._replace(action=clip.action.to(dtype))  # as frames are

    def _check_size(self, *lead: int) -> None:
        """Whether the batch [..., T] is large enough, told in clips, before a layer tells it in channels."""
        clips = math.prod(lead[:-1])
        if self._compares_clips and clips < 2:
            raise ValueError(f"the regulariser compares clips: it needs at least 2 clips, got {clips}: use a larger batch.")
        if self.training and clips * (lead[-1] - 1) < 2 and num_processes() == 1:
            layers = [module for name in self._networks for module in self.__dict__[name].modules()]
            if any(isinstance(layer, nn.modules.batchnorm._BatchNorm) for layer in layers):
                raise ValueError(
                    "BatchNorm in train mode needs at least 2 clips, or one of 3 frames, got 1 transition: use a larger batch."
                )

    def _run(self, name: str, params: TensorDictBase, *inputs: torch.Tensor) -> tuple[torch.Tensor, TensorDictBase]:
        """What a network writes for its inputs, in the order of ``_SIGNATURES``: its own entry, and everything."""
        module, (roles, key) = self.__dict__[name], _SIGNATURES[name]
        keys = self.tensor_keys
        latent = choose_output(self.encoder, keys.latent)
        names = {LATENT: (keys.latent,) if latent is None else (keys.latent, latent), ACTION: (keys.action,)}
        tensordict = feed(name, module, dict(zip(roles, inputs)), names, inputs[0].shape[:1])
        written = call(module, params, tensordict)
        return output(module, written, getattr(keys, key)), written

    def _encode(self, pixels: torch.Tensor) -> torch.Tensor:
        """Frames [B, T, 3, H, W] -> latents [B, T, D]."""
        latent, _ = self._run("encoder", self.encoder_params, pixels)
        if latent.shape[:-1] != pixels.shape[:-3]:
            raise ValueError(
                f"the encoder must map pixels [B, T, 3, H, W] to latents [B, T, D], got {list(pixels.shape)} to "
                f"{list(latent.shape)}."
            )
        return latent

    @torch.no_grad()
    def peek(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Latents [T, B, D] of a clip as training sees them; random state and running statistics stay as they are."""
        pixels = read_frames(tensordict, self.tensor_keys.pixels, self.num_frames)
        with torch.random.fork_rng():
            latent, _ = self._run("encoder", with_own_buffers(self.encoder_params), pixels)
        return latent.flatten(0, -3).transpose(0, 1)

    def _predict(self, latent: torch.Tensor, action: torch.Tensor, params: TensorDictBase) -> torch.Tensor:
        """Latents and action blocks [B, T - 1, ...] -> next latents [B, T - 1, D]."""
        if not in_autocast(latent.device):
            action = action.to(latent.dtype)  # networks may compute in another dtype than the data
        return self._run("predictor", params, latent, action)[0]

    def _recover(self, latent: torch.Tensor, next_latent: torch.Tensor, params: TensorDictBase) -> Recovered:
        """What the inverse model says led from latent to next_latent [B, T - 1, D]."""
        action, written = self._run("inverse_model", params, latent, next_latent)
        return Recovered(action, written.get(LOG_VAR, None), written.get(SPREAD, None))

    def _reduce(self, term: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
        """[B, T - 1] -> as the reduction says. Masked transitions are selected away, never multiplied by zero.

        On several processes a mean is taken over the mean count of transitions, so that its average over processes is
        the mean over the transitions of the global batch, however the masks are shared out.
        """
        if mask is not None:
            term = torch.where(mask, term, 0.0)
        if self.reduction == "none":
            return term
        if self.reduction == "sum":
            return term.sum()
        if mask is None:
            return term.mean()
        count = sum_over_processes(mask.sum()).clamp_min(1)  # [], of all processes
        return term.sum() * num_processes() / count


def with_own_buffers(params: TensorDictParams) -> TensorDictBase:
    """The same parameters beside copies of the buffers, so that BatchNorm statistics move once a step, not twice."""
    return params.apply(lambda value: value if isinstance(value, nn.Parameter) else value.clone())
