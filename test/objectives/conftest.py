"""The losses of ``loss_collection`` as fixtures."""

from __future__ import annotations

from collections.abc import Callable

import loss_collection
import pytest
from tensordict import TensorDict
from torch import nn

from torchrl_ficreg import FICRegLoss, LeWMLoss


@pytest.fixture
def networks() -> Callable[..., tuple[nn.Module, nn.Module, nn.Module]]:
    """``networks(dropout, kind)`` gives encoder, predictor and inverse model; the same numbers at every call."""
    return loss_collection.make_networks


@pytest.fixture
def make_loss() -> Callable[..., nn.Module]:
    """``make_loss(name, dropout, **arguments)``, always with the same numbers."""
    return loss_collection.make_loss


@pytest.fixture
def make_lewm() -> Callable[..., LeWMLoss]:
    """``make_lewm(dropout, **arguments)``."""
    return lambda *args, **kwargs: loss_collection.make_loss("lewm", *args, **kwargs)


@pytest.fixture
def make_ficreg() -> Callable[..., FICRegLoss]:
    """``make_ficreg(dropout, **arguments)``, with the numbers of ``make_lewm``."""
    return lambda *args, **kwargs: loss_collection.make_loss("paper", *args, **kwargs)


@pytest.fixture
def make_clip() -> Callable[..., TensorDict]:
    """``make_clip(*lead, frames, seed)`` is a clip [*lead, frames] of noise."""
    return loss_collection.make_clip
