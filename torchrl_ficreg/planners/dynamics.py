"""The dynamics in the precision and within the memory that a plan may use."""

from __future__ import annotations

import copy

import torch
from torch import nn

from torchrl_ficreg._device import Precision, uses_bf16
from torchrl_ficreg._torchrl_compat import with_child
from torchrl_ficreg.modules.predictor import CausalPredictor
from torchrl_ficreg.modules.world_model import LatentWorldModel


class BFloat16Copy:
    """A bfloat16 copy of a world model's predictor, brought up to date before every plan.

    Autocast would cast the weights at every imagined step. The storage of the copy stays where it is, so that a compiled
    rollout or a CUDA graph of it stays valid.
    """

    def __init__(self) -> None:
        self._source: nn.Module | None = None
        self._model: LatentWorldModel | None = None

    def of(self, world_model: LatentWorldModel) -> LatentWorldModel:
        """A world model that shares everything with the given one but its predictor, which computes in bfloat16."""
        with torch.inference_mode(False), torch.no_grad():
            source = predictor_of(world_model)
            if self._source is not source or self._is_outdated():
                predictor = copy.deepcopy(source).to(torch.bfloat16).requires_grad_(False)
                self._model = predictor if source is world_model else with_child(world_model, "predictor", predictor)
                self._source = source
            for mine, current in zip(_tensors(predictor_of(self._model)), _tensors(self._source)):
                mine.copy_(current)
            predictor_of(self._model).train(self._source.training)
        return self._model

    def _is_outdated(self) -> bool:
        """Whether the predictor was moved to another device or its tensors were replaced by some of another shape."""
        mine, current = _tensors(predictor_of(self._model)), _tensors(self._source)
        return [(t.device, t.shape) for t in mine] != [(t.device, t.shape) for t in current]

    def __deepcopy__(self, memo: dict) -> BFloat16Copy:
        return BFloat16Copy()


def predictor_of(world_model: LatentWorldModel) -> nn.Module:
    """The network that imagines: the predictor, or a whole world model of the user's own that has none."""
    return getattr(world_model, "predictor", world_model)


def _tensors(module: nn.Module) -> list[torch.Tensor]:
    return [*module.parameters(), *module.buffers()]


def plans_in_bf16(world_model: LatentWorldModel, precision: Precision) -> bool:
    """Whether rollouts run in a bfloat16 copy of the predictor.

    With ``"auto"`` only a float32 :class:`~torchrl_ficreg.CausalPredictor` is copied. A user's own network may not
    tolerate the rounding, and one that its user cast stays as it is.

    Args:
        world_model: the dynamics.
        precision: ``"auto"``, ``"fp32"`` or ``"bf16"``.
    """
    known = isinstance(predictor_of(world_model), CausalPredictor) and predictor_dtype(world_model) == torch.float32
    return uses_bf16(world_model.statistics.mean.device, "fp32" if precision == "auto" and not known else precision)


def predictor_dtype(world_model: LatentWorldModel, default: torch.dtype | None = None) -> torch.dtype | None:
    """Dtype of the predictor's floating-point parameters, ``default`` where it has none."""
    return next((p.dtype for p in predictor_of(world_model).parameters() if p.is_floating_point()), default)


def rollouts_within(world_model: LatentWorldModel, gibibytes: float, steps: int) -> int:
    """Rollouts of so many steps that fit into GPU memory together, an estimate.

    The activations of a step are taken to be float32 and as wide as the outputs of all weights of the predictor together.

    Args:
        world_model: the dynamics.
        gibibytes: memory for activations, GiB.
        steps: action blocks in a rollout.
    """
    width = sum(len(weight) for weight in predictor_of(world_model).parameters() if weight.ndim > 1)
    return int(gibibytes * 2**30 / (4 * steps * max(width, world_model.latent_dim)))
