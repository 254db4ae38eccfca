"""Gradient norm of every term of every loss at every network: docs/results/gradient_flow.{json,png} and a table of the docs."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib
import torch
from tensordict import TensorDict

from torchrl_ficreg import FICRegLoss, gradient_flow, InverseDynamicsModel, LeWMLoss, make_world_model, ModelConfig
from torchrl_ficreg.objectives import JointInverseLoss, PLDMLoss

DOCS = Path(__file__).resolve().parents[2] / "docs"
NETWORKS = ("encoder", "predictor", "inverse_model")
HISTORY, BLOCK = 3, 10  # latents that the predictor takes; width of an action block

# title: class, kind of inverse model, arguments
LOSSES = {
    "LeWMLoss": (LeWMLoss, None, {}),
    "LeWMLoss, prediction_steps=3": (LeWMLoss, None, {"prediction_steps": 3}),
    'FICRegLoss, context="detached"': (FICRegLoss, "mlp", {}),
    'FICRegLoss, context="live"': (FICRegLoss, "mlp", {"context": "live"}),
    'FICRegLoss, consistency="trusted"': (FICRegLoss, "mlp", {"consistency": "trusted"}),
    'FICRegLoss, consistency="nll"': (FICRegLoss, "gaussian", {"consistency": "nll"}),
    'FICRegLoss, consistency_target="judge"': (FICRegLoss, "mlp", {"consistency_target": "judge"}),
    "FICRegLoss, consistency_steps=2": (FICRegLoss, "mlp", {"consistency_steps": 2}),
    "FICRegLoss, ensemble": (FICRegLoss, "ensemble", {}),
    "FICRegLoss, transformer": (FICRegLoss, "transformer", {}),
    "JointInverseLoss": (JointInverseLoss, "mlp", {}),
    "JointInverseLoss, sigreg_coeff=0": (JointInverseLoss, "mlp", {"sigreg_coeff": 0.0}),
    "PLDMLoss": (PLDMLoss, "mlp", {"time_cov_coeff": 1.0, "idm_coeff": 1.0}),
}


def main() -> None:
    """Measures every loss on one random clip batch."""
    torch.set_num_threads(1)  # reproducible digits
    tables = {title: measure(*entry) for title, entry in LOSSES.items()}
    (DOCS / "results").mkdir(parents=True, exist_ok=True)
    (DOCS / "results" / "gradient_flow.json").write_text(json.dumps(tables, indent=2) + "\n")
    (DOCS / "source" / "gradient_flow.rst").write_text(tabulate(tables))
    draw(tables, DOCS / "results" / "gradient_flow.png")


def measure(make: type, kind: str | None, arguments: dict) -> dict[str, dict[str, float]]:
    """``{term: {network: norm}}`` of a loss on new networks with the same seed for each loss."""
    torch.manual_seed(0)
    config = ModelConfig.preset("cpu", history=HISTORY)
    model, _ = make_world_model(config, action_dim=2)
    for block in model.predictor.module.blocks:  # AdaLN-zero passes no gradient to the actions at initialization
        torch.nn.init.normal_(block.to_modulation.weight, std=0.1)
    pixels = torch.randint(0, 256, (32, HISTORY + 1, 3, 64, 64), dtype=torch.uint8)
    action = torch.randn(32, HISTORY + 1, BLOCK)
    networks = [model.encoder, model.predictor]
    if kind is not None:
        history = {"history": HISTORY} if kind == "transformer" else {}
        networks.append(InverseDynamicsModel(config.latent_dim, BLOCK, config.inverse_hidden_dim, kind=kind, **history))
    torch.manual_seed(1)  # the same dropout for every kind of inverse model
    clip = TensorDict({"pixels": pixels, "action": action}, action.shape[:2])
    return gradient_flow(make(*networks, **arguments), clip)


def tabulate(tables: dict[str, dict[str, dict[str, float]]]) -> str:
    """The tables as one list-table of reStructuredText; exact zeros are 0."""
    lines = [
        ".. Written by tools/study/gradient_flow.py.",
        "",
        ".. list-table:: Gradient norm of every term at every network; 0 is exact",
        "   :header-rows: 1",
        "",
        "   * - loss",
        "     - term",
        *(f"     - {name.replace('_', ' ')}" for name in NETWORKS),
    ]
    for title, table in tables.items():
        for number, (term, row) in enumerate(table.items()):
            lines += [f"   * - {f'``{title}``' if number == 0 else ''}".rstrip(), f"     - ``{term}``"]
            lines += [f"     - {number_of(row[name]) if name in row else ''}".rstrip() for name in NETWORKS]
    return "\n".join(lines) + "\n"


def number_of(norm: float) -> str:
    """Two digits, or 0 for an exact zero."""
    return "0" if norm == 0 else f"{norm:.2g}"


def draw(tables: dict[str, dict[str, dict[str, float]]], target: Path) -> None:
    """One panel per loss; zeros are white, norms are shaded by their logarithm."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = 3
    rows = -(-len(tables) // columns)
    figure, axes = pyplot.subplots(rows, columns, figsize=(5.2 * columns, 2.7 * rows), squeeze=False)
    for axis in axes.flat[len(tables) :]:
        axis.set_axis_off()
    for axis, (title, table) in zip(axes.flat, tables.items()):
        networks = [name for name in NETWORKS if name in next(iter(table.values()))]
        values = torch.tensor([[row[name] for name in networks] for row in table.values()])
        axis.imshow(values.clamp_min(1e-5).log10(), cmap="Greens", vmin=-5, vmax=3, aspect="auto")
        for i, j in torch.cartesian_prod(torch.arange(len(table)), torch.arange(len(networks))).tolist():
            axis.text(j, i, number_of(values[i, j].item()), ha="center", va="center")
        axis.set_xticks(range(len(networks)), [name.replace("_", " ") for name in networks])
        axis.set_yticks(range(len(table)), list(table))
        axis.set_title(title, fontsize=10)
    figure.tight_layout()
    figure.savefig(target, dpi=100)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
