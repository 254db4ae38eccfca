"""Which tensor of an official LeWM checkpoint is which of ours.

One to one, but for two habits of the published networks: query, key and value of the vision transformer are three
layers (ours is one, their rows on top of each other), and the patch embedding and the first action layer are
convolutions whose stride is their kernel (ours are linear layers on flattened patches).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import torch

from torchrl_ficreg.pretrained._sizes import Sizes

Naming = Literal["transformers4", "transformers5"]
_ENCODER_LAYER = {"transformers4": "encoder.encoder.layer.", "transformers5": "encoder.layers."}
# Parts of one layer of the vision transformer: ours, those of transformers 4, those of transformers 5.
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


class Match(NamedTuple):
    """One tensor of ours and the published ones that hold the same numbers.

    Attributes:
        ours: name in the state of a :class:`~torchrl_ficreg.modules.world_model.LatentWorldModel`.
        theirs: published names; several stand on top of each other in ours.
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
    """Which generation of ``transformers`` named the encoder's layers."""
    old = any(name.startswith(_ENCODER_LAYER["transformers4"]) for name in names)
    return "transformers4" if old else "transformers5"


def matches(sizes: Sizes, naming: Naming) -> list[Match]:
    """All tensors of a LeWM world model with the given sizes, each once."""
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
