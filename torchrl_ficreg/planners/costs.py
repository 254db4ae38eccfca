"""Costs of imagined trajectories, [E, K, T, D] x [E, D] -> [E, K]; lower is better.

E environments, K candidates, T imagined blocks. A cost is any module called as ``cost(predicted, goal)``; one that also
wants the candidates' action blocks [E, K, T, F * A] or the latents they start from [E, D] names them ``action`` and
``start`` in its ``forward``. The goal's distance is measured in squared latent units, an action's effort in squared
z-scores; :class:`CostSum` can make one independent of the other's scale.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_ficreg.keys import LATENT, RECOVERED_ACTION
from torchrl_ficreg.modules.feed import arrange, feed, NEXT_LATENT, read_output, require_module

Cost = Callable[..., torch.Tensor]


def wanted_by(cost: Cost) -> tuple[str, ...]:
    """Which of ``action`` and ``start`` a cost names.

    Raises:
        TypeError: it cannot be called, or is a class in place of an instance of it.
    """
    if isinstance(cost, type) or not callable(cost):
        raise TypeError(
            f"a cost is a module or function (predicted, goal) -> [E, K], such as GoalDistance(), got {cost!r}."
        )
    parameters = inspect.signature(cost.forward if isinstance(cost, nn.Module) else cost).parameters
    takes_all = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    return tuple(name for name in ("action", "start") if takes_all or name in parameters)


class GoalDistance(nn.Module):
    """Squared distance of the last predicted latent from the goal (arXiv 2603.19312).

    Examples:
        >>> import torch
        >>> GoalDistance()(torch.ones(1, 3, 5, 4), torch.zeros(1, 4))
        tensor([[4., 4., 4.]])
    """

    def forward(self, predicted: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """[E, K, T, D] and [E, D] -> [E, K]."""
        return (predicted[:, :, -1] - goal.unsqueeze(1)).square().sum(-1)


class PathDistance(nn.Module):
    """Squared distance from the goal, averaged over the whole path: a plan that arrives early is cheaper.

    Args:
        discount: weight of each imagined block relative to the one after it; below 1 the end counts more.

    Examples:
        >>> import torch
        >>> path = torch.tensor([[[[2.0], [0.0]], [[0.0], [2.0]]]])  # there late, there early: [1, 2, 2, 1]
        >>> PathDistance()(path, torch.zeros(1, 1)), PathDistance(discount=0.5)(path, torch.zeros(1, 1))
        (tensor([[2., 2.]]), tensor([[1.3333, 2.6667]]))
    """

    def __init__(self, discount: float = 1.0) -> None:
        super().__init__()
        if not 0 < discount <= 1:
            raise ValueError(f"discount must lie in (0, 1], got {discount}.")
        self.discount = discount

    def forward(self, predicted: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """[E, K, T, D] and [E, D] -> [E, K]."""
        distance = (predicted - goal[:, None, None]).square().sum(-1)  # [E, K, T]
        blocks = distance.shape[-1]
        weight = self.discount ** torch.arange(blocks - 1, -1, -1, device=distance.device, dtype=distance.dtype)
        return (distance * (weight / weight.sum())).sum(-1)


class ActionEffort(nn.Module):
    """Mean squared z-scored action: among plans that end equally well, the least unusual one.

    Examples:
        >>> import torch
        >>> ActionEffort()(torch.zeros(1, 3, 5, 4), torch.zeros(1, 4), torch.full((1, 3, 5, 10), 2.0))
        tensor([[4., 4., 4.]])
    """

    def forward(self, predicted: torch.Tensor, goal: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Action blocks [E, K, T, F * A] -> [E, K]; the latents are not looked at."""
        return action.square().mean((-1, -2))


class InverseConsistency(nn.Module):
    """The trained judge scores each imagined step: would it recover the action that was imagined? (arXiv 2607.02403)

    The mean squared error, in z-scores, between a candidate's action blocks and those that the inverse dynamics model
    recovers from its imagined latents. Where a search leaves what the predictor has learnt, imagined transitions stop
    looking like consequences of their actions, and this cost rises. Add it to a distance by a scale-free
    :class:`CostSum`. A model with a ``history`` H, such as the transformer, judges every step from the last H latents.

    Args:
        inverse_model: reads two latents, by name as in :class:`~torchrl_ficreg.FICRegLoss`, writes the recovered action
            block; see :class:`~torchrl_ficreg.InverseDynamicsModel`. Keep it in ``eval()``.

    Examples:
        >>> import torch
        >>> from torchrl_ficreg import InverseDynamicsModel
        >>> cost = InverseConsistency(InverseDynamicsModel(latent_dim=4, action_dim=10))
        >>> cost(torch.zeros(1, 3, 5, 4), torch.zeros(1, 4), torch.zeros(1, 3, 5, 10), torch.zeros(1, 4)).shape
        torch.Size([1, 3])
    """

    def __init__(self, inverse_model: TensorDictModuleBase) -> None:
        super().__init__()
        require_module("inverse_model", inverse_model)
        arrange("inverse_model", inverse_model.in_keys, {LATENT: (), NEXT_LATENT: ()})
        self.inverse_model = inverse_model

    def forward(
        self, predicted: torch.Tensor, goal: torch.Tensor, action: torch.Tensor, start: torch.Tensor
    ) -> torch.Tensor:
        """[E, K, T, D], [E, D], [E, K, T, F * A] and [E, D] -> [E, K]."""
        first = start[:, None, None].expand(-1, predicted.shape[1], 1, -1)  # [E, K, 1, D]
        before = torch.cat([first, predicted[:, :, :-1]], dim=2)  # [E, K, T, D]
        history = getattr(getattr(self.inverse_model, "module", self.inverse_model), "history", None)
        if history is None or before.shape[2] <= history:
            recovered = self._recover(before, predicted)  # [E, K, T, F * A]
        else:  # every window of H latents at once: the first tells its H actions, each later one its last
            windows = (latent.unfold(2, history, 1).transpose(-1, -2) for latent in (before, predicted))
            found = self._recover(*windows)  # [E, K, T - H + 1, H, F * A]
            recovered = torch.cat([found[:, :, 0], found[:, :, 1:, -1]], dim=2)
        return (recovered - action).square().mean((-1, -2))

    def _recover(self, latent: torch.Tensor, next_latent: torch.Tensor) -> torch.Tensor:
        """Action blocks that the model recovers from latents in whatever dtype; its own, if it was cast."""
        dtype = next((p.dtype for p in self.inverse_model.parameters()), latent.dtype)
        inputs = {LATENT: latent.to(dtype), NEXT_LATENT: next_latent.to(dtype)}
        judged = self.inverse_model(feed("inverse_model", self.inverse_model, inputs))
        return read_output(self.inverse_model, judged, RECOVERED_ACTION, 0).to(latent.dtype)


class CostSum(nn.Module):
    """Weighted sum of costs.

    With ``scale_free`` every term but the first is first scaled so that its standard deviation over the K candidates
    of an environment equals that of the first term. A weight of 0.5 then says "half as decisive as the first term"
    whatever units either has, in every environment and every iteration (arXiv 2607.02403). A plan on its own has no
    spread: its cost is that of the first term alone, by its weight.

    Args:
        terms: costs; see the module.
        weights: one number for each.
        scale_free: see above.

    Raises:
        ValueError: no terms, or another number of weights.

    Examples:
        >>> import torch
        >>> cost = CostSum([GoalDistance(), ActionEffort()], [1.0, 0.1])
        >>> cost(torch.ones(1, 3, 5, 4), torch.zeros(1, 4), torch.ones(1, 3, 5, 10), torch.zeros(1, 4))
        tensor([[4.1000, 4.1000, 4.1000]])
    """

    def __init__(self, terms: Sequence[nn.Module], weights: Sequence[float], *, scale_free: bool = False) -> None:
        super().__init__()
        if not terms or len(terms) != len(weights):
            raise ValueError(
                "CostSum takes at least one term and a weight for each, got "
                f"{len(terms)} terms and {len(weights)} weights."
            )
        self.terms, self.weights, self.scale_free = nn.ModuleList(terms), tuple(weights), scale_free
        self.wanted = [wanted_by(term) for term in terms]

    def forward(
        self, predicted: torch.Tensor, goal: torch.Tensor, action: torch.Tensor, start: torch.Tensor
    ) -> torch.Tensor:
        """[E, K, T, D], [E, D], [E, K, T, F * A] and [E, D] -> [E, K]."""
        extra = {"action": action, "start": start}
        values = [
            term(predicted, goal, **{name: extra[name] for name in names})
            for term, names in zip(self.terms, self.wanted)
        ]  # each [E, K]
        if self.scale_free:
            spreads = [value.detach().std(1, unbiased=False, keepdim=True) for value in values]  # each [E, 1]
            values[1:] = [
                value * torch.where(spread > 0, spreads[0] / spread, 0.0)
                for value, spread in zip(values[1:], spreads[1:])
            ]
        return torch.stack([weight * value for weight, value in zip(self.weights, values)]).sum(0)
