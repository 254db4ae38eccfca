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
def test_the_published_table_has_303_tensors(naming):
    """The counts of the released PushT weights, and with them those of our paper preset."""
    shapes = published_shapes("paper", naming)
    assert len(shapes) == 303
    state = {name: torch.Size(shape).numel() for name, shape in shapes.items()}
    buffers = [name for name in state if "running" in name or "tracked" in name]
    assert sum(state.values()) - sum(state[name] for name in buffers) == 18_034_478
    assert sum(name.startswith("encoder.") for name in shapes) == 198
    assert sum(name.startswith("predictor.") for name in shapes) == 81
    assert sum(name.startswith("action_encoder.") for name in shapes) == 6


@pytest.mark.parametrize("naming", ENCODER_NAMES)
def test_the_paper_preset_is_written_as_the_published_table(naming, tmp_path):
    """Every name, shape and dtype, and the config's every field."""
    model, _ = make_world_model(ModelConfig.preset("paper"), action_dim=2)
    save_lewm(model, tmp_path, naming=naming)
    tensors = torch.load(tmp_path / "weights.pt", weights_only=True)
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
    assert not tiny.training
    assert tiny.frame_skip == 5
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


def test_statistics_are_the_callers(tmp_path):
    folder = write(tmp_path, weights("tiny"))
    statistics = ActionStatistics(torch.tensor([-0.0087, 0.0068]), torch.tensor([0.2019, 0.2002]))
    assert torch.equal(load_lewm(folder, statistics=statistics).action_std, statistics.std)
    with pytest.raises(ValueError, match="acts in 2 dimensions, the statistics have 5"):
        load_lewm(folder, statistics=ActionStatistics(torch.zeros(5), torch.ones(5)))


def test_the_frame_skip_divides_the_block(tmp_path):
    folder = write(tmp_path, weights("tiny"))
    assert len(load_lewm(folder, frame_skip=2).action_mean) == 5
    with pytest.raises(ValueError, match="width 10 is no multiple of frame_skip 3"):
        load_lewm(folder, frame_skip=3)


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
    ],
)
def test_networks_that_ours_cannot_stand_for_are_refused(part, change, message, tmp_path):
    config = published_config("tiny")
    config[part] = change if change is None or change.get("_target_", "").startswith("torch") else config[part] | change
    with pytest.raises(ValueError, match=message):
        load_lewm(write(tmp_path, weights("tiny"), config))


def test_another_model_is_refused(tmp_path):
    config = published_config("tiny") | {"_target_": "stable_worldmodel.wm.pldm.PLDM"}
    with pytest.raises(ValueError, match="asks for PLDM, not for a LeWM or JEPA"):
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


@pytest.mark.parametrize("wrap", [lambda trap: trap, lambda trap: weights("tiny") | {"extra": trap}])
def test_a_pickle_is_never_executed(wrap, tmp_path):
    trap = tmp_path / "sprung"
    with pytest.raises(ValueError, match="is no plain state dict.*refused, since reading them runs their code"):
        load_lewm(write(tmp_path / "folder", wrap(Trap(trap))))
    assert not trap.exists()


def test_an_object_checkpoint_is_refused(tmp_path):
    with pytest.raises(ValueError, match="Whole pickled modules .* are refused"):
        load_lewm(write(tmp_path, torch.nn.Linear(2, 2)))


def test_an_archive_behind_a_pickle_does_not_let_it_through(tmp_path):
    """PyTorch reads such a file as the older format, whose sizes nothing bounds."""
    path = write(tmp_path, weights("tiny"), published_config("tiny"))
    file = next(path.glob("*.pt")) if path.is_dir() else path
    torch.save(weights("tiny"), file, _use_new_zipfile_serialization=False)
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("x", b"y")
    with pytest.raises(ValueError, match="no archive of PyTorch"):
        load_lewm(path)


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
    tensors = weights(case, naming)
    save_lewm(load_lewm(write(tmp_path / "theirs", tensors, published_config(case))), tmp_path / "ours", naming=naming)
    back = torch.load(tmp_path / "ours" / "weights.pt", weights_only=True)
    assert back.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert torch.equal(back[name], tensor) and back[name].dtype == tensor.dtype, name
    assert json.loads((tmp_path / "ours" / "config.json").read_text()) == published_config(case)


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


@pytest.mark.parametrize("change", ["shared", "repeated", "meta", "integer", "complex", "nan", "float8", "nested", "too large"])
def test_tensors_of_other_kinds_than_weights_are_refused(tiny, change, tmp_path):
    tensors = weights("tiny")
    name = "predictor.pos_embedding"
    if change == "shared":
        whole = torch.zeros(10**5)
        tensors |= {f"extra{i}": whole for i in range(200)}
    else:
        tensors[name] = {
            "repeated": torch.zeros(1).expand(10**4, 10**4),
            "meta": tensors[name].to("meta"),
            "integer": tensors[name].int(),
            "complex": tensors[name].to(torch.complex64),
            "nan": tensors[name] / 0,
            "float8": (tensors[name] / 0).to(torch.float8_e5m2),
            "nested": torch.nested.nested_tensor([tensors[name]]),
            "too large": torch.full_like(tensors[name], 1e300, dtype=torch.float64),
        }[change]
    with pytest.raises(ValueError, match="would take|not plain arrays|has dtype|holds a NaN") as caught:
        load_lewm(write(tmp_path, tensors, published_config("tiny")))
    assert "\n" not in str(caught.value)
