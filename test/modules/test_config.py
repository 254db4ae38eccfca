"""Claims about the presets: published sizes to the last parameter, and sizes that are refused."""

from __future__ import annotations

import pytest
import torch

from torchrl_ficreg import make_world_model, ModelConfig


def count(*modules):
    return sum(param.numel() for module in modules for param in module.parameters())


@pytest.fixture(scope="module")
def paper():
    with torch.device("meta"):
        return make_world_model(ModelConfig.preset("paper"), action_dim=2)


def test_the_paper_preset_has_the_published_parameters(paper):
    """LeWM's released PushT weights (arXiv 2603.19312): 18,034,478, part by part."""
    model, _ = paper
    encoder, predictor = model.encoder.module, model.predictor.module
    assert count(model) == 18_034_478
    assert count(encoder) - count(encoder.projector) == 5_501_376
    assert count(encoder.projector) == count(predictor.projector) == 792_768
    assert count(predictor.action_embedding) == 156_206
    assert count(predictor) - count(predictor.projector, predictor.action_embedding) == 10_791_360


def test_the_inverse_model_is_an_mlp_of_width_512(paper):
    """FICReg, appendix B: 2 * 192 -> 512 -> 512 -> 5 * 2."""
    assert count(paper[1]) == (384 + 1) * 512 + (512 + 1) * 512 + (512 + 1) * 10


@pytest.mark.parametrize("action_dim", [1, 5])
def test_sizes_reach_the_networks(action_dim):
    config = ModelConfig.preset("cpu", frame_skip=3, latent_dim=7, history=2, inverse_hidden_dim=11, predictor_depth=1)
    model, inverse_model = make_world_model(config, action_dim)
    assert (model.frame_skip, model.history, len(model.action_mean)) == (3, 2, action_dim)
    model.eval()
    latent = model.encode(torch.zeros(2, 3, 64, 64))
    assert latent.shape == (2, 7)
    assert model.rollout(latent[:, None], torch.zeros(2, 4, 3 * action_dim)).shape == (2, 4, 7)
    assert inverse_model(latent=latent, next_latent=latent).shape == (2, 3 * action_dim)


def test_presets_can_be_changed_and_numbers_may_come_from_json():
    """A preset itself is not changed. Lists become tuples, so that a configuration read back equals the one written."""
    assert ModelConfig.preset("cpu", latent_dim=3).latent_dim == 3 != ModelConfig.preset("cpu").latent_dim
    assert ModelConfig(conv_channels=[4, 8], predictor_dropout=0) == ModelConfig(conv_channels=(4, 8), predictor_dropout=0.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"encoder": "resnet"}, "unknown encoder 'resnet': choose 'vit', 'conv' or 'keypoint'"),
        ({"latent_dim": 0, "history": -1}, "positive, got latent_dim=0, history=-1"),
        ({"conv_channels": (4, 0)}, r"positive, got conv_channels=\(4, 0\)"),
        ({"conv_channels": ()}, r"positive, got conv_channels=\(\)"),
        ({"predictor_dropout": 1.0}, r"predictor_dropout must lie in \[0, 1\), got 1.0"),
        ({"predictor_dropout": -0.1}, r"predictor_dropout must lie in \[0, 1\), got -0.1"),
        ({"name": "tiny"}, r"unknown preset 'tiny': choose one of \['cpu', 'gpu_short', 'paper'\]"),
    ],
)
def test_impossible_sizes_and_unknown_presets_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        (ModelConfig.preset if "name" in wrong else ModelConfig)(**wrong)


def test_the_paper_preset_starts_from_the_published_weights():
    """transformers' ViT: truncated normal 0.02 and no bias; the predictor's position embedding is N(0, 1)."""
    torch.manual_seed(0)
    config = ModelConfig.preset("paper", image_size=28, predictor_depth=1)
    model, _ = make_world_model(config, action_dim=2)
    network = model.encoder.module
    for layer in (network.to_patch, *(part for part in network.blocks.modules() if isinstance(part, torch.nn.Linear))):
        assert layer.weight.std().item() == pytest.approx(0.02, rel=0.02) and not layer.bias.any()
    position = model.predictor.module.position
    assert position.std().item() == pytest.approx(1.0, abs=4 / (2 * position.numel()) ** 0.5)
