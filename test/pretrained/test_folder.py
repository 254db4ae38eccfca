"""A model saved in the package's own format comes back as it was; damaged and inconsistent folders are refused."""

from __future__ import annotations

import errno
import json
import os
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import torch
from checkpoints import assert_same, small_lewm

from torchrl_ficreg import GoalPolicy, InverseDynamicsModel
from torchrl_ficreg.data import ActionStatistics
from torchrl_ficreg.modules.goal_policy import load_goal_policy, save_goal_policy
from torchrl_ficreg.pretrained import load_lewm, load_pretrained, save_lewm, save_pretrained

pytest.importorskip("safetensors", reason="safetensors is not installed: torchrl_ficreg[pretrained]")

CARD = {
    "model": {"image_size": 16, "latent_dim": 6},
    "env": "two_room",
    "env_kwargs": {"noise": 0.1},
    "action_low": [-1.0, -1.0],
    "action_high": [1.0, 1.0],
    "config": {"seed": 3},
}


@pytest.mark.parametrize("kind", ["mlp", "gaussian", "ensemble", "transformer"])
def test_a_model_its_inverse_model_and_its_card_come_back_as_they_were(tiny_world, kind, tmp_path):
    model = tiny_world()
    model.statistics = ActionStatistics(torch.tensor([0.1, -2.0]), torch.tensor([0.3, 1 / 3]))
    extra = {"history": 3, "heads": 2} if kind == "transformer" else {}
    inverse_model = InverseDynamicsModel(6, 4, 16, 0.25, kind=kind, **extra)
    back, same_inverse_model, card = load_pretrained(save_pretrained(model, tmp_path, inverse_model, CARD))
    assert_same(back, model)
    assert_same(same_inverse_model, inverse_model)
    assert card == CARD
    assert (back.training, same_inverse_model.training, back.frame_skip) == (False, False, 2)
    assert str(same_inverse_model.module) == str(inverse_model.module)  # dropout and heads included
    assert sorted(file.name for file in tmp_path.iterdir()) == ["config.json", "model.safetensors"]


def test_a_lewm_model_of_any_size_can_be_kept_with_a_config_for_reading(tiny, tmp_path):
    back, inverse_model, card = load_pretrained(save_pretrained(tiny, tmp_path))
    assert_same(back, tiny)
    assert (inverse_model, card) == (None, {})
    content = json.loads((tmp_path / "config.json").read_text())
    assert (content["format"], content["version"]) == ("torchrl_ficreg.world_model", 1)
    assert content["world_model"]["predictor"]["history"] == 3
    assert content["statistics"] == {"mean": [0.0, 0.0], "std": [1.0, 1.0]}


def edited(**changes):
    return lambda content: content.update(changes)


def edit(config: Path, change) -> None:
    content = json.loads(config.read_text())
    change(content)
    config.write_text(json.dumps(content))


@pytest.fixture(params=["pretrained", "policy"])
def stored(request, tiny_world, tmp_path):
    """Both formats on one layout: the file of weights, the configuration beside it, and what loads the folder."""
    world_model = tiny_world()
    if request.param == "policy":
        save_goal_policy(GoalPolicy(6, 4, hidden_dim=16, depth=2), tmp_path, world_model)
        return tmp_path / "policy.safetensors", tmp_path / "policy.json", partial(load_goal_policy, world_model=world_model)
    save_pretrained(world_model, tmp_path)
    return tmp_path / "model.safetensors", tmp_path / "config.json", load_pretrained


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda _, config: edit(config, edited(version=2)), ValueError, "version 2, this release reads 1: update"),
        (lambda _, config: edit(config, edited(format="other")), ValueError, "is not of the format 'torchrl_ficreg"),
        (lambda _, config: config.write_text("{"), ValueError, "json is not JSON"),
        (lambda _, config: config.unlink(), FileNotFoundError, "no .*json in .*: give a folder that save_.* wrote"),
        (lambda weights, _: weights.write_bytes(weights.read_bytes()[:-10]), ValueError, "safetensors is damaged"),
        (lambda weights, _: weights.unlink(), FileNotFoundError, "no .*safetensors in .*: give a folder that save_.* wrote"),
    ],
    ids=["version", "format", "no JSON", "no configuration", "truncated", "no weights"],
)
def test_missing_and_damaged_files_are_named(stored, change, error, message):
    weights, config, load = stored
    change(weights, config)
    with pytest.raises(error, match=message):
        load(weights.parent)


def test_a_flipped_byte_anywhere_is_found(stored):
    weights, config, load = stored
    whole = weights.read_bytes()
    for at in range(0, len(whole), len(whole) // 10):
        weights.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(ValueError, match="safetensors|does not fit|belong together"):
            load(weights.parent)
    weights.write_bytes(whole)
    edit(config, lambda content: content.pop("weights_sha256"))  # as folders of earlier releases
    load(weights.parent)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (edited(statistics={"mean": [9.0, 0.0], "std": [1.0, 1.0]}), "hold different statistics"),
        (lambda content: content.pop("world_model"), "does not describe a world model"),
        (lambda content: content["world_model"]["encoder"].update(kind="timm"), "does not describe a world model"),
        (lambda content: content["world_model"]["predictor"].update(depth=1), "13 tensors are missing, left over or"),
        (lambda content: content["world_model"]["predictor"].update(mlp_dim=17), "6 tensors are missing, left .*mlp.0"),
        (edited(inverse_model=None), "tensors are missing, left over .*: inverse_model.module.layers.0.bias"),
        *((edited(card=card), "card must be a JSON object") for card in (None, [], "two_room")),
    ],
)
def test_files_that_do_not_belong_together_are_refused(tiny_world, change, message, tmp_path):
    save_pretrained(tiny_world(), tmp_path, InverseDynamicsModel(6, 4, 16))
    edit(tmp_path / "config.json", change)
    with pytest.raises(ValueError, match=message):
        load_pretrained(tmp_path)


@pytest.mark.parametrize(
    ("card", "error", "message"),
    [
        ({"action_low": [-1.0]}, ValueError, r"acts in 2 dimensions, card\['action_low'\] has 1"),
        ({"model": {"image_size": 224}}, ValueError, "describes another model: image_size 224, not 16"),
        ({"env_kwargs": {"path": Path("x")}}, TypeError, "the card must hold JSON values only"),
    ],
)
def test_a_card_that_does_not_fit_is_refused(tiny_world, card, error, message, tmp_path):
    with pytest.raises(error, match=message):
        save_pretrained(tiny_world(), tmp_path, card=card)
    assert not list(tmp_path.iterdir())


def test_without_safetensors_the_extra_is_named(tiny_world, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "safetensors.torch", None)
    with pytest.raises(ImportError, match=r"a saved model needs safetensors: pip install 'torchrl_ficreg\[pretrained\]'"):
        save_pretrained(tiny_world(), tmp_path)


SIZES = [10**9, 10**30, -1, 0, 1.5, float("nan"), True, "8", "", None, [4], [], {}]


@pytest.mark.parametrize(
    ("part", "fields"),
    [
        ("encoder", ("image_size", "latent_dim", "projector_dim", "channels")),
        ("predictor", ("width", "depth", "heads", "mlp_dim", "history", "dropout", "attention_dropout")),
        ("inverse_model", ("hidden_dim",)),
    ],
)
def test_sizes_that_the_weights_do_not_have_take_no_memory(tiny_world, part, fields, tmp_path, at_most):
    """Compared with the file before anything is built: at most a gigabyte may be taken, and little time."""
    config = save_pretrained(tiny_world(), tmp_path, InverseDynamicsModel(6, 4, 16)) / "config.json"
    whole = config.read_text()
    for field in fields:
        for size in SIZES:
            if field.endswith("dropout") and size == 0:
                continue  # a possible rate
            content = json.loads(whole)
            (content if part == "inverse_model" else content["world_model"])[part][field] = size
            config.write_text(json.dumps(content))
            began = time.monotonic()
            with pytest.raises(ValueError, match="does not describe a world model|does not fit") as caught:
                load_pretrained(tmp_path)
            assert time.monotonic() - began < 5, (field, size)
            assert "\n" not in str(caught.value) and len(str(caught.value)) < 400, (field, size)


def test_every_rate_comes_back(tiny_world, tmp_path):
    """Those of the predictor, of its attention weights and of the inverse model; fine-tuning goes on as it was."""
    model = tiny_world(predictor_dropout=0.25, predictor_attention_dropout=0.125)
    inverse_model = InverseDynamicsModel(6, 4, 16, dropout=0.5)
    loaded, back, _ = load_pretrained(save_pretrained(model, tmp_path / "ours", inverse_model))
    for one, other in ((model, loaded), (inverse_model, back)):
        theirs = dict(other.named_modules())
        for name, layer in one.named_modules():
            for rate in ("p", "weight_dropout"):
                assert getattr(layer, rate, None) == getattr(theirs[name], rate, None), name
    with pytest.raises(ValueError, match="one dropout for .*, this one 0.25 and 0.125"):
        save_lewm(small_lewm(dropout=0.25, attention_dropout=0.125), tmp_path / "lewm")
    same = small_lewm(dropout=0.25, attention_dropout=0.25)
    block = load_lewm(save_lewm(same, tmp_path / "lewm"), frame_skip=same.frame_skip).predictor.module.blocks[0]
    assert (block.attn.weight_dropout, block.attn.dropout.p, block.mlp[2].p) == (0.25, 0.25, 0.25)
    model.predictor.module.blocks[0].mlp[2].p = 0.5
    with pytest.raises(ValueError, match=r"blocks.0.mlp.2 is Dropout\(p=0.5, inplace=False\), built anew it would be Dropout\(p=0.25"):
        save_pretrained(model, tmp_path / "ours")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("action_std", 0.0, "action_std must be positive"),
        ("action_std", -1.0, "action_std must be positive"),
        ("action_std", float("inf"), "action_std holds a NaN or an infinity"),
        ("action_mean", float("nan"), "action_mean holds a NaN or an infinity"),
        ("predictor.module.position", float("inf"), "position holds a NaN or an infinity"),
    ],
)
def test_numbers_that_no_trained_network_has_are_refused(tiny_world, name, value, message, tmp_path):
    model = tiny_world()
    dict([*model.named_parameters(), *model.named_buffers()])[name].data.fill_(value)
    with pytest.raises(ValueError, match=message):
        load_pretrained(save_pretrained(model, tmp_path))


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("at", range(1, 5))
@pytest.mark.parametrize("format_name", ["pretrained", "lewm", "policy"])
def test_a_save_that_fails_or_is_killed_at_any_write_leaves_a_whole_model(format_name, at, tmp_path, monkeypatch):
    """The old one or the new one, never a mixture; the next save leaves nothing but its own files."""
    old, new = small_lewm(), small_lewm(heads=4, dim_head=2)  # every tensor has the same shape
    save, load = {
        "pretrained": (save_pretrained, lambda folder: load_pretrained(folder)[0]),
        "lewm": (save_lewm, lambda folder: load_lewm(folder, frame_skip=old.frame_skip)),
        "policy": (partial(save_goal_policy, world_model=old), partial(load_goal_policy, world_model=old)),
    }[format_name]
    if format_name == "policy":
        old, new = GoalPolicy(8, 4, hidden_dim=16), GoalPolicy(8, 4, hidden_dim=8)
    save(old, tmp_path)
    before, replace, calls = snapshot(tmp_path), os.replace, []

    class Killed(BaseException):
        pass

    def failing(source, target):
        calls.append(target)
        if len(calls) == at:
            raise OSError(errno.ENOSPC, "No space left on device") if at < 4 else Killed
        replace(source, target)

    monkeypatch.setattr(os, "replace", failing)
    with pytest.raises((OSError, Killed)):
        save(new, tmp_path)
    monkeypatch.undo()
    found, expected = load(tmp_path), old if at < 4 else new
    assert_same(found, expected)
    if format_name != "policy":  # whose tensors tell its sizes
        heads = [model.predictor.module.arguments["heads"] for model in (found, expected)]
        assert heads[0] == heads[1]
    if at < 4:
        assert snapshot(tmp_path) == before
    save(old, tmp_path)
    assert snapshot(tmp_path) == before
