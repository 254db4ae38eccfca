"""Costs of imagined trajectories; lower is better.

A cost is a module or a function ``cost(predicted, goal, *, action, start, time_to_go)`` -> [E, K] for E environments with K
candidates of T action blocks: predicted latents [E, K, T, D], goal latents [E, D], the candidates' z-scored action blocks
[E, K, T, F * A], the latents they start from [E, D] and the number of blocks until the goal is due [E] int64, from 1 to T. It may
leave out the keyword arguments that it does not use.

:class:`GoalDistance` and :class:`PathDistance` are in squared latent units, :class:`ActionEffort` and
:class:`InverseConsistency` in squared z-scores; :class:`CostSum` adds them up, independent of their scales if asked.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_ficreg._torchrl_compat import without_compile
from torchrl_ficreg.keys import LATENT, NEXT_LATENT, RECOVERED_ACTION
from torchrl_ficreg.modules.feed import arrange, feed, read_output, require_module

Cost = Callable[..., torch.Tensor]


class GoalDistance(nn.Module):
    """Squared distance from the goal when it is due: of the last predicted latent (arXiv 2603.19312) without a time-to-go.

    Examples:
        >>> import torch
        >>> GoalDistance()(torch.ones(1, 3, 5, 4), torch.zeros(1, 4))
        tensor([[4., 4., 4.]])
    """

    def forward(
        self, predicted: torch.Tensor, goal: torch.Tensor, time_to_go: torch.Tensor | None = None
    ) -> torch.Tensor:
        """[E, K, T, D], [E, D] and [E] -> [E, K]."""
        if time_to_go is None:
            due = predicted[:, :, -1]
        else:
            due = predicted[torch.arange(len(predicted), device=predicted.device), :, time_to_go - 1]  # [E, K, D]
        return (due - goal.unsqueeze(1)).square().sum(-1)


class StayDistance(nn.Module):
    """Squared distance from the goal, averaged over the blocks from the one at which the goal is due to the last.

    A plan arrives in time and stays. Where the goal is due at the horizon, this is :class:`GoalDistance`; where it is due at
    once, without a discount, :class:`PathDistance`.

    Args:
        discount (float, optional): weight of each block relative to the one before; below 1, distances soon after the arrival
            have more weight. Default: ``1.0``.

    Raises:
        ValueError: ``discount`` is not in (0, 1].

    Examples:
        >>> import torch
        >>> path = torch.tensor([[[[2.0], [0.0], [0.0]], [[2.0], [0.0], [2.0]]]])  # stays, passes by: [1, 2, 3, 1]
        >>> due = torch.tensor([2])
        >>> StayDistance()(path, torch.zeros(1, 1), due), StayDistance(discount=0.25)(path, torch.zeros(1, 1), due)
        (tensor([[0., 2.]]), tensor([[0.0000, 0.8000]]))
    """

    def __init__(self, discount: float = 1.0) -> None:
        super().__init__()
        self.discount = _check_discount(discount)

    def forward(
        self, predicted: torch.Tensor, goal: torch.Tensor, time_to_go: torch.Tensor | None = None
    ) -> torch.Tensor:
        """[E, K, T, D], [E, D] and [E] -> [E, K]."""
        blocks = predicted.shape[2]
        if time_to_go is None:
            time_to_go = torch.full((len(predicted),), blocks, device=predicted.device)
        distance = (predicted - goal[:, None, None]).square().sum(-1)  # [E, K, T]
        late = torch.arange(1, blocks + 1, device=predicted.device) - time_to_go.unsqueeze(1)  # [E, T]
        weight = torch.where(late < 0, 0.0, self.discount ** late.clamp_min(0).to(distance.dtype))
        weight = weight / weight.sum(1, keepdim=True)
        return (distance * weight.unsqueeze(1)).sum(-1)


class PathDistance(nn.Module):
    """Squared distance from the goal, averaged over the whole path: a plan that arrives early is cheaper.

    Args:
        discount (float, optional): weight of each imagined block relative to the next one; below 1 the end has more weight.
            Default: ``1.0``.

    Raises:
        ValueError: ``discount`` is not in (0, 1].

    Examples:
        >>> import torch
        >>> path = torch.tensor([[[[2.0], [0.0]], [[0.0], [2.0]]]])  # arrives late, arrives early: [1, 2, 2, 1]
        >>> PathDistance()(path, torch.zeros(1, 1)), PathDistance(discount=0.5)(path, torch.zeros(1, 1))
        (tensor([[2., 2.]]), tensor([[1.3333, 2.6667]]))
    """

    def __init__(self, discount: float = 1.0) -> None:
        super().__init__()
        self.discount = _check_discount(discount)

    def forward(self, predicted: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """[E, K, T, D] and [E, D] -> [E, K]."""
        distance = (predicted - goal[:, None, None]).square().sum(-1)  # [E, K, T]
        blocks = distance.shape[-1]
        weight = self.discount ** torch.arange(blocks - 1, -1, -1, device=distance.device, dtype=distance.dtype)
        return (distance * (weight / weight.sum())).sum(-1)


class ActionEffort(nn.Module):
    """Mean squared z-scored action: among plans that end equally well, those closest to the mean action are cheaper.

    Examples:
        >>> import torch
        >>> ActionEffort()(torch.zeros(1, 3, 5, 4), torch.zeros(1, 4), torch.full((1, 3, 5, 10), 2.0))
        tensor([[4., 4., 4.]])
    """

    def forward(self, predicted: torch.Tensor, goal: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Action blocks [E, K, T, F * A] -> [E, K]; the latents are not used."""
        return action.square().mean((-1, -2))


class InverseConsistency(nn.Module):
    """Error of the inverse dynamics model on the imagined transitions (arXiv 2607.02403).

    The mean squared error, in z-scores, between a candidate's action blocks and those that the inverse dynamics model
    recovers from its imagined latents. It rises where a search leaves the training distribution of the predictor. Add it to a
    distance with a scale-free :class:`CostSum`. A model with a ``history`` H, such as the transformer, recovers every action
    from the last H latents.

    Args:
        inverse_model (TensorDictModule): reads two latents, by name as in :class:`~torchrl_ficreg.FICRegLoss`, and writes the
            recovered action block [..., F * A], z-scored; see :class:`~torchrl_ficreg.InverseDynamicsModel`. In ``eval()``
            mode.

    Raises:
        TypeError: ``inverse_model`` is no TensorDictModule.
        ValueError: its keys do not say which latent is which.

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
        history = getattr(self.inverse_model, "history", None)
        if history is None or before.shape[2] <= history:
            recovered = self._recover(before, predicted)  # [E, K, T, F * A]
        else:  # all windows of H latents in one batch: H actions from the first, the last action from the others
            windows = (latent.unfold(2, history, 1).transpose(-1, -2) for latent in (before, predicted))
            actions = self._recover(*windows)  # [E, K, T - H + 1, H, F * A]
            recovered = torch.cat([actions[:, :, 0], actions[:, :, 1:, -1]], dim=2)
        return (recovered - action).square().mean((-1, -2))

    def _recover(self, latent: torch.Tensor, next_latent: torch.Tensor) -> torch.Tensor:
        """Recovered action blocks, computed in the dtype of the inverse model and returned in that of the latents."""
        dtype = next((p.dtype for p in self.inverse_model.parameters()), latent.dtype)
        inputs = {LATENT: latent.to(dtype), NEXT_LATENT: next_latent.to(dtype)}
        written = self.inverse_model(feed("inverse_model", self.inverse_model, inputs))
        return read_output(self.inverse_model, written, RECOVERED_ACTION).to(latent.dtype)


class CostSum(nn.Module):
    """Weighted sum of costs.

    With ``scale_free`` every term but the first is scaled so that its standard deviation over the K candidates of an
    environment equals that of the first term. A weight of 0.5 then means half the influence of the first term, whatever the
    units, in every environment and every iteration (arXiv 2607.02403). Over a single candidate the standard deviation is zero:
    its cost is the weighted first term alone.

    Args:
        terms (sequence of nn.Module): costs; see the module.
        weights (sequence of float): one for each term.
        scale_free (bool, optional): see above. Default: ``False``.

    Raises:
        ValueError: no terms, or another number of weights. When called: a term that is not [E, K].
        TypeError: a term that is no module.

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
        self._keywords = [keywords_of(term) for term in terms]

    def forward(
        self,
        predicted: torch.Tensor,
        goal: torch.Tensor,
        action: torch.Tensor,
        start: torch.Tensor,
        time_to_go: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """[E, K, T, D], [E, D], [E, K, T, F * A], [E, D] and [E] -> [E, K]."""
        values = [
            call_cost(term, keywords, predicted, goal, action=action, start=start, time_to_go=time_to_go)
            for term, keywords in zip(self.terms, self._keywords)
        ]  # each [E, K]
        if self.scale_free:
            first, *others = (value.detach().std(1, unbiased=False, keepdim=True) for value in values)  # each [E, 1]
            values[1:] = [value * torch.where(std > 0, first / std, 0.0) for value, std in zip(values[1:], others)]
        return torch.stack([weight * value for weight, value in zip(self.weights, values)]).sum(0)


def _check_discount(discount: float) -> float:
    if not 0 < discount <= 1:
        raise ValueError(f"discount must lie in (0, 1], got {discount}.")
    return discount


def keywords_of(cost: Cost) -> tuple[str, ...]:
    """Which of ``action``, ``start`` and ``time_to_go`` a cost takes.

    Raises:
        TypeError: it cannot be called, or is a class in place of an instance of it.
    """
    if isinstance(cost, type) or not callable(cost):
        raise TypeError(
            f"a cost is a module or function (predicted, goal) -> [E, K], such as GoalDistance(), got {cost!r}."
        )
    cost = without_compile(cost)  # a compiled module takes everything
    try:
        parameters = inspect.signature(cost.forward if isinstance(cost, nn.Module) else cost).parameters
    except ValueError:  # a ScriptFunction, for example, has no signature
        return ()
    takes_all = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    return tuple(name for name in ("action", "start", "time_to_go") if takes_all or name in parameters)


def call_cost(
    cost: Cost,
    keywords: Sequence[str],
    predicted: torch.Tensor,
    goal: torch.Tensor,
    **given: torch.Tensor | None,
) -> torch.Tensor:
    """Calls a cost with those of ``given`` that are in ``keywords``: ``action``, ``start``, ``time_to_go``; see the module.

    Raises:
        ValueError: the result has another shape than [E, K].
    """
    value = cost(predicted, goal, **{name: given[name] for name in keywords})
    shape = value.shape if isinstance(value, torch.Tensor) else type(value).__name__
    if shape != predicted.shape[:2]:
        raise ValueError(
            f"a cost maps predictions {list(predicted.shape)} and goals {list(goal.shape)} to [E, K] = "
            f"{list(predicted.shape[:2])}, {type(cost).__name__} returned {shape if isinstance(shape, str) else list(shape)}."
        )
    return value
