"""Writes and compares checkpoints for the tests of both formats."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from golden.formula import published_config
from torch import nn

from torchrl_ficreg import CausalPredictor, LatentWorldModel, ViTEncoder


def small_lewm(**predictor) -> LatentWorldModel:
    """A world model that LeWM has too; other arguments of the predictor may be given."""
    encoder = ViTEncoder(image_size=14, patch_size=7, width=12, depth=1, heads=3, mlp_dim=16, projector_dim=12, latent_dim=8)
    sizes = {"latent_dim": 8, "action_dim": 4, "width": 8, "depth": 1, "heads": 2, "dim_head": 4, "mlp_dim": 16}
    sizes |= {"projector_dim": 12, "attention_dropout": 0.1}
    return LatentWorldModel(encoder, CausalPredictor(**{**sizes, **predictor}), frame_skip=2).eval()


def write(folder: Path, tensors: Any, config: dict | None = None, name: str = "weights.pt") -> Path:
    """Writes a published checkpoint; its configuration is that of the case ``"tiny"`` unless given."""
    folder.mkdir(exist_ok=True, parents=True)
    torch.save(tensors, folder / name)
    (folder / "config.json").write_text(json.dumps(config if config is not None else published_config("tiny")))
    return folder


def assert_same(model: nn.Module | dict[str, torch.Tensor], other: nn.Module | dict[str, torch.Tensor]) -> None:
    """Equal names, values and dtypes, of networks or of states."""
    state, expected = (one if isinstance(one, dict) else one.state_dict() for one in (model, other))
    assert state.keys() == expected.keys()
    for name, tensor in expected.items():
        assert torch.equal(state[name], tensor) and state[name].dtype == tensor.dtype, name
