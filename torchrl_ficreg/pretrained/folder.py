"""Our own format: ``model.safetensors`` and ``config.json``, readable without running anything that is in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from torchrl_ficreg._safe_files import (
    check_kinds,
    check_shapes,
    check_sizes,
    CHECKSUM,
    config_file,
    json_text,
    read_config,
    read_shapes,
    read_tensors,
    require_safetensors,
    save_model,
    state_of,
)
from torchrl_ficreg.modules.inverse import InverseDynamicsModel
from torchrl_ficreg.modules.world_model import LatentWorldModel
from torchrl_ficreg.pretrained._sizes import (
    build_inverse_model,
    build_world_model,
    inverse_model_sizes,
    Sizes,
    world_model_sizes,
)

FORMAT, VERSION = "torchrl_ficreg.world_model", 1
CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
_MODEL, _INVERSE = "world_model", "inverse_model"
_BOUNDS = ("action_low", "action_high")


@dataclass(frozen=True)
class ModelCard:
    """What one must know about a model to use it without its dataset, as plain JSON values.

    Attributes:
        model: fields of :class:`ModelConfig`.
        env: name of the environment it was trained on.
        env_kwargs: how that environment was made.
        action_low, action_high: bounds of a raw action [A], environment units.
        config: the whole resolved configuration of the run that made it.

    Raises:
        ValueError: a field of another type, or bounds that are no two lists of one length.
    """

    model: dict[str, Any]
    env: str
    env_kwargs: dict[str, Any]
    action_low: list[float]
    action_high: list[float]
    config: dict[str, Any]

    def __post_init__(self) -> None:
        kinds = {"model": dict, "env": str, "env_kwargs": dict, "config": dict}
        for name, kind in kinds.items():
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} of a model's card must be a {kind.__name__}, got {str(getattr(self, name))[:40]!r}.")
        bounds = self.action_low, self.action_high
        lists = all(isinstance(bound, (list, tuple)) and all(isinstance(n, (int, float)) for n in bound) for bound in bounds)
        if not lists or not 0 < len(bounds[0]) == len(bounds[1]) or not all(a <= b for a, b in zip(*bounds)):
            raise ValueError(
                f"action_low={str(bounds[0])[:40]} and action_high={str(bounds[1])[:40]} of a model's card must be two lists "
                "of as many numbers, low <= high."
            )

    @property
    def action_dim(self) -> int:
        """A, raw action dimension."""
        return len(self.action_low)


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
        card: JSON values to travel along. The fields of :class:`ModelCard` are understood
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
    require_safetensors()
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
        json_text(card)
    except (TypeError, ValueError, RecursionError) as error:
        raise TypeError(f"the card must hold JSON values only ({error}).") from error
    folder = Path(folder).expanduser()
    save_model(folder, WEIGHTS_FILE, state_of(parts), CONFIG_FILE, content)
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
    require_safetensors()
    folder = Path(folder).expanduser()
    weights, config = folder / WEIGHTS_FILE, config_file(folder / WEIGHTS_FILE, folder / CONFIG_FILE)
    for file in (config, weights):
        if not file.exists():
            raise FileNotFoundError(f"no {file.name} in {folder}: give a folder that save_pretrained wrote.")
    content = read_config(config, FORMAT, VERSION, instead="an official LeWM checkpoint is read by load_lewm.")
    shapes = read_shapes(weights)
    try:
        described = {_MODEL: content[_MODEL]} | ({} if content[_INVERSE] is None else {_INVERSE: content[_INVERSE]})
        check_sizes(described, len(shapes))
        with torch.device("meta"):
            wanted = state_of(_build(described))
        statistics, card = content["statistics"], content["card"]
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:160] if isinstance(error, ValueError) else repr(error)[:160]
        raise ValueError(f"{config} does not describe a world model ({reason}).") from error
    if not isinstance(card, dict):
        raise ValueError(f"{config}: card must be a JSON object, got {str(card)[:40]!r}.")
    try:
        check_shapes(wanted, shapes)
    except ValueError as error:
        raise ValueError(f"{folder}: {WEIGHTS_FILE} does not fit {CONFIG_FILE}, {error}") from error
    tensors = read_tensors(weights, content.get(CHECKSUM))
    check_kinds(wanted, tensors)
    parts = _build(described)
    for part, module in parts.items():
        module.load_state_dict({name: tensors[f"{part}.{name}"] for name in module.state_dict()})
    model, inverse_model = parts[_MODEL], parts.get(_INVERSE)
    if _statistics(model) != statistics:
        raise ValueError(f"{folder}: {CONFIG_FILE} and {WEIGHTS_FILE} hold different statistics, they do not belong together.")
    for part in parts.values():
        part.to(device).eval()
    return model, inverse_model, card


def _build(described: dict[str, Sizes]) -> dict[str, nn.Module]:
    """The networks of a configuration, with fresh weights."""
    builders = {_MODEL: build_world_model, _INVERSE: build_inverse_model}
    return {part: builders[part](sizes) for part, sizes in described.items()}


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
