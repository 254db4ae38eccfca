"""Every loss, and its variants, around networks of a few hundred parameters, and clips of noise for them."""

from __future__ import annotations

from dataclasses import replace

import torch
from tensordict import TensorDict
from torch import nn

from torchrl_ficreg import FICRegLoss, InverseDynamicsModel, LeWMLoss, make_world_model, ModelConfig, SIGReg
from torchrl_ficreg.objectives import JointInverseLoss, PLDMLoss

SIZE, BLOCK, LATENT = 16, 6, 6  # pixels, width of an action block (2 actions of 3 dimensions), width of a latent
TINY = ModelConfig(
    encoder="conv",
    image_size=SIZE,
    frame_skip=2,
    latent_dim=LATENT,
    history=3,
    conv_channels=(4, 8),
    encoder_projector_dim=12,
    predictor_width=8,
    predictor_depth=2,
    predictor_heads=2,
    predictor_dim_head=4,
    predictor_mlp_dim=16,
    predictor_projector_dim=12,
    inverse_hidden_dim=16,
)
CONFIG = replace(TINY, history=2, predictor_dropout=0.5)

BASELINE = {
    "loss_pred": {"encoder": True, "predictor": True, "inverse_model": False},
    "loss_sigreg": {"encoder": True, "predictor": False, "inverse_model": False},
}
LEWM = {term: {name: row[name] for name in ("encoder", "predictor")} for term, row in BASELINE.items()}
DETACHED = {
    **BASELINE,
    "loss_idm": {"encoder": False, "predictor": False, "inverse_model": True},
    "loss_consistency": {"encoder": False, "predictor": True, "inverse_model": False},
}
LIVE = {**DETACHED, "loss_consistency": {"encoder": True, "predictor": True, "inverse_model": False}}
JOINT = {**BASELINE, "loss_idm": {"encoder": True, "predictor": False, "inverse_model": True}}
PLDM = {
    "loss_pred": BASELINE["loss_pred"],
    **{f"loss_{name}": BASELINE["loss_sigreg"] for name in ("var", "cov", "time_sim", "time_var", "time_cov")},
    "loss_idm": JOINT["loss_idm"],
}

# name: class, arguments, kind of the inverse model, which network receives gradient from which term
COLLECTION = {
    "lewm": (LeWMLoss, {}, None, LEWM),
    "lewm_two_steps": (LeWMLoss, {"prediction_steps": 2}, None, LEWM),
    "paper": (FICRegLoss, {}, "mlp", DETACHED),
    "live": (FICRegLoss, {"context": "live"}, "mlp", LIVE),
    "trusted": (FICRegLoss, {"consistency": "trusted"}, "mlp", DETACHED),
    "nll": (FICRegLoss, {"consistency": "nll"}, "gaussian", DETACHED),
    "ensemble": (FICRegLoss, {}, "ensemble", DETACHED),
    "transformer": (FICRegLoss, {}, "transformer", DETACHED),
    "judge": (FICRegLoss, {"consistency_target": "judge"}, "mlp", DETACHED),
    "two_steps": (FICRegLoss, {"consistency_steps": 2}, "mlp", DETACHED),
    "two_steps_live": (FICRegLoss, {"consistency_steps": 2, "context": "live"}, "mlp", LIVE),
    "diagnostics": (FICRegLoss, {"diagnostics": True}, "mlp", DETACHED),
    "joint": (JointInverseLoss, {}, "mlp", JOINT),
    "joint_bare": (JointInverseLoss, {"sigreg_coeff": 0.0}, "mlp", {k: JOINT[k] for k in ("loss_pred", "loss_idm")}),
    "pldm": (PLDMLoss, {"time_cov_coeff": 0.5, "idm_coeff": 1.0}, "mlp", PLDM),
}
LOSSES = ("lewm", "paper", "joint", "pldm")  # one of each class
FICREG = [name for name, entry in COLLECTION.items() if entry[0] is FICRegLoss]


def make_networks(dropout: float = 0.5, kind: str = "mlp") -> tuple[nn.Module, nn.Module, nn.Module]:
    """Encoder, predictor and inverse model; the same numbers at every call.

    All parameters are moved off their start values, where zeroed layers would hide paths of the gradient.
    """
    torch.manual_seed(0)
    model, inverse_model = make_world_model(replace(CONFIG, predictor_dropout=dropout), action_dim=3)
    with torch.no_grad():
        for param in [*model.parameters(), *inverse_model.parameters()]:
            param.add_(0.1 * torch.randn_like(param))
    if kind != "mlp":
        inverse_model = InverseDynamicsModel(LATENT, BLOCK, 16, kind=kind, **({"history": 2} if kind == "transformer" else {}))
    return model.encoder, model.predictor, inverse_model


def make_loss(name: str, dropout: float = 0.5, **arguments) -> nn.Module:
    """The loss of that name in ``COLLECTION``, always with the same numbers."""
    make, defaults, kind, _ = COLLECTION[name]
    networks = make_networks(dropout, kind or "mlp")[: 2 if kind is None else 3]
    if make is not PLDMLoss:
        arguments.setdefault("sigreg", SIGReg(16))
    return make(*networks, **{**defaults, **arguments})


def noise(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """Standard normal numbers, the same at every call."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def make_clip(*lead: int, frames: int = 3, seed: int = 0) -> TensorDict:
    """A clip [*lead, frames] of noise, [8, frames] when no lead is given."""
    generator = torch.Generator().manual_seed(seed)
    shape = (*(lead or (8,)), frames)
    pixels = torch.randint(0, 256, (*shape, 3, SIZE, SIZE), dtype=torch.uint8, generator=generator)
    return TensorDict({"pixels": pixels, "action": torch.randn(*shape, BLOCK, generator=generator)}, shape)


def make_mask(*lead: int, frames: int = 3) -> torch.Tensor:
    """[*lead, frames] bool, false for some action blocks."""
    return torch.rand(*(lead or (8,)), frames, generator=torch.Generator().manual_seed(0)) > 0.4


def call(loss: nn.Module, *args, **kwargs):
    """One call under one seed, with the first directions of SIGReg."""
    torch.manual_seed(0)
    if hasattr(loss, "sigreg"):
        loss.sigreg.generator_state[1] = 0
    return loss(*args, **kwargs)


def total(output: TensorDict) -> torch.Tensor:
    """The objective: the plain sum of all terms."""
    return sum(value.sum() for key, value in output.items() if key.startswith("loss"))


def coefficients(loss: nn.Module) -> list[str]:
    """Names of the coefficients of its terms."""
    return sorted(name for name, _ in loss.named_buffers() if name.endswith("_coeff"))


def gradients(loss: nn.Module, clip: TensorDict, *terms: str) -> dict[str, list[torch.Tensor | None]]:
    """Gradients of the parameters of each network from some terms, from all by default."""
    loss.zero_grad()
    output = call(loss, clip)
    total(output.select(*terms) if terms else output).backward()
    return {name: [param.grad for param in getattr(loss, name).parameters()] for name in loss._networks}


def all_equal(ours, theirs) -> bool:
    """Whether two sequences of tensors are the same to the last bit."""
    return all(one.equal(other) for one, other in zip(ours, theirs, strict=True))
