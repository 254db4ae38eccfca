"""A tiny run with all parts of a real one: dropout, BatchNorm, an inverse model, validation, a card."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torchrl.checkpoint import Checkpoint

from torchrl_ficreg import FICRegLoss, LeWMLoss, make_world_model, ModelConfig
from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.pretrained import ModelCard
from torchrl_ficreg.trainers import checkpoint_components, OfflineTrainer, stop_on_signal

SIZES = ModelConfig(
    encoder="conv",
    image_size=16,
    frame_skip=2,
    latent_dim=4,
    history=1,
    conv_channels=(4, 8),
    encoder_projector_dim=8,
    predictor_width=16,
    predictor_depth=1,
    predictor_heads=2,
    predictor_dim_head=8,
    predictor_mlp_dim=16,
    predictor_projector_dim=16,
    predictor_dropout=0.1,
    inverse_hidden_dim=8,
)
STILL = replace(SIZES, predictor_dropout=0.0)  # without dropout
LOW, HIGH = [-4.0, -4.0], [4.0, 4.0]


def record(episodes: int = 10) -> list[dict[str, np.ndarray]]:
    """Random pictures and actions."""
    rng = np.random.default_rng(0)
    return [
        {
            "pixels": rng.integers(0, 256, (24, 3, 16, 16), dtype=np.uint8),
            "action": np.pad(rng.uniform(-1, 1, (23, 2)), ((0, 1), (0, 0))).astype(np.float32),
            "state": rng.normal(size=(24, 2)),
        }
        for _ in range(episodes)
    ]


def make_data(split: str = "train", *, episodes: int = 10, **settings) -> OfflineTrajectories:
    """7 training episodes of 22 clips, hence 9 batches of 16 an epoch."""
    settings = {"split": split, "num_frames": 2, "frame_skip": 2, "batch_size": 16, **settings}
    return OfflineTrajectories.from_episodes(record(episodes), **settings)


def make_trainer(
    run_dir: Path | None = None,
    *,
    method: str = "ficreg",
    data: OfflineTrajectories | None = None,
    validate: bool = True,
    sizes: ModelConfig = SIZES,
    **settings,
) -> OfflineTrainer:
    """A trainer of three epochs, with the same initial weights at every call."""
    data = make_data() if data is None else data
    torch.manual_seed(0)
    model, inverse_model = make_world_model(sizes, action_dim=2)
    model.statistics = data.statistics
    if method == "lewm":
        loss = LeWMLoss(model.encoder, model.predictor)
    else:
        loss = FICRegLoss(model.encoder, model.predictor, inverse_model)
    card = ModelCard(asdict(sizes), "two_room", {"collision": "swept"}, LOW, HIGH, config={"seed": 0})
    defaults = {"epochs": 3, "lr": 1e-2, "log_interval": 4, "precision": "fp32", "progress_bar": False}
    if validate:
        defaults["validation_buffer"] = make_data("validation", drop_last=False)
    return OfflineTrainer(
        loss,
        data,
        run_dir=run_dir,
        components=checkpoint_components(model, inverse_model, card),
        **{**defaults, **settings},
    )


def weights(trainer: OfflineTrainer) -> dict[str, torch.Tensor]:
    """Copies of every parameter and buffer of the loss and its networks."""
    return {name: value.clone() for name, value in trainer.loss_module.state_dict().items()}


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    """Equality to the last bit."""
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def run(run_dir: Path, weights_file: Path) -> None:
    """One start of a command: continues after the last checkpoint, and saves the final weights."""
    trainer = make_trainer(run_dir, data=make_data(prefetch=1), epochs=6)
    trainer.resume()
    with open(weights_file.with_suffix(".starts"), "a") as file:
        file.write(f"{trainer.step}\n")
    trainer.train()
    part = weights_file.with_suffix(".part")
    torch.save(weights(trainer), part)
    part.rename(weights_file)


def run_until_signalled(run_dir: Path) -> None:
    """A long run that stops on SIGTERM; a file named after its first step says that the handler is installed."""
    trainer = make_trainer(run_dir, data=make_data(prefetch=1), validate=False, epochs=60)
    trainer.resume()
    with stop_on_signal(trainer):
        run_dir.with_name(f"ready{trainer.step}").touch()
        trainer.train()


def table(run_dir: Path, split: str | None = None) -> list[dict[str, str]]:
    """Rows of the metrics, of one split or of all."""
    with open(run_dir / "metrics.csv", newline="") as file:
        return [row for row in csv.DictReader(file) if split in (None, row["split"])]


def logged_steps(run_dir: Path, split: str = "train") -> list[int]:
    """Steps that have a row."""
    return [int(row["step"]) for row in table(run_dir, split)]


def at_step(trainer: OfflineTrainer, step: int, action: Callable[[], object]) -> None:
    """Calls ``action`` after a step."""
    trainer.register_op("post_steps", lambda: action() if trainer.step == step else None)


def fail_after(trainer: OfflineTrainer, step: int, error: BaseException) -> None:
    """Makes the trainer raise after a step."""
    at_step(trainer, step, lambda: (_ for _ in ()).throw(error))


def train_interrupted(trainer: OfflineTrainer, step: int) -> None:
    """Trains until an exception after a step. Checkpoints are written after steps 9, 18 and 27."""
    fail_after(trainer, step, KeyboardInterrupt())
    with suppress(KeyboardInterrupt):
        trainer.train()


def watch_updates(trainer: OfflineTrainer, what: Callable[[], object]) -> list:
    """Collects ``what()`` right before every update of the optimizer."""
    seen = []
    trainer.optimizer.register_step_pre_hook(lambda *_: seen.append(what()))
    return seen


def snapshot(folder: Path) -> dict[Path, bytes]:
    """Content of every file."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def half_written(run_dir: Path) -> set[str]:
    """Names of what a process left behind that was killed while it wrote a checkpoint."""
    return {path.name for path in (run_dir / "checkpoints").glob(".*")}


def damage(path: Path, how: str) -> None:
    data = bytearray(path.read_bytes())
    if how == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif how == "flipped":  # every 97th byte of the payloads; the zip's directory at the end stays readable
        with zipfile.ZipFile(path) as archive:
            end, manifest = archive.start_dir, archive.getinfo("manifest.json")
        for at in range(200, min(end, manifest.header_offset), 97):
            data[at] ^= 0xFF
        path.write_bytes(data)
    elif how == "without the card":
        with zipfile.ZipFile(path) as archive:
            kept = [(info, archive.read(info)) for info in archive.infolist() if "card" not in info.filename]
        with zipfile.ZipFile(path, "w") as archive:
            for info, content in kept:
                archive.writestr(info, content)
    else:
        Checkpoint(something={"else": 1}).save(path, format="archive")
