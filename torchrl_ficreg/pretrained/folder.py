"""The package's own format: ``model.safetensors`` and ``config.json``, read without executing code from them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg._safe_files import (
    check_kinds,
    check_shapes,
    check_sizes,
    CHECKSUM,
    json_text,
    open_model_folder,
    read_tensors,
    require_safetensors,
    save_model,
    state_of,
)
from torchrl_ficreg.modules.conv import ConvEncoder, ConvNetwork
from torchrl_ficreg.modules.inverse import INVERSE_NETWORKS, InverseDynamicsModel
from torchrl_ficreg.modules.keypoints import KeypointEncoder, KeypointNetwork
from torchrl_ficreg.modules.predictor import CausalPredictor, CausalTransformer
from torchrl_ficreg.modules.vit import VisionTransformer, ViTEncoder
from torchrl_ficreg.modules.world_model import LatentWorldModel

FORMAT, VERSION = "torchrl_ficreg.world_model", 1
CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
_MODEL, _INVERSE = "world_model", "inverse_model"
_BOUNDS = ("action_low", "action_high")

Sizes = dict[str, Any]  # the arguments that build a network, as plain numbers
# Encoders by kind, and their arguments in the order of config.json, which leaves out how they are initialised.
_ENCODERS = {"vit": ViTEncoder, "conv": ConvEncoder, "keypoint": KeypointEncoder}
_ENCODER_ARGUMENTS = {
    VisionTransformer: (
        *("vit", "image_size", "projector_dim", "latent_dim"),
        *("patch_size", "width", "depth", "heads", "mlp_dim"),
    ),
    ConvNetwork: ("conv", "image_size", "projector_dim", "latent_dim", "channels"),
    KeypointNetwork: ("keypoint", "image_size", "channels", "num_keypoints", "latent_dim"),
}


@dataclass(frozen=True)
class ModelCard:
    """What is needed to use a model without its dataset, as JSON values.

    Attributes:
        model: fields of :class:`ModelConfig`; empty for networks of your own.
        env: name of the environment that it was trained on.
        env_kwargs: keyword arguments of that environment.
        action_low: lower bounds of an action [A], in environment units.
        action_high: upper bounds of an action [A], in environment units.
        config: the resolved configuration of the run that trained it.

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
    """Writes a world model to a folder: weights, sizes, action statistics and a card.

    Weights are written in float32; loading and saving again gives the same bits. Keys are not saved: a loaded model reads
    and writes the default ones.

    Args:
        model (LatentWorldModel): a model of the package's own networks.
        folder (str or Path): created if missing; a model already there is replaced.
        inverse_model (InverseDynamicsModel, optional): its inverse dynamics model. Default: None.
        card (mapping, optional): JSON values to save along. :func:`~torchrl_ficreg.trainers.load_world_model` needs the
            fields of :class:`ModelCard`. Default: None.

    Returns:
        the folder.

    Raises:
        ImportError: safetensors is not installed.
        TypeError: networks other than the package's own, or a card with values that JSON does not have.
        ValueError: a card that does not fit the model, or a network that was changed since it was built.

    Examples:
        >>> import tempfile
        >>> from torchrl_ficreg import make_world_model, ModelConfig
        >>> model, inverse_model = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> card = {"env": "two_room", "action_low": [-1.0, -1.0], "action_high": [1.0, 1.0]}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = save_pretrained(model, folder, inverse_model, card)
        ...     same, same_inverse, read = load_pretrained(folder)
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
    """Loads a folder that :func:`save_pretrained` wrote.

    Args:
        folder (str or Path): with ``config.json`` and ``model.safetensors``.
        device (torch.device or str, optional): device of the networks. Default: ``"cpu"``.

    Returns:
        the world model with its action statistics, the inverse dynamics model if one was saved, both in eval mode,
        and the card.

    Raises:
        ImportError: safetensors is not installed.
        FileNotFoundError: no such files.
        ValueError: another format or version, damaged files, or files that do not belong together.
    """
    folder = Path(folder).expanduser()
    advice = {"writer": "save_pretrained", "instead": "an official LeWM checkpoint is read by load_lewm."}
    weights, config, content, shapes = open_model_folder(folder, WEIGHTS_FILE, CONFIG_FILE, FORMAT, VERSION, **advice)
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


def world_model_sizes(model: LatentWorldModel) -> Sizes:
    """``encoder``, ``predictor`` and ``frame_skip`` of a world model: the arguments of its networks.

    Raises:
        TypeError: networks other than the package's own.
        ValueError: one of them was changed since it was built, such as the dropout of one layer.

    Examples:
        >>> from torchrl_ficreg import make_world_model, ModelConfig
        >>> model, _ = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> world_model_sizes(model)["encoder"]["kind"]
        'keypoint'
    """
    encoder, predictor = _own_network(model.encoder, _ENCODER_ARGUMENTS), _own_network(model.predictor, (CausalTransformer,))
    kind, *names = _ENCODER_ARGUMENTS[type(encoder)]
    sizes = {
        "encoder": {"kind": kind, **{name: encoder.arguments[name] for name in names}},
        "predictor": {name: value for name, value in predictor.arguments.items() if name != "position_std"},
        "frame_skip": model.frame_skip,
    }
    if "channels" in names:
        sizes["encoder"]["channels"] = list(sizes["encoder"]["channels"])
    _check_same(model, build_world_model, sizes)
    return sizes


def build_world_model(sizes: Sizes) -> LatentWorldModel:
    """The world model that :func:`world_model_sizes` describes, with fresh weights."""
    arguments = dict(sizes["encoder"])
    encoder = _ENCODERS[arguments.pop("kind")](**arguments)
    return LatentWorldModel(encoder, CausalPredictor(**sizes["predictor"]), frame_skip=sizes["frame_skip"])


def inverse_model_sizes(inverse_model: InverseDynamicsModel) -> Sizes:
    """``kind`` and arguments of an inverse dynamics model.

    Raises:
        TypeError: a network other than the package's own.
        ValueError: it was changed since it was built.
    """
    kinds = {make: kind for kind, (make, _) in INVERSE_NETWORKS.items()}
    network = _own_network(inverse_model, kinds)
    sizes = {"kind": kinds[type(network)], **network.arguments}
    _check_same(inverse_model, build_inverse_model, sizes)
    return sizes


def build_inverse_model(sizes: Sizes) -> InverseDynamicsModel:
    """The inverse dynamics model that :func:`inverse_model_sizes` describes, with fresh weights."""
    return InverseDynamicsModel(**sizes)


def _own_network(module: nn.Module, known: Collection[type[nn.Module]]) -> nn.Module:
    network = module.module if isinstance(module, TensorDictModule) else module
    if type(network) not in known:
        names = ", ".join(sorted(kind.__name__ for kind in known))
        raise TypeError(f"only the package's own networks can be described ({names}), got {type(network).__name__}.")
    return network


def _check_same(module: nn.Module, build: Callable[[Sizes], nn.Module], sizes: Sizes) -> None:
    """Compares every layer with that of the network that will be built from the sizes.

    Raises:
        ValueError: a layer differs.
    """
    with torch.device("meta"):
        built = build(sizes)
    theirs = {name: _settings(layer) for name, layer in built.named_modules()}
    for name, layer in module.named_modules():
        name, ours = name.replace("_orig_mod.", ""), _settings(layer)
        if theirs.get(name, ours) != ours:
            raise ValueError(
                f"layer {name} is {ours}, built anew it would be {theirs[name]}: save a model as it was built, without changes "
                "to single layers."
            )
    check_shapes(built.state_dict(), {name: value.shape for name, value in module.state_dict().items()})


def _settings(layer: nn.Module) -> str:
    """What no weight of a layer shows, such as a dropout rate."""
    kind = "" if any(layer.children()) else type(layer).__name__  # torch.compile wraps others
    return f"{kind}({layer.extra_repr()})"


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
