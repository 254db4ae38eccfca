"""Trains a world model from stored clips, with TorchRL's trainer."""

from __future__ import annotations

import errno
import math
import os
import shutil
import time
from collections import defaultdict, deque
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.objectives.common import LossModule
from torchrl.record.loggers import Logger
from torchrl.trainers import Trainer
from torchrl.trainers.trainers import LRSchedulerHook

from torchrl_ficreg._device import keep_freed_memory, Precision
from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.distributed import from_main, is_main, rank, wait_for_all, world_size
from torchrl_ficreg.trainers.checkpoint import (
    check_members,
    check_room,
    CHECKPOINTS,
    DAMAGES,
    latest_whole,
    RandomState,
    set_odd_aside,
    sweep_unpacked,
)
from torchrl_ficreg.trainers.hooks import Meter, MetricsTable, Progress, Validation
from torchrl_ficreg.trainers.loggers import TolerantLogger
from torchrl_ficreg.trainers.stepper import OfflineStepper, parallelise, Strategy
from torchrl_ficreg.trainers.stream import ReadError, ReplayStream


class Clock:
    """Wall time spent in training, over all lives of a run."""

    def __init__(self) -> None:
        self._before, self._began = 0.0, None

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return self._before + (time.perf_counter() - self._began if self._began is not None else 0.0)

    def start(self) -> None:
        """Begins to count."""
        self._began = time.perf_counter()

    def stop(self) -> None:
        """Ceases to count."""
        self._before, self._began = self.seconds, None

    def state_dict(self) -> dict[str, float]:
        """The seconds so far."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Continues from there."""
        self._before = float(state_dict["seconds"])


class WarmupCosine:
    """Factor of the learning rate: linear from 0 over the warm-up, then a cosine to 0 at the last step.

    Args:
        steps: of the whole schedule, which a run may leave before its end.
        warmup: share of them in which the factor rises.

    Examples:
        >>> factor = WarmupCosine(steps=100, warmup=0.1)
        >>> factor(0), factor(9), round(factor(100), 6)
        (0.1, 1.0, 0.0)
    """

    def __init__(self, steps: int, warmup: float) -> None:
        self.steps, self.rise = steps, max(1, round(warmup * steps))

    def __call__(self, step: int) -> float:
        """Factor of the update after ``step`` updates."""
        if step < self.rise:
            return (step + 1) / self.rise
        return 0.5 * (1 + math.cos(math.pi * (step - self.rise) / max(1, self.steps - self.rise)))


METRICS = "metrics.csv"
_KEPT = 100  # latest numbers of each kind in memory, for hooks such as TorchRL's EarlyStopping; all are in metrics.csv


class OfflineTrainer(Trainer):
    """A :class:`torchrl.trainers.Trainer` that is fed by a replay buffer of clips.

    One AdamW for everything, gradient clipping, linear warm-up and a cosine to zero over the exact number of steps,
    bfloat16 autocast where the device is good at it. TorchRL's hooks register on it as on any trainer; a *frame* in
    their settings (``wait_for``, ``patience``) is one stored frame of a clip, batch x T of them a step.

    With a ``run_dir`` it writes ``metrics.csv`` and, after every epoch, a checkpoint below ``checkpoints/``. Each is
    published by one atomic rename and the previous one is kept until then: a kill at any instant leaves a loadable
    one. :meth:`resume` continues from the latest, and on one device a resumed run ends with the very weights of an
    unbroken one: optimiser, schedule, random state and the position in the data are part of a checkpoint.

    What goes wrong on the way, and what happens then; the checkpoints already there are never touched:

    ========================================  =====================================================================
    a loss or gradient is not finite          stops, ``FloatingPointError``; no weight is updated
    a batch cannot be read                    stops, :class:`ReadError`; a single process writes a checkpoint first
    a file of the dataset vanishes            warns and goes on (the mapping still holds it); shorter: cannot be read
    no room for a checkpoint                  stops, ``OSError``
    no room for ``metrics.csv``               warns and goes on; rows wait in memory until there is room
    the logger fails or hangs                 warns and goes on without it
    SIGTERM, inside :class:`stop_on_signal`   writes a checkpoint after the step and exits with code 85; SIGINT: 130
    SIGKILL, a crash, a power cut             continues from the last checkpoint when started again
    the newest checkpoint is damaged          warns and continues from the one before
    ``train()`` without ``resume()``          ``ValueError`` where the folder holds checkpoints
    ========================================  =====================================================================

    Args:
        loss_module: a loss such as :class:`~torchrl_ficreg.FICRegLoss`, already on its device.
        replay_buffer: training clips, in whole batches (``drop_last``).
        epochs: passes over all clips.
        schedule_epochs: length of the learning rate's schedule, in epochs and at least ``epochs``; None: ``epochs``. A run
            that ends earlier than its schedule ends at a rate above zero.
        keep_epoch: epoch whose checkpoint stays, as ``checkpoints/epoch-<n>.torchrl``, whatever comes later; None: none.
        lr, weight_decay: of AdamW.
        warmup: share of the schedule in which the learning rate rises from zero.
        clip_norm: largest gradient norm.
        precision: see :func:`~torchrl_ficreg._device.autocast`.
        run_dir: folder for metrics and checkpoints; None writes nothing.
        components: more things to put into a checkpoint, by name: anything with a ``state_dict``, or JSON values.
        validation_buffer: clips of held-out episodes, evaluated after every epoch.
        validation_batches: batches of them to average over.
        log_interval: steps between rows of ``metrics.csv``.
        logger: a TorchRL logger that receives the same numbers.
        progress_bar: show one.
        strategy: of several processes, ``"ddp"`` or ``"fsdp"``; see :mod:`~torchrl_ficreg.trainers.stepper`.
        accumulate: parts of a batch that are learned from one after another; see :class:`OfflineStepper`.
        compile: the loss, by ``torch.compile``.

    Raises:
        FloatingPointError: a loss stopped being finite, see :class:`OfflineStepper`.
        ValueError: a setting outside its range, or a buffer that serves incomplete batches.
    """

    def __init__(
        self,
        loss_module: LossModule,
        replay_buffer: OfflineTrajectories,
        *,
        epochs: int,
        schedule_epochs: int | None = None,
        keep_epoch: int | None = None,
        lr: float = 5e-5,
        weight_decay: float = 1e-3,
        warmup: float = 0.01,
        clip_norm: float = 1.0,
        precision: Precision = "auto",
        run_dir: Path | str | None = None,
        components: dict[str, Any] | None = None,
        validation_buffer: OfflineTrajectories | None = None,
        validation_batches: int = 4,
        log_interval: int = 10,
        logger: Logger | None = None,
        progress_bar: bool = True,
        strategy: Strategy = "ddp",
        accumulate: int = 1,
        compile: bool = False,
    ) -> None:
        if epochs < 1 or lr <= 0 or weight_decay < 0 or clip_norm <= 0 or not 0 <= warmup < 1 or log_interval < 1:
            raise ValueError(
                "epochs, lr, clip_norm and log_interval must be positive, weight_decay not negative and warmup in "
                f"[0, 1), got {epochs}, {lr}, {clip_norm}, {log_interval}, {weight_decay} and {warmup}."
            )
        if schedule_epochs is not None and schedule_epochs < epochs:
            raise ValueError(f"schedule_epochs must be at least epochs={epochs}, or None, got {schedule_epochs}.")
        if keep_epoch is not None and not 1 <= keep_epoch <= epochs:
            raise ValueError(f"keep_epoch must lie between 1 and epochs={epochs}, or be None, got {keep_epoch}.")
        if validation_buffer is not None and validation_batches < 1:
            raise ValueError(f"validation_batches must be positive, got {validation_batches}.")
        if accumulate < 1 or replay_buffer.batch_size % (2 * accumulate) and accumulate > 1:
            raise ValueError(
                f"accumulate={accumulate} must cut the {replay_buffer.batch_size} clips of a batch into equal parts of "
                "at least 2."
            )
        self.steps_per_epoch = replay_buffer.batches_per_epoch
        if self.steps_per_epoch * replay_buffer.batch_size > len(replay_buffer):
            raise ValueError("the last batch of an epoch is incomplete: make the training buffer with drop_last=True.")
        reduction = getattr(loss_module, "reduction", "mean")
        if reduction != "mean":  # a sum would be divided by accumulate and by the number of processes
            raise ValueError(
                f"the trainer averages losses over the parts of a batch and over processes, which needs reduction='mean', got "
                f"{reduction!r}: build the loss with 'mean'."
            )
        self.total_steps, self._resumed = epochs * self.steps_per_epoch, False
        self.schedule_steps = (schedule_epochs or epochs) * self.steps_per_epoch
        self.keep_epoch = keep_epoch
        frames = replay_buffer.batch_size * replay_buffer.num_frames  # of one step
        self._check_parts(replay_buffer, validation_buffer)
        self.parallel = parallelise(loss_module, strategy, compile)
        params = self.parallel.params
        if params[0].device.type == "cpu":
            keep_freed_memory(2**31 - 1)  # the activations of a step, which the next one needs again
        stream = ReplayStream(replay_buffer, params[0].device)
        meter = Meter(replay_buffer.batch_size, lambda: stream.waited, params[0].device)
        metrics = None if run_dir is None or not is_main() else Path(run_dir) / METRICS
        self.metrics_table = MetricsTable(metrics, log_interval, self.total_steps, meter)
        optimizer = torch.optim.AdamW(params, lr=lr, weight_decay=weight_decay, fused=params[0].device.type != "mps")
        rotation = None if run_dir is None else CheckpointRotation(Path(run_dir) / CHECKPOINTS, keep_last=2)
        super().__init__(
            collector=stream,
            total_frames=self.total_steps * frames,
            frame_skip=world_size(),  # so that frames count over all processes
            optim_steps_per_batch=1,
            loss_module=loss_module.train(),
            optimizer=optimizer,
            optimization_stepper=OfflineStepper(precision, clip_norm, self.metrics_table.due, accumulate),
            progress_bar=False,
            auto_log_optim_steps=False,
            log_interval=0,
            save_trainer_interval=self.steps_per_epoch * frames - 1,  # the comparison is strict
            checkpoint=(
                None
                if run_dir is None
                else Checkpoint(format="archive", rng=RandomState(params[0].device), **(components or {}))
            ),
            checkpoint_rotation=rotation,
        )
        self._log_dict = defaultdict(partial(deque, maxlen=_KEPT))
        self._checkpoint_skip_warnings.add("logger")  # it has no state, on purpose
        self.logger = TolerantLogger.around(logger) if is_main() else None
        self.schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, WarmupCosine(self.schedule_steps, warmup))
        LRSchedulerHook(self.schedule, interval="optim").register(self)
        self.clock = Clock()
        self.register_module("clock", self.clock)
        self.metrics_table.register(self)
        if validation_buffer is not None:
            hook = Validation(validation_buffer, self.steps_per_epoch, validation_batches, precision, self.metrics_table)
            hook.register(self)
        if progress_bar and is_main():
            Progress(self.total_steps, log_interval).register(self)

    @staticmethod
    def _check_parts(*buffers: OfflineTrajectories | None) -> None:
        for part in (buffer.part for buffer in buffers if buffer is not None):
            if part != (rank(), world_size()):
                raise ValueError(
                    f"process {rank()} of {world_size()} was given a dataset with part={part}: make its datasets with "
                    "part=(rank(), world_size())."
                )

    @property
    def step(self) -> int:
        """Optimisation steps taken."""
        return self._optim_count

    def resume(self, start: Path | str | None = None) -> bool:
        """Loads the latest checkpoint of the run, if there is one, and says whether anything was loaded.

        Args:
            start: a checkpoint, of another run say, to begin from where the run has none yet.

        Raises:
            FileNotFoundError: the run is past ``keep_epoch``, and that epoch's checkpoint was not kept.
            ValueError: the checkpoint is damaged, or belongs to other networks, data or hooks.
        """
        rotation, latest = self.checkpoint_rotation, None
        if rotation is not None:
            latest = latest_whole(rotation)
            if is_main():
                set_odd_aside(rotation)
        latest = from_main(start if latest is None else latest)
        if latest is not None:
            check_members(latest)
            sweep_unpacked()
            try:
                checkpoint = Checkpoint() if self.checkpoint is None else self.checkpoint
                # Every component takes its tensors to its own device; the one they came from may not exist here.
                self._sync_checkpoint_components(checkpoint).load(latest, map_location="cpu")
            except DAMAGES as error:
                raise ValueError(
                    f"{latest} cannot be continued ({error}): repeat the settings it was made with, or, if it is "
                    "damaged, move it away to continue from the one before."
                ) from error
            planned = self.schedule.lr_lambdas[0].steps
            if planned != self.schedule_steps:
                raise ValueError(
                    f"{latest} was scheduled for {planned} steps, not {self.schedule_steps}: the learning rate has "
                    "fallen accordingly. Repeat its epochs, schedule_epochs and batch size, or begin another run."
                )
            self.parallel.restored(self.optimizer)
            _align(self.optimizer)
            self._keep(latest)  # the process may have been killed between the checkpoint and this
        self._resumed = True
        self._sweep()
        self.metrics_table.drop_after(self.step)
        return latest is not None

    def _save_trainer(self) -> None:
        """Saves, when :meth:`save_trainer` finds that a checkpoint is due.

        Raises:
            OSError: it cannot be written, for want of room say. The checkpoints already there stay as they are.
        """
        with self.parallel.whole(self.optimizer):
            if is_main():
                if self.checkpoint_rotation is not None:
                    check_room(self.checkpoint_rotation.directory, self.loss_module.parameters())
                try:
                    super()._save_trainer()
                    if self.checkpoint_rotation is not None:
                        self._keep(self.checkpoint_rotation.latest())
                except (OSError, RuntimeError) as error:
                    advice = "make room; " if _is_full(error) else ""
                    raise OSError(
                        f"the checkpoint of step {self.step} cannot be written ({error}): {advice}the same command "
                        "continues from the last one."
                    ) from error
            wait_for_all()  # a process that ended meanwhile would have torchrun stop the writer too

    @property
    def kept(self) -> Path | None:
        """Where the checkpoint of ``keep_epoch`` is, or will be."""
        if self.keep_epoch is None or self.checkpoint_rotation is None:
            return None
        return self.checkpoint_rotation.directory / f"epoch-{self.keep_epoch}.torchrl"

    def _keep(self, checkpoint: Path) -> None:
        """Keeps a checkpoint beside the rotation, which does not touch it, where it is that of ``keep_epoch``."""
        if self.kept is None or self.kept.exists() or not is_main():
            return
        end = self.keep_epoch * self.steps_per_epoch
        if self.step > end:
            raise FileNotFoundError(
                f"{self.kept} is missing: this run is past epoch {self.keep_epoch} and did not keep it. Choose another "
                "epoch, or begin another run."
            )
        if self.step == end:
            self.kept.parent.mkdir(parents=True, exist_ok=True)
            part = self.kept.with_name(f".{self.kept.name}.part")
            part.unlink(missing_ok=True)  # of a process that was killed, or a link, through which nothing is written
            shutil.copyfile(checkpoint, part)
            os.replace(part, self.kept)

    def _sweep(self) -> None:
        """Removes what a killed process left half-written beside its checkpoints."""
        if self.checkpoint_rotation is None or not is_main():
            return
        for pattern in (".*.stage-*", ".*.archive-*", ".*.delete-*"):
            for left in self.checkpoint_rotation.directory.glob(pattern):
                shutil.rmtree(left) if left.is_dir() and not left.is_symlink() else left.unlink()

    def train(self) -> None:
        """Runs to the end, or not at all when the resumed run had reached it.

        Raises:
            ValueError: there are checkpoints of a run, and :meth:`resume` was not called.
        """
        rotation, begun = self.checkpoint_rotation, self.step > 0 or self._resumed
        if rotation is not None and not begun and any(rotation.directory.glob(f"{rotation.prefix}-*")):
            raise ValueError(
                f"{rotation.directory} holds checkpoints of a run: call resume() before train() to continue it, or "
                "give another run_dir."
            )
        if self.step < self.total_steps:
            self.clock.start()
            try:
                super().train()
            except ReadError:
                if world_size() == 1:  # the other processes are at work on the next batch already
                    self.save_trainer(force_save=True)
                raise
            self.clock.stop()
            if isinstance(self.logger, TolerantLogger):
                self.logger.flush()
        self.parallel.finished(self.optimizer)


def _is_full(error: OSError | RuntimeError) -> bool:
    """Whether a disk, a quota or the largest size of a file was exceeded; PyTorch's archives tell it in words only."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return "writ" in str(error)


def _align(optimizer: torch.optim.Optimizer) -> None:
    """Lays loaded moments out in memory as their parameters are.

    A checkpoint keeps values, not strides, and the fused AdamW walks over raw memory: beside a channels-last weight,
    contiguous moments would meet the wrong elements.
    """
    for parameter, state in optimizer.state.items():
        for key, value in state.items():
            if torch.is_tensor(value) and value.shape == parameter.shape:
                state[key] = torch.empty_like(parameter, requires_grad=False).copy_(value)
