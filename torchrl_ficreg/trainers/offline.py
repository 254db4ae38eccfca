"""Trains a world model on recorded clips, with TorchRL's trainer."""

from __future__ import annotations

import errno
import math
import os
import shutil
import time
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.objectives.common import LossModule
from torchrl.record.loggers import Logger
from torchrl.trainers.trainers import LRSchedulerHook

from torchrl_ficreg._device import keep_freed_memory, Precision
from torchrl_ficreg._torchrl_compat import BaseTrainer, HALF_WRITTEN
from torchrl_ficreg.distributed import barrier, broadcast_from_rank0, is_main, rank, world_size
from torchrl_ficreg.trainers.checkpoint import (
    check_members,
    CHECKPOINTS,
    DAMAGES,
    latest_intact,
    RandomState,
    remove_old_unpacked,
    require_checkpoint_space,
    set_unreadable_aside,
)
from torchrl_ficreg.trainers.hooks import MetricsTable, Progress, Throughput, Validation
from torchrl_ficreg.trainers.loggers import TolerantLogger
from torchrl_ficreg.trainers.stepper import DistributedLoss, OfflineStepper
from torchrl_ficreg.trainers.stream import ClipBuffer, ReadError, ReplayStream

METRICS = "metrics.csv"


class OfflineTrainer(BaseTrainer):
    """A :class:`torchrl.trainers.Trainer` that samples clips from a replay buffer.

    One AdamW over all parameters, gradient clipping, a linear warm-up and a cosine to zero over the exact number of
    steps, and bfloat16 autocast where the device is fast at it. TorchRL's hooks register on it as on any trainer; a
    *frame* in their settings (``wait_for``, ``patience``) is one stored frame of a clip, and a step takes B x T of them.

    With a ``run_dir`` it writes ``metrics.csv`` and, after every epoch, a checkpoint below ``checkpoints/``. A checkpoint
    is published by one atomic rename, and the previous one is kept until then, so that a process killed at any time
    leaves a loadable one. :meth:`resume` continues from the latest. On one device, a resumed run ends with bitwise the
    weights of an unbroken one: a checkpoint holds optimizer state, schedule, random state and the position in the data.

    Behaviour on failure; existing checkpoints are never changed:

    ========================================  =====================================================================
    a loss or gradient is not finite          stops with ``FloatingPointError``; no weight is updated
    a batch cannot be read                    stops with :class:`ReadError`; a single process writes a checkpoint first
    a file of the dataset was deleted         warns and continues (the mapping still holds it)
    a file of the dataset was truncated       as a batch that cannot be read
    no space for a checkpoint                 stops with ``OSError``
    no space for ``metrics.csv``              warns and continues; rows wait in memory until there is space
    the logger fails or hangs                 warns and continues without it
    SIGTERM, inside :class:`stop_on_signal`   writes a checkpoint after the step and exits with code 85; SIGINT: 130
    SIGKILL, a crash, a power failure         continues from the last checkpoint when started again
    the newest checkpoint is damaged          warns and continues from the one before
    ``train()`` without ``resume()``          ``ValueError`` where the folder holds checkpoints
    ========================================  =====================================================================

    Args:
        loss_module (LossModule): a loss such as :class:`~torchrl_ficreg.FICRegLoss`, on its device.
        replay_buffer (ClipBuffer): training clips in whole batches (``drop_last``), such as
            :class:`~torchrl_ficreg.data.OfflineTrajectories`; :class:`~torchrl_ficreg.trainers.stream.ClipBuffer` lists
            what another replay buffer needs.

    Keyword Args:
        epochs (int): passes over all clips.
        schedule_epochs (int, optional): length of the learning-rate schedule in epochs, at least ``epochs``. A run that
            ends before its schedule ends with a learning rate above zero. Default: ``None``, ``epochs``.
        lr (float, optional): peak learning rate of AdamW. Default: ``5e-5``.
        weight_decay (float, optional): of AdamW. Default: ``1e-3``.
        warmup (float, optional): fraction of the schedule in which the learning rate rises, in [0, 1).
            Default: ``0.01``.
        clip_norm (float, optional): largest norm of the gradient of all parameters. Default: ``1.0``.
        accumulate (int, optional): micro-batches that a batch is split into; see :class:`OfflineStepper`.
            Default: ``1``.
        precision (str, optional): see :func:`~torchrl_ficreg._device.autocast`. Default: ``"auto"``.
        compile (bool, optional): compile the loss with ``torch.compile``. Default: ``False``.
        run_dir (path, optional): folder for metrics and checkpoints. Default: ``None``, nothing is written.
        components (dict, optional): name -> further components of a checkpoint: objects with a ``state_dict``, or JSON
            values. Default: ``None``.
        keep_epoch (int, optional): epoch whose checkpoint is kept for good, as ``checkpoints/epoch-<n>.torchrl``.
            Default: ``None``.
        validation_buffer (ClipBuffer, optional): clips of held-out episodes, evaluated after every epoch.
            Default: ``None``.
        validation_batches (int, optional): batches of them to average over. Default: ``4``.
        log_interval (int, optional): steps between rows of ``metrics.csv``. Default: ``10``.
        logger (Logger, optional): TorchRL logger that receives the same numbers. Default: ``None``.
        progress_bar (bool, optional): show a progress bar. Default: ``True``.
        description (str, optional): text before the progress bar. Default: ``"train"``.

    Raises:
        ValueError: an argument is out of range, the buffer stores single steps, serves incomplete batches or those of
            another rank, or the loss is not a mean.

    Examples:
        >>> import numpy as np
        >>> from torchrl_ficreg import LeWMLoss, make_world_model, ModelConfig
        >>> from torchrl_ficreg.data import OfflineTrajectories
        >>> rng = np.random.default_rng(0)
        >>> episode = {
        ...     "pixels": rng.integers(0, 256, (12, 3, 64, 64), dtype=np.uint8),
        ...     "action": np.pad(rng.normal(size=(11, 2)), ((0, 1), (0, 0))).astype(np.float32),
        ...     "state": np.zeros((12, 1)),
        ... }
        >>> clips = OfflineTrajectories.from_episodes(
        ...     [episode] * 2, split="all", num_frames=2, frame_skip=5, batch_size=4
        ... )
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", history=1), action_dim=2)
        >>> trainer = OfflineTrainer(LeWMLoss(model.encoder, model.predictor), clips, epochs=1, progress_bar=False)
        >>> trainer.train()
        >>> trainer.step, trainer.total_steps
        (3, 3)
    """

    def __init__(
        self,
        loss_module: LossModule,
        replay_buffer: ClipBuffer,
        *,
        epochs: int,
        schedule_epochs: int | None = None,
        lr: float = 5e-5,
        weight_decay: float = 1e-3,
        warmup: float = 0.01,
        clip_norm: float = 1.0,
        accumulate: int = 1,
        precision: Precision = "auto",
        compile: bool = False,
        run_dir: Path | str | None = None,
        components: dict[str, Any] | None = None,
        keep_epoch: int | None = None,
        validation_buffer: ClipBuffer | None = None,
        validation_batches: int = 4,
        log_interval: int = 10,
        logger: Logger | None = None,
        progress_bar: bool = True,
        description: str = "train",
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
        batch_size = replay_buffer.batch_size
        if accumulate < 1 or batch_size % (2 * accumulate) and accumulate > 1:
            raise ValueError(
                f"accumulate={accumulate} must cut the {batch_size} clips of a batch into equal parts of at least 2."
            )
        reduction = getattr(loss_module, "reduction", "mean")
        if reduction != "mean":  # a sum would be divided by accumulate and by the number of ranks
            raise ValueError(
                "the trainer averages losses over the parts of a batch and over processes, which needs reduction='mean', "
                f"got {reduction!r}: build the loss with 'mean'."
            )
        stream = ReplayStream(replay_buffer, next(loss_module.parameters()).device)
        if stream.batches_per_epoch * batch_size > len(replay_buffer):
            raise ValueError("the last batch of an epoch is incomplete: make the training buffer with drop_last=True.")
        for buffer in (replay_buffer, validation_buffer):
            _check_rank(buffer)
        self.steps_per_epoch = stream.batches_per_epoch
        self.total_steps = epochs * self.steps_per_epoch
        self.schedule_steps = (schedule_epochs or epochs) * self.steps_per_epoch
        self.keep_epoch = keep_epoch
        self._resumed = False
        self.distributed_loss = DistributedLoss(loss_module, compile)
        if stream.device.type == "cpu":
            keep_freed_memory(2**31 - 1)  # the activations of a step, which the next step allocates again
        throughput = Throughput(batch_size, lambda: stream.waited, stream.device)
        metrics = None if run_dir is None or not is_main() else Path(run_dir) / METRICS
        self.metrics_table = MetricsTable(metrics, log_interval, self.total_steps, throughput)
        optimizer = torch.optim.AdamW(
            [p for p in loss_module.parameters() if p.requires_grad],
            lr=lr,
            weight_decay=weight_decay,
            fused=stream.device.type != "mps",
        )
        checkpoint = rotation = None
        if run_dir is not None:
            checkpoint = Checkpoint(format="archive", rng=RandomState(stream.device), **(components or {}))
            rotation = CheckpointRotation(Path(run_dir) / CHECKPOINTS, keep_last=2)
        frames = batch_size * stream.num_frames  # of one step
        super().__init__(
            collector=stream,
            total_frames=self.total_steps * frames,
            frame_skip=world_size(),  # counts frames over all ranks
            optim_steps_per_batch=1,
            loss_module=loss_module.train(),
            optimizer=optimizer,
            optimization_stepper=OfflineStepper(precision, clip_norm, self.metrics_table.due, accumulate),
            progress_bar=False,
            auto_log_optim_steps=False,
            log_interval=0,
            save_trainer_interval=self.steps_per_epoch * frames - 1,  # TorchRL saves above the interval, not at it
            checkpoint=checkpoint,
            checkpoint_rotation=rotation,
            logger=TolerantLogger.around(logger) if is_main() else None,
        )
        self.schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, WarmupCosine(self.schedule_steps, warmup))
        LRSchedulerHook(self.schedule, interval="optim").register(self)
        self.clock = ElapsedTime()
        self.register_module("clock", self.clock)
        self.metrics_table.register(self)
        if validation_buffer is not None:
            hook = Validation(validation_buffer, self.steps_per_epoch, validation_batches, precision, self.metrics_table)
            hook.register(self)
        if progress_bar and is_main():
            Progress(self.total_steps, log_interval, description).register(self)

    def train(self) -> None:
        """Trains to the last step; returns at once where a resumed run had reached it.

        Raises:
            FloatingPointError: a loss or a gradient is not finite.
            OSError: a checkpoint cannot be written.
            ReadError: a batch cannot be read.
            ValueError: the run has checkpoints, and :meth:`resume` was not called.
        """
        rotation, begun = self.checkpoint_rotation, self.step > 0 or self._resumed
        if rotation is not None and not begun and any(rotation.directory.glob(f"{rotation.prefix}-*")):
            raise ValueError(
                f"{rotation.directory} holds checkpoints of a run: call resume() before train() to continue it, or "
                "give another run_dir."
            )
        if self.step >= self.total_steps:
            return
        self.clock.start()
        try:
            super().train()
        except ReadError:
            if world_size() == 1:  # the other ranks have begun the next step
                self.save_trainer(force_save=True)
            raise
        self.clock.stop()
        if isinstance(self.logger, TolerantLogger):
            self.logger.flush()

    def resume(self, start: Path | str | None = None) -> bool:
        """Loads the latest checkpoint of the run, if there is one.

        Args:
            start (path, optional): a checkpoint, for example of another run, to load where the run has none.
                Default: ``None``.

        Returns:
            whether a checkpoint was loaded.

        Raises:
            FileNotFoundError: the run is past ``keep_epoch``, and the checkpoint of that epoch was not kept.
            ValueError: the checkpoint is damaged, or belongs to other networks, data or hooks.
        """
        rotation, latest = self.checkpoint_rotation, None
        if rotation is not None:
            latest = latest_intact(rotation)
            if is_main():
                set_unreadable_aside(rotation)
        latest = broadcast_from_rank0(start if latest is None else latest)
        if latest is not None:
            check_members(latest)
            remove_old_unpacked()
            try:
                self.load_checkpoint(latest)
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
            _match_strides(self.optimizer)
            self._keep(latest)  # the process may have been killed between the checkpoint and its copy
        self._resumed = True
        self._remove_half_written()
        self.metrics_table.drop_after(self.step)
        return latest is not None

    def write_checkpoint(self) -> None:
        """Writes a checkpoint on rank 0, while the other ranks wait; :meth:`save_trainer` calls it where one is due.

        Raises:
            OSError: it cannot be written, for example for want of space. Existing checkpoints stay as they are.
        """
        if is_main():
            if self.checkpoint_rotation is not None:
                require_checkpoint_space(self.checkpoint_rotation.directory, self.loss_module.parameters())
            try:
                super().write_checkpoint()
                if self.checkpoint_rotation is not None:
                    self._keep(self.checkpoint_rotation.latest())
            except (OSError, RuntimeError) as error:
                advice = "make room; " if _is_full(error) else ""
                raise OSError(
                    f"the checkpoint of step {self.step} cannot be written ({error}): {advice}the same command "
                    "continues from the last one."
                ) from error
        barrier()  # torchrun would stop rank 0 while it writes, if another rank ended

    @property
    def kept(self) -> Path | None:
        """Path of the checkpoint of ``keep_epoch``, whether or not it exists yet."""
        if self.keep_epoch is None or self.checkpoint_rotation is None:
            return None
        return self.checkpoint_rotation.directory / f"epoch-{self.keep_epoch}.torchrl"

    def _keep(self, checkpoint: Path) -> None:
        """Copies the checkpoint of ``keep_epoch`` to a name that the rotation leaves alone; ignores other epochs."""
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
            part.unlink(missing_ok=True)  # of a killed process, or a link, which copyfile would follow
            shutil.copyfile(checkpoint, part)
            os.replace(part, self.kept)

    def _remove_half_written(self) -> None:
        """Removes what a killed process left half-written beside its checkpoints."""
        if self.checkpoint_rotation is None or not is_main():
            return
        for pattern in HALF_WRITTEN:
            for left in self.checkpoint_rotation.directory.glob(pattern):
                shutil.rmtree(left) if left.is_dir() and not left.is_symlink() else left.unlink()


class WarmupCosine:
    """Learning-rate factor for ``LambdaLR``: linear warm-up from zero, then a cosine to zero at the last step.

    Its attributes are part of a checkpoint, as the state of the ``LambdaLR``.

    Args:
        steps (int): optimization steps of the whole schedule. A run may end before.
        warmup (float): fraction of the steps in which the factor rises, in [0, 1).

    Examples:
        >>> factor = WarmupCosine(steps=100, warmup=0.1)
        >>> factor(0), factor(9), round(factor(100), 6)
        (0.1, 1.0, 0.0)
    """

    def __init__(self, steps: int, warmup: float) -> None:
        self.steps = steps
        self.rise = max(1, round(warmup * steps))

    def __call__(self, step: int) -> float:
        """Factor of the update that follows ``step`` updates."""
        if step < self.rise:
            return (step + 1) / self.rise
        return 0.5 * (1 + math.cos(math.pi * (step - self.rise) / max(1, self.steps - self.rise)))


class ElapsedTime:
    """Wall-clock training time in seconds, accumulated across restarts of a run.

    Examples:
        >>> elapsed = ElapsedTime()
        >>> elapsed.load_state_dict({"seconds": 60.0})
        >>> elapsed.seconds
        60.0
    """

    def __init__(self) -> None:
        self._before = 0.0
        self._began: float | None = None

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return self._before + (time.perf_counter() - self._began if self._began is not None else 0.0)

    def start(self) -> None:
        """Starts the timer."""
        self._began = time.perf_counter()

    def stop(self) -> None:
        """Stops the timer."""
        self._before, self._began = self.seconds, None

    def state_dict(self) -> dict[str, float]:
        """``seconds``."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Continues from ``seconds``."""
        self._before = float(state_dict["seconds"])


def _check_rank(buffer: ClipBuffer | None) -> None:
    sampler = getattr(buffer, "sampler", None)
    got = (getattr(sampler, "rank", 0), getattr(sampler, "world_size", 1))
    if buffer is not None and got != (rank(), world_size()):
        raise ValueError(
            f"rank {rank()} of {world_size()} was given a dataset of rank {got[0]} of {got[1]}: make its datasets with "
            "rank=rank(), world_size=world_size()."
        )


def _is_full(error: OSError | RuntimeError) -> bool:
    """Whether a disk, a quota or the largest file size was exceeded; PyTorch's archives say so in the message only."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return "writ" in str(error)


def _match_strides(optimizer: torch.optim.Optimizer) -> None:
    """Gives a loaded optimizer state the strides of its parameters.

    A checkpoint holds values, not strides, and the fused AdamW runs over raw memory: with a channels-last weight and a
    contiguous moment it would combine elements of different positions.
    """
    for parameter, state in optimizer.state.items():
        for key, value in state.items():
            if torch.is_tensor(value) and value.shape == parameter.shape:
                state[key] = torch.empty_like(parameter, requires_grad=False).copy_(value)
