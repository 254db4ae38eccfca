"""Hooks that look after a loss: is the latent space alive, and how much does a term weigh by now?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tensordict import TensorDictBase
from torchrl import torchrl_logger
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_ficreg.modules.precision import autocast, Precision
from torchrl_ficreg.objectives.base import LatentLoss
from torchrl_ficreg.objectives.gather import gather_clips
from torchrl_ficreg.objectives.health import latent_health
from torchrl_ficreg.objectives.sigreg import SIGReg
from torchrl_ficreg.objectives.vicreg import TemporalStraightness
from torchrl_ficreg.trainers.distributed import is_main
from torchrl_ficreg.trainers.hooks import MetricsTable


class LatentAlarm(TrainerHookBase):
    """Logs floor ratio and effective rank of the latents every few steps, and warns when they say collapse.

    Clips of three frames and more give a third number, ``straightness``: the mean cosine between successive steps in
    latent space, 1 on a straight path. See :func:`~torchrl_ficreg.objectives.latent_health` for the others. Nothing about
    the run is changed by looking: no random number is used up and no running statistic moved. On several processes every
    one looks at the same steps, and all report the numbers of the global batch.

    Args:
        interval: steps between looks; the first step is one.
        precision: as in training.
        table: gets the numbers as columns.
    """

    def __init__(self, interval: int, precision: Precision = "auto", table: MetricsTable | None = None) -> None:
        if interval < 1:
            raise ValueError(f"interval must be positive, got {interval}.")
        self.interval, self.precision, self.table = interval, precision, table
        self._numbers: dict[str, float] = {}

    def __call__(self, batch: TensorDictBase) -> dict[str, float] | None:
        """Called after every optimisation step."""
        step = self._trainer._optim_count
        if step % self.interval and step != 1:
            return None
        loss: LatentLoss = self._trainer.loss_module
        with autocast(batch.device or "cpu", self.precision):
            latent = loss.peek(batch)  # [T, B, D]
        health = latent_health(latent, SIGReg().to(latent.device))
        if health.alarm is not None and step != 1 and is_main():  # at the very start nothing has been learned yet
            torchrl_logger.warning(f"step {step}: {health.alarm}")
        numbers = {"floor_ratio": health.floor_ratio, "effective_rank": health.effective_rank}
        if len(latent) >= 3:
            clips = gather_clips(latent.float().transpose(0, 1))  # [B of all processes, T, D]
            numbers["straightness"] = TemporalStraightness()(clips).item()
        self._keep(numbers)
        return self._numbers

    def _keep(self, numbers: dict[str, float]) -> None:
        self._numbers = dict(numbers)
        if self.table is not None:
            self.table.extra.update(self._numbers)

    def state_dict(self) -> dict[str, Any]:
        """The last numbers, so that the table of a resumed run equals that of an unbroken one."""
        return dict(self._numbers)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Shows them again."""
        self._keep({key: float(value) for key, value in state_dict.items()})

    def register(self, trainer: Trainer, name: str = "latent_alarm") -> None:
        """Registers after each optimisation step."""
        self._trainer = trainer
        trainer.register_op("post_optim_log", self)
        trainer.register_module(name, self)


class CoefficientSchedule(TrainerHookBase):
    """Sets a coefficient of the loss before every step. Coefficients are buffers, so nothing is recompiled.

    Args:
        name: of the coefficient, for instance ``"consistency_coeff"``.
        value: function of the share of training done, in [0, 1).
        steps: of the whole run.

    Raises:
        AttributeError: when registered on a trainer whose loss has no such coefficient.

    Examples:
        >>> ramp = CoefficientSchedule("consistency_coeff", lambda done: 0.1 * min(1.0, done / 0.2), steps=1000)
        >>> ramp.value(0.1)
        0.05
    """

    def __init__(self, name: str, value: Callable[[float], float], steps: int) -> None:
        self.name, self.value, self.steps = name, value, steps

    def __call__(self) -> None:
        """Called before every optimisation step."""
        setattr(self._trainer.loss_module, self.name, self.value(self._trainer._optim_count / self.steps))

    def register(self, trainer: Trainer, name: str | None = None) -> None:
        """Registers before each optimisation step."""
        getattr(trainer.loss_module, self.name)
        self._trainer = trainer
        trainer.register_op("pre_optim_steps", self)
