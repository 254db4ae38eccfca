"""Measures who receives gradient from which term of FICReg, and draws it: docs/results/gradient_flow.{json,png}."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib
import torch
from tensordict import TensorDict

from torchrl_ficreg import FICRegLoss, gradient_flow, make_world_model, ModelConfig

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results"


def main() -> None:
    """Measures both contexts on one random clip batch."""
    tables = {}
    for context in ("detached", "live"):
        torch.manual_seed(0)
        model, inverse_model = make_world_model(ModelConfig.preset("cpu", history=3), action_dim=2)
        for block in model.predictor.module.blocks:  # away from AdaLN-zero, whose first step passes nothing on
            torch.nn.init.normal_(block.to_modulation.weight, std=0.1)
        loss = FICRegLoss(model.encoder, model.predictor, inverse_model, context=context)
        pixels = torch.randint(0, 256, (32, 4, 3, 64, 64), dtype=torch.uint8)
        tables[context] = gradient_flow(loss, TensorDict({"pixels": pixels, "action": torch.randn(32, 4, 10)}, [32, 4]))
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "gradient_flow.json").write_text(json.dumps(tables, indent=2) + "\n")
    draw(tables, RESULTS / "gradient_flow.png")


def draw(tables: dict[str, dict[str, dict[str, float]]], target: Path) -> None:
    """One table per context; zeros are blank on white, norms shaded by their logarithm."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(tables), figsize=(5.2 * len(tables), 2.6))
    for axis, (context, table) in zip(axes, tables.items()):
        networks = list(next(iter(table.values())))
        values = torch.tensor([[row[name] for name in networks] for row in table.values()])
        axis.imshow(values.clamp_min(1e-5).log10(), cmap="Greens", vmin=-5, vmax=1.5, aspect="auto")
        for i, j in torch.cartesian_prod(torch.arange(len(table)), torch.arange(len(networks))).tolist():
            text = "0" if values[i, j] == 0 else f"{values[i, j]:.2g}"
            axis.text(j, i, text, ha="center", va="center")
        axis.set_xticks(range(len(networks)), [name.replace("_", " ") for name in networks])
        axis.set_yticks(range(len(table)), list(table))
        axis.set_title(f'context="{context}"')
    figure.tight_layout()
    figure.savefig(target, dpi=120)


if __name__ == "__main__":
    main()
