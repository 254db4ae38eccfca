"""Weights and inputs by formula, so that golden files hold nothing but outputs. Needs torch alone.

The published table of tensors is written down here too: ``test_lewm.py`` builds checkpoints from it, and
``test/pretrained/golden/make_lewm.py`` compares it with the published networks.
"""

from __future__ import annotations

import zlib

import torch

# Arguments of the published networks. "paper" is LeWM for PushT; the others are small and have hardly two sizes alike.
# "faint": factor on what enters the transformers, so small that the epsilon of their first normalizations counts.
CASES = {
    "paper": {
        "image_size": 224, "patch_size": 14, "width": 192, "depth": 12, "heads": 3, "mlp": 768, "hidden": 2048,
        "latent": 192, "frames": 3, "block": 10, "smoothed": 10, "p_depth": 6, "p_heads": 16, "p_dim_head": 64,
        "p_mlp": 2048, "p_hidden": 2048,
    },
    "tiny": {
        "image_size": 28, "patch_size": 7, "width": 24, "depth": 2, "heads": 3, "mlp": 40, "hidden": 56,
        "latent": 20, "frames": 3, "block": 10, "smoothed": 6, "p_depth": 3, "p_heads": 2, "p_dim_head": 16,
        "p_mlp": 44, "p_hidden": 36, "faint": 0.003,
    },
    "intact": {  # a cube model whose first action layer keeps the width of the block
        "image_size": 28, "patch_size": 14, "width": 24, "depth": 2, "heads": 2, "mlp": 96, "hidden": 48,
        "latent": 192, "frames": 2, "block": 25, "smoothed": 25, "p_depth": 1, "p_heads": 3, "p_dim_head": 8,
        "p_mlp": 32, "p_hidden": 40,
    },
}  # fmt: skip
SEED = 20260319
ROWS, HORIZON = 2, 5  # trajectories; imagined steps

ENCODER_NAMES = {
    "transformers4": {
        "layer": "encoder.encoder.layer.",
        "qkv": [f"attention.attention.{part}" for part in ("query", "key", "value")],
        "out": "attention.output.dense",
        "mlp": ("intermediate.dense", "output.dense"),
    },
    "transformers5": {
        "layer": "encoder.layers.",
        "qkv": [f"attention.{part}_proj" for part in "qkv"],
        "out": "attention.o_proj",
        "mlp": ("mlp.fc1", "mlp.fc2"),
    },
}


def published_shapes(case: str, naming: str = "transformers4") -> dict[str, tuple[int, ...]]:
    """Name and shape of every tensor of a published LeWM checkpoint."""
    s, names, shapes = CASES[case], ENCODER_NAMES[naming], {}

    def affine(name, *shape):
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = shape, shape[:1]

    def projector(name, into, hidden, out):
        affine(f"{name}.net.0", hidden, into)
        affine(f"{name}.net.1", hidden)
        shapes[f"{name}.net.1.running_mean"] = shapes[f"{name}.net.1.running_var"] = (hidden,)
        shapes[f"{name}.net.1.num_batches_tracked"] = ()
        affine(f"{name}.net.3", out, hidden)

    width, latent, inner = s["width"], s["latent"], s["p_heads"] * s["p_dim_head"]
    shapes["encoder.embeddings.cls_token"] = (1, 1, width)
    shapes["encoder.embeddings.position_embeddings"] = (1, (s["image_size"] // s["patch_size"]) ** 2 + 1, width)
    affine("encoder.embeddings.patch_embeddings.projection", width, 3, s["patch_size"], s["patch_size"])
    for index in range(s["depth"]):
        layer = f"{names['layer']}{index}"
        for part in (*names["qkv"], names["out"]):
            affine(f"{layer}.{part}", width, width)
        affine(f"{layer}.{names['mlp'][0]}", s["mlp"], width)
        affine(f"{layer}.{names['mlp'][1]}", width, s["mlp"])
        affine(f"{layer}.layernorm_before", width)
        affine(f"{layer}.layernorm_after", width)
    affine("encoder.layernorm", width)
    shapes["predictor.pos_embedding"] = (1, s["frames"], latent)
    affine("predictor.transformer.norm", latent)
    for index in range(s["p_depth"]):
        layer = f"predictor.transformer.layers.{index}"
        affine(f"{layer}.attn.norm", latent)
        shapes[f"{layer}.attn.to_qkv.weight"] = (3 * inner, latent)
        affine(f"{layer}.attn.to_out.0", latent, inner)
        affine(f"{layer}.mlp.net.0", latent)
        affine(f"{layer}.mlp.net.1", s["p_mlp"], latent)
        affine(f"{layer}.mlp.net.4", latent, s["p_mlp"])
        affine(f"{layer}.adaLN_modulation.1", 6 * latent, latent)
    affine("action_encoder.patch_embed", s["smoothed"], s["block"], 1)
    affine("action_encoder.embed.0", 4 * latent, s["smoothed"])
    affine("action_encoder.embed.2", latent, 4 * latent)
    projector("projector", width, s["hidden"], latent)
    projector("pred_proj", latent, s["p_hidden"], latent)
    return shapes


def published_config(case: str) -> dict:
    """The ``config.json`` that belongs to it."""
    s = CASES[case]

    def projector(into, hidden):
        norm = {"_target_": "torch.nn.BatchNorm1d", "_partial_": True}
        sizes = {"input_dim": into, "hidden_dim": hidden, "output_dim": s["latent"]}
        return {"_target_": "stable_worldmodel.wm.lewm.module.MLP", **sizes, "norm_fn": norm}

    encoder = {
        "_target_": "stable_pretraining.backbone.utils.vit_hf",
        "size": "tiny",
        "patch_size": s["patch_size"],
        "image_size": s["image_size"],
        "pretrained": False,
        "use_mask_token": False,
    }
    action_encoder = {
        "_target_": "stable_worldmodel.wm.lewm.module.Embedder",
        "input_dim": s["block"],
        "emb_dim": s["latent"],
    }
    if case != "paper":
        encoder |= {"hidden_size": s["width"], "num_hidden_layers": s["depth"]}
        encoder |= {"num_attention_heads": s["heads"], "intermediate_size": s["mlp"]}
        action_encoder["smoothed_dim"] = s["smoothed"]
    return {
        "_target_": "stable_worldmodel.wm.lewm.LeWM",
        "encoder": encoder,
        "predictor": {
            "_target_": "stable_worldmodel.wm.lewm.module.Predictor",
            "num_frames": s["frames"],
            "input_dim": s["latent"],
            "hidden_dim": s["latent"],
            "output_dim": s["latent"],
            "depth": s["p_depth"],
            "heads": s["p_heads"],
            "mlp_dim": s["p_mlp"],
            "dim_head": s["p_dim_head"],
            "dropout": 0.1,
            "emb_dropout": 0.0,
        },
        "action_encoder": action_encoder,
        "projector": projector(s["width"], s["hidden"]),
        "pred_proj": projector(s["latent"], s["p_hidden"]),
    }


def uniform(name: str, shape: tuple[int, ...]) -> torch.Tensor:
    """Numbers in [-1, 1) from integer arithmetic alone: the same bits on every machine and with every torch."""
    count = torch.Size(shape).numel()
    x = torch.arange(count, dtype=torch.int64) + (zlib.crc32(name.encode()) ^ SEED)
    for factor in (0x45D9F3B, 0x119DE1F3):  # an integer hash of 32 bits
        x = ((x >> 16 ^ x) * factor) & 0xFFFFFFFF
    x = (x >> 16 ^ x) & 0xFFFFFF
    return (x.float() / 2**23 - 1).reshape(shape)


def weights(case: str, naming: str = "transformers4") -> dict[str, torch.Tensor]:
    """A weight for every published name, of the size that a trained network has; drawn by transformers 4's name."""
    faint = CASES[case].get("faint", 1.0)
    old, new = ENCODER_NAMES["transformers4"], ENCODER_NAMES["transformers5"]
    pairs = [(new["layer"], old["layer"]), *zip(new["qkv"], old["qkv"]), (new["out"], old["out"])]
    pairs += list(zip(new["mlp"], old["mlp"]))
    filled = {}
    for name, shape in published_shapes(case, naming).items():
        seed = name
        if name.startswith(new["layer"]):
            for theirs, ours in pairs:
                seed = seed.replace(theirs, ours)
        noise = uniform(seed, shape)
        if name.endswith("num_batches_tracked"):
            filled[name] = torch.tensor(1234)
        elif name.endswith("running_var"):
            filled[name] = 1 + 0.5 * noise
        elif len(shape) == 1:
            is_scale = name.endswith(".weight")  # of a normalization: linear layers have matrices
            filled[name] = (1 + 0.3 * noise) if is_scale else 0.2 * noise
        elif name.endswith(("cls_token", "position_embeddings", "pos_embedding")):
            filled[name] = 0.5 * noise
        else:
            fan_in = torch.Size(shape[1:]).numel()
            filled[name] = noise * (3 / fan_in) ** 0.5
        if name.startswith(("encoder.embeddings.", "predictor.pos_embedding")):
            filled[name] *= faint
    return filled


def inputs(case: str) -> dict[str, torch.Tensor]:
    """Frames uint8 [ROWS, 3, H, W], latents [ROWS, 3, D] and z-scored action blocks [ROWS, HORIZON, F * A]."""
    s = CASES[case]
    pixels = uniform("pixels", (ROWS, 3, s["image_size"], s["image_size"]))
    return {
        "pixels": ((pixels + 1) * 128).to(torch.uint8),
        "latent": 1.5 * s.get("faint", 1.0) * uniform("latent", (ROWS, 3, s["latent"])),
        "action": 2 * uniform("action", (ROWS, HORIZON, s["block"])),
    }
