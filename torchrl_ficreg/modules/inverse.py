"""Inverse dynamics models: they recover the action block that led from one latent to the next.

All read ``latent`` and ``("next", "latent")`` [..., T, D] and write ``recovered_action`` [..., T, F * A], z-scored. Two
also write an uncertainty of every dimension: a Gaussian head ``recovered_action_log_var``, an ensemble
``recovered_action_variance``, the variance among its members. None contains a BatchNorm, which would normalise predicted
transitions by their own statistics in train mode, and hide from the consistency term what all predictions have in common.
"""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from torchrl_ficreg.keys import (
    LATENT,
    NEXT_LATENT,
    RECOVERED_ACTION,
    RECOVERED_ACTION_LOG_VAR,
    RECOVERED_ACTION_VARIANCE,
)
from torchrl_ficreg.modules.feed import sort_keys
from torchrl_ficreg.modules.layers import keep_arguments
from torchrl_ficreg.modules.transformer import Block

_LOG_VAR_RANGE = (-7.0, 2.0)  # of z-scored actions: from a std of 0.03 to one of 2.7


class InverseMLP(nn.Module):
    """Three linear layers on two concatenated latents (FICReg, appendix B).

    Args:
        latent_dim (int): D.
        action_dim (int): F * A, width of an action block.
        hidden_dim (int, optional): width of the two hidden layers. Default: ``512``.
        dropout (float, optional): dropout rate of the two hidden layers. Default: ``0.0``.
    """

    @keep_arguments
    def __init__(self, latent_dim: int, action_dim: int, hidden_dim: int = 512, dropout: float = 0.0) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(2 * latent_dim, hidden_dim),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(hidden_dim, hidden_dim),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(hidden_dim, action_dim),
        )

    def forward(self, latent: torch.Tensor, next_latent: torch.Tensor) -> torch.Tensor:
        """[..., D] and [..., D] -> action block [..., F * A], z-scored."""
        return self.layers(torch.cat([latent, next_latent], dim=-1))


class GaussianInverse(InverseMLP):
    """Mean and log-variance of the action block; arguments as for :class:`InverseMLP`."""

    @keep_arguments
    def __init__(self, latent_dim: int, action_dim: int, hidden_dim: int = 512, dropout: float = 0.0) -> None:
        super().__init__(latent_dim, 2 * action_dim, hidden_dim, dropout)

    def forward(self, latent: torch.Tensor, next_latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """[..., D] and [..., D] -> mean and log-variance, each [..., F * A]."""
        mean, log_var = super().forward(latent, next_latent).chunk(2, dim=-1)
        low, high = _LOG_VAR_RANGE  # soft bounds (arXiv 1805.12114), whose gradient never vanishes
        log_var = high - F.softplus(high - log_var)
        return mean, low + F.softplus(log_var - low)


class InverseEnsemble(nn.Module):
    """Independently initialised :class:`InverseMLP` members; writes the mean and the variance of their outputs.

    Args:
        latent_dim (int): D.
        action_dim (int): F * A, width of an action block.
        hidden_dim (int, optional): width of the hidden layers of a member. Default: ``512``.
        dropout (float, optional): dropout rate of a member. Default: ``0.0``.
        members (int, optional): number of members, at least 2. Default: ``4``.
    """

    @keep_arguments
    def __init__(
        self, latent_dim: int, action_dim: int, hidden_dim: int = 512, dropout: float = 0.0, members: int = 4
    ) -> None:
        super().__init__()
        if members < 2:
            raise ValueError(f"an ensemble needs at least 2 members, got {members}.")
        self.members = nn.ModuleList(InverseMLP(latent_dim, action_dim, hidden_dim, dropout) for _ in range(members))

    def forward(self, latent: torch.Tensor, next_latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """[..., D] and [..., D] -> mean and variance over members, each [..., F * A]."""
        recovered = torch.stack([member(latent, next_latent) for member in self.members])  # [K, ..., F * A]
        recovered = recovered if recovered.dtype == torch.float64 else recovered.float()  # variances cancel in bfloat16
        return recovered.mean(0), recovered.var(0, unbiased=False)


class InverseTransformer(nn.Module):
    """Recovers an action block from all latents up to it: one frame does not show a velocity, several do.

    A causal transformer reads the latents up to t; a head recovers the action block from its state, the latent and the
    next latent. Only the next latent of step t enters, so a predicted transition is evaluated after real history.

    Args:
        latent_dim (int): D.
        action_dim (int): F * A, width of an action block.
        hidden_dim (int, optional): width of the transformer and of the head. Default: ``256``.
        dropout (float, optional): dropout rate of the head. Default: ``0.0``.
        history (int): H, length of the longest sequence of latents.
        depth (int, optional): number of blocks. Default: ``2``.
        heads (int, optional): attention heads of a block. Default: ``4``.
    """

    @keep_arguments
    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        hidden_dim: int = 256,
        dropout: float = 0.0,
        *,
        history: int,
        depth: int = 2,
        heads: int = 4,
    ) -> None:
        super().__init__()
        self.history = history
        self.to_width = nn.Linear(latent_dim, hidden_dim)
        self.position = nn.Parameter(torch.empty(1, history, hidden_dim))
        self.blocks = nn.ModuleList(Block(hidden_dim, heads, 2 * hidden_dim, 1e-5, causal=True) for _ in range(depth))
        self.norm = nn.LayerNorm(hidden_dim)
        self.head = nn.Sequential(
            nn.Linear(hidden_dim + 2 * latent_dim, hidden_dim),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(hidden_dim, action_dim),
        )
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draws the position embedding; the layers have their own ``reset_parameters``."""
        nn.init.normal_(self.position, std=0.02)

    def forward(self, latent: torch.Tensor, next_latent: torch.Tensor) -> torch.Tensor:
        """[..., T, D] and [..., T, D], T at most H -> action blocks [..., T, F * A].

        Raises:
            ValueError: more than H latents.
        """
        if not 1 <= latent.shape[-2] <= self.history:
            raise ValueError(
                f"the inverse model takes 1 to {self.history} latents, got {latent.shape[-2]}: give shorter clips, or "
                f"build it with history={latent.shape[-2]}."
            )
        tokens = self.to_width(latent.reshape(-1, *latent.shape[-2:])) + self.position[:, : latent.shape[-2]]
        for block in self.blocks:
            tokens = block(tokens)  # [N, T, hidden]
        state = self.norm(tokens).reshape(*latent.shape[:-1], -1)  # [..., T, hidden]
        return self.head(torch.cat([state, latent, next_latent], dim=-1))


class InverseDynamicsModel(TensorDictModule):
    """``latent`` and ``("next", "latent")`` [..., D] -> ``recovered_action`` [..., F * A], z-scored.

    Args:
        latent_dim (int): D.
        action_dim (int): F * A, width of an action block.
        hidden_dim (int, optional): width of the hidden layers. Default: ``512``.
        dropout (float, optional): dropout rate of the hidden layers. Default: ``0.0``.
        kind (str, optional): ``"mlp"``, the paper's; ``"gaussian"``, which also writes ``recovered_action_log_var``;
            ``"ensemble"``, which also writes ``recovered_action_variance``; or ``"transformer"``, which takes sequences
            [..., T, D] of up to ``history`` latents. Default: ``"mlp"``.
        in_keys (tuple of NestedKey, optional): where the two latents are read. Their order matters only where their
            names do not say which is which. Default: ``("latent", ("next", "latent"))``.
        out_key (NestedKey, optional): where the action block is written. Default: ``"recovered_action"``.
        **network: further arguments of the network of that kind: ``members``, or ``history``, ``depth`` and ``heads``.

    Raises:
        ValueError: an unknown kind.

    Examples:
        >>> import torch
        >>> inverse_model = InverseDynamicsModel(latent_dim=16, action_dim=10)
        >>> inverse_model(latent=torch.zeros(2, 3, 16), next_latent=torch.zeros(2, 3, 16)).shape
        torch.Size([2, 3, 10])
        >>> InverseDynamicsModel(16, 10, kind="gaussian").out_keys
        ['recovered_action', 'recovered_action_log_var']
    """

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        hidden_dim: int = 512,
        dropout: float = 0.0,
        *,
        kind: Literal["mlp", "gaussian", "ensemble", "transformer"] = "mlp",
        in_keys: tuple[NestedKey, NestedKey] = (LATENT, ("next", LATENT)),
        out_key: NestedKey = RECOVERED_ACTION,
        **network,
    ) -> None:
        if kind not in INVERSE_NETWORKS:
            raise ValueError(f"unknown kind of inverse model {kind!r}: choose one of {sorted(INVERSE_NETWORKS)}.")
        make, extra_keys = INVERSE_NETWORKS[kind]
        module = make(latent_dim, action_dim, hidden_dim, dropout, **network)
        keys = sort_keys("inverse_model", in_keys, LATENT, NEXT_LATENT)
        super().__init__(module, in_keys=keys, out_keys=[out_key, *extra_keys])


INVERSE_NETWORKS = {
    "mlp": (InverseMLP, ()),
    "gaussian": (GaussianInverse, (RECOVERED_ACTION_LOG_VAR,)),
    "ensemble": (InverseEnsemble, (RECOVERED_ACTION_VARIANCE,)),
    "transformer": (InverseTransformer, ()),
}
