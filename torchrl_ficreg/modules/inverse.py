"""Inverse dynamics models: which action led from one latent to the next, and how sure can one be?

One interface. All read ``latent`` and ``("next", "latent")`` [..., T, D] and write ``recovered_action``
[..., T, F * A], z-scored. Some say how sure they are, per dimension: a Gaussian head writes
``recovered_action_log_var``, an ensemble writes ``recovered_action_spread``, the variance among its members. None
holds a BatchNorm: the same network judges imagined transitions, and running statistics would be moved by them.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from torchrl_ficreg.keys import LATENT, RECOVERED_ACTION
from torchrl_ficreg.modules.feed import NEXT_LATENT, sort_keys
from torchrl_ficreg.modules.transformer import Block

LOG_VAR, SPREAD = "recovered_action_log_var", "recovered_action_spread"
_LOG_VAR_RANGE = (-7.0, 2.0)  # of z-scored actions: from a std of 0.03 to one of 2.7


class InverseMLP(nn.Module):
    """Three linear layers on two concatenated latents (FICReg, appendix B).

    Args:
        latent_dim: D.
        action_dim: width of an action block, frame skip x raw action dimension.
        hidden_dim, dropout: of the two hidden layers.
    """

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

    def __init__(self, latent_dim: int, action_dim: int, hidden_dim: int = 512, dropout: float = 0.0) -> None:
        super().__init__(latent_dim, 2 * action_dim, hidden_dim, dropout)

    def forward(self, latent: torch.Tensor, next_latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """[..., D] and [..., D] -> mean and log-variance, each [..., F * A]."""
        mean, log_var = super().forward(latent, next_latent).chunk(2, dim=-1)
        low, high = _LOG_VAR_RANGE  # softly bounded (arXiv 1805.12114), so that the gradient never dies
        log_var = high - F.softplus(high - log_var)
        return mean, low + F.softplus(log_var - low)


class InverseEnsemble(nn.Module):
    """Independently started :class:`InverseMLP` members; their mean, and their variance where they disagree.

    Args:
        members: at least 2.
        latent_dim, action_dim, hidden_dim, dropout: of each member.
    """

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
    """Sees all latents so far: one frame hides velocity, a few show it.

    A causal transformer reads the latents up to t; its state and the next latent give the action. Only the next latent
    of step t is taken from the transition to be judged, so an imagined one is seen against real history.

    Args:
        latent_dim: D.
        action_dim: width of an action block.
        hidden_dim: width of the transformer and of the head.
        dropout: in the head.
        history: H, longest sequence of latents.
        depth, heads: of the transformer.
    """

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
        """Draws the position embedding; the layers reset themselves."""
        nn.init.normal_(self.position, std=0.02)

    def forward(self, latent: torch.Tensor, next_latent: torch.Tensor) -> torch.Tensor:
        """[..., T, D] and [..., T, D], T at most H -> action blocks [..., T, F * A].

        Raises:
            ValueError: more than H latents.
        """
        if not 1 <= latent.shape[-2] <= self.history:
            raise ValueError(
                f"the inverse model sees 1 to {self.history} latents, got {latent.shape[-2]}: give shorter clips, or "
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
        latent_dim: D.
        action_dim: width F * A of an action block.
        hidden_dim, dropout: see :class:`InverseMLP`.
        kind: ``"mlp"``, the paper's; ``"gaussian"``, which also writes ``recovered_action_log_var``; ``"ensemble"``,
            which also writes ``recovered_action_spread``; or ``"transformer"``, which sees up to ``history`` latents
            and needs sequences [..., T, D].
        in_keys, out_key: where the two latents are read, told apart by name where they can be, and the action block is
            written.
        **network: further arguments of the network of that kind (``members``; ``history``, ``depth``, ``heads``).

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
        kind: str = "mlp",
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
    "gaussian": (GaussianInverse, (LOG_VAR,)),
    "ensemble": (InverseEnsemble, (SPREAD,)),
    "transformer": (InverseTransformer, ()),
}
