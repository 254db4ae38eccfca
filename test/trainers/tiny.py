"""The smallest run that has everything a real one has: dropout, BatchNorm, an inverse model, validation, a card."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

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
    """A trainer of three epochs that a second call with the same arguments makes again, weight for weight."""
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


def finite(tensors: dict[str, torch.Tensor]) -> bool:
    """No NaN and no infinity anywhere."""
    return all(math.isfinite(value.double().sum()) for value in tensors.values())


def run(run_dir: Path, weights_file: Path) -> None:
    """One start of the command: continues where the last one was killed, then leaves its weights."""
    trainer = make_trainer(run_dir, data=make_data(prefetch=1), epochs=6)
    trainer.resume()
    with open(weights_file.with_suffix(".starts"), "a") as file:
        file.write(f"{trainer.step}\n")
    trainer.train()
    part = weights_file.with_suffix(".part")
    torch.save(weights(trainer), part)
    part.rename(weights_file)


def run_until_told(run_dir: Path) -> None:
    """A long run that stops when it is told to; says, by a file, from which step on it listens."""
    trainer = make_trainer(run_dir, data=make_data(prefetch=1), validate=False, epochs=60)
    trainer.resume()
    with stop_on_signal(trainer):
        run_dir.with_name(f"listens{trainer.step}").touch()
        trainer.train()
