"""Trainer hooks: metrics table, validation, evaluation, collapse monitor, coefficient schedule, progress, throughput."""

from __future__ import annotations

import mmap
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl import torchrl_logger
from torchrl.trainers import Trainer, TrainerHookBase
from tqdm import tqdm

from torchrl_ficreg._device import autocast, Precision
from torchrl_ficreg._torchrl_compat import step_count
from torchrl_ficreg.distributed import all_gather, all_reduce_mean, is_main
from torchrl_ficreg.objectives.base import LatentLoss
from torchrl_ficreg.objectives.diagnostics import latent_health
from torchrl_ficreg.objectives.sigreg import SIGReg
from torchrl_ficreg.objectives.terms import TemporalStraightness
from torchrl_ficreg.trainers.checkpoint import RandomState, SUCCESS
from torchrl_ficreg.trainers.loggers import CsvRows
from torchrl_ficreg.trainers.signals import exit_on_signal, Preempted, stop_requested
from torchrl_ficreg.trainers.stream import ClipBuffer

GIB = 2**30  # bytes
_UNKNOWN = -1.0  # success rate that was not measured: TorchRL's rotation needs a number in every checkpoint


class MetricsTable(TrainerHookBase):
    """Writes a row of ``metrics.csv`` every few steps and passes its numbers to the trainer's logger.

    A resumed run removes the rows of steps after its checkpoint. The logger also gets the first step of a process, so
    that hooks such as TorchRL's ``EarlyStopping`` find a value.

    Args:
        path (Path or None): the CSV file; None writes no file.
        interval (int): steps between rows.
        last_step (int): steps of the whole run. The last one always gets a row.
        throughput (Throughput, optional): adds speed and memory to the rows of training. Default: one that counts a clip
            per step.

    Attributes:
        extra (dict[str, float]): further columns of every row of training, set by other hooks.
    """

    def __init__(self, path: Path | None, interval: int, last_step: int, throughput: Throughput | None = None) -> None:
        self.path = path
        self.interval = interval
        self.last_step = last_step
        self.throughput = Throughput(1) if throughput is None else throughput
        self.extra: dict[str, float] = {}
        self._rows = None if path is None else CsvRows(path, first=("step", "split"))
        self._first = True

    def __call__(self, optim_steps: int, losses: TensorDictBase) -> dict[str, float] | None:
        """Called after every optimization step."""
        due = self.due(optim_steps)
        if not due and not self._first:
            return None
        self._first = False
        names = sorted(losses.keys(), key=lambda name: (name.startswith("grad_norm_"), name))  # norms of networks last
        row = {name: losses[name].float().mean().item() for name in names} | self.extra
        row |= self.throughput.read(optim_steps)
        if due:
            self._write({"step": optim_steps, "split": "train", **row})
        return row

    def due(self, step: int) -> bool:
        """Whether a step gets a row."""
        return step % self.interval == 0 or step == self.last_step

    def write_validation(self, step: int, terms: dict[str, float], split: str = "validation") -> None:
        """Writes a row of numbers of held-out data."""
        self._write({"step": step, "split": split, **terms})

    def _write(self, row: dict[str, Any]) -> None:
        if self._rows is not None:
            self._rows.append(row)

    def drop_after(self, step: int) -> None:
        """Removes rows of later steps, atomically, and resets the throughput."""
        self.throughput.reset(step)
        if self._rows is not None:
            self._rows.drop_after(step)

    def register(self, trainer: Trainer, name: str = "metrics_table") -> None:
        """Registers after each optimization step."""
        trainer.register_op("post_optim_complete_log", self)


class Validation(TrainerHookBase):
    """Evaluates the loss on held-out clips every few steps, in eval mode.

    The global random state is restored, so that a run with validation trains as one without.

    Args:
        replay_buffer (ClipBuffer): clips of held-out episodes.
        interval (int): steps between evaluations, usually those of an epoch.
        batches (int): batches to average over, the same ones each time. An incomplete batch is used only if it is the
            only one.
        precision (str): as in training.
        table (MetricsTable): where the terms are written.
    """

    def __init__(
        self, replay_buffer: ClipBuffer, interval: int, batches: int, precision: Precision, table: MetricsTable
    ) -> None:
        whole = len(replay_buffer) // replay_buffer.batch_size  # an incomplete batch of few clips is mostly noise
        self.replay_buffer = replay_buffer
        self.interval = interval
        self.batches = max(1, min(batches, whole))
        self.precision = precision
        self.table = table

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> dict[str, float] | None:
        """Called after every step."""
        trainer, step = self._trainer, step_count(self._trainer)
        if step % self.interval:
            return None
        loss = trainer.loss_module.eval()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            if hasattr(self.replay_buffer, "seek"):
                self.replay_buffer.seek(0)
            outputs = []
            for _ in range(self.batches):
                clip = self.replay_buffer.sample().to(batch.device)
                with autocast(batch.device, self.precision):
                    outputs.append(all_reduce_mean(loss(clip)))
        loss.train()
        terms = {key: torch.stack([out[key].float().mean() for out in outputs]).mean().item() for key in outputs[0].keys()}
        self.table.write_validation(step, terms)
        return {f"validation_{key}": value for key, value in terms.items()}

    def register(self, trainer: Trainer, name: str = "validation") -> None:
        """Registers after each step."""
        self._trainer = trainer
        trainer.register_op("post_steps_log", self)


class EvaluationHook(TrainerHookBase):
    """Evaluates the model every few steps, in eval mode, before the checkpoint of that step is written.

    With several ranks, rank 0 evaluates and the others wait. Random states are restored, so that a run with evaluation
    trains as one without.

    SIGTERM and SIGINT abort an evaluation, because the scheduler may kill the process soon and the checkpoint of the step
    is still to be written. The success rate of that step is recorded as unknown, and the signal then has its effect on
    the training, see :class:`stop_on_signal`.

    Args:
        evaluate (Callable[[], dict[str, float]]): returns numbers, among them ``success_rate`` in [0, 1].
        interval (int): steps between evaluations.
        table (MetricsTable): where the numbers are written, as a row of the split ``"evaluation"``.
    """

    def __init__(self, evaluate: Callable[[], dict[str, float]], interval: int, table: MetricsTable) -> None:
        self.evaluate = evaluate
        self.interval = interval
        self.table = table
        self._latest = (0, _UNKNOWN)  # step, rate

    def __call__(self, batch: TensorDictBase) -> dict[str, float] | None:
        """Called after every step."""
        trainer, step = self._trainer, step_count(self._trainer)
        if step % self.interval or not is_main() or stop_requested(trainer):
            return None
        state, received = RandomState(next(trainer.loss_module.parameters()).device), None
        before = state.state_dict()
        trainer.loss_module.eval()
        try:
            with exit_on_signal(signal.SIGTERM, signal.SIGINT):
                numbers = {key: float(value) for key, value in self.evaluate().items()}
        except Preempted as preempted:
            received = preempted.signal
        finally:
            trainer.loss_module.train()
            state.load_state_dict(before)
        if received is not None:
            signal.raise_signal(received)
            return None
        self._latest = (step, numbers[SUCCESS])
        self.table.write_validation(step, numbers, split="evaluation")
        return {f"evaluation_{key}": value for key, value in numbers.items()}

    def metadata(self, trainer: Trainer) -> dict[str, float]:
        """For the manifest of a checkpoint: the success rate of its weights, -1 where it was not measured."""
        step, rate = self._latest
        return {SUCCESS: rate if step == step_count(trainer) else _UNKNOWN}

    def forget(self) -> None:
        """Records the success rate as unknown, after something else than the trainer has changed the weights."""
        self._latest = (0, _UNKNOWN)

    def register(self, trainer: Trainer, name: str = "success_rate") -> None:
        """Registers after each step. The rotation then keeps the best checkpoint besides the latest."""
        self._trainer = trainer
        trainer.register_op("post_steps_log", self)
        if trainer.checkpoint_rotation is not None:
            trainer.checkpoint_metadata = self.metadata
            trainer.checkpoint_rotation.keep_best = (SUCCESS, "max")


class CollapseMonitor(TrainerHookBase):
    """Logs diagnostics of the latents every few steps, and warns of a collapse.

    The numbers are ``floor_ratio`` and ``effective_rank`` of :func:`~torchrl_ficreg.objectives.latent_health`, and for
    clips of three frames or more ``straightness``, the mean cosine between successive steps in latent space: 1 on a
    straight path. Training is not affected: no random number is drawn and no running statistic is updated. With several
    ranks, the numbers are those of the global batch.

    Args:
        interval (int): steps between measurements. The first step is measured too.
        precision (str, optional): as in training. Default: ``"auto"``.
        table (MetricsTable, optional): gets the numbers as columns. Default: ``None``.

    Raises:
        ValueError: ``interval`` is not positive.
    """

    def __init__(self, interval: int, precision: Precision = "auto", table: MetricsTable | None = None) -> None:
        if interval < 1:
            raise ValueError(f"interval must be positive, got {interval}.")
        self.interval = interval
        self.precision = precision
        self.table = table
        self._numbers: dict[str, float] = {}

    def __call__(self, batch: TensorDictBase) -> dict[str, float] | None:
        """Called after every optimization step."""
        step = step_count(self._trainer)
        if step % self.interval and step != 1:
            return None
        loss: LatentLoss = self._trainer.loss_module
        with autocast(batch.device or "cpu", self.precision):
            latent = loss.peek(batch)  # [T, B, D]
        health = latent_health(latent, SIGReg().to(latent.device))
        if health.alarm is not None and step != 1 and is_main():  # an untrained encoder looks collapsed
            torchrl_logger.warning(f"step {step}: {health.alarm}")
        numbers = {"floor_ratio": health.floor_ratio, "effective_rank": health.effective_rank}
        if len(latent) >= 3:
            clips = all_gather(latent.float().transpose(0, 1))  # [B of all ranks, T, D]
            numbers["straightness"] = TemporalStraightness()(clips).item()
        self._show(numbers)
        return self._numbers

    def _show(self, numbers: dict[str, float]) -> None:
        self._numbers = numbers
        if self.table is not None:
            self.table.extra.update(numbers)

    def state_dict(self) -> dict[str, Any]:
        """The latest numbers, so that a resumed run writes the same rows as an unbroken one."""
        return dict(self._numbers)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the latest numbers."""
        self._show({key: float(value) for key, value in state_dict.items()})

    def register(self, trainer: Trainer, name: str = "latent_alarm") -> None:
        """Registers after each optimization step; ``name`` is that of its state in checkpoints."""
        self._trainer = trainer
        trainer.register_op("post_optim_log", self)
        trainer.register_module(name, self)


class CoefficientSchedule(TrainerHookBase):
    """Sets a coefficient of the loss before every step. Coefficients are buffers, so nothing is recompiled.

    Args:
        name (str): of the coefficient, for example ``"consistency_coeff"``.
        value (Callable[[float], float]): fraction of the training done, in [0, 1) -> coefficient.
        steps (int): of the whole run.

    Raises:
        AttributeError: on registration, if the trainer's loss has no such coefficient.

    Examples:
        >>> ramp = CoefficientSchedule("consistency_coeff", lambda done: 0.1 * min(1.0, done / 0.2), steps=1000)
        >>> ramp.value(0.1)
        0.05
    """

    def __init__(self, name: str, value: Callable[[float], float], steps: int) -> None:
        self.name = name
        self.value = value
        self.steps = steps

    def __call__(self) -> None:
        """Called before every optimization step."""
        setattr(self._trainer.loss_module, self.name, self.value(step_count(self._trainer) / self.steps))

    def register(self, trainer: Trainer, name: str | None = None) -> None:
        """Registers before each optimization step."""
        getattr(trainer.loss_module, self.name)
        self._trainer = trainer
        trainer.register_op("pre_optim_steps", self)


class Progress(TrainerHookBase):
    """Progress bar over optimization steps with the weighted loss terms.

    Args:
        steps (int): of the whole run.
        interval (int): steps between updates of the terms.
        description (str, optional): text before the bar. Default: ``"train"``.
    """

    def __init__(self, steps: int, interval: int, description: str = "train") -> None:
        self.steps = steps
        self.interval = interval
        self.description = description
        self.bar: tqdm | None = None

    def __call__(self, optim_steps: int, losses: TensorDictBase) -> None:
        """Called after every optimization step."""
        if self.bar is None:
            done = optim_steps - 1
            self.bar = tqdm(total=self.steps, initial=done, desc=self.description, unit="step", dynamic_ncols=True)
        self.bar.update(1)
        if optim_steps % self.interval == 0:
            terms = sorted((key, value) for key, value in losses.items() if key.startswith("loss_"))
            shown = " ".join(f"{key.removeprefix('loss_')} {value.item():.3f}" for key, value in terms)
            self.bar.set_postfix_str(shown, refresh=False)
        if optim_steps >= self.steps:
            self.bar.close()

    def register(self, trainer: Trainer, name: str = "progress") -> None:
        """Registers after each optimization step."""
        trainer.register_op("post_optim_complete_log", self)


class Throughput:
    """Measures speed and memory between two calls of :meth:`read`, without a device synchronization.

    Args:
        clips_per_step (int): over all ranks.
        waited (Callable[[], float], optional): seconds spent in waiting for data so far, see
            :class:`~torchrl_ficreg.trainers.stream.ReplayStream`. Default: always 0.
        device (torch.device or str, optional): its peak memory is reported if it is a CUDA device. Default: ``"cpu"``.

    Examples:
        >>> throughput = Throughput(clips_per_step=128)
        >>> sorted(throughput.read(step=1))
        ['clips_per_second', 'loader_share', 'memory_gib', 'steps_per_second']
    """

    def __init__(
        self, clips_per_step: int, waited: Callable[[], float] = lambda: 0.0, device: torch.device | str = "cpu"
    ) -> None:
        self.clips_per_step = clips_per_step
        self.waited = waited
        self.device = torch.device(device)
        self._warned = False
        self.reset(0)

    def reset(self, step: int) -> None:
        """Starts a new measuring interval at a step."""
        self._start = (time.perf_counter(), self.waited(), step)

    def read(self, step: int) -> dict[str, float]:
        """Ends the measuring interval at a step and starts the next one.

        Returns:
            ``steps_per_second``, ``clips_per_second``, ``loader_share`` (fraction of the time in which data was waited
            for), ``memory_gib`` (GiB resident in this process now) and on CUDA devices ``cuda_memory_gib`` (GiB, the
            most that PyTorch has allocated so far).
        """
        began, waited, before = self._start
        self.reset(step)
        seconds = max(self._start[0] - began, 1e-9)
        rate = (step - before) / seconds
        numbers = {
            "steps_per_second": rate,
            "clips_per_second": rate * self.clips_per_step,
            "loader_share": (self._start[1] - waited) / seconds,
        }
        memory = resident_memory()
        if memory is not None:
            numbers["memory_gib"] = memory / GIB
        elif not self._warned:
            torchrl_logger.warning("this system does not report the memory of a process: metrics have no memory_gib.")
            self._warned = True
        if self.device.type == "cuda":
            numbers["cuda_memory_gib"] = torch.cuda.max_memory_allocated(self.device) / GIB
        return numbers


def resident_memory() -> int | None:
    """Resident set size of this process in bytes; its peak on systems without /proc; None on Windows."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text(encoding="utf-8").split()[1]) * mmap.PAGESIZE
    try:
        import resource
    except ImportError:  # Windows
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
