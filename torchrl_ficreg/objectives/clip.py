"""What a loss reads: the tensors of a clip, checked once at the door, and modules fed by their own keys."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey

from torchrl_ficreg.modules.collectives import sum_over_processes
from torchrl_ficreg.modules.pixels import check_finite


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


def read_clip(tensordict: TensorDictBase, pixels: NestedKey, action: NestedKey, mask: NestedKey) -> Clip:
    """Reads and checks a clip.

    Floating pixels are looked at in eager mode, on every device: a NaN would stay in the running statistics of BatchNorm.
    Masks and actions are looked at on the CPU and in eager mode only, where it costs next to nothing. On an accelerator it
    would hold up the queue, and in a compiled graph break it: there a wholly masked batch gives terms of zero, and actions
    that are not finite give terms that are not.

    Args:
        tensordict: left as it is.
        pixels: key of [..., T, 3, H, W], T >= 2.
        action: key of [..., T, F * A]; the last block is not used.
        mask: key of [..., T] bool; may be missing.

    Raises:
        KeyError: a key is missing.
        TypeError: actions that are not floating.
        ValueError: shapes that do not fit, no transition left by the mask, or pixels or actions that are not finite.
    """
    frames, blocks = require(tensordict, pixels), require(tensordict, action)
    if 0 in frames.shape:
        raise ValueError(f"the batch of clips is empty, pixels are {list(frames.shape)}: sample at least one clip.")
    if frames.ndim < 5 or frames.shape[-4] < 2:
        raise ValueError(
            f"a loss needs clips of at least 2 frames, pixels [B, T, 3, H, W] with T >= 2, "
            f"got {list(frames.shape)}: sample longer clips (num_frames)."
        )
    if blocks.shape[:-1] != frames.shape[:-3]:
        raise ValueError(
            f"every frame has an action block: expected action {[*frames.shape[:-3], 'F * A']}, "
            f"got {list(blocks.shape)}."
        )
    if not blocks.is_floating_point():
        raise TypeError(f"actions must be floating, z-scored numbers, got {blocks.dtype}: convert them.")
    trusted = tensordict.get(mask, None)
    blocks = blocks[..., :-1, :]
    if trusted is not None:
        if trusted.shape != frames.shape[:-3] or trusted.dtype != torch.bool:
            raise ValueError(
                f"a mask says of every action block whether to trust it: expected {list(frames.shape[:-3])} bool, "
                f"got {list(trusted.shape)} {trusted.dtype}."
            )
        trusted = trusted[..., :-1]
        blocks = torch.where(trusted.unsqueeze(-1), blocks, 0.0)
    check_finite(frames)
    if blocks.device.type == "cpu" and not torch.compiler.is_compiling():
        _check_values(blocks, trusted)
    return Clip(frames, blocks, trusted)


def _check_values(blocks: torch.Tensor, mask: torch.Tensor | None) -> None:
    if mask is not None and not sum_over_processes(mask.sum()):  # one process may well have none
        raise ValueError("the mask leaves no transition of the batch to learn from: sample other clips.")
    if not blocks.isfinite().all():
        bad = (~blocks.isfinite().all(-1)).sum().item()
        raise ValueError(
            f"{bad} of {blocks[..., 0].numel()} action blocks hold a NaN or an infinity: set their mask to false, or "
            "drop them from the dataset."
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
    return value


def check_module(name: str, module: TensorDictModule, num_inputs: int, out_key: NestedKey) -> None:
    """Whether a loss can feed a module.

    Args:
        name: what the loss calls it.
        module: any TensorDictModule.
        num_inputs: tensors it must read, in the order the loss gives them.
        out_key: the entry the loss takes when the module writes several.

    Raises:
        ValueError: another number of inputs, or none of its several outputs is called ``out_key``.
    """
    if len(module.in_keys) != num_inputs:
        raise ValueError(f"the {name} must read {num_inputs} entries, it reads {module.in_keys}: wrap it accordingly.")
    if len(module.out_keys) > 1 and out_key not in module.out_keys:
        raise ValueError(
            f"the {name} writes {module.out_keys} and none is {out_key!r}: rename the right one, or select it with "
            "selected_out_keys of a TensorDictSequential."
        )


def call(module: TensorDictModule, params: TensorDictBase, *inputs: torch.Tensor) -> TensorDictBase:
    """Feeds a TensorDictModule, with these parameters, by its own keys.

    Args:
        module: left as it is, after an error too.
        params: its parameters and buffers for this call.
        *inputs: one tensor for each of its ``in_keys``.

    Returns:
        what it read and wrote.
    """
    tensordict = TensorDict(dict(zip(module.in_keys, inputs)), batch_size=inputs[0].shape[:1])
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
    key = key if len(module.out_keys) > 1 else module.out_keys[0]
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(f"no {key!r} among {module.out_keys}, what the network writes: see loss.set_keys(...).")
    return value
