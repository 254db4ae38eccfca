"""Official LeWM checkpoints, ``config.json`` beside ``weights.pt``, to our world model and back."""

from __future__ import annotations

import io
import math
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
from torchrl_ficreg.pretrained._lewm_names import matches, Naming, naming_of
from torchrl_ficreg.pretrained._sizes import build_world_model, Sizes, world_model_sizes


_VIT_SIZES = {  # width, depth, heads; the MLP has four times the width
    "tiny": (192, 12, 3),
    "small": (384, 12, 6),
    "base": (768, 12, 12),
    "large": (1024, 24, 16),
    "huge": (1280, 32, 16),
}
_VIT_FIELDS = ("hidden_size", "num_hidden_layers", "num_attention_heads", "intermediate_size")
_DIM_HEAD = 64  # where the published predictor is not told otherwise
_LEWM = "stable_worldmodel.wm.lewm"
_MODELS = ("LeWM", "JEPA")
_TARGETS = {  # classes by which the parts may be called; the second names are those of the paper's release
    "encoder": ("vit_hf",),
    "predictor": ("Predictor", "ARPredictor"),
    "action_encoder": ("Embedder",),
    "projector": ("MLP",),
    "pred_proj": ("MLP",),
}
_READ = {  # fields that say a size, or nothing about the network
    "encoder": {"size", "patch_size", "image_size", "pretrained", "use_mask_token", *_VIT_FIELDS},
    "predictor": {
        *("num_frames", "input_dim", "hidden_dim", "output_dim"),
        *("depth", "heads", "mlp_dim", "dim_head", "dropout"),
    },
    "action_encoder": {"input_dim", "smoothed_dim", "emb_dim"},
    "projector": {"input_dim", "hidden_dim", "output_dim"},
    "pred_proj": {"input_dim", "hidden_dim", "output_dim"},
}
_FIXED = {  # fields that our networks leave no choice in
    "encoder": {
        "hidden_act": "gelu",
        "layer_norm_eps": 1e-12,
        "qkv_bias": True,
        "num_channels": 3,
        "hidden_dropout_prob": 0.0,
        "attention_probs_dropout_prob": 0.0,
    },
    "predictor": {"emb_dropout": 0.0},
    "action_encoder": {"mlp_scale": 4},
    "projector": {"norm_fn": "BatchNorm1d", "act_fn": "GELU"},
    "pred_proj": {"norm_fn": "BatchNorm1d", "act_fn": "GELU"},
}


def sizes_from_config(config: dict[str, Any], tensors: dict[str, torch.Tensor], frame_skip: int) -> Sizes:
    """What to build for a checkpoint. Sizes that ``config`` does not name are read off the shapes of ``tensors``.

    Args:
        config: content of ``config.json``.
        tensors: published names and tensors.
        frame_skip: F, raw actions in one block; the files do not say it.

    Returns:
        as :func:`~torchrl_ficreg.pretrained._sizes.world_model_sizes`.

    Raises:
        ValueError: networks that ours cannot stand for, or a size that neither config nor shapes tell.
    """
    if "encoder" not in config and isinstance(config.get("model"), dict):
        config = config["model"]  # the configuration of a whole run
    whole = _class_name(config)
    if whole not in _MODELS:
        raise ValueError(f"config.json asks for {whole}, not for a {' or '.join(_MODELS)}.")
    for part in _TARGETS:
        _check_part(part, config.get(part))
    read = _Sizes(config, tensors)
    vit = config["encoder"].get("size", "tiny")
    if vit not in _VIT_SIZES:
        raise ValueError(f"config.json: encoder.size must be one of {sorted(_VIT_SIZES)}, got {vit!r}.")
    vit_width, vit_depth, vit_heads = _VIT_SIZES[vit]
    patch = read("encoder.patch_size", "encoder.embeddings.patch_embeddings.projection.weight", 2)
    tokens = "encoder.embeddings.position_embeddings"
    width = read("predictor.hidden_dim", "predictor.transformer.norm.weight")
    ends = [read(f"predictor.{end}_dim", default=width) for end in ("input", "output")]
    if ends != [width, width]:
        raise ValueError(
            f"config.json: a predictor of width {width} between latents of width {ends[0]} and {ends[1]} holds "
            "projections that ours does not have; only equal widths can be read."
        )
    dropout = config["predictor"].get("dropout", 0.0)
    if isinstance(dropout, bool) or not isinstance(dropout, (int, float)) or not 0 <= dropout < 1:
        raise ValueError(f"config.json: predictor.dropout must lie in [0, 1), got {str(dropout)[:40]!r}.")
    latent_dim = read("projector.output_dim", "projector.net.3.weight", 0)
    encoder = {
        "kind": "vit",
        "image_size": read("encoder.image_size", tokens, 1, of=lambda tokens: math.isqrt(tokens - 1) * patch),
        "patch_size": patch,
        "width": read("encoder.hidden_size", default=vit_width),
        "depth": read("encoder.num_hidden_layers", default=vit_depth),
        "heads": read("encoder.num_attention_heads", default=vit_heads),
        "mlp_dim": read("encoder.intermediate_size", default=4 * vit_width),
        "projector_dim": read("projector.hidden_dim", "projector.net.0.weight", 0),
        "latent_dim": latent_dim,
    }
    predictor = {
        "latent_dim": latent_dim,
        "action_dim": read("action_encoder.input_dim", "action_encoder.patch_embed.weight", 1),
        "history": read("predictor.num_frames", "predictor.pos_embedding", 1),
        "width": width,
        "depth": read("predictor.depth", default=_count(tensors, "predictor.transformer.layers.")),
        "heads": read("predictor.heads"),
        "dim_head": read("predictor.dim_head", default=_DIM_HEAD),
        "mlp_dim": read("predictor.mlp_dim", "predictor.transformer.layers.0.mlp.net.1.weight", 0),
        "dropout": dropout,
        "attention_dropout": dropout,  # the published predictor has one rate for both
        "projector_dim": read("pred_proj.hidden_dim", "pred_proj.net.0.weight", 0),
        "action_bottleneck": read("action_encoder.smoothed_dim", "action_encoder.patch_embed.weight", 0),
    }
    return {"encoder": encoder, "predictor": predictor, "frame_skip": frame_skip}


def config_from_sizes(sizes: Sizes) -> dict[str, Any]:
    """The ``config.json`` from which the published loader builds the same networks.

    Raises:
        ValueError: networks that the published code cannot stand for.
    """
    encoder, predictor = sizes["encoder"], sizes["predictor"]
    if encoder["kind"] != "vit":
        raise ValueError(f"a LeWM checkpoint holds a vision transformer, this model a {encoder['kind']!r} encoder.")
    width = predictor["width"]
    if predictor["latent_dim"] != width:
        raise ValueError(
            f"LeWM's predictor is as wide as the latent; this one is {width} wide, for latents of "
            f"{predictor['latent_dim']}: build it with predictor_width equal to latent_dim."
        )
    if predictor["heads"] == 1 and predictor["dim_head"] == width:
        raise ValueError("LeWM's predictor has no output projection when a single head has the full width; ours has.")
    rates = predictor["dropout"], predictor["attention_dropout"]
    if rates[0] != rates[1]:
        raise ValueError(
            f"LeWM's predictor has one dropout for its layers and its attention weights, this one {rates[0]} and {rates[1]}: "
            "build it with predictor_attention_dropout equal to predictor_dropout."
        )
    vit = (encoder["width"], encoder["depth"], encoder["heads"], encoder["mlp_dim"])
    named = next((name for name, shape in _VIT_SIZES.items() if vit == (*shape, 4 * shape[0])), None)
    return {
        "_target_": f"{_LEWM}.LeWM",
        "encoder": {
            "_target_": "stable_pretraining.backbone.utils.vit_hf",
            "size": named or "tiny",
            "patch_size": encoder["patch_size"],
            "image_size": encoder["image_size"],
            "pretrained": False,
            "use_mask_token": False,
            **({} if named else dict(zip(_VIT_FIELDS, vit))),
        },
        "predictor": {
            "_target_": f"{_LEWM}.module.Predictor",
            "num_frames": predictor["history"],
            **dict.fromkeys(("input_dim", "hidden_dim", "output_dim"), width),
            **{field: predictor[field] for field in ("depth", "heads", "mlp_dim", "dim_head", "dropout")},
            "emb_dropout": 0.0,
        },
        "action_encoder": {
            "_target_": f"{_LEWM}.module.Embedder",
            "input_dim": predictor["action_dim"],
            "smoothed_dim": predictor["action_bottleneck"],
            "emb_dim": width,
        },
        "projector": _projector_config(encoder["width"], encoder["projector_dim"], encoder["latent_dim"]),
        "pred_proj": _projector_config(width, predictor["projector_dim"], predictor["latent_dim"]),
    }


class _Sizes:
    """Sizes of a checkpoint: the config's word, else a default, else the shape of a tensor."""

    def __init__(self, config: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
        self.config, self.tensors = config, tensors

    def __call__(self, field: str, tensor: str | None = None, axis: int = 0, *, default: int | None = None, of=int):
        part, _, name = field.partition(".")
        value = self.config[part].get(name)
        if value is None:
            value = default
        if value is None and tensor in self.tensors and self.tensors[tensor].ndim > axis:
            value = of(self.tensors[tensor].shape[axis])
        if not isinstance(value, int) or value < 1:
            wanted = f"the tensor {tensor} tells it" if tensor else "no tensor tells it"
            raise ValueError(f"config.json: {field} must be a positive integer, got {value!r} ({wanted}).")
        return value


def _check_part(part: str, fields: Any) -> None:
    """One section of the config asks for the network that ours is."""
    name = _class_name(fields)
    if name in ("None", "Identity") and part in ("projector", "pred_proj"):
        raise ValueError(f"config.json: the model was trained without {part!r}; ours always ends in a projector.")
    if not isinstance(fields, dict) or name not in _TARGETS[part]:
        raise ValueError(f"config.json: {part} must be a {' or '.join(_TARGETS[part])}, got {name}.")
    fixed, projector = _FIXED[part], part in ("projector", "pred_proj")
    unknown = sorted(fields.keys() - _READ[part] - fixed.keys() - {"_target_"})
    if unknown:
        raise ValueError(f"config.json: {part} has fields {unknown}, of which it is not known what they change.")
    given = {field: _class_name(fields[field]) if projector else fields[field] for field in fixed if field in fields}
    if projector:
        given.setdefault("norm_fn", "LayerNorm")  # the published class's own choice
    wrong = [f"{field}={value!r}, not {fixed[field]!r}" for field, value in given.items() if value != fixed[field]]
    if wrong:
        raise ValueError(f"config.json: {part} differs from our network ({'; '.join(wrong)}).")


def _class_name(node: Any) -> str:
    target = node.get("_target_", "no _target_") if isinstance(node, dict) else node
    return str(target).rpartition(".")[2]


def _count(tensors: dict[str, torch.Tensor], prefix: str) -> int:
    return len({name[len(prefix) :].partition(".")[0] for name in tensors if name.startswith(prefix)})


def _projector_config(in_dim: int, hidden_dim: int, out_dim: int) -> dict[str, Any]:
    return {
        "_target_": f"{_LEWM}.module.MLP",
        "input_dim": in_dim,
        "hidden_dim": hidden_dim,
        "output_dim": out_dim,
        "norm_fn": {"_target_": "torch.nn.BatchNorm1d", "_partial_": True},
    }


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
    """Reads an official LeWM checkpoint (arXiv 2603.19312), in eval mode and float32.

    Its encoder and predictor give the numbers of the published code. Two things are not in the files: the frame skip,
    5 in all published models, and the mean and std of raw actions. Without ``statistics`` the model keeps means of 0
    and stds of 1 and its planners would act in z-scores, so give those of the dataset it was trained on, or set
    ``model.statistics`` later.

    Tensors may bear the names of transformers 4 or 5, a prefix ``model.`` and a wrapper ``state_dict``, as a Lightning
    checkpoint does; buffers of the loss and a mask token are left out. Nothing in the file is executed.

    Args:
        path: a folder with ``config.json`` and one ``.pt`` file, or a file with ``config.json`` beside it.
        device: where the model goes.
        frame_skip: F, raw actions in one block.
        statistics: mean and std [A] of raw actions, environment units.

    Raises:
        FileNotFoundError: no such checkpoint, or no config.
        ValueError: several weight files; an object checkpoint; networks that ours cannot stand for; tensors that are
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

    Weights are written in float32, whatever precision the model is in. Action statistics and frame skip have no place
    in that format: keep them elsewhere.

    Args:
        model: with a vision transformer, and a predictor as wide as the latent.
        folder: made if missing; must hold no other ``.pt`` file, for the published loader refuses several.
        naming: ``"transformers4"``, as in the released weights, or ``"transformers5"``: the installed release of
            ``transformers`` decides which one the published loader wants.

    Returns:
        the folder.

    Raises:
        TypeError: networks other than the package's own.
        ValueError: an unknown naming, networks that LeWM cannot stand for, or other weights in the folder.
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
    """The weight file that a path means, and the configuration beside it."""
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
    """Tensors of a checkpoint under their bare published names; nothing in the file is executed."""
    size = require_regular_file(file).st_size
    try:
        _check_archive(file, size)
        content = torch.load(file, map_location="cpu", weights_only=True)
    # A damaged pickle raises whatever its instructions meet.
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
    # A tensor may repeat the bytes of its storage, and several may share one: copied, they would take more than the file.
    if any(value.device.type != "cpu" or value.layout != torch.strided or value.is_nested for value in tensors.values()):
        raise ValueError(f"{file} holds tensors that are not plain arrays: save the state_dict() of the model on the CPU.")
    need = sum(value.numel() * value.element_size() for value in tensors.values())
    if need > size:
        raise ValueError(f"{file} has {size} bytes, its tensors would take {need}: it is damaged, restore it.")
    check_numbers(tensors, file)
    return tensors


def _check_archive(file: Path, size: int) -> None:
    """Refuses an archive that unpacks to more than its size: PyTorch stores tensors as they are.

    Raises:
        ValueError: it does, or it is no archive, as PyTorch writes since 1.6.
    """
    with open(file, "rb") as content:  # an archive may be appended to anything, and PyTorch looks at the beginning
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
    """Our state, without action statistics, from published tensors, every one of which must have its place."""
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
