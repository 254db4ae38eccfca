"""Configuration of a world model: its sizes, named presets, and :func:`make_world_model`, which builds it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import get_args, Literal

from torchrl_ficreg.modules.conv import ConvEncoder
from torchrl_ficreg.modules.inverse import INVERSE_NETWORKS, InverseDynamicsModel
from torchrl_ficreg.modules.keypoints import KeypointEncoder
from torchrl_ficreg.modules.predictor import CausalPredictor
from torchrl_ficreg.modules.vit import Init, ViTEncoder
from torchrl_ficreg.modules.world_model import LatentWorldModel


@dataclass(frozen=True)
class ModelConfig:
    """All sizes of the package's networks, apart from the action dimension of the environment.

    The comment of each field says what it is.

    Raises:
        ValueError: an unknown encoder or a size that is not positive.
    """

    encoder: Literal["vit", "conv", "keypoint"] = "vit"
    image_size: int = 224  # H = W of the frames, pixels
    frame_skip: int = 5  # F, environment steps between two frames of a clip
    latent_dim: int = 192  # D
    history: int = 3  # H, most latents that the predictor takes at once
    encoder_init: Literal["torch", "published"] = "torch"  # of the "vit" encoder, see :class:`VisionTransformer`
    conv_channels: tuple[int, ...] = (16, 32, 64, 128)  # of the "conv" encoder; each layer halves the frame
    encoder_projector_dim: int = 2048  # hidden width of the BatchNorm projector of the "vit" and "conv" encoders
    keypoint_channels: tuple[int, ...] = (32, 32, 32)  # of the "keypoint" encoder's patches and two convolutions
    num_keypoints: int = 32  # maps of the "keypoint" encoder
    predictor_width: int = 192
    predictor_depth: int = 6
    predictor_heads: int = 16
    predictor_dim_head: int = 64
    predictor_mlp_dim: int = 2048
    predictor_projector_dim: int = 2048
    predictor_dropout: float = 0.1
    predictor_attention_dropout: float = 0.0  # of the attention weights; the published predictor has 0.1
    predictor_position_std: float = 0.02  # of the position embedding at the start; the published predictor has 1.0
    inverse_kind: Literal["mlp", "gaussian", "ensemble", "transformer"] = "mlp"
    inverse_hidden_dim: int = 512  # hidden width of the inverse dynamics model

    def __post_init__(self) -> None:
        for name in ("conv_channels", "keypoint_channels"):
            object.__setattr__(self, name, tuple(getattr(self, name)))  # JSON and YAML have lists only
        if self.encoder not in ("vit", "conv", "keypoint"):
            raise ValueError(f"unknown encoder {self.encoder!r}: choose 'vit', 'conv' or 'keypoint'.")
        if self.encoder_init not in get_args(Init):
            raise ValueError(f"unknown encoder_init {self.encoder_init!r}: choose one of {get_args(Init)}.")
        if self.inverse_kind not in INVERSE_NETWORKS:
            raise ValueError(f"unknown inverse_kind {self.inverse_kind!r}: choose one of {sorted(INVERSE_NETWORKS)}.")
        shares = ("predictor_dropout", "predictor_attention_dropout")
        others = (*shares, "predictor_position_std")
        sizes = {n: value for n, value in asdict(self).items() if not isinstance(value, (str, float)) and n not in others}
        sizes = {name: value if isinstance(value, tuple) else (value,) for name, value in sizes.items()}
        small = [name for name, values in sizes.items() if min(values, default=0) < 1]
        if small:
            raise ValueError(f"model sizes must be positive, got {', '.join(f'{n}={getattr(self, n)}' for n in small)}.")
        for name in shares:
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must lie in [0, 1), got {getattr(self, name)}.")
        if not self.predictor_position_std >= 0:
            raise ValueError(f"predictor_position_std must not be negative, got {self.predictor_position_std}.")

    @classmethod
    def preset(cls, name: str, **changes) -> ModelConfig:
        """A named configuration, with some fields changed.

        Args:
            name (str): ``"paper"``, ViT-Tiny/14 at 224 pixels (18.0 M parameters in the world model, arXiv 2603.19312) with
                the initialisation of the published code; ``"gpu_short"``, the same at 112 pixels; or ``"cpu"``, a
                keypoint encoder at 64 pixels and a small predictor, which train in minutes on two cores.
            **changes: fields with other values.

        Raises:
            ValueError: an unknown name, or a value out of range.
        """
        if name not in PRESETS:
            raise ValueError(f"unknown preset {name!r}: choose one of {sorted(PRESETS)}.")
        return replace(PRESETS[name], **changes)


_PAPER = ModelConfig(encoder_init="published", predictor_attention_dropout=0.1, predictor_position_std=1.0)
PRESETS = {
    "paper": _PAPER,
    "gpu_short": replace(_PAPER, image_size=112),
    "cpu": ModelConfig(
        encoder="keypoint",
        image_size=64,
        latent_dim=16,
        predictor_width=96,
        predictor_depth=3,
        predictor_heads=4,
        predictor_dim_head=32,
        predictor_mlp_dim=256,
        predictor_projector_dim=256,
        predictor_dropout=0.0,
    ),
}


def make_world_model(config: ModelConfig, action_dim: int) -> tuple[LatentWorldModel, InverseDynamicsModel]:
    """Builds a world model and an inverse dynamics model of the package's own networks.

    Args:
        config (ModelConfig): sizes; see :meth:`ModelConfig.preset`.
        action_dim (int): A, action dimension of the environment.

    Returns:
        the world model and the inverse dynamics model, in training mode.

    Examples:
        >>> model, _ = make_world_model(ModelConfig.preset("paper"), action_dim=2)
        >>> sum(p.numel() for p in model.parameters())
        18034478
    """
    block = config.frame_skip * action_dim
    sizes = {"image_size": config.image_size, "latent_dim": config.latent_dim}
    if config.encoder == "vit":
        encoder = ViTEncoder(projector_dim=config.encoder_projector_dim, init=config.encoder_init, **sizes)
    elif config.encoder == "conv":
        encoder = ConvEncoder(channels=config.conv_channels, projector_dim=config.encoder_projector_dim, **sizes)
    else:
        encoder = KeypointEncoder(
            channels=config.keypoint_channels, num_keypoints=config.num_keypoints, **sizes
        )
    predictor = CausalPredictor(
        latent_dim=config.latent_dim,
        action_dim=block,
        history=config.history,
        width=config.predictor_width,
        depth=config.predictor_depth,
        heads=config.predictor_heads,
        dim_head=config.predictor_dim_head,
        mlp_dim=config.predictor_mlp_dim,
        dropout=config.predictor_dropout,
        attention_dropout=config.predictor_attention_dropout,
        projector_dim=config.predictor_projector_dim,
        position_std=config.predictor_position_std,
    )
    extra = {"history": config.history} if config.inverse_kind == "transformer" else {}
    inverse_model = InverseDynamicsModel(
        config.latent_dim, block, config.inverse_hidden_dim, kind=config.inverse_kind, **extra
    )
    return LatentWorldModel(encoder, predictor, frame_skip=config.frame_skip), inverse_model
