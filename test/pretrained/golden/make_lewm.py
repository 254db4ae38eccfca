"""Makes lewm_*.pt beside this file: outputs of the published LeWM code for weights and inputs given by formula.

The published package is not a dependency of this one. Steps, in a separate environment:

    python3 -m venv published
    published/bin/pip install torch==2.13.0 transformers==5.23.0 einops==0.8.2
    published/bin/pip install --no-deps stable-worldmodel==0.1.1
    published/bin/python test/pretrained/golden/make_lewm.py            # writes the files
    published/bin/pip install transformers==4.57.6
    published/bin/python test/pretrained/golden/make_lewm.py --check    # the older names give the same numbers

LeWM and its predictor, action encoder and projectors run as published: ``stable_worldmodel.wm.lewm``, imported without
the rest of its package, which needs simulators. Its encoder, ``stable_pretraining``'s ``vit_hf``, is a ``ViTModel`` of
transformers without pooler and mask token, called with ``interpolate_pos_encoding=True``; it is built here directly.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from functools import partial
from pathlib import Path
from types import ModuleType

import torch
import transformers
from formula import CASES, HORIZON, inputs, published_shapes, ROWS, weights
from torch import nn

GOLDEN = Path(__file__).resolve().parent
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def published_lewm() -> tuple[ModuleType, ModuleType]:
    """The modules ``stable_worldmodel.wm.lewm`` and ``stable_worldmodel.wm.lewm.module``."""
    root = Path(importlib.util.find_spec("stable_worldmodel").origin).parent
    for name, folder in (("stable_worldmodel", root), ("stable_worldmodel.wm", root / "wm")):
        sys.modules[name] = ModuleType(name)  # in place of a package whose __init__ imports too much
        sys.modules[name].__path__ = [str(folder)]
    return tuple(importlib.import_module(f"stable_worldmodel.wm.{name}") for name in ("lewm", "lewm.module"))


def build(case: str, lewm: ModuleType, parts: ModuleType) -> nn.Module:
    """The published model with weights by formula, in eval mode."""
    s = CASES[case]
    vit = transformers.ViTConfig(
        hidden_size=s["width"],
        num_hidden_layers=s["depth"],
        num_attention_heads=s["heads"],
        intermediate_size=s["mlp"],
        image_size=s["image_size"],
        patch_size=s["patch_size"],
    )
    norm = partial(nn.BatchNorm1d)
    model = lewm.LeWM(
        encoder=transformers.ViTModel(vit, add_pooling_layer=False, use_mask_token=False),
        predictor=parts.Predictor(
            num_frames=s["frames"],
            input_dim=s["latent"],
            hidden_dim=s["latent"],
            output_dim=s["latent"],
            depth=s["p_depth"],
            heads=s["p_heads"],
            mlp_dim=s["p_mlp"],
            dim_head=s["p_dim_head"],
            dropout=0.1,
        ),
        action_encoder=parts.Embedder(input_dim=s["block"], smoothed_dim=s["smoothed"], emb_dim=s["latent"]),
        projector=parts.MLP(s["width"], s["hidden"], s["latent"], norm_fn=norm),
        pred_proj=parts.MLP(s["latent"], s["p_hidden"], s["latent"], norm_fn=norm),
    )
    naming = f"transformers{transformers.__version__.split('.')[0]}"
    shapes = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    if shapes != published_shapes(case, naming):
        raise ValueError(f"{case}: the table in formula.py is not that of the published networks ({naming}).")
    model.load_state_dict(weights(case, naming))
    return model.eval()


@torch.no_grad()
def outputs(case: str, model: nn.Module) -> dict[str, torch.Tensor]:
    """What the tests compare."""
    given = inputs(case)
    mean, std = (torch.tensor(numbers).view(3, 1, 1) for numbers in (IMAGENET_MEAN, IMAGENET_STD))
    frames = (given["pixels"] / 255 - mean) / std
    encoded = model.encode({"pixels": frames[:, None], "action": given["action"]})
    golden = {"latent": encoded["emb"][:, 0], "action_embedding": encoded["act_emb"]}  # [N, D], [N, HORIZON, D]
    for seen in range(1, CASES[case]["frames"] + 1):
        golden[f"predicted_{seen}"] = model.predict(given["latent"][:, :seen], encoded["act_emb"][:, :seen])
    rollout = model.rollout({"pixels": frames[:, None, None]}, given["action"][:, None])  # one candidate, one frame
    golden["rollout"] = rollout["predicted_emb"][:, 0, 1:]
    if golden["rollout"].shape != (ROWS, HORIZON, CASES[case]["latent"]):
        raise ValueError(f"{case}: the published rollout has another shape, {tuple(golden['rollout'].shape)}.")
    return {name: value.clone() for name, value in golden.items()}


def main() -> None:
    """Writes the golden files, or compares with them."""
    torch.set_num_threads(1)
    lewm, parts = published_lewm()
    for case in CASES:
        file, golden = GOLDEN / f"lewm_{case}.pt", outputs(case, build(case, lewm, parts))
        if "--check" in sys.argv:
            stored = torch.load(file, weights_only=True)
            worst = max((golden[name] - stored[name]).abs().max().item() for name in golden)
            print(f"{case}: largest difference {worst:.1e} with transformers {transformers.__version__}")
        else:
            torch.save(golden, file)
            scale = max(value.abs().max().item() for value in golden.values())
            print(f"{case}: {file.stat().st_size} bytes, numbers up to {scale:.2f}")


if __name__ == "__main__":
    main()
