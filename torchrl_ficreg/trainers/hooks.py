"""Hooks that any TorchRL trainer can register: metrics table, validation and progress bar."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer
from torchrl.trainers import Trainer, TrainerHookBase
from tqdm import tqdm

from torchrl_ficreg.modules.precision import autocast, Precision
from torchrl_ficreg.trainers.distributed import average
from torchrl_ficreg.trainers.meter import Meter
from torchrl_ficreg.trainers.rows import CsvRows


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
