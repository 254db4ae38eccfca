"""What our formats of a trained model share: two files that are replaced as one, and checks before memory is taken."""

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

from torchrl_ficreg._utils import read_json, require_regular_file, write_atomic

CHECKSUM = "weights_sha256"  # field of a configuration: the SHA-256 of the file of weights beside it
_LARGEST = 2**20  # of any size of a network
_LARGEST_IMAGE = 2**14  # pixels; of one side of a frame
_STAGED = ".next"


def require_safetensors() -> ModuleType:
    """The package by which models and policies are saved, looked for before there is something to lose.

    Raises:
        ImportError: it is not installed.
    """
    try:
        import safetensors.torch
    except ImportError as error:
        raise ImportError("safetensors is missing: pip install 'torchrl_ficreg[pretrained]'.") from error
    return safetensors


def save_model(
    folder: Path, weights: str, state: Mapping[str, torch.Tensor], config: str, content: Mapping[str, Any]
) -> None:
    """Writes a state in float32 as safetensors, and its configuration with the checksum of that file, by :func:`replace_files`.

    Args:
        folder: made if missing.
        weights, config: names of the two files.
        state: tensors by name.
        content: of the configuration, without the checksum.

    Raises:
        ImportError: safetensors is not installed.
        TypeError, ValueError: the configuration has values other than those of JSON.
        OSError: the files cannot be written; the old ones stay as they are.
    """
    data = require_safetensors().torch.save(as_float32(state), metadata={"format": "pt"})
    text = json_text({**content, CHECKSUM: hashlib.sha256(data).hexdigest()})
    replace_files(folder, (weights, data), (config, text))


def replace_files(folder: Path, weights: tuple[str, bytes], config: tuple[str, str]) -> None:
    """Writes a file of weights and the configuration beside it, as one: at any instant the old or the new model is there.

    Both are written under other names first. The weights take their name, which is when the new model replaces the old
    one, and then the configuration takes its own. Its other name bears the checksum of the weights: after a kill between
    the two, :func:`config_file` finds it.

    Args:
        folder: made if missing.
        weights, config: name and content of each.

    Raises:
        OSError: they cannot be written; the old files stay as they are.
    """
    folder.mkdir(parents=True, exist_ok=True)
    current = config_file(folder / weights[0], folder / config[0])
    if current.name != config[0]:  # a save was killed between its two steps
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
    """The configuration that belongs to a file of weights: ``config``, or one that a killed save left under another name."""
    if not any(config.parent.glob(f"{config.name}.*{_STAGED}")) or not weights.is_file():
        return config
    staged = _staged_config(config, _digest(weights))
    return staged if staged.is_file() and not staged.is_symlink() else config


def _staged_config(config: Path, digest: str) -> Path:
    return config.with_name(f"{config.name}.{digest[:16]}{_STAGED}")


def _sweep(folder: Path, *names: str) -> None:
    """Removes what a killed save left."""
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
    """The content of one of our JSON files.

    Args:
        file: to be read.
        kind, version: what its fields ``format`` and ``version`` must say.
        instead: what to do about a file of another format.

    Raises:
        ValueError: it is not JSON, or of another format or version.
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


def read_shapes(file: Path) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a safetensors file, from its header alone.

    Raises:
        ValueError: it is damaged.
    """
    require_regular_file(file)
    from safetensors import safe_open, SafetensorError

    try:
        with safe_open(file, "pt") as tensors:
            return {name: tuple(tensors.get_slice(name).get_shape()) for name in tensors.keys()}
    except (SafetensorError, OSError, OverflowError) as error:
        raise ValueError(f"{file} is damaged ({error}): restore it.") from error


def read_tensors(file: Path, digest: Any = None) -> dict[str, torch.Tensor]:
    """The tensors of a safetensors file, all finite.

    Args:
        file: to be read.
        digest: the SHA-256 that it must have; None: any, in folders of earlier releases.

    Raises:
        ValueError: it is damaged, has another checksum, or holds a number that no trained network has.
    """
    safetensors = require_safetensors()
    if digest is not None and digest != _digest(file):
        raise ValueError(f"{file} has another checksum than the configuration beside it notes: it is damaged, restore both.")
    try:
        tensors = safetensors.torch.load_file(file)
    except (safetensors.SafetensorError, KeyError) as error:
        raise ValueError(f"{file} is damaged ({error}): restore it.") from error
    check_numbers(tensors, file)
    return tensors


def check_sizes(sizes: Mapping[str, Any], num_tensors: int) -> None:
    """Refuses a description that asks for more than the weights beside it can be, before anything is built from it.

    Args:
        sizes: arguments of networks, nested; names that end in ``dropout`` are rates.
        num_tensors: in the file of weights. No network has more layers.

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
    """Compares what networks need with what a file has.

    Args:
        wanted: state of the networks, on the meta device say.
        found: shapes by name.

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
    """Refuses tensors that would be cast on loading: counts in place of weights, or complex numbers.

    Raises:
        ValueError: there is one.
    """
    for name, value in wanted.items():
        if value.is_floating_point() != tensors[name].is_floating_point() or tensors[name].is_complex():
            raise ValueError(f"{name} has dtype {tensors[name].dtype}, expected {value.dtype}.")


def check_numbers(tensors: Mapping[str, torch.Tensor], where: Path | str) -> None:
    """Refuses numbers that no trained network has.

    Args:
        tensors: by name; those that end in ``running_var`` are variances, those that end in ``_std`` are deviations.
        where: they come from, for the error.

    Raises:
        ValueError: a NaN or an infinity, a negative variance, or a deviation that is not positive.
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
    """The states of several networks as one, each tensor's name after its network's."""
    return {f"{part}.{name}": value for part, module in parts.items() for name, value in module.state_dict().items()}


def checksum_of(state: Mapping[str, torch.Tensor]) -> str:
    """SHA-256 of a state's names and float32 values, as hexadecimal digits; of any device."""
    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(name.encode())
        digest.update(state[name].detach().float().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def as_float32(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Copies on the CPU, contiguous, floating numbers in float32."""
    return {
        name: (value.float() if value.is_floating_point() else value).detach().cpu().contiguous()
        for name, value in tensors.items()
    }


def json_text(content: Mapping[str, Any]) -> str:
    """A configuration as it is written.

    Raises:
        TypeError, ValueError: values other than those of JSON.
    """
    return json.dumps(content, indent=2) + "\n"
