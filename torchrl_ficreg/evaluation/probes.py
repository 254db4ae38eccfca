"""Probes: what latents hold about the state of a scene, with errors in pixels, degrees and metres."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args, Literal

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from torchrl_ficreg.envs.registry import ENVIRONMENTS

ProbeKind = Literal["ridge", "mlp"]
Values = Mapping[str, torch.Tensor]


@dataclass(frozen=True)
class Quantity:
    """A physical quantity of a scene: a vector such as a position, or an angle.

    Attributes:
        name (str): what it is, such as ``"block angle"``.
        unit (str): of its values and errors.
        size (int): number C of its components.
        period (float, optional): of an angle, in ``unit``: values that differ by it look the same. Default: ``None``, a vector.
        tolerance (float, optional): largest error of the success rule, in ``unit``. Default: ``None``, not in the rule.

    Examples:
        >>> yaw = Quantity("cube yaw", "deg", period=90.0)
        >>> yaw.error(torch.tensor([[1.0]]), torch.tensor([[89.0]]))
        tensor([2.])
    """

    name: str
    unit: str
    size: int = 1
    period: float | None = None
    tolerance: float | None = None

    def targets(self, values: torch.Tensor) -> torch.Tensor:
        """What a probe is fitted to: values [..., C], of an angle its sine and cosine [..., 2 C]."""
        if self.period is None:
            return values
        phase = values * (2 * math.pi / self.period)
        return torch.cat([phase.sin(), phase.cos()], -1)

    def values(self, targets: torch.Tensor) -> torch.Tensor:
        """The values [..., C] that :meth:`targets` maps to these targets; an angle lies within half a period of 0."""
        if self.period is None:
            return targets
        return torch.atan2(*targets.chunk(2, -1)) * (self.period / (2 * math.pi))

    def error(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        """Euclidean distance [...] of values [..., C], in ``unit``; of angles the shorter way around."""
        difference = first - second
        if self.period is not None:
            difference = (difference + self.period / 2) % self.period - self.period / 2
        return difference.square().sum(-1).sqrt()


_CUBE = {  # names in OGBench's observations
    "cube": "privileged/block_0_pos",
    "cube yaw": "privileged/block_0_yaw",
    "gripper": "proprio/effector_pos",
    "gripper yaw": "proprio/effector_yaw",
    "gripper opening": "proprio/gripper_opening",
}
_REACHER_TOLERANCE = math.degrees(0.05)

_QUANTITIES: dict[str, tuple[Quantity, ...]] = {
    "two_room": (Quantity("agent", "px", size=2, tolerance=16.0),),
    "push_t": (
        Quantity("agent", "px", size=2, tolerance=20.0),
        Quantity("block", "px", size=2, tolerance=20.0),
        Quantity("block angle", "deg", period=360.0, tolerance=20.0),
        Quantity("agent velocity", "px/s", size=2),
    ),
    "reacher": (
        Quantity("shoulder", "deg", period=360.0, tolerance=_REACHER_TOLERANCE),
        Quantity("wrist", "deg", period=360.0, tolerance=_REACHER_TOLERANCE),
        Quantity("shoulder velocity", "rad/s"),
        Quantity("wrist velocity", "rad/s"),
    ),
    "cube": (
        Quantity("cube", "m", size=3, tolerance=0.04),
        Quantity("cube yaw", "deg", period=90.0),  # all faces look alike
        Quantity("gripper", "m", size=3),
        Quantity("gripper yaw", "deg", period=180.0),  # both fingers look alike
        Quantity("gripper opening", "of 1"),
    ),
}


def state_quantities(env: str) -> tuple[Quantity, ...]:
    """The quantities of an environment that :func:`measure_states` computes.

    Args:
        env (str): short name of an environment of the package, or its Gymnasium id.

    Raises:
        ValueError: an environment without quantities.

    Examples:
        >>> [quantity.name for quantity in state_quantities("push_t")]
        ['agent', 'block', 'block angle', 'agent velocity']
    """
    return _QUANTITIES[_short_name(env)]


def _short_name(env: str) -> str:
    for name in _QUANTITIES:
        if env in (name, ENVIRONMENTS[name].gym_id):
            return name
    raise ValueError(f"no quantities are known for the states of {env!r}: choose one of {sorted(_QUANTITIES)}.")


def measure_states(env: str, state: torch.Tensor) -> dict[str, torch.Tensor]:
    """Computes the quantities of an environment from simulator states.

    Args:
        env (str): short name of an environment of the package, or its Gymnasium id.
        state (Tensor): [..., S].

    Returns:
        a float64 tensor [..., C] for each of :func:`state_quantities`, by its name.

    Raises:
        ValueError: an environment without quantities.

    Examples:
        >>> state = torch.tensor([100.0, 110.0, 300.0, 310.0, torch.pi, 0.0, 2.0])
        >>> {name: value.tolist() for name, value in measure_states("push_t", state).items()}
        {'agent': [100.0, 110.0], 'block': [300.0, 310.0], 'block angle': [180.00000500895632], 'agent velocity': [0.0, 2.0]}
    """
    env, state = _short_name(env), state.double()
    if env == "two_room":
        return {"agent": state}
    if env == "push_t":
        angle = torch.rad2deg(state[..., 4:5])
        return {"agent": state[..., :2], "block": state[..., 2:4], "block angle": angle, "agent velocity": state[..., 5:7]}
    if env == "reacher":
        shoulder, wrist, shoulder_velocity, wrist_velocity = state.split(1, dim=-1)
        return {
            "shoulder": torch.rad2deg(shoulder),
            "wrist": torch.rad2deg(wrist),
            "shoulder velocity": shoulder_velocity,
            "wrist velocity": wrist_velocity,
        }
    from torchrl_ficreg.envs.cube.physics import CubeArm

    arm = CubeArm()
    rows = [arm.measure(row) for row in state.reshape(-1, state.shape[-1]).cpu().numpy()]
    values = {}
    for quantity in _QUANTITIES[env]:
        column = np.stack([row[_CUBE[quantity.name]] for row in rows])
        column = np.rad2deg(column) if quantity.unit == "deg" else column
        values[quantity.name] = torch.from_numpy(column).to(state.device).reshape(*state.shape[:-1], quantity.size)
    return values


class StateProbe(nn.Module):
    """Regression of physical quantities on latents, all at once; angles as sine and cosine.

    Latents and targets are standardized by their means and standard deviations in the rows of :meth:`fit`.

    Args:
        quantities (sequence of Quantity): what is regressed.
        kind (str, optional): ``"ridge"``, a linear map with a squared penalty on its weights, or ``"mlp"``, two hidden layers.
            Default: ``"ridge"``.

    Keyword Args:
        penalty (float, optional): of ``"ridge"``, relative to the number of rows. Default: ``1e-4``.
        width (int, optional): of the hidden layers of ``"mlp"``. Default: ``256``.
        steps (int, optional): of AdamW on ``"mlp"``, with 512 rows each. Default: ``2000``.
        seed (int, optional): of weights and batches of ``"mlp"``. Default: ``0``.

    Raises:
        ValueError: an unknown kind.

    Examples:
        >>> position = torch.rand(500, 2, generator=torch.Generator().manual_seed(0))
        >>> latent = position @ torch.tensor([[2.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
        >>> probe = StateProbe([Quantity("agent", "px", size=2)]).fit(latent[:400], {"agent": position[:400]})
        >>> score = probe.score(latent[400:], {"agent": position[400:]})["agent"]
        >>> score["unit"], score["r2"] > 0.999
        ('px', True)
    """

    def __init__(
        self,
        quantities: Sequence[Quantity],
        kind: ProbeKind = "ridge",
        *,
        penalty: float = 1e-4,
        width: int = 256,
        steps: int = 2000,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if kind not in get_args(ProbeKind):
            raise ValueError(f"kind must be one of {get_args(ProbeKind)}, got {kind!r}.")
        self.quantities, self.kind = tuple(quantities), kind
        self.penalty, self.width, self.steps, self.seed = penalty, width, steps, seed
        self.network: nn.Module | None = None  # standardized latents [..., D] -> standardized targets [..., K]

    def fit(self, latent: torch.Tensor, values: Values) -> StateProbe:
        """Fits the probe.

        Args:
            latent (Tensor): [N, D].
            values (dict): [N, C] for each quantity, by its name.

        Returns:
            the probe.

        Raises:
            KeyError: values of a quantity are missing.
            ValueError: other shapes, or numbers that are not finite.
        """
        target = self._targets(latent, values)  # [N, K]
        if latent.ndim != 2 or len(latent) < 2:
            raise ValueError(f"a probe is fitted to latents [N, D] with N >= 2, got {list(latent.shape)}.")
        if not (latent.isfinite().all() and target.isfinite().all()):
            raise ValueError("latents or values hold a NaN or an infinity: did training diverge?")
        latent = latent.double()
        self.latent_mean, self.latent_std = latent.mean(0), _std(latent)  # [D]
        self.target_mean, self.target_std = target.mean(0), _std(target)  # [K]
        x, y = (latent - self.latent_mean) / self.latent_std, (target - self.target_mean) / self.target_std
        with torch.inference_mode(False), torch.enable_grad():
            self.network = (self._fit_ridge if self.kind == "ridge" else self._fit_mlp)(x.clone(), y.clone())
        return self

    def _fit_ridge(self, x: torch.Tensor, y: torch.Tensor) -> nn.Module:
        gram = x.T @ x + self.penalty * len(x) * torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
        network = nn.Linear(x.shape[1], y.shape[1], bias=False, dtype=x.dtype, device=x.device).requires_grad_(False)
        network.weight.copy_(torch.linalg.solve(gram, x.T @ y).T)
        return network

    def _fit_mlp(self, x: torch.Tensor, y: torch.Tensor) -> nn.Module:
        x, y = x.float(), y.float()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            sizes = [x.shape[1], self.width, self.width, y.shape[1]]
            layers = [layer for pair in zip(sizes, sizes[1:]) for layer in (nn.Linear(*pair), nn.GELU())]
            network = nn.Sequential(*layers[:-1]).to(x.device)
            picks = torch.randint(len(x), (self.steps, min(512, len(x))))
        optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-2)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, total_steps=self.steps)
        for rows in picks.to(x.device):
            functional.mse_loss(network(x[rows]), y[rows]).backward()
            optimizer.step()
            optimizer.zero_grad()
            schedule.step()
        return network.requires_grad_(False).eval()

    def forward(self, latent: torch.Tensor) -> dict[str, torch.Tensor]:
        """Latents [..., D], real or imagined -> values [..., C] of each quantity, by its name.

        Raises:
            RuntimeError: the probe was not fitted.
        """
        targets = self._predict(latent).split(self._sizes(), -1)
        return {quantity.name: quantity.values(target) for quantity, target in zip(self.quantities, targets)}

    def errors(self, latent: torch.Tensor, values: Values) -> dict[str, torch.Tensor]:
        """Errors [...] of each quantity in its unit, for latents [..., D] and true values [..., C]."""
        return {q.name: q.error(value, values[q.name]) for q, value in zip(self.quantities, self(latent).values())}

    def score(self, latent: torch.Tensor, values: Values) -> dict[str, dict[str, Any]]:
        """Compares the regressed values with the true ones.

        Args:
            latent (Tensor): [N, D], of held-out episodes; real ones, or predictions of their latents.
            values (dict): the true values [N, C] of each quantity, by its name.

        Returns:
            for each quantity, by its name: ``unit``; ``median`` and ``p90`` of the error in this unit; ``constant``, the median
            error of the mean of the fitted rows; ``r2`` = 1 - squared error / variance, summed over the components of the
            targets (sine and cosine of an angle); ``r``, Pearson's correlation, averaged over these components. ``r2`` and
            ``r`` are None where the true values do not vary.
        """
        target, predicted = self._targets(latent, values), self._predict(latent)  # [N, K]
        mean = self.target_mean.expand_as(target)
        scores = {}
        for quantity, true, found, constant in zip(self.quantities, *(x.split(self._sizes(), -1) for x in (target, predicted, mean))):
            error = quantity.error(quantity.values(found), values[quantity.name].to(found))  # [N]
            baseline = quantity.error(quantity.values(constant), values[quantity.name].to(found))
            centered, guess = true - true.mean(0), found - found.mean(0)
            total = float(centered.square().sum())
            norms = centered.norm(dim=0) * guess.norm(dim=0)
            varies = guess.norm(dim=0) > 1e-9 * centered.norm(dim=0)  # not rounding errors of a constant
            r = torch.where(varies & (norms > 0), (centered * guess).sum(0) / norms, 0.0).mean()
            scores[quantity.name] = {
                "unit": quantity.unit,
                **quantiles(error),
                "constant": quantiles(baseline)["median"],
                "r2": 1 - float((true - found).square().sum()) / total if total > 0 else None,
                "r": float(r) if total > 0 else None,
            }
        return scores

    def _sizes(self) -> list[int]:
        return [quantity.size * (1 if quantity.period is None else 2) for quantity in self.quantities]

    def _targets(self, latent: torch.Tensor, values: Values) -> torch.Tensor:
        """Targets [..., K] of all quantities, float64."""
        missing = [quantity.name for quantity in self.quantities if quantity.name not in values]
        if missing:
            raise KeyError(f"values of {', '.join(missing)} are missing: see measure_states().")
        for quantity in self.quantities:
            shape, want = values[quantity.name].shape, (*latent.shape[:-1], quantity.size)
            if shape != want:
                raise ValueError(f"values of {quantity.name!r} must be {list(want)} for these latents, got {list(shape)}.")
        targets = [quantity.targets(values[quantity.name].double().to(latent.device)) for quantity in self.quantities]
        return torch.cat(targets, -1)

    @torch.no_grad()
    def _predict(self, latent: torch.Tensor) -> torch.Tensor:
        """Targets [..., K] regressed from latents [..., D], float64."""
        if self.network is None:
            raise RuntimeError("the probe was not fitted: call fit(latent, values) first.")
        x = (latent.double() - self.latent_mean) / self.latent_std
        dtype = next(self.network.parameters()).dtype
        return self.network(x.to(dtype)).double() * self.target_std + self.target_mean


def quantiles(error: torch.Tensor) -> dict[str, float]:
    """``median`` and ``p90`` of errors [N]."""
    middle, high = error.double().quantile(torch.tensor([0.5, 0.9], dtype=torch.float64, device=error.device)).tolist()
    return {"median": middle, "p90": high}


def _std(x: torch.Tensor) -> torch.Tensor:
    std = x.std(0, correction=0)
    return torch.where(std > 1e-8, std, torch.ones_like(std))
