"""The world model as a search runs it: in the precision that is fast, from weights that are always the current ones."""

from __future__ import annotations

import copy

import torch
from torch import nn

from torchrl_ficreg.modules.world_model import LatentWorldModel


class FastDynamics:
    """A bfloat16 copy of a world model's predictor, brought up to date before every plan.

    Autocast would cast the weights anew at every imagined step. The copy's storage stays where it is, so that a
    compiled rollout or a CUDA graph of it keeps reading the right place.
    """

    def __init__(self) -> None:
        self._source: nn.Module | None = None
        self._model: LatentWorldModel | None = None

    def of(self, world_model: LatentWorldModel) -> LatentWorldModel:
        """A world model that shares everything with the given one but its predictor, which computes in bfloat16."""
        with torch.inference_mode(False), torch.no_grad():
            if self._source is not world_model.predictor or self._misplaced():
                predictor = copy.deepcopy(world_model.predictor).to(torch.bfloat16).requires_grad_(False)
                self._model = copy.copy(world_model)
                self._model._modules = {**world_model._modules, "predictor": predictor}
                self._source = world_model.predictor
            for mine, current in zip(_tensors(self._model.predictor), _tensors(self._source)):
                mine.copy_(current)
            self._model.predictor.train(self._source.training)
        return self._model

    def _misplaced(self) -> bool:
        mine, current = _tensors(self._model.predictor), _tensors(self._source)
        return [(t.device, t.shape) for t in mine] != [(t.device, t.shape) for t in current]

    def __deepcopy__(self, memo: dict) -> FastDynamics:
        return FastDynamics()


def _tensors(module: nn.Module) -> list[torch.Tensor]:
    return [*module.parameters(), *module.buffers()]
