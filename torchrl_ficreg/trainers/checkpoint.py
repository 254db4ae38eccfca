"""What a world model's checkpoint holds, and how to get a usable model out of one."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torchrl import torchrl_logger
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation

from torchrl_ficreg.modules.inverse import InverseDynamicsModel
from torchrl_ficreg.modules.presets import make_world_model, ModelConfig
from torchrl_ficreg.modules.pretrained.folder import load_pretrained, WEIGHTS_FILE
from torchrl_ficreg.modules.world_model import LatentWorldModel

CHECKPOINTS = "checkpoints"
SUCCESS = "success_rate"  # in the manifest of a checkpoint; negative where it was not measured
_CARD, _MODEL, _INVERSE = "card", "world_model", "inverse_model"
DAMAGES = (CheckpointError, zipfile.BadZipFile, EOFError)  # what reading a damaged or foreign checkpoint raises


@dataclass(frozen=True)
class ModelCard:
    """What one must know about a model to use it without its dataset, as plain JSON values.

    Attributes:
        model: fields of :class:`ModelConfig`.
        env: name of the environment it was trained on.
        env_kwargs: how that environment was made.
        action_low, action_high: bounds of a raw action [A], environment units.
        config: the whole resolved configuration of the run that made it.
    """

    model: dict[str, Any]
    env: str
    env_kwargs: dict[str, Any]
    action_low: list[float]
    action_high: list[float]
    config: dict[str, Any]

    @property
    def action_dim(self) -> int:
        """A, raw action dimension."""
        return len(self.action_low)


def checkpoint_components(
    model: LatentWorldModel, inverse_model: InverseDynamicsModel, card: ModelCard
) -> dict[str, Any]:
    """The components by which :func:`load_world_model` finds a model in a trainer's checkpoint."""
    return {_MODEL: model, _INVERSE: inverse_model, _CARD: asdict(card)}


def find_checkpoint(path: Path | str, *, best: bool = False) -> Path:
    """The checkpoint a user means: a checkpoint itself, or the latest of a run directory.

    Args:
        path: of either.
        best: of a run directory, the one of the highest success instead, see :class:`SuccessRate`.

    Raises:
        FileNotFoundError: there is none, or success was never measured.
    """
    path = Path(path).expanduser()
    if Checkpoint.is_checkpoint(path):
        return path
    for directory in (path / CHECKPOINTS, path):
        rotation = CheckpointRotation(directory, keep_last=1, keep_best=(SUCCESS, "max"))
        found = (rotation.best() if best else rotation.latest()) if directory.is_dir() else None
        if found is not None and best and Checkpoint.manifest(found)["metadata"][SUCCESS] < 0:
            found = None
        if found is not None:
            return found
    if best:
        raise FileNotFoundError(f"no checkpoint with a measured success at {path}: train with evaluation.every=1, say.")
    raise FileNotFoundError(f"no checkpoint at {path}: give a run directory that train.py made, or a checkpoint in it.")


def latest_whole(rotation: CheckpointRotation) -> Path | None:
    """The newest checkpoint whose bytes are those that were written, None where there is none at all.

    Warns of damaged ones that are newer. Reads the whole file, to compare its checksums.

    Raises:
        ValueError: damaged ones are all there is: a new run would overwrite them.
    """
    known = rotation.checkpoints()
    whole = next((path for path in reversed(known) if _is_whole(path)), None)
    later = known if whole is None else known[known.index(whole) + 1 :]
    for path in sorted(rotation.directory.glob(f"{rotation.prefix}-*")):
        if path in known and path not in later:
            continue
        if whole is None:
            raise ValueError(f"{path} is damaged and there is no other checkpoint: move it away to begin again.")
        torchrl_logger.warning(f"{path} is damaged: continuing from {whole}.")
    return whole


def _is_whole(path: Path) -> bool:
    if path.is_dir():
        return True
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is None
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, NotImplementedError, RuntimeError):
        return False  # what a flipped byte makes zipfile raise depends on where it is


def check_room(directory: Path, parameters: Iterable[torch.Tensor]) -> None:
    """Asks for room for a checkpoint before it is written: a disk that fills up under a memory map cannot be caught.

    Raises:
        OSError: there is not enough.
    """
    directory.mkdir(parents=True, exist_ok=True)
    need = 2 * 4 * sum(p.numel() * p.element_size() for p in parameters)  # weights twice, two moments; staged, packed
    free = shutil.disk_usage(directory).free
    if free < need:
        raise OSError(
            f"no room for a checkpoint in {directory}: {free / 1e6:.0f} MB are free, {need / 1e6:.0f} MB needed. Make "
            "room; the same command continues from the last checkpoint."
        )


def read_card(path: Path | str) -> ModelCard:
    """The card of a checkpoint.

    Raises:
        ValueError: a checkpoint of another kind, or a damaged one.
    """
    try:
        return ModelCard(**Checkpoint(card={}).load(path, components=[_CARD]).values[_CARD])
    except (*DAMAGES, TypeError, KeyError) as error:
        raise ValueError(f"{path} is not a whole checkpoint of a world model ({error}).") from error


def load_world_model(path: Path | str) -> tuple[LatentWorldModel, InverseDynamicsModel | None, ModelCard]:
    """Builds the networks a checkpoint describes and loads their weights and action statistics.

    Args:
        path: a run directory, one checkpoint, or a folder written by
            :func:`~torchrl_ficreg.modules.pretrained.save_pretrained` with a card.

    Returns:
        the world model and its inverse dynamics model, in eval mode on the CPU, and the card. The inverse model is None
        where a pretrained folder has none.

    Raises:
        FileNotFoundError: no checkpoint there.
        ValueError: a checkpoint of another kind, or one whose parts do not fit together.
    """
    if (Path(path).expanduser() / WEIGHTS_FILE).is_file():
        model, inverse_model, card = load_pretrained(Path(path).expanduser())
        if card is None:
            raise ValueError(f"{path} has no card, so its environment is unknown: save it with save_pretrained(card=).")
        return model, inverse_model, ModelCard(**card)
    path = find_checkpoint(path)
    card = read_card(path)
    try:
        model, inverse_model = make_world_model(ModelConfig(**card.model), card.action_dim)
        parts = {_MODEL: model, _INVERSE: inverse_model}
        Checkpoint(**parts).load(path, components=list(parts), map_location="cpu")
    except (*DAMAGES, TypeError, KeyError) as error:
        raise ValueError(f"{path} is not a whole checkpoint of a world model ({error}).") from error
    return model.eval(), inverse_model.eval(), card
