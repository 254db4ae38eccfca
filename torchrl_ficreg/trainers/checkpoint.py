"""What a world model's checkpoint holds, and how to get a usable model out of one."""

from __future__ import annotations

import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

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
