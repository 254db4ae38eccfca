"""Losses around networks of a few hundred parameters, and clips of noise for them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_ficreg import FICRegLoss, LeWMLoss, make_world_model, ModelConfig, SIGReg

SIZE, BLOCK = 16, 6  # pixels, width of an action block: 2 actions of 3 dimensions
CONFIG = ModelConfig(
    encoder="conv",
    image_size=SIZE,
    frame_skip=2,
    latent_dim=6,
    history=2,
    conv_channels=(4, 8),
    encoder_projector_dim=12,
    predictor_width=8,
    predictor_depth=2,
    predictor_heads=2,
    predictor_dim_head=4,
    predictor_mlp_dim=16,
    predictor_projector_dim=12,
    predictor_dropout=0.5,
    inverse_hidden_dim=16,
)


@pytest.fixture
def networks() -> Callable[..., tuple[nn.Module, nn.Module, nn.Module]]:
    """``networks(dropout)`` gives encoder, predictor and inverse model; the same numbers at every call.

    All parameters are moved off their start values, where zeroed layers would hide paths of the gradient.
    """

    def networks(dropout: float = 0.5) -> tuple[nn.Module, nn.Module, nn.Module]:
        torch.manual_seed(0)
        config = ModelConfig(**{**vars(CONFIG), "predictor_dropout": dropout})
        model, inverse_model = make_world_model(config, action_dim=3)
        with torch.no_grad():
            for param in [*model.parameters(), *inverse_model.parameters()]:
                param.add_(0.1 * torch.randn_like(param))
        return model.encoder, model.predictor, inverse_model

    return networks


@pytest.fixture
def make_lewm(networks) -> Callable[..., LeWMLoss]:
    """``make_lewm(dropout, **arguments)``, always with the same numbers."""
    return lambda dropout=0.5, **kwargs: LeWMLoss(*networks(dropout)[:2], sigreg=SIGReg(16), **kwargs)


@pytest.fixture
def make_ficreg(networks) -> Callable[..., FICRegLoss]:
    """``make_ficreg(dropout, **arguments)``, with the numbers of ``make_lewm``."""
    return lambda dropout=0.5, **kwargs: FICRegLoss(*networks(dropout), sigreg=SIGReg(16), **kwargs)


@pytest.fixture
def make_clip() -> Callable[..., TensorDict]:
    """``make_clip(*lead, frames, seed)`` is a clip [*lead, frames] of noise."""

    def make_clip(*lead: int, frames: int = 3, seed: int = 0) -> TensorDict:
        generator = torch.Generator().manual_seed(seed)
        shape = (*(lead or (8,)), frames)
        pixels = torch.randint(0, 256, (*shape, 3, SIZE, SIZE), dtype=torch.uint8, generator=generator)
        return TensorDict({"pixels": pixels, "action": torch.randn(*shape, BLOCK, generator=generator)}, shape)

    return make_clip
