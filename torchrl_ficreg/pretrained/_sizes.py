"""Networks as plain numbers, read off a model, and the model built from them again.

A :class:`~torchrl_ficreg.modules.config.ModelConfig` names the sizes one chooses to train with. Weights made elsewhere
may have any size the networks can take, so what is stored beside weights is the arguments of the networks themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg.modules.conv import ConvEncoder, ConvNetwork
from torchrl_ficreg.modules.inverse import INVERSE_NETWORKS, InverseDynamicsModel, InverseEnsemble, InverseTransformer
from torchrl_ficreg.modules.keypoints import KeypointEncoder, KeypointNetwork
from torchrl_ficreg.modules.predictor import CausalPredictor, CausalTransformer
from torchrl_ficreg.modules.vit import VisionTransformer, ViTEncoder
from torchrl_ficreg.modules.world_model import LatentWorldModel

Sizes = dict[str, Any]
_SETTINGS = ("p", "weight_dropout", "heads", "causal", "eps", "momentum", "approximate", "stride", "padding")


def world_model_sizes(model: LatentWorldModel) -> Sizes:
    """``encoder``, ``predictor`` and ``frame_skip`` of a world model, as plain numbers.

    Raises:
        TypeError: networks other than the package's own.
        ValueError: one of them was changed in a way that these numbers do not tell, such as the dropout of one layer.

    Examples:
        >>> from torchrl_ficreg import make_world_model, ModelConfig
        >>> model, _ = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> world_model_sizes(model)["encoder"]["kind"]
        'conv'
    """
    sizes = {
        "encoder": _encoder_sizes(_network(model.encoder)),
        "predictor": _predictor_sizes(_network(model.predictor)),
        "frame_skip": model.frame_skip,
    }
    _check_same(model, build_world_model, sizes)
    return sizes


def build_world_model(sizes: Sizes) -> LatentWorldModel:
    """The world model that :func:`world_model_sizes` describes, with fresh weights."""
    arguments = dict(sizes["encoder"])
    encoder = {"vit": ViTEncoder, "conv": ConvEncoder, "keypoint": KeypointEncoder}[arguments.pop("kind")](**arguments)
    return LatentWorldModel(encoder, CausalPredictor(**sizes["predictor"]), frame_skip=sizes["frame_skip"])


def inverse_model_sizes(inverse_model: InverseDynamicsModel) -> Sizes:
    """Arguments of an inverse dynamics model, as plain numbers.

    Raises:
        TypeError: a network other than the package's own.
        ValueError: it was changed in a way that these numbers do not tell.
    """
    network = _network(inverse_model)
    kinds = {make: kind for kind, (make, _) in INVERSE_NETWORKS.items()}
    if type(network) not in kinds:
        raise _foreign(network, kinds)
    kind = kinds[type(network)]
    if isinstance(network, InverseTransformer):
        hidden_dim, dropout = network.to_width.out_features, network.head[2].p
        extra = {"history": network.history, "depth": len(network.blocks), "heads": network.blocks[0].attn.heads}
        latent_dim, outputs = network.to_width.in_features, network.head[-1].out_features
    else:
        ensemble = isinstance(network, InverseEnsemble)
        layers = (network.members[0] if ensemble else network).layers
        hidden_dim, dropout = layers[0].out_features, layers[2].p
        extra = {"members": len(network.members)} if ensemble else {}
        latent_dim, outputs = layers[0].in_features // 2, layers[-1].out_features
    action_dim = outputs // 2 if kind == "gaussian" else outputs
    sizes = {"latent_dim": latent_dim, "action_dim": action_dim, "hidden_dim": hidden_dim, "dropout": dropout}
    sizes = {"kind": kind, **sizes, **extra}
    _check_same(inverse_model, build_inverse_model, sizes)
    return sizes


def build_inverse_model(sizes: Sizes) -> InverseDynamicsModel:
    """The inverse dynamics model that :func:`inverse_model_sizes` describes, with fresh weights."""
    return InverseDynamicsModel(**sizes)


def _network(module: nn.Module) -> nn.Module:
    return module.module if isinstance(module, TensorDictModule) else module


def _check_same(module: nn.Module, build: Callable[[Sizes], nn.Module], sizes: Sizes) -> None:
    """Compares what no weight tells, layer by layer, with the network that will be built from the sizes.

    Raises:
        ValueError: a rate or another setting of a layer differs.
    """
    with torch.device("meta"):
        built = build(sizes)
    theirs = dict(_layers(built))
    for name, ours in _layers(module):
        differing = [f"{key}={ours.get(key)}" for key in ours if ours.get(key) != theirs.get(name, {}).get(key)]
        if differing:
            raise ValueError(
                f"layer {name} has {', '.join(differing)}, which the saved sizes do not tell: build the model with one rate "
                "for all layers, and save it without changes to single ones."
            )


def _layers(module: nn.Module) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, layer in module.named_modules():
        settings = {key: getattr(layer, key) for key in _SETTINGS if hasattr(layer, key)}
        if not any(True for _ in layer.parameters()) and not any(True for _ in layer.buffers()):
            settings["class"] = type(layer).__name__  # an activation
        yield name.replace("_orig_mod.", ""), settings


def _foreign(network: nn.Module, known) -> TypeError:
    names = ", ".join(sorted(make.__name__ for make in known))
    return TypeError(f"only the package's own networks can be described ({names}), got {type(network).__name__}.")


def _encoder_sizes(network: nn.Module) -> Sizes:
    known = (VisionTransformer, ConvNetwork, KeypointNetwork)
    if type(network) not in known:
        raise _foreign(network, known)
    if isinstance(network, KeypointNetwork):
        *channels, maps = [layer.out_channels for layer in network.convolutions if isinstance(layer, nn.Conv2d)]
        return {
            "kind": "keypoint",
            "image_size": network.normalize.image_size,
            "channels": channels,
            "num_keypoints": maps,
            "latent_dim": network.layer_out.out_features,
        }
    projector = network.projector
    shared = {
        "image_size": network.normalize.image_size,
        "projector_dim": projector.layer_in.out_features,
        "latent_dim": projector.layer_out.out_features,
    }
    if isinstance(network, ConvNetwork):
        channels = [layer.out_channels for layer in network.convolutions if isinstance(layer, nn.Conv2d)]
        return {"kind": "conv", **shared, "channels": channels}
    block = network.blocks[0]
    return {
        "kind": "vit",
        **shared,
        "patch_size": network.patch_size,
        "width": network.class_token.shape[-1],
        "depth": len(network.blocks),
        "heads": block.attn.heads,
        "mlp_dim": block.mlp[0].out_features,
    }


def _predictor_sizes(network: nn.Module) -> Sizes:
    if type(network) is not CausalTransformer:
        raise _foreign(network, (CausalTransformer,))
    block = network.blocks[0]
    return {
        "latent_dim": network.latent_dim,
        "action_dim": network.action_dim,
        "history": network.history,
        "width": network.position.shape[-1],
        "depth": len(network.blocks),
        "heads": block.attn.heads,
        "dim_head": block.attn.inner // block.attn.heads,
        "mlp_dim": block.mlp[0].out_features,
        "dropout": block.attn.dropout.p,
        "attention_dropout": block.attn.weight_dropout,
        "projector_dim": network.projector.layer_in.out_features,
        "action_bottleneck": network.action_embedding.compress.out_features,
    }
