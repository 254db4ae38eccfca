"""What a loss reads: the tensors of a clip, checked once at the door, and what its networks write."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey, unravel_key

from torchrl_ficreg.modules.collectives import sum_over_processes
from torchrl_ficreg.modules.feed import choose_output
from torchrl_ficreg.modules.pixels import check_finite, has_values


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
