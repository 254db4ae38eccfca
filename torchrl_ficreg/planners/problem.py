"""What a search is given: environments that can be asked what action sequences would cost."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
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


ImaginedCost = Callable[[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


@dataclass
class Problem:
    """A group of e environments to be planned for side by side; no environment's plan depends on another's.

    Attributes:
        latent: context [e, C, D], oldest first.
        past_action: z-scored blocks executed between the frames of the context [e, C - 1, F * A].
        goal: [e, D].
        initial: mean of the first iteration [e, horizon, F * A].
        bounds: of a z-scored block, (low [F * A], high [F * A]), equal where a component is held, or None.
        generators: one for each environment.
        imagined_cost: (latent, past_action, goal, candidates [e, K, horizon, F * A]) -> [e, K].
        proposals: what a policy would do [e, P, horizon, F * A], or None.
    """

    latent: torch.Tensor
    past_action: torch.Tensor
    goal: torch.Tensor
    initial: torch.Tensor
    bounds: tuple[torch.Tensor, torch.Tensor] | None
    generators: list[torch.Generator]
    imagined_cost: ImaginedCost
    proposals: torch.Tensor | None = field(default=None)

    def cost(self, candidates: torch.Tensor) -> torch.Tensor:
        """Imagined cost [e, K] of z-scored action blocks [e, K, horizon, F * A]."""
        return self.imagined_cost(self.latent, self.past_action, self.goal, candidates)

    def clamp(self, action: torch.Tensor) -> torch.Tensor:
        """Blocks [..., F * A] inside the bounds."""
        return action if self.bounds is None else action.clamp(*self.bounds)

    def noise(self, count: int) -> torch.Tensor:
        """Standard normal draws [e, count, horizon, F * A], each environment's from its own generator."""
        shape = (count, *self.initial.shape[1:])
        draws = [torch.randn(shape, generator=g, device=self.initial.device, dtype=torch.float32) for g in self.generators]
        return torch.stack(draws).to(self.initial.dtype)


def make_generator(seed: int, environment: int, device: torch.device) -> torch.Generator:
    """The random draws of one environment, named by a search's seed and the environment's own."""
    state = np.random.SeedSequence([seed, environment % 2**63]).generate_state(1, np.uint64)[0]
    return torch.Generator(device).manual_seed(int(state >> np.uint64(1)))
