"""Checkpoints of a run: which components they have, which one is loaded, and what is checked before that.

A checkpoint is one file, an archive of ``torchrl.checkpoint``: JSON and raw tensors, no pickles. Its components:

===============================================  ====================================================================
``world_model``, ``inverse_model``               weights, and the statistics of actions
``card``                                         a :class:`~torchrl_ficreg.pretrained.ModelCard`: how to build the networks
``loss_module``, ``optimizer``                   the loss with its networks and coefficients; AdamW
``trainer_state``, ``trainer_module.*``          step, learning-rate schedule, elapsed time, state of hooks
``collector``                                    position in the dataset, and its fingerprint
``rng``                                          random states of Python, NumPy and torch
``refinement``                                   whether the training on latents that follows is done
===============================================  ====================================================================

:func:`checkpoint_components` names the first three, which :func:`load_world_model` reads;
:class:`~torchrl_ficreg.trainers.OfflineTrainer` adds the others.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import stat
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torchrl import torchrl_logger
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation, GlobalRNGState

from torchrl_ficreg._safe_files import check_kinds, check_numbers, check_shapes, check_sizes, state_of
from torchrl_ficreg._torchrl_compat import STATE_FOLDER, UNPACKED
from torchrl_ficreg._utils import MOST_JSON_BYTES, read_json, require_regular_file, require_space
from torchrl_ficreg.modules.config import make_world_model, ModelConfig
from torchrl_ficreg.modules.inverse import InverseDynamicsModel
from torchrl_ficreg.modules.world_model import LatentWorldModel
from torchrl_ficreg.pretrained.folder import load_pretrained, ModelCard, WEIGHTS_FILE

CHECKPOINTS = "checkpoints"  # folder below the run directory
SUCCESS = "success_rate"  # in the manifest of a checkpoint; negative where it was not measured
DAMAGES = (CheckpointError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError)  # of a damaged or foreign file

_CARD, _MODEL, _INVERSE = "card", "world_model", "inverse_model"  # components
_CUDA = "cuda"  # entry of the random state: that of one device
_ALL_CUDA = "torch_cuda"  # TorchRL's entry: a list of all devices, as in older checkpoints
_MANIFEST = "manifest.json"
_MEMBERS = re.compile(r"manifest\.json|components/[\w.%-]+/(value\.json|state\.json|state/(meta\.json|tensor_\d+\.memmap))")
_COMPONENT_PATH = re.compile(r"components/\d{4,}-[\w.%-]+", re.ASCII)  # as TorchRL writes it
_UNPACKED_SECONDS = 24 * 3600.0  # age from which an unpacked archive belongs to no running loader
_MOST_UNPACKED = 16  # limit of the unpacked size, in sizes of the archive; weights and optimizer state compress far less


def checkpoint_components(
    model: LatentWorldModel, inverse_model: InverseDynamicsModel | None, card: ModelCard
) -> dict[str, Any]:
    """Components of a trainer's checkpoint from which :func:`load_world_model` can build the model.

    Args:
        model (LatentWorldModel): the world model that is trained.
        inverse_model (InverseDynamicsModel or None): its inverse dynamics model.
        card (ModelCard): configuration of the networks and of their environment.

    Returns:
        name -> component, for ``OfflineTrainer(components=...)``.
    """
    networks = {_MODEL: model} if inverse_model is None else {_MODEL: model, _INVERSE: inverse_model}
    return {**networks, _CARD: asdict(card)}


def load_world_model(
    path: Path | str,
    *,
    world_model: LatentWorldModel | None = None,
    inverse_model: InverseDynamicsModel | None = None,
) -> tuple[LatentWorldModel, InverseDynamicsModel | None, ModelCard]:
    """Builds the networks of a checkpoint and loads their weights and action statistics.

    A card describes the networks of this package only. For a checkpoint of your own networks, build them and pass them
    as ``world_model`` and ``inverse_model``; their weights are replaced.

    Args:
        path (path): a run directory, a checkpoint, or a folder written by
            :func:`~torchrl_ficreg.pretrained.save_pretrained` with a card.
        world_model (LatentWorldModel, optional): your own networks, of a checkpoint. Default: ``None``, those that the
            card describes.
        inverse_model (InverseDynamicsModel, optional): the same; not loaded if None beside a ``world_model``.
            Default: ``None``.

    Returns:
        the world model and its inverse dynamics model, in eval mode on the CPU, and the card. The inverse model is None
        where there is none.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: the checkpoint is damaged, of another kind, or its weights do not match its card or your networks.
    """
    folder = Path(path).expanduser()
    if (folder / WEIGHTS_FILE).is_file():
        if world_model is not None or inverse_model is not None:
            raise ValueError(f"{path} describes its own networks: leave out world_model and inverse_model.")
        model, inverse_model, card = load_pretrained(folder)
        if not card:
            raise ValueError(f"{path} has no card, so its environment is unknown: save it with save_pretrained(card=).")
        card = _card(card, path)
        if card.action_dim != len(model.action_mean):
            raise ValueError(f"{path}: its card has bounds of {card.action_dim} actions, its model {len(model.action_mean)}.")
        return model, inverse_model, card
    path = find_checkpoint(path)
    check_members(path)
    if inverse_model is not None and world_model is None:
        raise ValueError("an inverse_model of your own belongs to a world model of your own: give world_model too.")
    own = {name: part for name, part in ((_MODEL, world_model), (_INVERSE, inverse_model)) if part is not None}
    has_inverse = _INVERSE in read_manifest(path)["components"]
    kept = {name: _State() for name in own or ([_MODEL, _INVERSE] if has_inverse else [_MODEL])}
    card = _card(_load({_CARD: {}, **kept}, path).get(_CARD), path)  # one call: each unpacks the whole archive

    def build() -> dict[str, nn.Module]:
        return own or dict(zip(kept, make_world_model(ModelConfig(**card.model), card.action_dim)))

    try:
        # The sizes on the card are compared with the weights before any network is allocated.
        found = {f"{part}.{name}": value for part, holder in kept.items() for name, value in dict(holder.state).items()}
        if not own:
            check_sizes(card.model, len(found))
        with torch.device("meta"):
            wanted = state_of(build())
        check_shapes(wanted, {name: tuple(value.shape) for name, value in found.items()})
        check_kinds(wanted, found)
        check_numbers(found, "its weights")
        parts = build()
        for name, part in parts.items():
            part.load_state_dict(kept[name].state)
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        hint = "" if own else " Networks of your own are loaded by load_world_model(path, world_model=...)."
        raise ValueError(f"{path} is not a whole checkpoint of a world model ({reason}).{hint}") from error
    for part in parts.values():
        part.eval()
    return parts[_MODEL], parts.get(_INVERSE), card


def read_card(path: Path | str) -> ModelCard:
    """The card of a checkpoint.

    Args:
        path (path): the checkpoint.

    Raises:
        ValueError: it is damaged or of another kind.
    """
    check_members(path)
    return _card(_load({_CARD: {}}, Path(path).expanduser()).get(_CARD), path)


def find_checkpoint(path: Path | str, *, best: bool = False) -> Path:
    """Path of a checkpoint: ``path`` itself, or the latest checkpoint of a run directory.

    Damaged checkpoints of a run directory are skipped with a warning.

    Args:
        path (path): a checkpoint or a run directory.
        best (bool, optional): of a run directory, the checkpoint with the highest success rate, see
            :class:`EvaluationHook`. Default: ``False``.

    Raises:
        FileNotFoundError: there is none, or the success rate was never measured.
        ValueError: all are damaged.
    """
    path = Path(path).expanduser()
    if _is_checkpoint(path):
        return path
    for directory in (path / CHECKPOINTS, path):
        if best:
            rates = {file: _success(file) for file in checkpoints_in(directory) if _is_checkpoint(file)}
            ranked = sorted((file for file in rates if rates[file] >= 0), key=lambda file: rates[file])
            found = next((file for file in reversed(ranked) if not _damage(file)), None)
        else:
            found = latest_intact(CheckpointRotation(directory, keep_last=1))
        if found is not None:
            return found
    if best:
        raise FileNotFoundError(f"no checkpoint with a measured success at {path}: train with evaluation.every=1, say.")
    raise FileNotFoundError(f"no checkpoint at {path}: give a run directory that train.py made, or a checkpoint in it.")


def checkpoints_in(directory: Path, prefix: str = "checkpoint") -> list[Path]:
    """Paths in a folder that are named as a checkpoint, the oldest first. No file is read."""
    step = re.compile(rf"{re.escape(prefix)}-(\d+)(\.torchrl)?", re.ASCII)
    found = [(int(match[1]), file) for file in directory.glob(f"{prefix}-*") if (match := step.fullmatch(file.name))]
    return [file for _, file in sorted(found)]


def latest_intact(rotation: CheckpointRotation) -> Path | None:
    """The newest checkpoint with intact checksums; None where there is no checkpoint.

    Warns of newer ones that are damaged. Reads whole files.

    Raises:
        ValueError: there are damaged checkpoints only, which a new run would overwrite.
    """
    damaged: list[tuple[Path, str]] = []
    for path in reversed(checkpoints_in(rotation.directory, rotation.prefix)):
        reason = _damage(path)
        if reason is None:
            for later, why in reversed(damaged):
                torchrl_logger.warning(f"{later} is damaged: continuing from {path}.")
                torchrl_logger.debug(why)
            return path
        damaged.append((path, reason))
    if damaged:
        path, reason = damaged[-1]
        raise ValueError(f"{path} is damaged and there is no other checkpoint: move it away to begin again ({reason}).")
    return None


def set_unreadable_aside(rotation: CheckpointRotation) -> None:
    """Renames files that are named as a checkpoint and would make TorchRL's rotation fail.

    The rotation reads every manifest. It ignores truncated archives, but not FIFOs, manifests of gigabytes or manifests
    of another type.
    """
    for path in checkpoints_in(rotation.directory, rotation.prefix):
        if _is_checkpoint(path):
            continue
        try:
            if not path.is_dir():
                require_regular_file(path)
            if path.is_dir() or zipfile.is_zipfile(path):
                read_manifest(path)
        except (OSError, ValueError):
            path.rename(path.with_name(f"damaged-{path.name}"))


def require_checkpoint_space(directory: Path, parameters: Iterable[torch.Tensor]) -> None:
    """Checks that there is space for a checkpoint: a disk that fills up under a memory map ends the process (SIGBUS).

    Args:
        directory (Path): where it will be written; it need not exist yet.
        parameters (Iterable[torch.Tensor]): of the networks.

    Raises:
        OSError: there is not enough.
    """
    need = 2 * 4 * sum(p.numel() * p.element_size() for p in parameters)  # weights twice, optimizer state (2); staged, packed
    advice = "make room; the same command continues from the last checkpoint"
    require_space(directory, need, what=f"no room for a checkpoint: {directory}", reserve=0, advice=advice)


class RandomState(GlobalRNGState):
    """Random states of Python, NumPy, PyTorch's CPU and one device. TorchRL's component has those of all devices.

    A run can therefore be continued with fewer devices, or none: states of missing devices are ignored with a warning.

    Args:
        device (torch.device or str, optional): device of the training. Default: the current one, if CUDA is in use.

    Examples:
        >>> state = RandomState()
        >>> before = state.state_dict()
        >>> first = torch.rand(1)
        >>> state.load_state_dict(before)
        >>> torch.equal(torch.rand(1), first)
        True
    """

    def __init__(self, device: torch.device | str | None = None) -> None:
        self._device = None if device is None else torch.device(device)

    def state_dict(self) -> dict[str, Any]:
        """The current states."""
        state = super().state_dict()
        if _ALL_CUDA in state:
            every = state.pop(_ALL_CUDA)
            if self._device is None or self._device.type == "cuda":
                state[_CUDA] = every[self._index()]
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores the states of present devices. A state that is missing in ``state_dict`` is left unchanged."""
        states = dict(state_dict)
        every, one = states.pop(_ALL_CUDA, ()), states.pop(_CUDA, None)
        devices = torch.cuda.device_count() if torch.cuda.is_available() else 0
        absent = [f"cuda:{number}" for number in range(devices, len(every))]
        if one is not None and not devices:
            absent.append("cuda")
        for name in ("xpu", "mps"):
            if f"torch_{name}" in states and not getattr(torch, name).is_available():
                del states[f"torch_{name}"]
                absent.append(name)
        super().load_state_dict(states)
        for number, state in enumerate(every[:devices]):
            torch.cuda.set_rng_state(state.cpu(), number)
        if one is not None and devices:
            torch.cuda.set_rng_state(one.cpu(), self._index())
        if absent:
            torchrl_logger.warning(
                f"random states of {', '.join(absent)} are left out, no such device is here: the run goes on, with "
                "other random numbers than where it began."
            )

    def _index(self) -> int:
        index = None if self._device is None else self._device.index
        return torch.cuda.current_device() if index is None else index


# Checks of a file before TorchRL's loader reads it


def check_members(path: Path | str) -> None:
    """Checks that a checkpoint holds nothing but JSON and tensors, each of the size that its metadata states.

    TorchRL's loader would unpickle other entries, and extend a tensor file that is too short with zeros, in place.

    Args:
        path (path): a checkpoint, archive or folder.

    Raises:
        ValueError: it holds files or entries that the trainer does not write, or a tensor file of another size.
    """
    path = Path(path).expanduser()
    own, foreign = _component_files(path)
    with _members(path) as (sizes, read):
        for name, size in sizes.items():
            if name.startswith(foreign):
                continue
            if not _MEMBERS.fullmatch(name):
                raise ValueError(f"{path} holds {name[:80]!r}, which no checkpoint of this package has: it is not loaded.")
            if name != _MANIFEST and name not in own:  # TorchRL would not unpack it
                raise ValueError(f"{path} holds {name[:80]!r}, which its manifest does not list: it is not loaded.")
            if name.endswith(".json") and size > MOST_JSON_BYTES:
                raise ValueError(f"{path} is damaged: {name} takes {size} bytes, expected at most {MOST_JSON_BYTES}.")
        for name in (name for name in sizes if name.endswith("/state.json") and not name.startswith(foreign)):
            _check_references(path, name, read)
        for name in (name for name in sizes if name.endswith("state/meta.json") and not name.startswith(foreign)):
            try:
                notes = json.loads(read(name))
                whole = all(notes.pop(key) == value for key, value in STATE_FOLDER.items())
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


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a checkpoint, after checks of its size and type.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: the manifest is damaged, or not of a checkpoint.
    """
    try:
        if path.is_dir():
            content = read_json(path / _MANIFEST, "manifest")
        else:
            with _members(path) as (sizes, read):
                if sizes.get(_MANIFEST, 0) > MOST_JSON_BYTES:
                    raise ValueError(f"{_MANIFEST} takes {sizes[_MANIFEST]} bytes")
                content = json.loads(read(_MANIFEST))
        if not isinstance(content, dict) or not isinstance(content.get("metadata", {}), dict):
            raise ValueError("no JSON object")
        return Checkpoint.manifest(path)
    except (*DAMAGES, ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"{path} has no manifest of a checkpoint ({' '.join(str(error).split())[:160]}).") from error


def _is_checkpoint(path: Path) -> bool:
    try:
        read_manifest(path)
    except (OSError, ValueError):
        return False
    return True


def _success(path: Path) -> float:
    """The success rate in the manifest of a checkpoint, negative where it was not measured."""
    rate = read_manifest(path).get("metadata", {}).get(SUCCESS, -1.0)
    return float(rate) if isinstance(rate, (int, float)) and math.isfinite(rate) else -1.0


def _damage(path: Path) -> str | None:
    """Reason why a checkpoint cannot be loaded, or None. Reads the whole file."""
    try:
        check_members(path)
        if path.is_dir():
            return None
        with zipfile.ZipFile(path) as archive:
            name = archive.testzip()
        return None if name is None else f"{name[:80]} has another checksum"
    # A flipped byte makes zipfile raise one of many errors, depending on its position.
    except (*DAMAGES, OSError, ValueError, RuntimeError) as error:
        return " ".join(str(error).split())[:200]


def _component_files(path: Path) -> tuple[set[str], tuple[str, ...]]:
    """Files of the components that TorchRL's adapters read, and the folders of all other components.

    Other components were written by an adapter of the user, and only that adapter reads them: TorchRL loads a component
    with the adapter named in the manifest.

    Raises:
        ValueError: two components share a folder, or one lies inside another, under whatever spelling of the path.
    """
    records = list(read_manifest(path)["components"].values())
    odd = [record["path"] for record in records if not _COMPONENT_PATH.fullmatch(record["path"])]
    if odd or len({record["path"].casefold() for record in records}) < len(records):
        what = f"puts a component in {odd[0][:80]!r}" if odd else "puts two components in one place"
        raise ValueError(f"{path}: its manifest {what}, which no checkpoint of this package does: it is not loaded.")
    own = [record for record in records if record["adapter"].startswith("torchrl.")]
    files = {f"{record['path']}/{file}" for record in own for file in record["files"]}
    return files, tuple(f"{record['path']}/" for record in records if record not in own)


def _check_references(path: Path, name: str, read: Callable[[str], bytes]) -> None:
    """Checks that each tensor of a state is referenced once. Loading makes a copy for every reference.

    Raises:
        ValueError: a tensor is referenced again, or the file is not JSON.
    """
    seen: list[Any] = []

    def record(values: dict[str, Any]) -> dict[str, Any]:
        if values.get("kind") in ("tensor", "numpy"):
            seen.append(str(values.get("key")))
        return values

    try:
        json.loads(read(name), object_hook=record)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {name} is no readable JSON ({str(error)[:80]}).") from error
    if len(set(seen)) != len(seen):
        raise ValueError(f"{path}: {name} names a tensor more than once: it is not loaded.")


def _bytes_of(entry: dict[str, Any]) -> int:
    """Size in bytes of the tensor that an entry of ``meta.json`` describes.

    Raises:
        KeyError, ValueError: it does not describe a plain tensor.
    """
    dtype = getattr(torch, entry["dtype"].removeprefix("torch."))
    if entry["is_nested"] or entry.keys() != {"device", "shape", "dtype", "is_nested"} or not isinstance(dtype, torch.dtype):
        raise ValueError("no plain tensor")
    if any(type(size) is not int or size < 0 for size in entry["shape"]):
        raise ValueError("no shape")
    return math.prod(entry["shape"]) * dtype.itemsize


@contextmanager
def _members(path: Path) -> Iterator[tuple[dict[str, int], Callable[[str], bytes]]]:
    """Context that yields the sizes in bytes of the files of an archive or folder, by name, and a function that reads one.

    Raises:
        ValueError: it holds a link, a FIFO or a device, is not an archive, or would unpack to far more than its size.
    """
    if path.is_dir():
        files = [file for file in sorted(path.rglob("*")) if file.is_symlink() or not file.is_dir()]
        odd = [file for file in files if file.is_symlink() or not file.is_file()]
        if odd:
            raise ValueError(f"{odd[0]} is a link or no regular file: a checkpoint holds neither.")
        yield {file.relative_to(path).as_posix(): file.stat().st_size for file in files}, lambda name: (path / name).read_bytes()
        return
    try:
        size = require_regular_file(path).st_size
        archive = zipfile.ZipFile(path)
    except (*DAMAGES, OSError, ValueError) as error:
        raise ValueError(f"{path} is not a whole checkpoint of a world model ({error}).") from error

    def read(name: str) -> bytes:
        try:
            return archive.read(name)
        except (*DAMAGES, KeyError, OSError, RuntimeError, ValueError) as error:
            raise ValueError(f"{path} is damaged: {name} cannot be read ({' '.join(str(error).split())[:80]}).") from error

    with archive:
        entries = [entry for entry in archive.infolist() if not entry.is_dir()]
        for entry in entries:
            if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{path}: {entry.filename[:80]!r} is encrypted or packed in an unknown way: it is not loaded.")
        need = sum(entry.file_size for entry in entries)
        if need > _MOST_UNPACKED * size + 2**20:
            raise ValueError(f"{path} has {size} bytes and would unpack to {need}: it is not loaded.")
        yield {entry.filename: entry.file_size for entry in entries}, read


def _card(values: Any, path: Path | str) -> ModelCard:
    """A card from JSON values. Values that are not fields of a card are ignored.

    Raises:
        ValueError: a field is missing or has a wrong type.
    """
    names = [field.name for field in fields(ModelCard)]
    missing = [name for name in names if name not in values] if isinstance(values, dict) else names
    if missing:
        raise ValueError(
            f"{path} is not a whole checkpoint of a world model (its card has no {', '.join(missing)}): save it with a whole "
            "card, as dataclasses.asdict(ModelCard(...)) gives it."
        )
    try:
        return ModelCard(**{name: values[name] for name in names})
    except ValueError as error:
        raise ValueError(f"{path} is not a whole checkpoint of a world model ({error}).") from error


def _load(parts: dict[str, Any], path: Path) -> dict[str, Any]:
    """Loads components of a checkpoint on the CPU; returns the values of those that are plain JSON.

    Raises:
        OSError: an archive cannot be unpacked.
        ValueError: the checkpoint is damaged or of another kind.
    """
    remove_old_unpacked()
    try:
        return Checkpoint(**parts).load(path, components=list(parts), map_location="cpu").values
    except OSError as error:
        place = f"{path} cannot be unpacked in {tempfile.gettempdir()}" if path.is_file() else f"{path} cannot be read"
        raise OSError(f"{place} ({error.strerror or error}): make room, or set TMPDIR to a folder on another disk.") from error
    except (*DAMAGES, TypeError, KeyError) as error:
        reason = " ".join(str(error).split())[:160]
        raise ValueError(f"{path} is not a whole checkpoint of a world model ({reason}).") from error


class _State:
    """A component that stores the state it is given."""

    def __init__(self) -> None:
        self.state: Any = None

    def state_dict(self) -> Any:
        return self.state

    def load_state_dict(self, state_dict: Any) -> None:
        self.state = state_dict


def remove_old_unpacked() -> None:
    """Removes temporary folders older than a day, into which killed loaders of this user had unpacked archives."""
    for left in Path(tempfile.gettempdir()).glob(UNPACKED):
        try:
            found = left.lstat()
            mine = not hasattr(os, "getuid") or found.st_uid == os.getuid()
            if mine and stat.S_ISDIR(found.st_mode) and found.st_mtime < time.time() - _UNPACKED_SECONDS:
                shutil.rmtree(left, ignore_errors=True)
        except OSError:  # another process removed it
            continue
