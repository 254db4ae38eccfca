"""Shared by the formats of trained models: atomic replacement of two files, and checks before memory is allocated."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import nn

from torchrl_ficreg._utils import read_json, require, require_regular_file, write_atomic

CHECKSUM = "weights_sha256"  # field of a configuration: the SHA-256 of the file of weights beside it
_LARGEST = 2**20  # of any size of a network
_LARGEST_IMAGE = 2**14  # pixels; of one side of a frame
_STAGED = ".next"


def require_safetensors() -> ModuleType:
    """Imports ``safetensors.torch``, which saves models and policies; called before training starts.

    Raises:
        ImportError: safetensors is not installed.
    """
    return require("safetensors.torch", "pretrained", purpose="a saved model", package="safetensors")


def save_model(
    folder: Path, weights: str, state: Mapping[str, torch.Tensor], config: str, content: Mapping[str, Any]
) -> None:
    """Writes a state in float32 as safetensors, and its configuration with the checksum of that file.

    Args:
        folder (Path): created if missing.
        weights (str): name of the file of weights.
        state (mapping of str to Tensor): tensors by name.
        config (str): name of the configuration.
        content (mapping): the configuration, without the checksum.

    Raises:
        ImportError: safetensors is not installed.
        TypeError, ValueError: the configuration has values that JSON does not have.
        OSError: the files cannot be written; the old ones stay as they are.
    """
    data = require_safetensors().save(as_float32(state), metadata={"format": "pt"})
    text = json_text({**content, CHECKSUM: hashlib.sha256(data).hexdigest()})
    replace_files(folder, (weights, data), (config, text))


def replace_files(folder: Path, weights: tuple[str, bytes], config: tuple[str, str]) -> None:
    """Replaces a file of weights and its configuration atomically: at any instant either the old or the new model exists.

    Both are first written under temporary names. Renaming the weights replaces the old model by the new one; the
    configuration is renamed afterwards. Its temporary name contains the checksum of the weights, by which
    :func:`config_file` finds it if the process is killed between the two.

    Args:
        folder (Path): created if missing.
        weights (tuple of str and bytes): name and content of the file of weights.
        config (tuple of str and str): name and content of the configuration.

    Raises:
        OSError: a file cannot be written; the old files stay as they are.
    """
    folder.mkdir(parents=True, exist_ok=True)
    current = config_file(folder / weights[0], folder / config[0])
    if current.name != config[0]:  # a save was killed between the two renames
        os.replace(current, folder / config[0])
    _sweep(folder, weights[0], config[0])
    digest = hashlib.sha256(weights[1]).hexdigest()
    staged = [(folder / f"{weights[0]}{_STAGED}", weights[1]), (_staged_config(folder / config[0], digest), config[1])]
    try:
        for path, content in staged:
            write_atomic(path, content)
        os.replace(staged[0][0], folder / weights[0])
    except BaseException:
        for path, _ in staged:
            path.unlink(missing_ok=True)
        raise
    os.replace(staged[1][0], folder / config[0])


def config_file(weights: Path, config: Path) -> Path:
    """The configuration of a file of weights: ``config``, or the one that a killed save left under its temporary name."""
    if not any(config.parent.glob(f"{config.name}.*{_STAGED}")) or not weights.is_file():
        return config
    staged = _staged_config(config, _digest(weights))
    return staged if staged.is_file() and not staged.is_symlink() else config


def _staged_config(config: Path, digest: str) -> Path:
    return config.with_name(f"{config.name}.{digest[:16]}{_STAGED}")


def _sweep(folder: Path, *names: str) -> None:
    """Removes temporary files of killed saves."""
    for name in names:
        for pattern in (f"{name}{_STAGED}", f"{name}.*{_STAGED}", f"{name}.*.part"):
            for path in folder.glob(pattern):
                path.unlink()


def _digest(file: Path) -> str:
    require_regular_file(file)
    digest = hashlib.sha256()
    with open(file, "rb") as content:
        while part := content.read(2**20):
            digest.update(part)
    return digest.hexdigest()


def read_config(file: Path, kind: str, version: int, *, instead: str) -> dict[str, Any]:
    """Reads one of the package's JSON files.

    Args:
        file (Path): the file.
        kind (str): expected value of its field ``format``.
        version (int): expected value of its field ``version``.
        instead (str): advice in the error for a file of another format.

    Raises:
        ValueError: it is not JSON, or has another format or version.
    """
    try:
        content = read_json(file)
    except ValueError as error:
        raise ValueError(f"{file} is not JSON ({error.__cause__ or error}): is it damaged?") from error
    if not isinstance(content, dict) or content.get("format") != kind:
        raise ValueError(f"{file} is not of the format {kind!r}: {instead}")
    if content.get("version") != version:
        raise ValueError(
            f"{file} has version {content.get('version')!r}, this release reads {version}: update torchrl_ficreg."
        )
    return content


def open_model_folder(
    folder: Path, weights_name: str, config_name: str, kind: str, version: int, *, writer: str, instead: str
) -> tuple[Path, Path, dict[str, Any], dict[str, tuple[int, ...]]]:
    """Finds the two files of a saved model and reads what can be read of them without its tensors.

    Args:
        folder (Path): the folder.
        weights_name (str): name of the safetensors file.
        config_name (str): name of the configuration.
        kind (str): see :func:`read_config`, as ``version`` and ``instead``.
        version (int): see there.
        writer (str): what writes such folders, for an error.
        instead (str): see there.

    Returns:
        the file of weights, that of the configuration, its content, and the shapes of the weights by name.

    Raises:
        ImportError: safetensors is not installed.
        FileNotFoundError: one of the files is missing.
        ValueError: see :func:`read_config` and :func:`read_shapes`.
    """
    require_safetensors()
    weights, config = folder / weights_name, config_file(folder / weights_name, folder / config_name)
    for file in (config, weights):
        if not file.exists():
            raise FileNotFoundError(f"no {file.name} in {folder}: give a folder that {writer} wrote.")
    return weights, config, read_config(config, kind, version, instead=instead), read_shapes(weights)


def read_shapes(file: Path) -> dict[str, tuple[int, ...]]:
    """Reads names and shapes of a safetensors file from its header.

    Raises:
        ValueError: the file is damaged.
    """
    require_regular_file(file)
    from safetensors import safe_open, SafetensorError

    try:
        with safe_open(file, "pt") as tensors:
            return {name: tuple(tensors.get_slice(name).get_shape()) for name in tensors.keys()}
    except (SafetensorError, OSError, OverflowError) as error:
        raise ValueError(f"{file} is damaged ({error}): restore it.") from error


def read_tensors(file: Path, digest: Any = None) -> dict[str, torch.Tensor]:
    """Reads the tensors of a safetensors file.

    Args:
        file (Path): the file.
        digest (str, optional): expected SHA-256. Default: None, not checked, for folders of earlier releases.

    Raises:
        ValueError: the file is damaged, has another checksum, or contains values that :func:`check_numbers` refuses.
    """
    load_file = require_safetensors().load_file
    if digest is not None and digest != _digest(file):
        raise ValueError(f"{file} has another checksum than the configuration beside it notes: it is damaged, restore both.")
    from safetensors import SafetensorError

    try:
        tensors = load_file(file)
    except (SafetensorError, KeyError) as error:
        raise ValueError(f"{file} is damaged ({error}): restore it.") from error
    check_numbers(tensors, file)
    return tensors


def check_sizes(sizes: Mapping[str, Any], num_tensors: int) -> None:
    """Checks sizes of networks against the file of weights, before networks of these sizes are built.

    Args:
        sizes (mapping): arguments of networks, nested; names that end in ``dropout`` are rates.
        num_tensors (int): number of tensors in the file of weights; no network has more layers.

    Raises:
        ValueError: a value out of range or of another type.
    """
    for name, value in sizes.items():
        rate = name.endswith("dropout")
        if isinstance(value, Mapping) and not rate:
            check_sizes(value, num_tensors)
            continue
        values, most = list(value) if isinstance(value, (list, tuple)) and not rate else [value], _LARGEST
        if name.endswith("depth") or name == "members":
            most = num_tensors
        elif name == "image_size":
            most = _LARGEST_IMAGE
        if not 0 < len(values) <= num_tensors:
            raise ValueError(f"{name} lists {len(values)} layers, the file of weights has {num_tensors} tensors.")
        for number in values:
            if isinstance(number, str) and number and not rate:  # the kind of a network
                continue
            if isinstance(number, bool) or not isinstance(number, (int, float)):
                raise ValueError(f"{name} must be a number, got {str(number)[:40]!r}.")
            if rate:
                if not 0 <= number < 1:
                    raise ValueError(f"{name} must lie in [0, 1), got {number}.")
            elif isinstance(number, float):
                if not math.isfinite(number):
                    raise ValueError(f"{name} must be finite, got {number}.")
            elif name != "predictor_position_std" and not 1 <= number <= most:
                raise ValueError(f"{name} must be a whole number from 1 to {most}, got {str(number)[:24]}.")


def check_shapes(wanted: Mapping[str, torch.Tensor], found: Mapping[str, tuple[int, ...]]) -> None:
    """Compares the state of networks with the tensors of a file.

    Args:
        wanted (mapping of str to Tensor): state of the networks; may be on the meta device.
        found (mapping of str to tuple): shapes in the file by name.

    Raises:
        ValueError: tensors are missing, left over or of another shape.
    """
    differing = {name for name in wanted.keys() & found.keys() if tuple(wanted[name].shape) != tuple(found[name])}
    wrong = sorted((wanted.keys() ^ found.keys()) | differing)
    if wrong:
        raise ValueError(
            f"{len(wrong)} tensors are missing, left over or of another shape: {', '.join(str(n)[:60] for n in wrong[:2])}"
            f"{' ...' if len(wrong) > 2 else ''}."
        )


def check_kinds(wanted: Mapping[str, torch.Tensor], tensors: Mapping[str, torch.Tensor]) -> None:
    """Checks that loading does not cast integers or complex numbers to weights.

    Raises:
        ValueError: a tensor of another kind.
    """
    for name, value in wanted.items():
        if value.is_floating_point() != tensors[name].is_floating_point() or tensors[name].is_complex():
            raise ValueError(f"{name} has dtype {tensors[name].dtype}, expected {value.dtype}.")


def check_numbers(tensors: Mapping[str, torch.Tensor], where: Path | str) -> None:
    """Checks that tensors hold values that a trained network can have.

    Args:
        tensors (mapping of str to Tensor): by name; ``*running_var`` are variances, ``*_std`` standard deviations.
        where (Path or str): their origin, for the error.

    Raises:
        ValueError: a NaN or an infinity, a negative variance, or a standard deviation that is not positive.
    """
    for name, value in tensors.items():
        if not value.is_floating_point():
            continue
        if not value.float().isfinite().all():  # networks are in float32, which does not hold every float64
            raise ValueError(f"{where}: {name} holds a NaN or an infinity: the training failed, or the file is damaged.")
        if name.endswith("running_var") and (value < 0).any():
            raise ValueError(f"{where}: {name} holds a negative variance: the file is damaged, restore it.")
        if name.endswith("_std") and (value <= 0).any():
            raise ValueError(f"{where}: {name} must be positive, got {str(value.tolist())[:60]}: the file is damaged.")


def state_of(parts: Mapping[str, nn.Module]) -> dict[str, torch.Tensor]:
    """Merges the states of several networks; each name is prefixed by that of its network."""
    return {f"{part}.{name}": value for part, module in parts.items() for name, value in module.state_dict().items()}


def checksum_of(state: Mapping[str, torch.Tensor]) -> str:
    """SHA-256 of a state's names and float32 values, as hexadecimal digits; the same on every device."""
    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(name.encode())
        digest.update(state[name].detach().float().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def as_float32(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Contiguous copies on the CPU, floating tensors in float32."""
    return {
        name: (value.float() if value.is_floating_point() else value).detach().cpu().contiguous()
        for name, value in tensors.items()
    }


def json_text(content: Mapping[str, Any]) -> str:
    """A configuration as JSON text.

    Raises:
        TypeError, ValueError: values that JSON does not have.
    """
    return json.dumps(content, indent=2) + "\n"
