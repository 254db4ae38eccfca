"""Our own format: ``model.safetensors`` and ``config.json``, readable without running anything that is in them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from torchrl_ficreg.modules.inverse import InverseDynamicsModel
from torchrl_ficreg.modules.pretrained.sizes import (
    build_inverse_model,
    build_world_model,
    inverse_model_sizes,
    Sizes,
    world_model_sizes,
)
from torchrl_ficreg.modules.safe_files import read_config, require_safetensors
from torchrl_ficreg.modules.world_model import LatentWorldModel

FORMAT, VERSION = "torchrl_ficreg.world_model", 1
CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
_MODEL, _INVERSE = "world_model", "inverse_model"
_BOUNDS = ("action_low", "action_high")


def save_pretrained(
    model: LatentWorldModel,
    folder: Path | str,
    inverse_model: InverseDynamicsModel | None = None,
    card: Mapping[str, Any] | None = None,
) -> Path:
    """Writes a world model to share: weights, sizes, action statistics, and what else one must know about it.

    Weights are written in float32, whatever precision the model is in; loading and saving again gives the same bits.
    Keys of the modules are not kept: a loaded model reads and writes the package's standard ones.

    Args:
        model: of the package's own networks.
        folder: made if missing; a model already there is replaced.
        inverse_model: the judge that belongs to it.
        card: JSON values to travel along. The fields of :class:`~torchrl_ficreg.trainers.ModelCard` are understood
            by the rest of the package: ``model``, ``env``, ``env_kwargs``, ``action_low``, ``action_high`` (bounds of
            a raw action [A], environment units) and ``config``.

    Returns:
        the folder.

    Raises:
        ImportError: safetensors is not installed.
        TypeError: foreign networks, or a card with other than JSON values.
        ValueError: a card that does not fit the model.

    Examples:
        >>> import tempfile
        >>> from torchrl_ficreg import make_world_model, ModelConfig
        >>> model, inverse_model = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> card = {"env": "two_room", "action_low": [-1.0, -1.0], "action_high": [1.0, 1.0]}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = save_pretrained(model, folder, inverse_model, card)
        ...     same, judge, read = load_pretrained(folder)
        >>> read == card, torch.equal(same.predictor.module.position, model.predictor.module.position)
        (True, True)
    """
    safetensors = require_safetensors()
    card, sizes = dict(card or {}), world_model_sizes(model)
    _check_card(card, model, sizes)
    parts: dict[str, nn.Module] = {_MODEL: model} | ({} if inverse_model is None else {_INVERSE: inverse_model})
    content = {
        "format": FORMAT,
        "version": VERSION,
        _MODEL: sizes,
        _INVERSE: None if inverse_model is None else inverse_model_sizes(inverse_model),
        "statistics": _statistics(model),
        "card": card,
    }
    try:
        text = json.dumps(content, indent=2)
    except (TypeError, ValueError) as error:
        raise TypeError(f"the card must hold JSON values only ({error}).") from error
    tensors = {
        f"{part}.{name}": (tensor.float() if tensor.is_floating_point() else tensor).detach().cpu().contiguous()
        for part, module in parts.items()
        for name, tensor in module.state_dict().items()
    }
    folder = Path(folder).expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    safetensors.torch.save_file(tensors, folder / WEIGHTS_FILE, metadata={"format": "pt"})
    (folder / CONFIG_FILE).write_text(text + "\n", encoding="utf-8")
    return folder


def load_pretrained(
    folder: Path | str, *, device: torch.device | str = "cpu"
) -> tuple[LatentWorldModel, InverseDynamicsModel | None, dict[str, Any]]:
    """Reads what :func:`save_pretrained` wrote.

    Args:
        folder: with ``config.json`` and ``model.safetensors``.
        device: where the networks go.

    Returns:
        the world model with its action statistics, the inverse dynamics model if one was saved, both in eval mode,
        and the card.

    Raises:
        ImportError: safetensors is not installed.
        FileNotFoundError: no such files.
        ValueError: another format or version, damaged files, or files that do not belong together.
    """
    safetensors = require_safetensors()
    folder = Path(folder).expanduser()
    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"no {name} in {folder}: give a folder that save_pretrained wrote.")
    content = read_config(
        folder / CONFIG_FILE, FORMAT, VERSION, instead="an official LeWM checkpoint is read by load_lewm."
    )
    try:
        tensors = safetensors.torch.load_file(folder / WEIGHTS_FILE)
    except safetensors.SafetensorError as error:
        raise ValueError(f"{folder / WEIGHTS_FILE} is damaged ({error}).") from error
    try:
        model = build_world_model(content[_MODEL])
        inverse_model = None if content[_INVERSE] is None else build_inverse_model(content[_INVERSE])
        statistics, card = content["statistics"], content["card"]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{folder / CONFIG_FILE} does not describe a world model ({error!r}).") from error
    parts: dict[str, nn.Module] = {_MODEL: model} | ({} if inverse_model is None else {_INVERSE: inverse_model})
    _fill(parts, tensors, folder)
    if _statistics(model) != statistics:
        raise ValueError(f"{folder}: {CONFIG_FILE} and {WEIGHTS_FILE} hold different statistics, they do not belong together.")
    for part in parts.values():
        part.to(device).eval()
    return model, inverse_model, card


def _statistics(model: LatentWorldModel) -> dict[str, list[float]]:
    return {"mean": model.action_mean.float().tolist(), "std": model.action_std.float().tolist()}


def _check_card(card: dict[str, Any], model: LatentWorldModel, sizes: Sizes) -> None:
    action_dim = len(model.action_mean)
    for name in _BOUNDS:
        if name in card and len(card[name]) != action_dim:
            raise ValueError(f"the model acts in {action_dim} dimensions, card[{name!r}] has {len(card[name])}.")
    ours = {
        "image_size": sizes["encoder"]["image_size"],
        "frame_skip": sizes["frame_skip"],
        "latent_dim": sizes["predictor"]["latent_dim"],
        "history": sizes["predictor"]["history"],
    }
    named = card.get("model", {})
    other = [f"{name} {named[name]}, not {value}" for name, value in ours.items() if named.get(name, value) != value]
    if other:
        raise ValueError(f"card['model'] describes another model: {', '.join(other)}.")


def _fill(parts: dict[str, nn.Module], tensors: dict[str, torch.Tensor], folder: Path) -> None:
    """Loads every tensor, none missing, left over or of another shape."""
    wanted = {f"{part}.{name}": value for part, module in parts.items() for name, value in module.state_dict().items()}
    differing = {name for name in wanted.keys() & tensors.keys() if wanted[name].shape != tensors[name].shape}
    wrong = sorted((wanted.keys() ^ tensors.keys()) | differing)
    if wrong:
        raise ValueError(
            f"{folder}: {WEIGHTS_FILE} does not fit {CONFIG_FILE}, {len(wrong)} tensors are missing, left over or of another "
            f"shape: {', '.join(wrong[:8])}{' ...' if len(wrong) > 8 else ''}."
        )
    for part, module in parts.items():
        module.load_state_dict({name: tensors[f"{part}.{name}"] for name in module.state_dict()})
