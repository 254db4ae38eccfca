"""The package's predictor: a causal transformer, conditioned on actions, that predicts the next latent."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from torchrl_ficreg.keys import ACTION, ACTION_EMBEDDING, LATENT, PREDICTED_LATENT
from torchrl_ficreg.modules.feed import sort_keys
from torchrl_ficreg.modules.layers import keep_arguments, Projector
from torchrl_ficreg.modules.transformer import AdaptiveBlock, Cache, run_block


class ActionEncoderNetwork(nn.Module):
    """Two-layer embedding of an action block, after a narrow linear bottleneck (arXiv 2603.19312).

    Args:
        action_dim (int): F * A, width of an action block.
        width (int): width of the embedding.
        bottleneck (int, optional): width of the first linear layer. Default: ``10``.
    """

    def __init__(self, action_dim: int, width: int, bottleneck: int = 10) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.compress = nn.Linear(action_dim, bottleneck)
        self.layer_in = nn.Linear(bottleneck, 4 * width)
        self.layer_out = nn.Linear(4 * width, width)
        self.activation = nn.SiLU()

    def forward(self, action: torch.Tensor) -> torch.Tensor:
        """Action blocks [..., F * A], z-scored -> [..., width].

        Raises:
            ValueError: the blocks have another width.
        """
        if action.shape[-1] != self.action_dim:
            raise ValueError(
                f"action blocks must be {self.action_dim} wide (frame skip x raw action dimension), got "
                f"{action.shape[-1]}: check frame_skip and the environment the model was built for."
            )
        return self.layer_out(self.activation(self.layer_in(self.compress(action))))


class ActionEncoder(TensorDictModule):
    """``action`` [..., F * A] -> ``action_embedding`` [..., width].

    :class:`CausalPredictor` contains such a network of its own; this module is for use elsewhere.

    Args:
        action_dim (int): F * A, width of an action block.
        width (int): width of the embedding.
        bottleneck (int, optional): width of the first linear layer. Default: ``10``.
        in_key (NestedKey, optional): where action blocks are read. Default: ``"action"``.
        out_key (NestedKey, optional): where embeddings are written. Default: ``"action_embedding"``.

    Examples:
        >>> import torch
        >>> ActionEncoder(action_dim=10, width=32)(action=torch.zeros(4, 10)).shape
        torch.Size([4, 32])
    """

    def __init__(
        self,
        action_dim: int,
        width: int,
        bottleneck: int = 10,
        *,
        in_key: NestedKey = ACTION,
        out_key: NestedKey = ACTION_EMBEDDING,
    ) -> None:
        super().__init__(ActionEncoderNetwork(action_dim, width, bottleneck), in_keys=[in_key], out_keys=[out_key])


class CausalTransformer(nn.Module):
    """Predicts the latent after each given one, from the latents up to it and the action block that follows it.

    Args:
        latent_dim (int, optional): D. Default: ``192``.
        action_dim (int): F * A, width of an action block.
        history (int, optional): H, the most latents that it takes at once. Default: ``3``.
        width (int, optional): channels of a token. Default: ``192``.
        depth (int, optional): number of blocks. Default: ``6``.
        heads (int, optional): attention heads of a block. Default: ``16``.
        dim_head (int, optional): width of a head. Default: ``64``.
        mlp_dim (int, optional): hidden width of a block's feed-forward layer. Default: ``2048``.
        dropout (float, optional): dropout rate of the blocks. Default: ``0.1``.
        attention_dropout (float, optional): dropout rate of the attention weights. Default: ``0.0``.
        projector_dim (int, optional): hidden width of the BatchNorm projector at the end. Default: ``2048``.
        action_bottleneck (int, optional): see :class:`ActionEncoderNetwork`. Default: ``10``.
        position_std (float, optional): standard deviation of the position embedding at initialisation. Default: ``0.02``.

    Attributes:
        latent_dim: D.
        action_dim: F * A.
        history: H.
        checkpointing: see :func:`~torchrl_ficreg.modules.transformer.checkpoint_activations`.
    """

    checkpointing = False

    @keep_arguments
    def __init__(
        self,
        *,
        latent_dim: int = 192,
        action_dim: int,
        history: int = 3,
        width: int = 192,
        depth: int = 6,
        heads: int = 16,
        dim_head: int = 64,
        mlp_dim: int = 2048,
        dropout: float = 0.1,
        attention_dropout: float = 0.0,
        projector_dim: int = 2048,
        action_bottleneck: int = 10,
        position_std: float = 0.02,
    ) -> None:
        super().__init__()
        if not position_std >= 0:
            raise ValueError(f"position_std must not be negative, got {position_std}.")
        self.position_std = position_std
        self.history, self.latent_dim, self.action_dim = history, latent_dim, action_dim
        self.action_embedding = ActionEncoderNetwork(action_dim, width, action_bottleneck)
        self.to_width = nn.Identity() if latent_dim == width else nn.Linear(latent_dim, width)
        self.position = nn.Parameter(torch.empty(1, history, width))
        self.blocks = nn.ModuleList(
            AdaptiveBlock(width, heads, dim_head, mlp_dim, dropout, attention_dropout) for _ in range(depth)
        )
        self.norm = nn.LayerNorm(width)
        self.projector = Projector(width, projector_dim, latent_dim)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draws the position embedding; the layers have their own ``reset_parameters``."""
        nn.init.normal_(self.position, std=self.position_std)

    def modulation(self, action: torch.Tensor) -> list[torch.Tensor]:
        """Action blocks [..., T, F * A] -> modulation of each layer [..., T, 6 * width].

        It depends on the actions only, so a rollout computes it once and slides its window over the result.
        """
        condition = self.action_embedding(action)  # [..., T, width]
        return [block.modulation(condition) for block in self.blocks]

    def rollout(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Feeds predictions back: the same as :meth:`forward` on each window, without computing tokens twice.

        While the window grows, the keys and values of its tokens are cached and one token is computed per step. Once the
        window slides, every position changes and all tokens are computed anew, in the last layer only the last one.
        Dropout is not applied: use it in eval mode.

        Args:
            latent (Tensor): context [N, C, D], oldest first.
            action (Tensor): blocks [N, C - 1 + S, F * A]: those between the context frames, then those to predict for.

        Returns:
            [N, S, D].
        """
        context = latent.shape[-2]
        modulation = self.modulation(action)
        window = list(latent.unbind(-2))  # C + S latents in the end, each [N, D]
        seen, first = None, max(0, context - self.history)  # oldest token of the window
        for end in range(context, action.shape[-2] + 1):
            if end - first > self.history:
                seen, first = None, end - self.history
            known = 0 if seen is None else seen[0][0].shape[-2]  # tokens of the window that are cached
            new = torch.stack(window[first + known : end], dim=-2)  # [N, T, D]
            ahead = [layer[:, first + known : end] for layer in modulation]
            grows = end - first < self.history and end < action.shape[-2]
            predicted, seen = self._extend(new, ahead, seen, known, grows)
            window.append(predicted)
        return torch.stack(window[context:], dim=-2)

    def _extend(
        self,
        latent: torch.Tensor,
        modulation: list[torch.Tensor],
        past: list[Cache] | None,
        position: int,
        keep: bool,
    ) -> tuple[torch.Tensor, list[Cache] | None]:
        """New latents [N, T, D] from ``position`` on, after the cached ones -> the next latent [N, D] and the cache."""
        tokens = self.to_width(latent) + self.position[:, position : position + latent.shape[-2]]  # [N, T, width]
        seen = []
        for depth, (block, ahead) in enumerate(zip(self.blocks, modulation)):
            last = depth == len(self.blocks) - 1
            tokens, cache = block.extend(tokens, ahead, past[depth] if past else None, last=last, keep=keep)
            seen.append(cache)
        return self.projector(self.norm(tokens))[:, -1], seen if keep else None

    def forward(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Latents [..., T, D] and the action blocks after them [..., T, F * A] -> next latents [..., T, D].

        Raises:
            ValueError: more than H latents, or a wrong width.
        """
        lead, tokens = latent.shape[:-2], latent.shape[-2]
        if not 1 <= tokens <= self.history:
            raise ValueError(
                f"the predictor takes 1 to {self.history} latents, got {tokens}: "
                f"give clips of {self.history + 1} frames, or build it with history={tokens}."
            )
        if latent.shape[-1] != self.latent_dim:
            raise ValueError(f"latents must be {self.latent_dim} wide, got {latent.shape[-1]}.")
        latent, action = latent.reshape(-1, *latent.shape[-2:]), action.reshape(-1, *action.shape[-2:])
        x = self.to_width(latent) + self.position[:, :tokens]  # [N, T, width]
        for block, modulation in zip(self.blocks, self.modulation(action)):
            x = run_block(block, x, modulation, checkpointing=self.checkpointing)
        return self.projector(self.norm(x)).reshape(*lead, tokens, -1)


class CausalPredictor(TensorDictModule):
    """``latent`` [..., T, D] and ``action`` [..., T, F * A] -> ``predicted_latent`` [..., T, D].

    Row t of the output predicts the latent one frame after row t of the input. A transformer with causal attention over
    at most H latents, AdaLN-zero conditioning on the action and a BatchNorm projector. The default sizes are the paper's
    (arXiv 2603.19312): 11.7 M parameters. The published code also has ``attention_dropout=0.1`` and
    ``position_std=1.0``, which ``ModelConfig.preset("paper")`` sets.

    Args:
        in_keys (tuple of NestedKey, optional): where latents and action blocks are read. Their order matters only where
            their names do not say which is which. Default: ``("latent", "action")``.
        out_key (NestedKey, optional): where predictions are written. Default: ``"predicted_latent"``.
        **network: arguments of :class:`CausalTransformer`.

    Raises:
        ValueError: more than H latents, or a wrong width.

    Examples:
        >>> import torch
        >>> predictor = CausalPredictor(latent_dim=16, action_dim=10, history=3, depth=1).eval()
        >>> predictor(latent=torch.zeros(2, 3, 16), action=torch.zeros(2, 3, 10)).shape
        torch.Size([2, 3, 16])
    """

    def __init__(
        self,
        *,
        in_keys: tuple[NestedKey, NestedKey] = (LATENT, ACTION),
        out_key: NestedKey = PREDICTED_LATENT,
        **network,
    ) -> None:
        keys = sort_keys("predictor", in_keys, LATENT, ACTION)
        super().__init__(CausalTransformer(**network), in_keys=keys, out_keys=[out_key])
