"""What a world model's checkpoint holds, and how to get a usable model out of one."""

from __future__ import annotations

import json
import math
import re
import shutil
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
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
_MEMBERS = re.compile(r"manifest\.json|components/[\w.%-]+/(value\.json|state\.json|state/(meta\.json|tensor_\d+\.memmap))")
_FOLDER = {"shape": [], "_type": "<class 'tensordict._td.TensorDict'>"}  # what meta.json notes beside tensors
_MOST_JSON = 64 * 2**20  # bytes of one text file of a checkpoint
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


def check_members(path: Path | str) -> None:
    """Looks at every file of a checkpoint before a general loader does: nothing but JSON and tensors may be in it.

    A general loader runs the code of a pickle that it meets, and fills a tensor file that is too short with zeros, in
    place.

    Args:
        path: a checkpoint, archive or folder.

    Raises:
        ValueError: it holds files or entries other than the trainer writes, or a tensor file of another size than noted.
    """
    with _members(Path(path).expanduser()) as (sizes, read):
        for name, size in sizes.items():
            if not _MEMBERS.fullmatch(name):
                raise ValueError(f"{path} holds {name[:80]!r}, which no checkpoint of this package has: it is not loaded.")
            if name.endswith(".json") and size > _MOST_JSON:
                raise ValueError(f"{path} is damaged: {name} takes {size} bytes, expected at most {_MOST_JSON}.")
        for name in (name for name in sizes if name.endswith("state/meta.json")):
            try:
                notes = json.loads(read(name))
                whole = all(notes.pop(key) == value for key, value in _FOLDER.items())
                notes.pop("device", None)
                needs = {key: _bytes_of(entry) for key, entry in notes.items()}
            except (*DAMAGES, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
                raise ValueError(f"{path}: {name} notes something that is no tensor: it is not loaded.") from error
            folder = name.removesuffix("meta.json")
            found = {file.removeprefix(folder): size for file, size in sizes.items() if file.startswith(folder)}
            del found["meta.json"]
            if not whole or not found.keys() <= {f"{key}.memmap" for key in needs}:
                raise ValueError(f"{path}: {name} and the tensors beside it do not fit together: it is not loaded.")
            for key, need in needs.items():
                size = found.get(f"{key}.memmap", 0)
                if size != need:
                    raise ValueError(f"{path} is damaged: {folder}{key}.memmap has {size} bytes, expected {need}.")


def _bytes_of(entry: dict[str, Any]) -> int:
    """Size of the tensor that an entry of ``meta.json`` notes.

    Raises:
        KeyError, ValueError: it notes something else.
    """
    dtype = getattr(torch, entry["dtype"].removeprefix("torch."))
    if entry["is_nested"] or entry.keys() != {"device", "shape", "dtype", "is_nested"} or not isinstance(dtype, torch.dtype):
        raise ValueError("no plain tensor")
    return math.prod(entry["shape"]) * dtype.itemsize


@contextmanager
def _members(path: Path) -> Iterator[tuple[dict[str, int], Callable[[str], bytes]]]:
    """Sizes of the regular files of an archive or a folder, by their names inside it, and how to read one.

    Raises:
        ValueError: it holds a link, a FIFO or a device.
    """
    if path.is_dir():
        files = [file for file in sorted(path.rglob("*")) if file.is_symlink() or not file.is_dir()]
        odd = [file for file in files if file.is_symlink() or not file.is_file()]
        if odd:
            raise ValueError(f"{odd[0]} is a link or no regular file: a checkpoint holds neither.")
        yield {file.relative_to(path).as_posix(): file.stat().st_size for file in files}, lambda name: (path / name).read_bytes()
        return
    try:
        archive = zipfile.ZipFile(path)
    except (*DAMAGES, OSError) as error:
        raise ValueError(f"{path} is not a whole checkpoint of a world model ({error}).") from error
    with archive:
        entries = [entry for entry in archive.infolist() if not entry.is_dir()]
        yield {entry.filename: entry.file_size for entry in entries}, archive.read


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
    check_members(path)
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
