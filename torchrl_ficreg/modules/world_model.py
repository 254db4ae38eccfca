"""The latent world model: encode, predict, rollout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch, TensorDictModuleBase
from tensordict.utils import NestedKey

from torchrl_ficreg.data.action_statistics import ActionStatistics
from torchrl_ficreg.keys import ACTION, LATENT, PIXELS, PREDICTED_LATENT
from torchrl_ficreg.modules.feed import (
    arrange,
    choose_output,
    feed,
    Names,
    read_output,
    require_module,
    require_tensordict,
)
from torchrl_ficreg.modules.keyed import KeyedMixin
from torchrl_ficreg.modules.layers import check_finite


class LatentWorldModel(KeyedMixin, TensorDictModuleBase):
    """An encoder and a predictor, as one model to plan with.

    The networks may be any TensorDictModules, see :mod:`torchrl_ficreg.protocols`. The model holds the statistics of the
    actions it was trained on as buffers, so it translates between environment actions and z-scored action blocks
    without the dataset. It contains no loss, no cost and no environment.

    :meth:`forward` encodes clips and predicts every frame but the first, in the manner of a TensorDictModule;
    :meth:`encode`, :meth:`predict` and :meth:`rollout` do the same with tensors.

    Args:
        encoder (TensorDictModuleBase): reads ``pixels`` [..., 3, H, W], writes ``latent`` [..., D].
        predictor (TensorDictModuleBase): reads ``latent`` [..., T, D] and ``action`` [..., T, F * A], writes
            ``predicted_latent`` [..., T, D]. The inputs are told apart by their keys, as in
            :class:`~torchrl_ficreg.LeWMLoss`. Where it has a method ``rollout``, :meth:`rollout` uses it.
        frame_skip (int): F, environment actions in one action block.
        latent_dim (int, optional): D, width of a latent. Default: the attribute ``latent_dim`` of the predictor.
        action_dim (int, optional): F * A, width of an action block. As in all networks of the package, ``action_dim`` is
            the width of what the network reads. Default: the attribute ``action_dim`` of the predictor.
        history (int, optional): H, the most latents that the predictor takes at once. Default: the attribute ``history``
            of the predictor.
        statistics (ActionStatistics, optional): mean and std [A] of environment actions. Default: zeros and ones.
        in_keys (sequence of NestedKey, optional): where :meth:`forward` reads pixels and action blocks, in this order.
            Default: ``("pixels", "action")``.
        out_keys (sequence of NestedKey, optional): where :meth:`forward` writes latents and predictions, in this order.
            Default: ``("latent", "predicted_latent")``.

    Attributes:
        latent_dim: D.
        history: H.
        frame_skip: F.

    An attribute of the predictor may also be one of the network that a ``TensorDictModule`` wraps. A
    ``TensorDictSequential`` has none: give the three arguments.

    Raises:
        TypeError: an encoder or predictor that is no TensorDictModule, or a size that neither the predictor nor an
            argument gives.
        ValueError: a size that is no positive integer or differs between argument and predictor, an action block that is
            no multiple of ``frame_skip``, or keys that do not tell the inputs of the predictor apart.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_ficreg import CausalPredictor, ConvEncoder, LatentWorldModel
        >>> predictor = CausalPredictor(latent_dim=16, action_dim=10, history=1, depth=1)
        >>> model = LatentWorldModel(ConvEncoder(), predictor, frame_skip=5).eval()
        >>> latent = model.encode(torch.zeros(7, 3, 64, 64, dtype=torch.uint8))
        >>> model.rollout(latent[:, None], torch.zeros(7, 4, 10)).shape
        torch.Size([7, 4, 16])

        A predictor of your own, and keys of your own:

        >>> class Residual(torch.nn.Module):
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.layer = torch.nn.Linear(26, 16)
        ...     def forward(self, latent, action):
        ...         return latent + self.layer(torch.cat([latent, action], -1))
        >>> predictor = TensorDictModule(Residual(), ["latent", "action"], ["predicted_latent"])
        >>> model = LatentWorldModel(ConvEncoder(), predictor, frame_skip=5, latent_dim=16, action_dim=10, history=1)
        >>> model.set_keys(pixels=("camera", "rgb"))
        >>> clip = TensorDict({("camera", "rgb"): torch.rand(7, 2, 3, 64, 64), "action": torch.zeros(7, 2, 10)}, [7])
        >>> model(clip)["predicted_latent"].shape
        torch.Size([7, 1, 16])
    """

    @dataclass(frozen=True)
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can rename.

        Attributes:
            pixels: read, [..., T, 3, H, W] uint8 or floating.
            action: read, [..., T, F * A], z-scored. Also a name by which the predictor may read it.
            latent: written, [..., T, D]. Also what to take from an encoder that writes several entries, if it writes
                this one, else ``latent``; and a name by which the predictor may read it.
            predicted_latent: written, [..., T - 1, D]. Also what to take from a predictor that writes several entries,
                if it writes this one, else ``predicted_latent``.
        """

        pixels: NestedKey = PIXELS
        action: NestedKey = ACTION
        latent: NestedKey = LATENT
        predicted_latent: NestedKey = PREDICTED_LATENT

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        predictor: TensorDictModuleBase,
        *,
        frame_skip: int,
        latent_dim: int | None = None,
        action_dim: int | None = None,
        history: int | None = None,
        statistics: ActionStatistics | None = None,
        in_keys: Sequence[NestedKey] = (PIXELS, ACTION),
        out_keys: Sequence[NestedKey] = (LATENT, PREDICTED_LATENT),
    ) -> None:
        super().__init__()
        for name, module in (("encoder", encoder), ("predictor", predictor)):
            require_module(name, module)
        if len(in_keys) != 2 or len(out_keys) != 2:
            raise ValueError(
                f"a world model has in_keys [pixels, action] and out_keys [latent, predicted_latent], got {list(in_keys)} and "
                f"{list(out_keys)}."
            )
        self.set_keys(**dict(zip(("pixels", "action", "latent", "predicted_latent"), (*in_keys, *out_keys))))
        self.encoder, self.predictor = encoder, predictor
        arrange("predictor", predictor.in_keys, self._names())
        self.frame_skip = _size("frame_skip", frame_skip)
        self.latent_dim = _size("latent_dim", latent_dim, predictor)
        self.history = _size("history", history, predictor)
        block = _size("action_dim", action_dim, predictor)
        if block % frame_skip:
            raise ValueError(
                f"an action block (action_dim) of width {block} is no multiple of frame_skip {frame_skip}: expected "
                f"{frame_skip} x the action dimension of the environment."
            )
        self.register_buffer("action_mean", torch.zeros(block // frame_skip))
        self.register_buffer("action_std", torch.ones(block // frame_skip))
        if statistics is not None:
            self.statistics = statistics

    def _apply_keys(self) -> None:
        keys = self.tensor_keys
        self.in_keys, self.out_keys = [keys.pixels, keys.action], [keys.latent, keys.predicted_latent]

    @property
    def block_dim(self) -> int:
        """F * A, the width of an action block."""
        return self.frame_skip * len(self.action_mean)

    @property
    def statistics(self) -> ActionStatistics:
        """Mean and std [A] of environment actions in the training episodes."""
        return ActionStatistics(self.action_mean, self.action_std)

    @statistics.setter
    def statistics(self, value: ActionStatistics) -> None:
        if value.mean.shape != self.action_mean.shape:
            raise ValueError(
                f"the model acts in {len(self.action_mean)} dimensions, the statistics have {len(value.mean)}: "
                "they belong to another environment."
            )
        self.action_mean.copy_(value.mean)
        self.action_std.copy_(value.std)

    def encode(self, pixels: torch.Tensor) -> torch.Tensor:
        """Encodes frames.

        Args:
            pixels (Tensor): [..., 3, H, W], uint8 or floating in 0..1.

        Returns:
            latents [..., D].

        Raises:
            ValueError: floats that are not finite.
            KeyError: the encoder writes several entries, and no key says which is the latent.
        """
        check_finite(pixels)
        written = self.encoder(feed("encoder", self.encoder, {PIXELS: pixels}))
        return read_output(self.encoder, written, self.tensor_keys.latent, LATENT)

    def predict(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Predicts the latent after each of at most H given ones.

        Args:
            latent (Tensor): [..., T, D], oldest first.
            action (Tensor): z-scored action blocks [..., T, F * A]; each leads from the latent of its row to the next.

        Returns:
            next latents [..., T, D].
        """
        written = self.predictor(feed("predictor", self.predictor, {LATENT: latent, ACTION: action}, self._names()))
        return read_output(self.predictor, written, self.tensor_keys.predicted_latent, PREDICTED_LATENT)

    def _names(self) -> Names:
        """What the predictor may call its inputs beside their contract names."""
        latent = choose_output(self.encoder, self.tensor_keys.latent, LATENT)
        own = [self.tensor_keys.latent] if latent is None else [self.tensor_keys.latent, latent]
        return {LATENT: own, ACTION: [self.tensor_keys.action]}

    def rollout(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Predicts where a sequence of action blocks leads, feeding predictions back.

        The window grows from the context to H latents and then slides; positions count from its oldest latent, as in
        training.

        Args:
            latent (Tensor): context [..., C, D], oldest first.
            action (Tensor): z-scored action blocks [..., C - 1 + N, F * A]: those executed between the context frames,
                then those to predict for.

        Returns:
            predicted latents [..., N, D].

        Raises:
            ValueError: no block to predict for, leading dimensions that differ, or a wrong width.
        """
        if not (
            min(latent.ndim, action.ndim) >= 2
            and latent.shape[:-2] == action.shape[:-2]
            and 1 <= latent.shape[-2] <= action.shape[-2]
            and latent.shape[-1] == self.latent_dim
        ):
            raise ValueError(
                f"rollout takes latents [..., C, {self.latent_dim}] and C - 1 + N action blocks "
                f"[..., C - 1 + N, F * A], N >= 1, got {list(latent.shape)} and {list(action.shape)}."
            )
        lead = latent.shape[:-2]
        rows, blocks = latent.reshape(-1, *latent.shape[-2:]), action.reshape(-1, *action.shape[-2:])
        rollout = getattr(self.predictor, "rollout", self._rollout)
        return rollout(rows, blocks).reshape(*lead, -1, self.latent_dim)

    def _rollout(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """As :meth:`CausalTransformer.rollout`, for any network: [N, C, D] and [N, C - 1 + S, F * A] -> [N, S, D]."""
        context = latent.shape[-2]
        for end in range(context, action.shape[-2] + 1):
            start = max(0, end - self.history)
            predicted = self.predict(latent[:, start:end], action[:, start:end])[:, -1:]  # [N, 1, D]
            latent = torch.cat([latent, predicted], dim=-2)
        return latent[:, context:]

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Encodes clips and predicts every frame but the first from those before it.

        All other entries are kept. The result is written into the given tensordict, whose batch size is that of the
        clips, such as [B]. With a batch size that also counts the frames, [B, T], the T - 1 predictions have no place in
        it: the result is then a shallow copy with batch size [B], and the given tensordict stays as it is.

        Args:
            tensordict (TensorDictBase): ``pixels`` [..., T, 3, H, W] and z-scored ``action`` [..., T, F * A], of which
                the last block is not used; T is at most H + 1.

        Returns:
            the tensordict, with ``latent`` [..., T, D] and ``predicted_latent`` [..., T - 1, D].

        Raises:
            KeyError: ``pixels`` or ``action`` is missing.
        """
        require_tensordict("a world model", tensordict)
        keys, inputs = self.tensor_keys, {}
        for name in (keys.pixels, keys.action):
            inputs[name] = tensordict.get(name, None)
            if inputs[name] is None:
                raise KeyError(f"the world model reads {name!r}, which is missing: rename it, or see set_keys(...).")
        latent = self.encode(inputs[keys.pixels])
        predicted = self.predict(latent[..., :-1, :], inputs[keys.action][..., :-1, :])
        if tensordict.ndim >= latent.ndim - 1:
            lead = latent.shape[:-2]
            names = tensordict.names[: len(lead)] if tensordict.ndim and any(tensordict.names) else None
            # Not copy(): the batch size of a lazy stack is fixed.
            tensordict = TensorDict(dict(tensordict.items()), lead, device=tensordict.device, names=names)
        return tensordict.set(keys.latent, latent).set(keys.predicted_latent, predicted)


def _size(name: str, given: int | None, predictor: TensorDictModuleBase | None = None) -> int:
    """A size as an argument gives it, or an attribute of the predictor.

    Raises:
        TypeError: neither does.
        ValueError: they differ, or it is no positive integer.
    """
    own = getattr(predictor, name, None)
    size = own if given is None else given
    if size is None:
        raise TypeError(f"the predictor has no attribute {name}: give it one, or LatentWorldModel(..., {name}=).")
    if not isinstance(size, int) or isinstance(size, bool) or size < 1:
        raise ValueError(f"{name} must be a positive integer, got {size!r}.")
    if own is not None and own != size:
        raise ValueError(f"{name}={size} differs from {name}={own} of the predictor: leave the argument out.")
    return size
