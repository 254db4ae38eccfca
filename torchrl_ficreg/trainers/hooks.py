"""Hooks for TorchRL trainers: metrics table, validation, progress, throughput, success rate, collapse, coefficients."""

from __future__ import annotations

import mmap
import signal
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl import torchrl_logger
from torchrl.data import ReplayBuffer
from torchrl.trainers import Trainer, TrainerHookBase
from tqdm import tqdm

from torchrl_ficreg._device import autocast, Precision
from torchrl_ficreg.distributed import average, gather_clips, is_main
from torchrl_ficreg.objectives.base import LatentLoss
from torchrl_ficreg.objectives.diagnostics import latent_health
from torchrl_ficreg.objectives.sigreg import SIGReg
from torchrl_ficreg.objectives.terms import TemporalStraightness
from torchrl_ficreg.trainers.checkpoint import RandomState, SUCCESS
from torchrl_ficreg.trainers.loggers import CsvRows
from torchrl_ficreg.trainers.signals import exit_on_signal, Preempted, told_to_stop


GIB = 2**30


class Meter:
    """Measures between two looks, without a synchronisation of its own.

    Args:
        clips_per_step: of one optimisation step, over all processes.
        waited: seconds waited for data so far, see :class:`~torchrl_ficreg.trainers.stream.ReplayStream`.
        device: whose peak of memory is reported, where it is a CUDA device.

    Examples:
        >>> meter = Meter(clips_per_step=128)
        >>> sorted(meter.look(step=1))
        ['clips_per_second', 'loader_share', 'memory_gib', 'steps_per_second']
    """

    def __init__(
        self, clips_per_step: int, waited: Callable[[], float] = lambda: 0.0, device: torch.device | str = "cpu"
    ) -> None:
        self.clips_per_step, self.waited, self.device = clips_per_step, waited, torch.device(device)
        self._warned = False
        self.begin(0)

    def begin(self, step: int) -> None:
        """Counts from here."""
        self._since = (time.perf_counter(), self.waited(), step)

    def look(self, step: int) -> dict[str, float]:
        """Means since the last look: ``loader_share`` is the part of a step's time in which data was waited for.

        Memory in GiB: ``memory_gib`` resident in this process now, ``cuda_memory_gib`` the most that PyTorch has
        allocated on the device so far.
        """
        began, waited, before = self._since
        self.begin(step)
        seconds = max(self._since[0] - began, 1e-9)
        rate = (step - before) / seconds
        numbers = {
            "steps_per_second": rate,
            "clips_per_second": rate * self.clips_per_step,
            "loader_share": (self._since[1] - waited) / seconds,
        }
        memory = resident_memory()
        if memory is not None:
            numbers["memory_gib"] = memory / GIB
        elif not self._warned:
            torchrl_logger.warning("this system does not tell how much memory a process takes: no memory_gib is noted.")
            self._warned = True
        if self.device.type == "cuda":
            numbers["cuda_memory_gib"] = torch.cuda.max_memory_allocated(self.device) / GIB
        return numbers


def resident_memory() -> int | None:
    """Bytes of this process that lie in memory; else the most there ever were; None where the system tells neither.

    Examples:
        >>> resident_memory() > 1_000_000
        True
    """
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text(encoding="utf-8").split()[1]) * mmap.PAGESIZE
    try:
        import resource
    except ImportError:  # Windows
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


class MetricsTable(TrainerHookBase):
    """Writes one row of ``metrics.csv`` every few steps and hands the numbers to the trainer's logger.

    A resumed run drops the rows that were written after its checkpoint. The first step of a process is always handed to
    the logger, so that hooks such as TorchRL's ``EarlyStopping`` find a value.

    Args:
        path: the CSV file, or None for the logger alone.
        interval: steps between rows.
        last_step: steps of the whole run; the last one always gets a row.
        meter: speed and memory go into every row of training.
    """

    def __init__(self, path: Path | None, interval: int, last_step: int, meter: Meter | None = None) -> None:
        self.path, self.interval, self.last_step = path, interval, last_step
        self.meter = Meter(1) if meter is None else meter
        self._rows = None if path is None else CsvRows(path, first=("step", "split"))
        self._silent = True
        self.extra: dict[str, float] = {}  # what other hooks want in every row, as LatentAlarm does

    def __call__(self, optim_steps: int, losses: TensorDictBase) -> dict[str, float] | None:
        """Called after every optimisation step."""
        due = self.due(optim_steps)
        if not due and not self._silent:
            return None
        self._silent = False
        names = sorted(losses.keys(), key=lambda name: (name.startswith("grad_norm_"), name))  # single networks last
        row = {name: losses[name].float().mean().item() for name in names} | self.extra
        row |= self.meter.look(optim_steps)
        if due:
            self._write({"step": optim_steps, "split": "train", **row})
        return row

    def due(self, step: int) -> bool:
        """Whether this step gets a row."""
        return step % self.interval == 0 or step == self.last_step

    def write_validation(self, step: int, terms: dict[str, float], split: str = "validation") -> None:
        """Adds a row of terms of held-out data."""
        self._write({"step": step, "split": split, **terms})

    def _write(self, row: dict[str, Any]) -> None:
        if self._rows is not None:
            self._rows.append(row)

    def drop_after(self, step: int) -> None:
        """Removes rows of later steps, in one piece, and begins to measure speed."""
        self.meter.begin(step)
        if self._rows is not None:
            self._rows.drop_after(step)

    def register(self, trainer: Trainer, name: str = "metrics_table") -> None:
        """Registers after each optimisation step."""
        trainer.register_op("post_optim_complete_log", self)


class Validation(TrainerHookBase):
    """Evaluates the loss on held-out clips every few steps, in eval mode.

    The global random state is left as it was found, so that a run with validation trains as one without.

    Args:
        replay_buffer: clips of held-out episodes.
        interval: steps between evaluations, usually an epoch.
        batches: batches averaged over, the same ones each time; an incomplete one only where there is no other.
        precision: as in training.
        table: where the terms are written.
    """

    def __init__(
        self, replay_buffer: ReplayBuffer, interval: int, batches: int, precision: Precision, table: MetricsTable
    ) -> None:
        whole = len(replay_buffer) // replay_buffer.batch_size  # the numbers of a few clips left over are mostly noise
        self.replay_buffer, self.interval, self.batches = replay_buffer, interval, max(1, min(batches, whole))
        self.precision, self.table = precision, table

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> dict[str, float] | None:
        """Called after every step."""
        trainer, step = self._trainer, self._trainer._optim_count
        if step % self.interval:
            return None
        loss = trainer.loss_module.eval()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.replay_buffer.seek(0)
            outputs = []
            for _ in range(self.batches):
                clip = self.replay_buffer.sample().to(batch.device)
                with autocast(batch.device, self.precision):
                    outputs.append(average(loss(clip)))
        loss.train()
        terms = {key: torch.stack([out[key].float().mean() for out in outputs]).mean().item() for key in outputs[0].keys()}
        self.table.write_validation(step, terms)
        return {f"validation_{key}": value for key, value in terms.items()}

    def register(self, trainer: Trainer, name: str = "validation") -> None:
        """Registers after each step."""
        self._trainer = trainer
        trainer.register_op("post_steps_log", self)


class Progress(TrainerHookBase):
    """A progress bar over optimisation steps that shows the weighted loss terms.

    Args:
        steps: of the whole run.
        interval: steps between updates of the numbers.
    """

    def __init__(self, steps: int, interval: int) -> None:
        self.steps, self.interval = steps, interval
        self.bar: tqdm | None = None

    def __call__(self, optim_steps: int, losses: TensorDictBase) -> None:
        """Called after every optimisation step."""
        if self.bar is None:
            self.bar = tqdm(total=self.steps, initial=optim_steps - 1, desc="train", unit="step", dynamic_ncols=True)
        self.bar.update(1)
        if optim_steps % self.interval == 0:
            self.bar.set_postfix_str(_terms(losses.items()), refresh=False)
        if optim_steps >= self.steps:
            self.bar.close()

    def register(self, trainer: Trainer, name: str = "progress") -> None:
        """Registers after each optimisation step."""
        trainer.register_op("post_optim_complete_log", self)


def _terms(items: Iterable[tuple[str, torch.Tensor]]) -> str:
    return " ".join(f"{key[5:]} {value.item():.3f}" for key, value in sorted(items) if key.startswith("loss_"))


_UNKNOWN = -1.0  # below every rate: TorchRL's rotation wants a number from every checkpoint


class SuccessRate(TrainerHookBase):
    """Evaluates the model every few steps, in eval mode, before the checkpoint of that step is written.

    Where several processes train, the main one evaluates and the others wait. Random states are left as they were
    found, so that a run with evaluation trains as one without.

    SIGTERM and SIGINT end an evaluation at once, and its rate stays unknown: the checkpoint of the step comes after it,
    and who sent the signal may not wait long. The signal then does what it does in training, see
    :class:`stop_on_signal`.

    Args:
        evaluate: returns numbers, ``success_rate`` in [0, 1] among them.
        interval: steps between evaluations.
        table: where they are written, as a row of the split ``"evaluation"``.
    """

    def __init__(self, evaluate: Callable[[], dict[str, float]], interval: int, table: MetricsTable) -> None:
        self.evaluate, self.interval, self.table = evaluate, interval, table
        self._latest = (0, _UNKNOWN)  # step, rate

    def __call__(self, batch: TensorDictBase) -> dict[str, float] | None:
        """Called after every step."""
        trainer, step = self._trainer, self._trainer._optim_count
        if step % self.interval or not is_main() or told_to_stop(trainer):
            return None
        state, stopped = RandomState(next(trainer.loss_module.parameters()).device), None
        before = state.state_dict()
        trainer.loss_module.eval()
        try:
            with exit_on_signal(signal.SIGTERM, signal.SIGINT):
                numbers = {key: float(value) for key, value in self.evaluate().items()}
        except Preempted as stop:
            stopped = stop.signal
        finally:
            trainer.loss_module.train()
            state.load_state_dict(before)
        if stopped is not None:
            signal.raise_signal(stopped)
            return None
        self._latest = (step, numbers[SUCCESS])
        self.table.write_validation(step, numbers, split="evaluation")
        return {f"evaluation_{key}": value for key, value in numbers.items()}

    def metadata(self, trainer: Trainer) -> dict[str, float]:
        """For the manifest of a checkpoint: the rate of these very weights, -1 where it was not measured."""
        step, rate = self._latest
        return {SUCCESS: rate if step == trainer._optim_count else _UNKNOWN}

    def forget(self) -> None:
        """To be called when the weights have been changed by something else than the trainer."""
        self._latest = (0, _UNKNOWN)

    def register(self, trainer: Trainer, name: str = "success_rate") -> None:
        """Registers after each step; from now on the rotation keeps the best checkpoint besides the latest."""
        self._trainer = trainer
        trainer.register_op("post_steps_log", self)
        if trainer.checkpoint_rotation is not None:
            trainer.checkpoint_metadata = self.metadata
            trainer.checkpoint_rotation.keep_best = (SUCCESS, "max")


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
