"""Inverse dynamics model: which action led from one latent to the next?"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from torchrl_ficreg.data.schema import LATENT, RECOVERED_ACTION


class InverseMLP(nn.Module):
    """Three linear layers on two concatenated latents (FICReg, appendix B).

    No BatchNorm: the same network judges imagined transitions, and running statistics would be moved by them.

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


class InverseDynamicsModel(TensorDictModule):
    """``latent`` and ``("next", "latent")`` [..., D] -> ``recovered_action`` [..., F * A], z-scored.

    Args:
        latent_dim: D.
        action_dim: width F * A of an action block.
        hidden_dim, dropout: see :class:`InverseMLP`.
        in_keys, out_key: where the two latents are read and the action block is written.

    Examples:
        >>> import torch
        >>> inverse_model = InverseDynamicsModel(latent_dim=16, action_dim=10)
        >>> inverse_model(latent=torch.zeros(2, 3, 16), next_latent=torch.zeros(2, 3, 16)).shape
        torch.Size([2, 3, 10])
    """

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        hidden_dim: int = 512,
        dropout: float = 0.0,
        *,
        in_keys: tuple[NestedKey, NestedKey] = (LATENT, ("next", LATENT)),
        out_key: NestedKey = RECOVERED_ACTION,
    ) -> None:
        network = InverseMLP(latent_dim, action_dim, hidden_dim, dropout)
        super().__init__(network, in_keys=list(in_keys), out_keys=[out_key])
