"""Official LeWM checkpoints give, in our modules, the numbers of the published code, and are written back as they were.

Networks that ours do not have are refused by name, and no code in a file is executed. The golden tensors were computed by
the published code (``test/pretrained/golden/make_lewm.py``) from weights and inputs by formula.
"""

from __future__ import annotations

import json
import os
import time
import zipfile
from pathlib import Path

import pytest
import torch
from checkpoints import assert_same, write
from golden.formula import ENCODER_NAMES, inputs, published_config, published_shapes, weights

from torchrl_ficreg import make_world_model, ModelConfig
from torchrl_ficreg.data import ActionStatistics
from torchrl_ficreg.pretrained import load_lewm, save_lewm
from torchrl_ficreg.pretrained.folder import build_world_model, world_model_sizes

GOLDEN = Path(__file__).parent / "golden"
LOSS_BUFFERS = {"sigreg.t": torch.ones(17), "sigreg.phi": torch.ones(17), "sigreg.weights": torch.ones(17)}


@pytest.mark.parametrize("naming", ENCODER_NAMES)
def test_the_paper_preset_is_written_as_the_published_table(naming, tmp_path):
    """Each of the 303 names, every shape and dtype, and the config's every field."""
    model, _ = make_world_model(ModelConfig.preset("paper"), action_dim=2)
    save_lewm(model, tmp_path, naming=naming)
    tensors = torch.load(tmp_path / "weights.pt", weights_only=True)
    assert len(tensors) == 303
    assert {name: tuple(tensor.shape) for name, tensor in tensors.items()} == published_shapes("paper", naming)
    integers = {name for name, tensor in tensors.items() if tensor.dtype != torch.float32}
    assert integers == {"projector.net.1.num_batches_tracked", "pred_proj.net.1.num_batches_tracked"}
    assert {tensors[name].dtype for name in integers} == {torch.int64}
    published = published_config("paper")
    published["action_encoder"]["smoothed_dim"] = 10  # the class's default, spelled out
    assert json.loads((tmp_path / "config.json").read_text()) == published


@pytest.mark.parametrize(
    ("case", "naming"),
    [("paper", "transformers4"), *((case, naming) for case in ("tiny", "intact") for naming in ENCODER_NAMES)],
)
def test_outputs_are_those_of_the_published_forward_pass(case, naming, tmp_path):
    """Encoder, action encoder, predictor on 1 to H latents, and a rollout whose window grows from one and slides."""
    model = load_lewm(write(tmp_path, weights(case, naming), published_config(case)))
    golden, given = torch.load(GOLDEN / f"lewm_{case}.pt", weights_only=True), inputs(case)
    with torch.no_grad():
        latent = model.encode(given["pixels"])
        ours = {
            "latent": latent,
            "action_embedding": model.predictor.module.action_embedding(given["action"]),
            "rollout": model.rollout(latent[:, None], given["action"]),
        }
        for seen in range(1, model.history + 1):
            ours[f"predicted_{seen}"] = model.predict(given["latent"][:, :seen], given["action"][:, :seen])
    assert ours.keys() == golden.keys()
    assert min(value.std() for value in golden.values()) > 0.1  # else 1e-5 would prove nothing
    for name, expected in golden.items():
        torch.testing.assert_close(ours[name], expected, rtol=0, atol=1e-5, msg=f"{name} differs")


def test_a_loaded_model_is_the_paper_preset_in_eval_mode(tiny):
    assert not tiny.training and tiny.frame_skip == 5
    assert tiny.action_mean.tolist() == [0, 0] and tiny.action_std.tolist() == [1, 1]
    assert [block.attn_norm.eps for block in tiny.encoder.module.blocks] == [1e-12] * 2
    assert tiny.encoder.module.projector.norm.num_batches_tracked == 1234


@pytest.mark.parametrize("naming", ENCODER_NAMES)
@pytest.mark.parametrize(
    "wrap",
    [
        lambda tensors: {f"model.{name}": tensor for name, tensor in tensors.items()},
        lambda tensors: {"state_dict": tensors, "epoch": 3},
        lambda tensors: {"model": tensors},
        lambda tensors: {"state_dict": {f"model.{name}": t for name, t in tensors.items()} | LOSS_BUFFERS},
        lambda tensors: tensors | {f"model.{name}": tensor for name, tensor in LOSS_BUFFERS.items()},
        lambda tensors: {f"model._orig_mod.{name}": tensor for name, tensor in tensors.items()},
        lambda tensors: tensors | {"encoder.embeddings.mask_token": torch.ones(1, 1, 24)},
    ],
    ids=["prefix", "state_dict", "model", "lightning", "loss buffers", "compiled", "mask token"],
)
def test_wrappings_of_a_checkpoint_do_not_matter(wrap, naming, tiny, tmp_path):
    assert_same(load_lewm(write(tmp_path, wrap(weights("tiny", naming)))), tiny)


def test_a_file_may_be_named_where_there_are_several(tiny, tmp_path):
    for epoch in (1, 2):
        write(tmp_path, weights("tiny"), name=f"weights_epoch_{epoch}.pt")
    with pytest.raises(ValueError, match=r"2 weight files \(weights_epoch_1.pt, weights_epoch_2.pt\): give the path"):
        load_lewm(tmp_path)
    assert_same(load_lewm(tmp_path / "weights_epoch_2.pt"), tiny)


def test_statistics_and_frame_skip_are_the_callers(tmp_path):
    folder = write(tmp_path, weights("tiny"))
    statistics = ActionStatistics(torch.tensor([-0.0087, 0.0068]), torch.tensor([0.2019, 0.2002]))
    assert torch.equal(load_lewm(folder, statistics=statistics).action_std, statistics.std)
    assert len(load_lewm(folder, frame_skip=2).action_mean) == 5


def test_a_first_action_layer_as_wide_as_the_block_is_read(tmp_path):
    """Some cube models keep 25 actions at 25: (25, 25, 1) and (768, 25)."""
    config = published_config("intact")
    del config["action_encoder"]["smoothed_dim"]
    embedding = load_lewm(write(tmp_path, weights("intact"), config)).predictor.module.action_embedding
    assert embedding.compress.weight.shape == (25, 25)
    assert embedding.layer_in.weight.shape == (768, 25)


def test_sizes_that_the_config_leaves_out_are_read_off_the_tensors(tiny, tmp_path):
    config = published_config("tiny")
    for part, fields in {
        "encoder": ("image_size", "patch_size"),
        "predictor": ("num_frames", "input_dim", "hidden_dim", "output_dim", "depth", "mlp_dim"),
        "action_encoder": ("input_dim", "smoothed_dim", "emb_dim"),
        "projector": ("input_dim", "hidden_dim", "output_dim"),
        "pred_proj": ("input_dim", "hidden_dim", "output_dim"),
    }.items():
        for field in fields:
            del config[part][field]
    assert world_model_sizes(load_lewm(write(tmp_path, weights("tiny"), config))) == world_model_sizes(tiny)


def test_names_of_the_papers_release_and_a_whole_runs_config_are_understood(tiny, tmp_path):
    config = published_config("tiny") | {"_target_": "jepa.JEPA", "embed_dim": 20, "history_size": 3}
    config["predictor"]["_target_"] = "module.ARPredictor"
    assert_same(load_lewm(write(tmp_path, weights("tiny"), {"model": config, "seed": 1})), tiny)


# Refusals


def without(name):
    return lambda tensors: tensors.pop(name)


def changed(name, tensor):
    return lambda tensors: tensors.update({name: tensor})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without("pred_proj.net.1.running_var"), r"1 missing \(pred_proj.net.1.running_var\)"),
        (without("encoder.encoder.layer.1.output.dense.bias"), r"1 missing \(encoder.encoder.layer.1.output.dense.b"),
        (changed("encoder.pooler.dense.weight", torch.ones(2)), r"1 unexpected \(encoder.pooler.dense.weight\)"),
        (
            changed("predictor.pos_embedding", torch.ones(1, 4, 20)),
            r"1 of another shape \(predictor.pos_embedding \(1, 4, 20\) instead of \(1, 3, 20\)\)",
        ),
        (changed("action_encoder.patch_embed.weight", torch.ones(6, 10)), r"\(6, 10\) instead of \(6, 10, 1\)"),
        (changed("encoder.layernorm.weight", 3), "'encoder.layernorm.weight' is a int, no tensor"),
        (changed("model.encoder.layernorm.weight", torch.ones(24)), "'encoder.layernorm.weight' comes twice"),
    ],
)
def test_tensors_that_do_not_fit_are_named(damage, message, tmp_path):
    tensors = weights("tiny")
    damage(tensors)
    with pytest.raises(ValueError, match=message):
        load_lewm(write(tmp_path, tensors))


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("projector", None, "trained without 'projector'"),
        ("pred_proj", {"_target_": "torch.nn.Identity"}, "trained without 'pred_proj'"),
        ("projector", {"norm_fn": {"_target_": "torch.nn.LayerNorm"}}, "norm_fn='LayerNorm', not 'BatchNorm1d'"),
        ("pred_proj", {"act_fn": {"_target_": "torch.nn.ReLU"}}, "act_fn='ReLU', not 'GELU'"),
        ("encoder", {"_target_": "timm.create_model"}, "encoder must be a vit_hf, got create_model"),
        ("encoder", {"size": "giant"}, "encoder.size must be one of .*got 'giant'"),
        ("encoder", {"layer_norm_eps": 1e-6}, "encoder differs from our network .*layer_norm_eps=1e-06, not 1e-12"),
        ("encoder", {"pooler_act": "tanh"}, r"encoder has fields \['pooler_act'\]"),
        ("predictor", {"emb_dropout": 0.1}, "emb_dropout=0.1, not 0.0"),
        ("predictor", {"output_dim": 40}, "width 20 between latents of width 20 and 40"),
        ("predictor", {"heads": None}, "predictor.heads must be a positive integer, got None"),
        ("predictor", {"depth": "3"}, "predictor.depth must be a positive integer, got '3'"),
        ("predictor", {"depth": 2}, "13 unexpected .*layers.2"),
        ("action_encoder", {"mlp_scale": 2}, "mlp_scale=2, not 4"),
        ("_target_", "stable_worldmodel.wm.pldm.PLDM", "asks for PLDM, not for a LeWM or JEPA"),
    ],
)
def test_networks_that_ours_cannot_stand_for_are_refused(part, change, message, tmp_path):
    config = published_config("tiny")
    whole = not isinstance(change, dict) or change.get("_target_", "").startswith("torch")
    config[part] = change if whole else config[part] | change
    with pytest.raises(ValueError, match=message):
        load_lewm(write(tmp_path, weights("tiny"), config))


def test_what_is_not_there_is_said(tmp_path):
    with pytest.raises(FileNotFoundError, match="no LeWM checkpoint at"):
        load_lewm(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="no .pt file in"):
        load_lewm(tmp_path)
    folder = write(tmp_path, weights("tiny"))
    (folder / "config.json").write_text("{")
    with pytest.raises(ValueError, match="is not JSON"):
        load_lewm(folder)
    (folder / "config.json").unlink()
    with pytest.raises(FileNotFoundError, match="no config.json beside"):
        load_lewm(folder)


class Trap:
    """Makes a file when unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda trap: trap, "is no plain state dict.*refused, since reading them runs their code"),
        (lambda trap: weights("tiny") | {"extra": trap}, "is no plain state dict.*refused, since reading them runs their code"),
        (lambda _: torch.nn.Linear(2, 2), "Whole pickled modules .* are refused"),
    ],
)
def test_a_pickle_is_never_executed(wrap, message, tmp_path):
    trap = tmp_path / "sprung"
    with pytest.raises(ValueError, match=message):
        load_lewm(write(tmp_path / "folder", wrap(Trap(trap))))
    assert not trap.exists()


def test_an_archive_behind_a_pickle_does_not_let_it_through(tmp_path):
    """PyTorch reads such a file as the older format, whose sizes nothing bounds."""
    folder = write(tmp_path, weights("tiny"))
    torch.save(weights("tiny"), folder / "weights.pt", _use_new_zipfile_serialization=False)
    with zipfile.ZipFile(folder / "weights.pt", "a") as archive:
        archive.writestr("x", b"y")
    with pytest.raises(ValueError, match="no archive of PyTorch"):
        load_lewm(folder)


@pytest.mark.parametrize("content", [b"", b"not a checkpoint"])
def test_a_damaged_file_is_refused(content, tmp_path):
    folder = write(tmp_path, weights("tiny"))
    (folder / "weights.pt").write_bytes(content)
    with pytest.raises(ValueError, match="is no plain state dict"):
        load_lewm(folder)


# Writing


@pytest.mark.parametrize("naming", ENCODER_NAMES)
@pytest.mark.parametrize("case", ["tiny", "intact"])
def test_a_published_checkpoint_comes_back_bit_for_bit(case, naming, tmp_path):
    tensors, ours = weights(case, naming), tmp_path / "ours"
    save_lewm(load_lewm(write(tmp_path / "theirs", tensors, published_config(case))), ours, naming=naming)
    assert_same(torch.load(ours / "weights.pt", weights_only=True), tensors)
    assert json.loads((ours / "config.json").read_text()) == published_config(case)


def test_a_half_precision_model_is_written_in_float32(tiny, tmp_path):
    half = build_world_model(world_model_sizes(tiny))
    half.load_state_dict(tiny.state_dict())
    half.bfloat16()
    back = load_lewm(save_lewm(half, tmp_path))
    assert {tensor.dtype for tensor in back.parameters()} == {torch.float32}
    assert torch.equal(back.predictor.module.position, half.predictor.module.position.float())
    assert half.predictor.module.position.dtype == torch.bfloat16


def test_the_published_loader_finds_one_weight_file(tiny, tmp_path):
    write(tmp_path, {}, name="weights_epoch_1.pt")
    with pytest.raises(ValueError, match=r"holds other weights \(weights_epoch_1.pt\)"):
        save_lewm(tiny, tmp_path)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"encoder": "conv"}, "holds a vision transformer, this model a 'conv' encoder"),
        ({"encoder": "vit", "image_size": 14}, "this one is 8 wide, for latents of 6"),
        (
            {"encoder": "vit", "image_size": 14, "latent_dim": 8, "predictor_heads": 1, "predictor_dim_head": 8},
            "a single head has the full width",
        ),
    ],
)
def test_models_that_lewm_cannot_stand_for_are_not_written(tiny_world, sizes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        save_lewm(tiny_world(**sizes), tmp_path)
    assert not list(tmp_path.iterdir())


def test_foreign_networks_and_namings_are_refused(linear_world, tiny, tmp_path):
    with pytest.raises(TypeError, match=r"own networks .* \(ConvNetwork, KeypointNetwork, VisionTransformer\), got Corner"):
        save_lewm(linear_world(), tmp_path)
    with pytest.raises(ValueError, match="naming must be 'transformers4' or 'transformers5', got 'timm'"):
        save_lewm(tiny, tmp_path, naming="timm")


# Damaged and hostile files


@pytest.mark.parametrize(("part", "field"), [("predictor", "depth"), ("predictor", "heads"), ("encoder", "image_size")])
@pytest.mark.parametrize("size", [10**6, 10**9, -1])
def test_sizes_of_a_lewm_config_that_the_weights_do_not_have_take_no_memory(tiny, part, field, size, tmp_path, at_most):
    config = published_config("tiny")
    config[part][field] = size
    path = write(tmp_path, weights("tiny"), config)
    began = time.monotonic()
    with pytest.raises(ValueError, match="cannot be read as a LeWM checkpoint") as caught:
        load_lewm(path)
    assert time.monotonic() - began < 5 and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        lambda weight: torch.zeros(1).expand(10**4, 10**4),
        lambda weight: weight.to("meta"),
        lambda weight: weight.int(),
        lambda weight: weight.to(torch.complex64),
        lambda weight: weight / 0,
        lambda weight: (weight / 0).to(torch.float8_e5m2),
        lambda weight: torch.nested.nested_tensor([weight]),
        lambda weight: torch.full_like(weight, 1e300, dtype=torch.float64),
        None,
    ],
    ids=["repeated", "meta", "integer", "complex", "nan", "float8", "nested", "too large", "shared"],
)
def test_tensors_of_other_kinds_than_weights_are_refused(change, tmp_path):
    tensors, shared = weights("tiny"), torch.zeros(10**5)
    if change is None:
        tensors |= {f"extra{i}": shared for i in range(200)}
    else:
        tensors["predictor.pos_embedding"] = change(tensors["predictor.pos_embedding"])
    with pytest.raises(ValueError, match="would take|not plain arrays|has dtype|holds a NaN") as caught:
        load_lewm(write(tmp_path, tensors))
    assert "\n" not in str(caught.value)
