"""What a world model's checkpoint holds, and how to get a usable model out of one."""

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
from torchrl import torchrl_logger
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation, GlobalRNGState

from torchrl_ficreg._safe_files import check_kinds, check_numbers, check_shapes, check_sizes, state_of
from torchrl_ficreg._utils import MOST_JSON_BYTES, read_json, require_regular_file
from torchrl_ficreg.modules.config import make_world_model, ModelConfig
from torchrl_ficreg.modules.inverse import InverseDynamicsModel
from torchrl_ficreg.modules.world_model import LatentWorldModel
from torchrl_ficreg.pretrained.folder import load_pretrained, ModelCard, WEIGHTS_FILE


_CUDA, _ALL_CUDA = "cuda", "torch_cuda"  # ours: one device; TorchRL's: a list of all, found in older checkpoints


class RandomState(GlobalRNGState):
    """Random states of Python, NumPy, PyTorch's CPU and one device; TorchRL's component keeps those of all devices.

    A run may so be continued with fewer devices, or without any: states of absent ones are left out with one warning.

    Args:
        device: the one that is trained on. Default: the current one, where CUDA is in use.

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
        """The states as they are now."""
        state = super().state_dict()
        if _ALL_CUDA in state:
            every = state.pop(_ALL_CUDA)
            if self._device is None or self._device.type == "cuda":
                state[_CUDA] = every[self._index()]
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Takes over the states of what is there. One that a checkpoint does not have stays as it is."""
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


CHECKPOINTS = "checkpoints"
SUCCESS = "success_rate"  # in the manifest of a checkpoint; negative where it was not measured
_CARD, _MODEL, _INVERSE = "card", "world_model", "inverse_model"
_MEMBERS = re.compile(r"manifest\.json|components/[\w.%-]+/(value\.json|state\.json|state/(meta\.json|tensor_\d+\.memmap))")
_FOLDER = {"shape": [], "_type": "<class 'tensordict._td.TensorDict'>"}  # what meta.json notes beside tensors
_PLACE = re.compile(r"components/\d{4,}-[\w.%-]+", re.ASCII)  # of one component, as TorchRL writes it
_MANIFEST = "manifest.json"
_UNPACKED_SECONDS = 24 * 3600.0  # no loader takes as long
_MOST_UNPACKED = 16  # times the size of an archive: what trained weights and moments never shrink by
# What reading a damaged or foreign checkpoint raises.
DAMAGES = (CheckpointError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError)


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

    Damaged checkpoints of a run directory are passed over, with a warning.

    Raises:
        FileNotFoundError: there is none, or success was never measured.
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
            found = latest_whole(CheckpointRotation(directory, keep_last=1))
        if found is not None:
            return found
    if best:
        raise FileNotFoundError(f"no checkpoint with a measured success at {path}: train with evaluation.every=1, say.")
    raise FileNotFoundError(f"no checkpoint at {path}: give a run directory that train.py made, or a checkpoint in it.")


def checkpoints_in(directory: Path, prefix: str = "checkpoint") -> list[Path]:
    """What bears the name of a checkpoint of a run, the oldest first; nothing is read."""
    step = re.compile(rf"{re.escape(prefix)}-(\d+)(\.torchrl)?", re.ASCII)
    found = [(int(match[1]), file) for file in directory.glob(f"{prefix}-*") if (match := step.fullmatch(file.name))]
    return [file for _, file in sorted(found)]


def latest_whole(rotation: CheckpointRotation) -> Path | None:
    """The newest checkpoint whose bytes are those that were written, None where there is none at all.

    Warns of damaged ones that are newer. Reads the whole file, to compare its checksums.

    Raises:
        ValueError: damaged ones are all there is: a new run would overwrite them.
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


def set_odd_aside(rotation: CheckpointRotation) -> None:
    """Renames what bears the name of a checkpoint and would stop TorchRL's rotation, which reads every manifest.

    It passes over archives that were cut short, but not over FIFOs, or manifests of gigabytes or of other types.
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


def _damage(path: Path) -> str | None:
    """Why a checkpoint cannot be loaded, None where it can; reads the whole file."""
    try:
        check_members(path)
        if path.is_dir():
            return None
        with zipfile.ZipFile(path) as archive:
            name = archive.testzip()
        return None if name is None else f"{name[:80]} has another checksum"
    # What a flipped byte makes zipfile raise depends on where it is.
    except (*DAMAGES, OSError, ValueError, RuntimeError) as error:
        return " ".join(str(error).split())[:200]


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a checkpoint, whose size and type are checked before TorchRL reads it.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged, or that of something else.
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
    """The success rate that a checkpoint notes, negative where it was not measured."""
    rate = read_manifest(path).get("metadata", {}).get(SUCCESS, -1.0)
    return float(rate) if isinstance(rate, (int, float)) and math.isfinite(rate) else -1.0


def check_members(path: Path | str) -> None:
    """Looks at every file of a checkpoint before a general loader does: nothing but JSON and tensors may be in it.

    A general loader runs the code of a pickle that it meets, and fills a tensor file that is too short with zeros, in
    place.

    Args:
        path: a checkpoint, archive or folder.

    Raises:
        ValueError: it holds files or entries other than the trainer writes, or a tensor file of another size than noted.
    """
    path = Path(path).expanduser()
    own, foreign = _places(path)
    with _members(path) as (sizes, read):
        for name, size in sizes.items():
            if name.startswith(foreign):
                continue
            if not _MEMBERS.fullmatch(name):
                raise ValueError(f"{path} holds {name[:80]!r}, which no checkpoint of this package has: it is not loaded.")
            if name != _MANIFEST and name not in own:  # nor would it be unpacked
                raise ValueError(f"{path} holds {name[:80]!r}, which its manifest does not list: it is not loaded.")
            if name.endswith(".json") and size > MOST_JSON_BYTES:
                raise ValueError(f"{path} is damaged: {name} takes {size} bytes, expected at most {MOST_JSON_BYTES}.")
        for name in (name for name in sizes if name.endswith("/state.json") and not name.startswith(foreign)):
            _check_references(path, name, read)
        for name in (name for name in sizes if name.endswith("state/meta.json") and not name.startswith(foreign)):
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


def _places(path: Path) -> tuple[set[str], tuple[str, ...]]:
    """The files that TorchRL will read of the components it knows, and where those of other components lie.

    The latter are of an adapter of the user, and only that adapter reads them: TorchRL loads a component by the adapter
    that its manifest names, and refuses others.

    Raises:
        ValueError: two components lie in one place, or one inside another, by whatever way of writing it.
    """
    records = list(read_manifest(path)["components"].values())
    odd = [record["path"] for record in records if not _PLACE.fullmatch(record["path"])]
    if odd or len({record["path"].casefold() for record in records}) < len(records):
        what = f"puts a component in {odd[0][:80]!r}" if odd else "puts two components in one place"
        raise ValueError(f"{path}: its manifest {what}, which no checkpoint of this package does: it is not loaded.")
    own = [record for record in records if record["adapter"].startswith("torchrl.")]
    files = {f"{record['path']}/{file}" for record in own for file in record["files"]}
    return files, tuple(f"{record['path']}/" for record in records if record not in own)


def _check_references(path: Path, name: str, read: Callable[[str], bytes]) -> None:
    """Each tensor of a state is named once: loading copies it as often as it is named.

    Raises:
        ValueError: one is named again, or it is no JSON.
    """
    seen: list[Any] = []

    def note(values: dict[str, Any]) -> dict[str, Any]:
        if values.get("kind") in ("tensor", "numpy"):
            seen.append(str(values.get("key")))
        return values

    try:
        json.loads(read(name), object_hook=note)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {name} is no readable JSON ({str(error)[:80]}).") from error
    if len(set(seen)) != len(seen):
        raise ValueError(f"{path}: {name} names a tensor more than once: it is not loaded.")


def _bytes_of(entry: dict[str, Any]) -> int:
    """Size of the tensor that an entry of ``meta.json`` notes.

    Raises:
        KeyError, ValueError: it notes something else.
    """
    dtype = getattr(torch, entry["dtype"].removeprefix("torch."))
    if entry["is_nested"] or entry.keys() != {"device", "shape", "dtype", "is_nested"} or not isinstance(dtype, torch.dtype):
        raise ValueError("no plain tensor")
    if any(type(size) is not int or size < 0 for size in entry["shape"]):
        raise ValueError("no shape")
    return math.prod(entry["shape"]) * dtype.itemsize


@contextmanager
def _members(path: Path) -> Iterator[tuple[dict[str, int], Callable[[str], bytes]]]:
    """Sizes of the regular files of an archive or a folder, by their names inside it, and how to read one.

    Raises:
        ValueError: it holds a link, a FIFO or a device, is no archive, or one that unpacks to far more than its size.
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
    return _card(_load({_CARD: {}}, Path(path).expanduser()).get(_CARD), path)


def _card(values: Any, path: Path | str) -> ModelCard:
    """A card from its JSON values, of which others than its fields are left out.

    Raises:
        ValueError: a field is missing, or no field of a card.
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


class _State:
    """A component that keeps the state it is given, without networks to load it into."""

    def __init__(self) -> None:
        self.state: Any = None

    def state_dict(self) -> Any:
        return self.state

    def load_state_dict(self, state_dict: Any) -> None:
        self.state = state_dict


def sweep_unpacked() -> None:
    """Removes archives that loaders of this user unpacked a day ago and, killed, left in the folder of temporary files."""
    for left in Path(tempfile.gettempdir()).glob("torchrl-checkpoint-load-*"):
        try:
            found = left.lstat()
            mine = not hasattr(os, "getuid") or found.st_uid == os.getuid()
            if mine and stat.S_ISDIR(found.st_mode) and found.st_mtime < time.time() - _UNPACKED_SECONDS:
                shutil.rmtree(left, ignore_errors=True)
        except OSError:  # another process removed it
            continue


def _load(parts: dict[str, Any], path: Path) -> dict[str, Any]:
    """Reads components of a checkpoint, on the CPU; their values.

    Raises:
        OSError: an archive cannot be unpacked.
        ValueError: a checkpoint of another kind, or a damaged one.
    """
    sweep_unpacked()
    try:
        return Checkpoint(**parts).load(path, components=list(parts), map_location="cpu").values
    except OSError as error:
        place = f"{path} cannot be unpacked in {tempfile.gettempdir()}" if path.is_file() else f"{path} cannot be read"
        raise OSError(f"{place} ({error.strerror or error}): make room, or set TMPDIR to a folder on another disk.") from error
    except (*DAMAGES, TypeError, KeyError) as error:
        reason = " ".join(str(error).split())[:160]
        raise ValueError(f"{path} is not a whole checkpoint of a world model ({reason}).") from error


def load_world_model(path: Path | str) -> tuple[LatentWorldModel, InverseDynamicsModel | None, ModelCard]:
    """Builds the networks a checkpoint describes and loads their weights and action statistics.

    Args:
        path: a run directory, one checkpoint, or a folder written by
            :func:`~torchrl_ficreg.pretrained.save_pretrained` with a card.

    Returns:
        the world model and its inverse dynamics model, in eval mode on the CPU, and the card. The inverse model is None
        where a pretrained folder has none.

    Raises:
        FileNotFoundError: no checkpoint there.
        ValueError: a checkpoint of another kind, or one whose parts do not fit together.
    """
    if (Path(path).expanduser() / WEIGHTS_FILE).is_file():
        model, inverse_model, card = load_pretrained(Path(path).expanduser())
        if not card:
            raise ValueError(f"{path} has no card, so its environment is unknown: save it with save_pretrained(card=).")
        card = _card(card, path)
        if card.action_dim != len(model.action_mean):
            raise ValueError(f"{path}: its card has bounds of {card.action_dim} actions, its model {len(model.action_mean)}.")
        return model, inverse_model, card
    path = find_checkpoint(path)
    check_members(path)
    kept = {_MODEL: _State(), _INVERSE: _State()}
    card = _card(_load({_CARD: {}, **kept}, path).get(_CARD), path)  # in one call: each unpacks the archive
    try:
        # Compared with what the file has before the networks take memory.
        found = {f"{part}.{name}": value for part, holder in kept.items() for name, value in dict(holder.state).items()}
        check_sizes(card.model, len(found))
        with torch.device("meta"):
            wanted = state_of(dict(zip(kept, make_world_model(ModelConfig(**card.model), card.action_dim))))
        check_shapes(wanted, {name: tuple(value.shape) for name, value in found.items()})
        check_kinds(wanted, found)
        check_numbers(found, "its weights")
        parts = dict(zip(kept, make_world_model(ModelConfig(**card.model), card.action_dim)))
        for name, part in parts.items():
            part.load_state_dict(kept[name].state)
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{path} is not a whole checkpoint of a world model ({reason}).") from error
    return parts[_MODEL].eval(), parts[_INVERSE].eval(), card
