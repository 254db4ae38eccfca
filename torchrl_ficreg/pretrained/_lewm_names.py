"""Names in official LeWM checkpoints: which tensor is which of ours, and which field of the configuration which argument.

Tensors correspond one to one, with two exceptions: query, key and value of the published vision transformer are three
layers (ours is one, with their rows stacked), and the published patch embedding and first action layer are convolutions
whose stride is their kernel (ours are linear layers on flattened patches).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import torch

from torchrl_ficreg.pretrained.folder import Sizes

Naming = Literal["transformers4", "transformers5"]
_ENCODER_LAYER = {"transformers4": "encoder.encoder.layer.", "transformers5": "encoder.layers."}
# Parts of a layer of the vision transformer: ours, in transformers 4, in transformers 5.
_VIT_PARTS = (
    ("attn_norm", ("layernorm_before",), ("layernorm_before",)),
    (
        "attn.to_qkv",
        tuple(f"attention.attention.{part}" for part in ("query", "key", "value")),
        tuple(f"attention.{part}_proj" for part in "qkv"),
    ),
    ("attn.to_out", ("attention.output.dense",), ("attention.o_proj",)),
    ("mlp_norm", ("layernorm_after",), ("layernorm_after",)),
    ("mlp.0", ("intermediate.dense",), ("mlp.fc1",)),
    ("mlp.3", ("output.dense",), ("mlp.fc2",)),
)
_PREDICTOR_PARTS = {
    "to_modulation": "adaLN_modulation.1",
    "attn_norm": "attn.norm",
    "attn.to_out": "attn.to_out.0",
    "mlp_norm": "mlp.net.0",
    "mlp.0": "mlp.net.1",
    "mlp.3": "mlp.net.4",
}
_PROJECTOR_PARTS = {"layer_in": "net.0", "norm": "net.1", "layer_out": "net.3"}
_BATCH_NORM_BUFFERS = ("running_mean", "running_var", "num_batches_tracked")
_VIT_SIZES = {  # width, depth, heads; the MLP has four times the width
    "tiny": (192, 12, 3),
    "small": (384, 12, 6),
    "base": (768, 12, 12),
    "large": (1024, 24, 16),
    "huge": (1280, 32, 16),
}
_VIT_FIELDS = ("hidden_size", "num_hidden_layers", "num_attention_heads", "intermediate_size")
_DIM_HEAD = 64  # default of the published predictor
_LEWM = "stable_worldmodel.wm.lewm"
_MODELS = ("LeWM", "JEPA")
_TARGETS = {  # class names of the parts; the second ones are those of the paper's release
    "encoder": ("vit_hf",),
    "predictor": ("Predictor", "ARPredictor"),
    "action_encoder": ("Embedder",),
    "projector": ("MLP",),
    "pred_proj": ("MLP",),
}
_READ = {  # fields that give a size, or do not matter for the network
    "encoder": {"size", "patch_size", "image_size", "pretrained", "use_mask_token", *_VIT_FIELDS},
    "predictor": {
        *("num_frames", "input_dim", "hidden_dim", "output_dim"),
        *("depth", "heads", "mlp_dim", "dim_head", "dropout"),
    },
    "action_encoder": {"input_dim", "smoothed_dim", "emb_dim"},
    "projector": {"input_dim", "hidden_dim", "output_dim"},
    "pred_proj": {"input_dim", "hidden_dim", "output_dim"},
}
_FIXED = {  # fields that have one possible value in our networks
    "encoder": {
        "hidden_act": "gelu",
        "layer_norm_eps": 1e-12,
        "qkv_bias": True,
        "num_channels": 3,
        "hidden_dropout_prob": 0.0,
        "attention_probs_dropout_prob": 0.0,
    },
    "predictor": {"emb_dropout": 0.0},
    "action_encoder": {"mlp_scale": 4},
    "projector": {"norm_fn": "BatchNorm1d", "act_fn": "GELU"},
    "pred_proj": {"norm_fn": "BatchNorm1d", "act_fn": "GELU"},
}


class Match(NamedTuple):
    """A tensor of ours and the published ones with the same values.

    Attributes:
        ours: name in the state of a :class:`~torchrl_ficreg.modules.world_model.LatentWorldModel`.
        theirs: published names; several are concatenated along the first axis in ours.
        trailing: published shape without its first axis, where it differs from ours.
    """

    ours: str
    theirs: tuple[str, ...]
    trailing: tuple[int, ...] | None = None

    def published_shape(self, ours: torch.Tensor) -> tuple[int, ...]:
        """Shape of each of ``theirs``."""
        if not ours.ndim:
            return ()
        return (len(ours) // len(self.theirs), *(self.trailing or ours.shape[1:]))

    def publish(self, ours: torch.Tensor) -> dict[str, torch.Tensor]:
        """Our tensor as the published ones."""
        parts = ours.chunk(len(self.theirs)) if len(self.theirs) > 1 else [ours]
        shape = self.published_shape(ours)
        return {name: part.reshape(shape).clone() for name, part in zip(self.theirs, parts)}

    def adopt(self, theirs: dict[str, torch.Tensor], like: torch.Tensor) -> torch.Tensor:
        """The published tensors as ours, shaped ``like`` it."""
        parts = [theirs[name] for name in self.theirs]
        return (torch.cat(parts) if len(parts) > 1 else parts[0]).reshape(like.shape)


def naming_of(names: list[str]) -> Naming:
    """Which release of ``transformers`` named the encoder's layers."""
    old = any(name.startswith(_ENCODER_LAYER["transformers4"]) for name in names)
    return "transformers4" if old else "transformers5"


def matches(sizes: Sizes, naming: Naming) -> list[Match]:
    """All tensors of a LeWM world model of the given sizes."""
    return [*_encoder(sizes["encoder"], naming), *_predictor(sizes["predictor"])]


def _affine(ours: str, *theirs: str) -> Iterator[Match]:
    for kind in ("weight", "bias"):
        yield Match(f"{ours}.{kind}", tuple(f"{name}.{kind}" for name in theirs))


def _projector(ours: str, theirs: str) -> Iterator[Match]:
    for part, published in _PROJECTOR_PARTS.items():
        yield from _affine(f"{ours}.{part}", f"{theirs}.{published}")
    for buffer in _BATCH_NORM_BUFFERS:
        yield Match(f"{ours}.norm.{buffer}", (f"{theirs}.{_PROJECTOR_PARTS['norm']}.{buffer}",))


def _encoder(sizes: Sizes, naming: Naming) -> Iterator[Match]:
    ours, theirs, patch = "encoder.module", "encoder.embeddings", sizes["patch_size"]
    yield Match(f"{ours}.class_token", (f"{theirs}.cls_token",))
    yield Match(f"{ours}.position", (f"{theirs}.position_embeddings",))
    yield Match(f"{ours}.to_patch.weight", (f"{theirs}.patch_embeddings.projection.weight",), (3, patch, patch))
    yield Match(f"{ours}.to_patch.bias", (f"{theirs}.patch_embeddings.projection.bias",))
    for layer in range(sizes["depth"]):
        for part, *generations in _VIT_PARTS:
            published = generations[naming == "transformers5"]
            names = [f"{_ENCODER_LAYER[naming]}{layer}.{name}" for name in published]
            yield from _affine(f"{ours}.blocks.{layer}.{part}", *names)
    yield from _affine(f"{ours}.norm", "encoder.layernorm")
    yield from _projector(f"{ours}.projector", "projector")


def _predictor(sizes: Sizes) -> Iterator[Match]:
    ours, theirs = "predictor.module", "predictor.transformer"
    action, published = f"{ours}.action_embedding", "action_encoder"
    yield Match(f"{action}.compress.weight", (f"{published}.patch_embed.weight",), (sizes["action_dim"], 1))
    yield Match(f"{action}.compress.bias", (f"{published}.patch_embed.bias",))
    yield from _affine(f"{action}.layer_in", f"{published}.embed.0")
    yield from _affine(f"{action}.layer_out", f"{published}.embed.2")
    yield Match(f"{ours}.position", ("predictor.pos_embedding",))
    for layer in range(sizes["depth"]):
        mine, other = f"{ours}.blocks.{layer}", f"{theirs}.layers.{layer}"
        for part, name in _PREDICTOR_PARTS.items():
            yield from _affine(f"{mine}.{part}", f"{other}.{name}")
        yield Match(f"{mine}.attn.to_qkv.weight", (f"{other}.attn.to_qkv.weight",))
    yield from _affine(f"{ours}.norm", f"{theirs}.norm")
    yield from _projector(f"{ours}.projector", "pred_proj")


def sizes_from_config(config: dict[str, Any], tensors: dict[str, torch.Tensor], frame_skip: int) -> Sizes:
    """Sizes of the networks of a checkpoint; those missing in ``config`` are inferred from the shapes of ``tensors``.

    Args:
        config (dict): content of ``config.json``.
        tensors (dict of str to Tensor): by published name.
        frame_skip (int): F, environment actions in one block, which the files do not contain.

    Returns:
        sizes as :func:`~torchrl_ficreg.pretrained.folder.world_model_sizes` gives them.

    Raises:
        ValueError: networks that differ from ours, or a size that neither config nor shapes give.
    """
    if "encoder" not in config and isinstance(config.get("model"), dict):
        config = config["model"]  # the configuration of a whole run
    whole = _class_name(config)
    if whole not in _MODELS:
        raise ValueError(f"config.json asks for {whole}, not for a {' or '.join(_MODELS)}.")
    for part in _TARGETS:
        _check_part(part, config.get(part))
    read = _SizeReader(config, tensors)
    vit = config["encoder"].get("size", "tiny")
    if vit not in _VIT_SIZES:
        raise ValueError(f"config.json: encoder.size must be one of {sorted(_VIT_SIZES)}, got {vit!r}.")
    vit_width, vit_depth, vit_heads = _VIT_SIZES[vit]
    patch = read("encoder.patch_size", "encoder.embeddings.patch_embeddings.projection.weight", 2)
    tokens = "encoder.embeddings.position_embeddings"
    width = read("predictor.hidden_dim", "predictor.transformer.norm.weight")
    ends = [read(f"predictor.{end}_dim", default=width) for end in ("input", "output")]
    if ends != [width, width]:
        raise ValueError(
            f"config.json: a predictor of width {width} between latents of width {ends[0]} and {ends[1]} holds "
            "projections that ours does not have; only equal widths can be read."
        )
    dropout = config["predictor"].get("dropout", 0.0)
    if isinstance(dropout, bool) or not isinstance(dropout, (int, float)) or not 0 <= dropout < 1:
        raise ValueError(f"config.json: predictor.dropout must lie in [0, 1), got {str(dropout)[:40]!r}.")
    latent_dim = read("projector.output_dim", "projector.net.3.weight", 0)
    encoder = {
        "kind": "vit",
        "image_size": read("encoder.image_size", tokens, 1, of=lambda tokens: math.isqrt(tokens - 1) * patch),
        "patch_size": patch,
        "width": read("encoder.hidden_size", default=vit_width),
        "depth": read("encoder.num_hidden_layers", default=vit_depth),
        "heads": read("encoder.num_attention_heads", default=vit_heads),
        "mlp_dim": read("encoder.intermediate_size", default=4 * vit_width),
        "projector_dim": read("projector.hidden_dim", "projector.net.0.weight", 0),
        "latent_dim": latent_dim,
    }
    predictor = {
        "latent_dim": latent_dim,
        "action_dim": read("action_encoder.input_dim", "action_encoder.patch_embed.weight", 1),
        "history": read("predictor.num_frames", "predictor.pos_embedding", 1),
        "width": width,
        "depth": read("predictor.depth", default=_count(tensors, "predictor.transformer.layers.")),
        "heads": read("predictor.heads"),
        "dim_head": read("predictor.dim_head", default=_DIM_HEAD),
        "mlp_dim": read("predictor.mlp_dim", "predictor.transformer.layers.0.mlp.net.1.weight", 0),
        "dropout": dropout,
        "attention_dropout": dropout,  # the published predictor has one rate for both
        "projector_dim": read("pred_proj.hidden_dim", "pred_proj.net.0.weight", 0),
        "action_bottleneck": read("action_encoder.smoothed_dim", "action_encoder.patch_embed.weight", 0),
    }
    return {"encoder": encoder, "predictor": predictor, "frame_skip": frame_skip}


def config_from_sizes(sizes: Sizes) -> dict[str, Any]:
    """The ``config.json`` from which the published loader builds the same networks.

    Raises:
        ValueError: networks that the published code does not have.
    """
    encoder, predictor = sizes["encoder"], sizes["predictor"]
    if encoder["kind"] != "vit":
        raise ValueError(f"a LeWM checkpoint holds a vision transformer, this model a {encoder['kind']!r} encoder.")
    width = predictor["width"]
    if predictor["latent_dim"] != width:
        raise ValueError(
            f"LeWM's predictor is as wide as the latent; this one is {width} wide, for latents of "
            f"{predictor['latent_dim']}: build it with predictor_width equal to latent_dim."
        )
    if predictor["heads"] == 1 and predictor["dim_head"] == width:
        raise ValueError("LeWM's predictor has no output projection when a single head has the full width; ours has.")
    rates = predictor["dropout"], predictor["attention_dropout"]
    if rates[0] != rates[1]:
        raise ValueError(
            f"LeWM's predictor has one dropout for its layers and its attention weights, this one {rates[0]} and {rates[1]}: "
            "build it with predictor_attention_dropout equal to predictor_dropout."
        )
    vit = (encoder["width"], encoder["depth"], encoder["heads"], encoder["mlp_dim"])
    named = next((name for name, shape in _VIT_SIZES.items() if vit == (*shape, 4 * shape[0])), None)
    return {
        "_target_": f"{_LEWM}.LeWM",
        "encoder": {
            "_target_": "stable_pretraining.backbone.utils.vit_hf",
            "size": named or "tiny",
            "patch_size": encoder["patch_size"],
            "image_size": encoder["image_size"],
            "pretrained": False,
            "use_mask_token": False,
            **({} if named else dict(zip(_VIT_FIELDS, vit))),
        },
        "predictor": {
            "_target_": f"{_LEWM}.module.Predictor",
            "num_frames": predictor["history"],
            **dict.fromkeys(("input_dim", "hidden_dim", "output_dim"), width),
            **{field: predictor[field] for field in ("depth", "heads", "mlp_dim", "dim_head", "dropout")},
            "emb_dropout": 0.0,
        },
        "action_encoder": {
            "_target_": f"{_LEWM}.module.Embedder",
            "input_dim": predictor["action_dim"],
            "smoothed_dim": predictor["action_bottleneck"],
            "emb_dim": width,
        },
        "projector": _projector_config(encoder["width"], encoder["projector_dim"], encoder["latent_dim"]),
        "pred_proj": _projector_config(width, predictor["projector_dim"], predictor["latent_dim"]),
    }


class _SizeReader:
    """Reads a size from the configuration, else takes a default, else the shape of a tensor."""

    def __init__(self, config: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
        self.config, self.tensors = config, tensors

    def __call__(self, field: str, tensor: str | None = None, axis: int = 0, *, default: int | None = None, of=int):
        part, _, name = field.partition(".")
        value = self.config[part].get(name)
        if value is None:
            value = default
        if value is None and tensor in self.tensors and self.tensors[tensor].ndim > axis:
            value = of(self.tensors[tensor].shape[axis])
        if not isinstance(value, int) or value < 1:
            wanted = f"the tensor {tensor} tells it" if tensor else "no tensor tells it"
            raise ValueError(f"config.json: {field} must be a positive integer, got {value!r} ({wanted}).")
        return value


def _check_part(part: str, fields: Any) -> None:
    """Checks that one section of the configuration describes a network that ours is."""
    name = _class_name(fields)
    if name in ("None", "Identity") and part in ("projector", "pred_proj"):
        raise ValueError(f"config.json: the model was trained without {part!r}; ours always ends in a projector.")
    if not isinstance(fields, dict) or name not in _TARGETS[part]:
        raise ValueError(f"config.json: {part} must be a {' or '.join(_TARGETS[part])}, got {name}.")
    fixed, projector = _FIXED[part], part in ("projector", "pred_proj")
    unknown = sorted(fields.keys() - _READ[part] - fixed.keys() - {"_target_"})
    if unknown:
        raise ValueError(f"config.json: {part} has fields {unknown}, of which it is not known what they change.")
    given = {field: _class_name(fields[field]) if projector else fields[field] for field in fixed if field in fields}
    if projector:
        given.setdefault("norm_fn", "LayerNorm")  # the published class's own choice
    wrong = [f"{field}={value!r}, not {fixed[field]!r}" for field, value in given.items() if value != fixed[field]]
    if wrong:
        raise ValueError(f"config.json: {part} differs from our network ({'; '.join(wrong)}).")


def _class_name(node: Any) -> str:
    target = node.get("_target_", "no _target_") if isinstance(node, dict) else node
    return str(target).rpartition(".")[2]


def _count(tensors: dict[str, torch.Tensor], prefix: str) -> int:
    return len({name[len(prefix) :].partition(".")[0] for name in tensors if name.startswith(prefix)})


def _projector_config(in_dim: int, hidden_dim: int, out_dim: int) -> dict[str, Any]:
    return {
        "_target_": f"{_LEWM}.module.MLP",
        "input_dim": in_dim,
        "hidden_dim": hidden_dim,
        "output_dim": out_dim,
        "norm_fn": {"_target_": "torch.nn.BatchNorm1d", "_partial_": True},
    }
