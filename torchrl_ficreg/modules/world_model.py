"""The latent world model: encode, predict, rollout."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_ficreg.data.action_statistics import ActionStatistics
from torchrl_ficreg.keys import ACTION, LATENT, PIXELS, PREDICTED_LATENT
from torchrl_ficreg.modules.feed import arrange, choose_output, feed, Names, read_output, require_module
from torchrl_ficreg.modules.layers import check_finite
from torchrl_ficreg.modules.predictor import CausalPredictor


class LatentWorldModel(TensorDictModuleBase):
    """Encoder and predictor as one thing to plan with. It knows no loss, no cost and no environment.

    The action statistics are part of its state: whoever holds the model can translate between environment actions
    and the z-scored action blocks it was trained on, without the dataset.

    Args:
        encoder: reads ``pixels`` [..., 3, H, W], writes ``latent`` [..., D].
        predictor: reads ``latent`` and ``action``, writes ``predicted_latent``; fed by name as in
            :class:`~torchrl_ficreg.LeWMLoss`. One of your own, or its network, has the attributes ``history``, the longest
            window of latents it sees, ``latent_dim`` and ``action_dim``, the widths of a latent and of an action block.
        frame_skip: F, raw actions in one block.
        statistics: mean and std [A] of raw actions; zeros and ones when none are given.

    Raises:
        TypeError: an encoder or predictor that is no TensorDictModule, or a predictor without those attributes.
        ValueError: an action block that is no multiple of ``frame_skip``, or keys that do not say which input is which.

    Examples:
        >>> import torch
        >>> from torchrl_ficreg import CausalPredictor, ConvEncoder, LatentWorldModel
        >>> predictor = CausalPredictor(latent_dim=16, action_dim=10, history=1, depth=1)
        >>> model = LatentWorldModel(ConvEncoder(), predictor, frame_skip=5).eval()
        >>> latent = model.encode(torch.zeros(7, 3, 64, 64, dtype=torch.uint8))
        >>> model.rollout(latent[:, None], torch.zeros(7, 4, 10)).shape
        torch.Size([7, 4, 16])
    """

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        predictor: CausalPredictor,
        *,
        frame_skip: int,
        statistics: ActionStatistics | None = None,
    ) -> None:
        super().__init__()
        for name, module in (("encoder", encoder), ("predictor", predictor)):
            require_module(name, module)
        arrange("predictor", predictor.in_keys, self._names(encoder))
        missing = [name for name in ("history", "latent_dim", "action_dim") if not hasattr(predictor, name)]
        if missing:
            raise TypeError(
                "a predictor of your own says how many latents it sees (history), how wide they are (latent_dim) and how wide "
                f"an action block is (action_dim): give it, or its network, {' and '.join(missing)}."
            )
        if not (isinstance(frame_skip, int) and frame_skip >= 1):
            raise ValueError(f"frame_skip must be a whole number of at least 1 action, got {frame_skip!r}.")
        block = predictor.action_dim
        if block % frame_skip:
            raise ValueError(f"an action block of width {block} is no multiple of frame_skip {frame_skip}.")
        self.encoder, self.predictor, self.frame_skip = encoder, predictor, frame_skip
        self.in_keys, self.out_keys = [PIXELS, ACTION], [LATENT, PREDICTED_LATENT]
        self.register_buffer("action_mean", torch.zeros(block // frame_skip))
        self.register_buffer("action_std", torch.ones(block // frame_skip))
        if statistics is not None:
            self.statistics = statistics

    @property
    def history(self) -> int:
        """H, the longest window of latents the predictor sees."""
        return self.predictor.history

    @property
    def latent_dim(self) -> int:
        """D, the width of a latent."""
        return self.predictor.latent_dim

    @property
    def block_dim(self) -> int:
        """F * A, the width of an action block."""
        return self.frame_skip * len(self.action_mean)

    @property
    def statistics(self) -> ActionStatistics:
        """Mean and std [A] of raw actions in the training episodes."""
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
        """Frames [..., 3, H, W], uint8 or floats in 0..1 -> latents [..., D].

        Raises:
            ValueError: floats that are not finite.
        """
        check_finite(pixels)
        written = self.encoder(feed("encoder", self.encoder, {PIXELS: pixels}))
        return read_output(self.encoder, written, LATENT, -1)

    def predict(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Latents [..., T, D] and the z-scored action blocks leading on [..., T, F * A] -> next latents [..., T, D]."""
        inputs = {LATENT: latent, ACTION: action}
        written = self.predictor(feed("predictor", self.predictor, inputs, self._names(self.encoder)))
        return read_output(self.predictor, written, PREDICTED_LATENT, -1)

    @staticmethod
    def _names(encoder: TensorDictModuleBase) -> Names:
        """What the predictor may call its inputs beside their contract names."""
        return {LATENT: (choose_output(encoder, LATENT) or LATENT,), ACTION: ()}

    def rollout(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Imagines where a sequence of action blocks leads, feeding predictions back.

        The window grows from the context to H latents and then slides; positions count from its oldest latent, as in
        training.

        Args:
            latent: context [..., C, D], oldest first.
            action: z-scored action blocks [..., C - 1 + N, F * A]: those executed between the context frames, then
                those to be imagined.

        Returns:
            predicted latents [..., N, D].

        Raises:
            ValueError: no block to imagine, leading dimensions that differ, or a wrong width.
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
        imagine = getattr(self.predictor, "imagine", self._imagine)
        return imagine(rows, blocks).reshape(*lead, -1, self.latent_dim)

    def _imagine(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """As :meth:`CausalTransformer.imagine`, for any network: [N, C, D] and [N, C - 1 + S, F * A] -> [N, S, D]."""
        context = latent.shape[-2]
        for end in range(context, action.shape[-2] + 1):
            start = max(0, end - self.history)
            predicted = self.predict(latent[:, start:end], action[:, start:end])[:, -1:]  # [N, 1, D]
            latent = torch.cat([latent, predicted], dim=-2)
        return latent[:, context:]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Encodes a clip and predicts every frame but its first from those before it.

        Args:
            tensordict: ``pixels`` [..., T, 3, H, W] and z-scored ``action`` [..., T, F * A]; left as it is.

        Returns:
            a new tensordict with ``latent`` [..., T, D] and ``predicted_latent`` [..., T - 1, D].
        """
        latent = self.encode(tensordict.get(PIXELS))
        predicted = self.predict(latent[..., :-1, :], tensordict.get(ACTION)[..., :-1, :])
        return TensorDict({LATENT: latent, PREDICTED_LATENT: predicted}, latent.shape[:-2])
