"""Measures which network receives gradient from which term."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.objectives.common import LossModule


def gradient_flow(loss: LossModule, clip: TensorDictBase) -> dict[str, dict[str, float]]:
    """Gradient norm of every loss term at every network.

    Nothing is accumulated into ``.grad``. Random layers and BatchNorm statistics are used and moved as by one call of
    the loss.

    Args:
        loss: a loss whose networks were registered with ``convert_to_functional``.
        clip: what the loss reads.

    Returns:
        ``{term: {network: norm}}``; exactly 0.0 where no gradient arrives.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import FICRegLoss, ModelConfig, gradient_flow, make_world_model
        >>> model, inverse_model = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> loss = FICRegLoss(model.encoder, model.predictor, inverse_model)
        >>> pixels = torch.randint(0, 256, (8, 2, 3, 64, 64), dtype=torch.uint8)
        >>> flow = gradient_flow(loss, TensorDict({"pixels": pixels, "action": torch.randn(8, 2, 10)}, [8, 2]))
        >>> flow["loss_consistency"]["encoder"], flow["loss_consistency"]["inverse_model"]
        (0.0, 0.0)
    """
    networks = {
        name.removesuffix("_params"): [p for p in params.parameters() if p.requires_grad]
        for name, params in loss.named_children()
        if name.endswith("_params") and not name.startswith("target_")
    }
    terms = {key: value.sum() for key, value in loss(clip).items() if key.startswith("loss")}
    table: dict[str, dict[str, float]] = {}
    for term, value in terms.items():
        table[term] = {}
        for name, params in networks.items():
            reachable = bool(params) and value.requires_grad  # not so where networks are frozen
            grads = torch.autograd.grad(value, params, retain_graph=True, allow_unused=True) if reachable else ()
            squares = [grad.float().square().sum() for grad in grads if grad is not None]
            table[term][name] = torch.stack(squares).sum().sqrt().item() if squares else 0.0
    return table
