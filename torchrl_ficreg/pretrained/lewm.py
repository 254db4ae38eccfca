"""Reads and writes official LeWM checkpoints, ``config.json`` beside ``weights.pt``."""

from __future__ import annotations

import io
import pickle
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from torchrl_ficreg._safe_files import check_kinds, check_numbers, check_sizes, config_file, json_text, replace_files
from torchrl_ficreg._utils import read_json, require_regular_file
from torchrl_ficreg.data.action_statistics import ActionStatistics
from torchrl_ficreg.modules.world_model import LatentWorldModel
from torchrl_ficreg.pretrained._lewm_names import config_from_sizes, matches, Naming, naming_of, sizes_from_config
from torchrl_ficreg.pretrained.folder import build_world_model, world_model_sizes

_CONFIG, _WEIGHTS = "config.json", "weights.pt"
_WRAPPERS = ("state_dict", "model")
_PREFIXES = ("model.", "module.")
_UNUSED = ("sigreg.", "encoder.embeddings.mask_token")  # of the training loss; of masked pretraining
_STATISTICS = ("action_mean", "action_std")


def load_lewm(
    path: Path | str,
    *,
    device: torch.device | str = "cpu",
    frame_skip: int = 5,
    statistics: ActionStatistics | None = None,
) -> LatentWorldModel:
    """Loads an official LeWM checkpoint (arXiv 2603.19312), in eval mode and float32.

    Encoder and predictor give the same numbers as the published code. The files contain neither the frame skip, 5 in all
    published models, nor the mean and std of actions. Without ``statistics`` the model has means of 0 and stds of 1, and
    its planners would act in z-scores: give those of its training dataset, or set ``model.statistics`` later.

    Tensors may have the names of transformers 4 or 5, a prefix ``model.`` and a wrapper ``state_dict``, as in a Lightning
    checkpoint; buffers of the loss and a mask token are ignored. No code in the file is executed.

    Args:
        path (str or Path): a folder with ``config.json`` and one ``.pt`` file, or such a file beside ``config.json``.
        device (torch.device or str, optional): device of the model. Default: ``"cpu"``.
        frame_skip (int, optional): F, environment actions in one block. Default: ``5``.
        statistics (ActionStatistics, optional): mean and std [A] of actions in environment units. Default: zeros and ones.

    Raises:
        FileNotFoundError: no such checkpoint, or no configuration.
        ValueError: several weight files; an object checkpoint; networks that differ from the package's; tensors that are
            missing, unexpected or of another shape.

    Examples:
        >>> import tempfile
        >>> from torchrl_ficreg import make_world_model, ModelConfig
        >>> sizes = {"image_size": 28, "predictor_depth": 1, "predictor_heads": 2}
        >>> model, _ = make_world_model(ModelConfig.preset("paper", **sizes), action_dim=2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = save_lewm(model, folder)
        ...     same = load_lewm(folder)
        >>> all(torch.equal(a, b) for a, b in zip(model.state_dict().values(), same.state_dict().values()))
        True
    """
    file, config = _find(Path(path).expanduser())
    tensors = _read_tensors(file)
    try:
        sizes = sizes_from_config(config, tensors, frame_skip)
        check_sizes(sizes, len(tensors))
        with torch.device("meta"):
            described = build_world_model(sizes)
        adopted = _adopt(described, tensors)
        model = build_world_model(sizes)
        model.load_state_dict(adopted | {name: model.get_buffer(name) for name in _STATISTICS})
    except (ValueError, TypeError, LookupError, RuntimeError, ArithmeticError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{file} cannot be read as a LeWM checkpoint: {reason}") from error
    if statistics is not None:
        model.statistics = statistics
    return model.to(device).eval()


def save_lewm(model: LatentWorldModel, folder: Path | str, *, naming: Naming = "transformers4") -> Path:
    """Writes a world model as an official LeWM checkpoint, for the published loader or :func:`load_lewm`.

    Weights are written in float32. The format has no action statistics and no frame skip: keep them elsewhere.

    Args:
        model (LatentWorldModel): with a vision transformer, and a predictor as wide as the latent.
        folder (str or Path): created if missing; may contain no other ``.pt`` file, as the published loader refuses
            several.
        naming (str, optional): ``"transformers4"``, as in the released weights, or ``"transformers5"``. The published
            loader needs that of the installed release of ``transformers``. Default: ``"transformers4"``.

    Returns:
        the folder.

    Raises:
        TypeError: networks other than the package's own.
        ValueError: an unknown naming, networks that LeWM does not have, or other weights in the folder.
    """
    if naming not in ("transformers4", "transformers5"):
        raise ValueError(f"naming must be 'transformers4' or 'transformers5', got {naming!r}.")
    folder = Path(folder).expanduser()
    others = sorted(file.name for file in folder.glob("*.pt") if file.name != _WEIGHTS)
    if others:
        raise ValueError(f"{folder} holds other weights ({', '.join(others)}): choose a folder of its own.")
    sizes = world_model_sizes(model)
    config = config_from_sizes(sizes)
    published: dict[str, torch.Tensor] = {}
    state = model.state_dict()
    for match in matches(sizes, naming):
        ours = state[match.ours].detach().cpu()
        published |= match.publish(ours.float() if ours.is_floating_point() else ours)
    weights = io.BytesIO()
    torch.save(published, weights)
    replace_files(folder, (_WEIGHTS, weights.getvalue()), (_CONFIG, json_text(config)))
    return folder


def _find(path: Path) -> tuple[Path, dict[str, Any]]:
    """Finds the file of weights and reads the configuration beside it."""
    if path.is_dir():
        files = sorted(path.glob("*.pt"))
        if len(files) > 1:
            names = ", ".join(file.name for file in files)
            raise ValueError(f"{path} holds {len(files)} weight files ({names}): give the path of one of them.")
        if not files:
            raise FileNotFoundError(f"no .pt file in {path}: a LeWM checkpoint is {_CONFIG} and {_WEIGHTS}.")
        path = files[0]
    if not path.is_file():
        raise FileNotFoundError(f"no LeWM checkpoint at {path}: give a folder with {_CONFIG} and {_WEIGHTS}.")
    config = config_file(path, path.with_name(_CONFIG))
    if not config.exists():
        raise FileNotFoundError(f"no {_CONFIG} beside {path}: it names the sizes of the networks.")
    try:
        content = read_json(config)
    except ValueError as error:
        raise ValueError(f"{config} is not JSON ({error.__cause__ or error}).") from error
    if not isinstance(content, dict):
        raise ValueError(f"{config} must hold a JSON object, got {type(content).__name__}.")
    return path, content


def _read_tensors(file: Path) -> dict[str, torch.Tensor]:
    """Reads the tensors of a checkpoint by their published names, without prefixes; executes no code in the file."""
    size = require_regular_file(file).st_size
    try:
        _check_archive(file, size)
        content = torch.load(file, map_location="cpu", weights_only=True)
    # A damaged pickle may raise any of these.
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{file} is no plain state dict. Whole pickled modules (*_object.ckpt) and checkpoints with objects in "
            "them are refused, since reading them runs their code: save the state_dict() of the model, alone, where "
            f"you trust it ({str(error).splitlines()[0] if str(error) else type(error).__name__})."
        ) from error
    for key in _WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
    if not isinstance(content, Mapping) or not content:
        raise ValueError(f"{file} must hold named tensors, got {type(content).__name__}.")
    tensors: dict[str, torch.Tensor] = {}
    for name, value in content.items():
        name = _bare(str(name))
        if name.startswith(_UNUSED):
            continue
        if not isinstance(value, torch.Tensor) or name in tensors:
            what = "comes twice" if name in tensors else f"is a {type(value).__name__}, no tensor"
            raise ValueError(f"{file}: {name!r} {what}: save the state_dict() of the model alone.")
        tensors[name] = value
    # Expanded tensors and tensors that share a storage would take more memory than the file when copied.
    if any(value.device.type != "cpu" or value.layout != torch.strided or value.is_nested for value in tensors.values()):
        raise ValueError(f"{file} holds tensors that are not plain arrays: save the state_dict() of the model on the CPU.")
    need = sum(value.numel() * value.element_size() for value in tensors.values())
    if need > size:
        raise ValueError(f"{file} has {size} bytes, its tensors would take {need}: it is damaged, restore it.")
    check_numbers(tensors, file)
    return tensors


def _check_archive(file: Path, size: int) -> None:
    """Checks that an archive does not unpack to more than its size: PyTorch stores tensors without compression.

    Raises:
        ValueError: it does, or it is no archive of PyTorch 1.6 or later.
    """
    with open(file, "rb") as content:  # zipfile also opens archives appended to other data, which PyTorch reads as pickles
        if content.read(4) != b"PK\x03\x04":
            raise ValueError("no archive of PyTorch")
    try:
        with zipfile.ZipFile(file) as archive:
            need = sum(entry.file_size for entry in archive.infolist())
    except (zipfile.BadZipFile, zlib.error, OSError, NotImplementedError) as error:
        raise ValueError(f"no archive of PyTorch: {error}") from error
    if need > size:
        raise ValueError(f"{size} bytes would unpack to {need}")


def _bare(name: str) -> str:
    name = name.replace("_orig_mod.", "")  # torch.compile's
    while name.startswith(_PREFIXES):
        name = name.partition(".")[2]
    return name


def _adopt(model: LatentWorldModel, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Converts published tensors to the state of a world model without its action statistics; all must be used."""
    state = model.state_dict()
    table = matches(world_model_sizes(model), naming_of(list(tensors)))
    shapes = {name: match.published_shape(state[match.ours]) for match in table for name in match.theirs}
    missing, unexpected = sorted(shapes.keys() - tensors.keys()), sorted(tensors.keys() - shapes.keys())
    mis_shaped = [
        f"{name} {tuple(tensors[name].shape)} instead of {shape}"
        for name, shape in sorted(shapes.items())
        if name in tensors and tensors[name].shape != shape
    ]
    found = {"missing": missing, "unexpected": unexpected, "of another shape": mis_shaped}
    wrong = [f"{len(names)} {what} ({_listed(names)})" for what, names in found.items() if names]
    if wrong:
        raise ValueError(f"of {len(shapes)} tensors that config.json asks for: {'; '.join(wrong)}.")
    check_kinds({name: state[match.ours] for match in table for name in match.theirs}, tensors)
    return {match.ours: match.adopt(tensors, like=state[match.ours]) for match in table}


def _listed(names: list[str], most: int = 12) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
