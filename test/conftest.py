"""Fixtures of all tests: world models small enough to be searched exhaustively, or by hand."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from _losses import TINY
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg import LatentWorldModel, make_world_model
from torchrl_ficreg.data import ActionStatistics
from torchrl_ficreg.envs import _workers

if FORKSERVER := "forkserver" in multiprocessing.get_all_start_methods():
    multiprocessing.set_forkserver_preload(["torchrl_ficreg.trainers", "torchrl_ficreg.envs"])


class LinearDynamics(nn.Module):
    """z' = z + sum of the F actions of the block: the sum of all planned actions is the way travelled."""

    def __init__(self, frame_skip: int, dim: int) -> None:
        super().__init__()
        self.history, self.latent_dim, self.action_dim = 1, dim, frame_skip * dim
        self.position = nn.Parameter(torch.eye(dim).repeat(frame_skip, 1))  # [F * A, D]

    def forward(self, latent, action):
        return latent + action @ self.position


class Corner(nn.Module):
    """The first two pixels of the red channel, as latents."""

    def forward(self, pixels):
        return pixels[..., 0, 0, :2].float()


@pytest.fixture
def linear_world() -> Callable[..., LatentWorldModel]:
    """``linear_world(frame_skip, mean, std)``: the plane, moved in by the z-scored actions."""

    def linear_world(frame_skip: int = 2, mean=(0.0, 0.0), std=(1.0, 1.0)) -> LatentWorldModel:
        predictor = TensorDictModule(LinearDynamics(frame_skip, 2), ["latent", "action"], ["predicted_latent"])
        encoder = TensorDictModule(Corner(), ["pixels"], ["latent"])
        statistics = ActionStatistics(torch.tensor(mean), torch.tensor(std))
        return LatentWorldModel(encoder, predictor, frame_skip=frame_skip, statistics=statistics).eval()

    return linear_world


@pytest.fixture
def tiny_world() -> Callable[..., LatentWorldModel]:
    """``tiny_world(action_dim, **sizes)`` in eval mode, all parameters moved off their start values."""

    def tiny_world(action_dim: int = 2, **sizes) -> LatentWorldModel:
        torch.manual_seed(0)
        model, _ = make_world_model(replace(TINY, **sizes), action_dim)
        with torch.no_grad():
            for param in model.parameters():
                param.add_(0.3 * torch.randn_like(param))
        return model.eval()

    return tiny_world


@pytest.fixture(params=[True, False], ids=["fast_bf16", "slow_bf16"])
def fast_bf16(request, monkeypatch) -> bool:
    """Whether this processor is taken for one with fast bfloat16 products: a test runs once for each."""
    monkeypatch.setattr("torchrl_ficreg._device.has_fast_bf16", lambda device, kind="products": request.param)
    return request.param


@pytest.fixture(autouse=True, scope="session")
def quick_workers():
    """Worker processes are forked from a server that has imported the package, which takes seconds.

    They are spawned, as outside of tests, in most of test_workers.py and by scripts in processes of their own.
    """
    with pytest.MonkeyPatch.context() as patch:
        if FORKSERVER:
            context = multiprocessing.get_context("forkserver")
            patch.setattr(_workers, "multiprocessing", SimpleNamespace(get_context=lambda method: context))
        yield


@pytest.fixture(autouse=True, scope="session")
def interruptible():
    """Shells start background jobs with SIGINT ignored, and children inherit that: Ctrl-C works in tests all the same."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
