"""Claims about checkpoints: small, complete, readable by TorchRL, enough to plan with, and refused when damaged."""

from __future__ import annotations

import functools
import itertools
import json
import os
import pickle
import random
import shutil
import tempfile
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tiny import damage, HIGH, LOW, make_data, make_trainer, SIZES, snapshot
from torchrl.checkpoint import Checkpoint, CheckpointAdapter, CheckpointRotation, GlobalRNGState

from torchrl_ficreg import make_world_model, ModelConfig
from torchrl_ficreg.pretrained import ModelCard, save_pretrained
from torchrl_ficreg.trainers import checkpoint_components, find_checkpoint, load_world_model
from torchrl_ficreg.trainers.checkpoint import latest_intact, RandomState


@pytest.fixture
def checkpoint(finished, tmp_path) -> Path:
    """A copy of the last checkpoint of the finished run."""
    return Path(shutil.copy(find_checkpoint(finished[0]), tmp_path / "model.torchrl"))


def both(run_dir: Path) -> list[Path]:
    """Checkpoints of steps 18 and 27."""
    return sorted((run_dir / "checkpoints").iterdir())


def test_torchrl_reads_them(finished):
    """By its own class, one component into a new loss."""
    run_dir, trainer = finished
    path = find_checkpoint(run_dir)
    manifest = Checkpoint.manifest(path)
    assert {"loss_module", "optimizer", "rng", "collector", "card", "world_model"} <= set(manifest["components"])
    fresh = make_trainer().loss_module
    Checkpoint(loss_module=fresh).load(path, components=["loss_module"])
    for name, value in trainer.loss_module.state_dict().items():
        assert torch.equal(fresh.state_dict()[name], value), name


def test_the_dataset_is_not_inside(tmp_path):
    """Four times the data does not make the file larger."""
    sizes = []
    for episodes in (10, 40):
        make_trainer(tmp_path / str(episodes), epochs=1, data=make_data(episodes=episodes)).train()
        sizes.append(find_checkpoint(tmp_path / str(episodes)).stat().st_size)
    assert sizes[1] - sizes[0] < 2000
    assert sizes[1] < 40 * 24 * 3 * 16 * 16 / 2


@pytest.mark.parametrize("what", ["run", "checkpoints", "file"])
def test_a_model_comes_back_whole_from_whatever_the_user_names(finished, what):
    """Weights, action statistics and card, in eval mode; the same latents as the trained model."""
    run_dir, trainer = finished
    latest = both(run_dir)[-1]
    model, inverse_model, card = load_world_model({"run": run_dir, "checkpoints": latest.parent, "file": latest}[what])
    assert not model.training and not inverse_model.training
    assert ModelConfig(**card.model) == SIZES
    assert (card.env, card.action_low, card.action_high, card.action_dim) == ("two_room", LOW, HIGH, 2)
    statistics = make_data().statistics
    assert torch.equal(model.action_mean, statistics.mean) and torch.equal(model.action_std, statistics.std)
    frames = torch.randint(0, 256, (5, 3, 16, 16), dtype=torch.uint8)
    loss = trainer.loss_module.eval()
    with torch.no_grad(), loss.encoder_params.to_module(loss.encoder):
        expected = loss.encoder(TensorDict({"pixels": frames}, [5]))["latent"]
    assert torch.equal(model.encode(frames), expected)
    trained = {name.split("module.", 1)[1]: p for name, p in loss.inverse_model_params.named_parameters()}
    assert all(torch.equal(p, trained[name.split("module.", 1)[1]]) for name, p in inverse_model.named_parameters())


@pytest.mark.parametrize("where", ["nowhere", "empty", "text.txt", "~no_such_user/x"])
def test_an_absent_checkpoint_is_reported_by_its_path(tmp_path, where):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.txt").write_text("no checkpoint")
    target = where if where.startswith("~") else tmp_path / where
    with pytest.raises((FileNotFoundError, RuntimeError), match="no checkpoint at|home directory"):
        load_world_model(target)


@pytest.mark.parametrize("how", ["without the card", "foreign"])
def test_a_checkpoint_without_card_or_networks_is_refused_in_one_line(checkpoint, how):
    damage(checkpoint, how)
    before = snapshot(checkpoint.parent)
    with pytest.raises(ValueError, match="model.torchrl"):
        load_world_model(checkpoint)
    assert snapshot(checkpoint.parent) == before


def test_a_flipped_byte_in_the_header_of_an_archive_member_is_damage_too(run_dir):
    """Whatever zipfile makes of it: the run continues from the latest checkpoint, or from the one before."""
    earlier, latest = both(run_dir)
    whole, found = latest.read_bytes(), set()
    for at in range(0, 60, 3):
        latest.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        found.add(latest_intact(CheckpointRotation(latest.parent, keep_last=2)))
        if found == {latest}:
            assert make_trainer(run_dir).resume()
    assert earlier in found <= {earlier, latest}


class Cuda:
    """In the place of ``torch.cuda``'s random states: as many devices as told, each with a number for a state."""

    def __init__(self, monkeypatch, devices: int, current: int = 0) -> None:
        self.states = [torch.tensor([number], dtype=torch.uint8) for number in range(devices)]
        for name, value in {
            "is_available": lambda: devices > 0,
            "is_initialized": lambda: devices > 0,
            "device_count": lambda: devices,
            "current_device": lambda: current,
            "get_rng_state_all": lambda: [state.clone() for state in self.states],
            "set_rng_state": self.set,
        }.items():
            monkeypatch.setattr(torch.cuda, name, value)

    def set(self, state: torch.Tensor, device: int) -> None:
        self.states[device] = state

    @property
    def numbers(self) -> list[int]:
        return [state.item() for state in self.states]


def draw() -> tuple[float, float, float]:
    return random.random(), np.random.rand(), torch.rand(()).item()


def test_the_state_of_the_device_trained_on_is_kept_and_goes_to_the_one_trained_on_now(monkeypatch, warnings):
    """Of four, device 2 by name or as the current one; on a machine of two it is given to the current one."""
    Cuda(monkeypatch, 4, current=2)
    for component in (RandomState("cuda:2"), RandomState("cuda"), RandomState()):
        state = component.state_dict()
        assert state["cuda"].item() == 2 and "torch_cuda" not in state
    assert "cuda" not in RandomState("cpu").state_dict()
    here = Cuda(monkeypatch, 2, current=1)
    RandomState("cuda:0").load_state_dict(state)
    assert here.numbers == [2, 1]
    here = Cuda(monkeypatch, 2, current=1)
    RandomState().load_state_dict(state)
    assert here.numbers == [0, 2]
    assert not warnings


@pytest.mark.parametrize(("devices", "left_out"), [(0, "cuda:0, cuda:1, cuda:2"), (2, "cuda:2"), (3, None)])
def test_states_of_absent_devices_are_left_out_with_one_warning(monkeypatch, warnings, devices, left_out):
    """Checkpoints of TorchRL's component have all devices; every other state is restored."""
    state = GlobalRNGState().state_dict()
    expected = draw()
    state["torch_cuda"] = [torch.tensor([7 + number], dtype=torch.uint8) for number in range(3)]
    here = Cuda(monkeypatch, devices)
    RandomState("cpu").load_state_dict(state)
    assert draw() == expected
    assert here.numbers == [7, 8, 9][:devices]
    assert len(warnings) == (left_out is not None)
    assert left_out is None or f"random states of {left_out} are left out" in warnings[0]


def test_a_run_begun_on_cuda_goes_on_where_there_is_none(run_dir, continue_run, warnings):
    """Random state and tensors say that they come from cuda:0, as in a checkpoint made there."""
    repack(both(run_dir)[1], lambda name, content: content.replace(b'"device":"cpu"', b'"device":"cuda:0"'))
    continue_run(run_dir, 27)
    assert not warnings
    state = RandomState().state_dict()
    RandomState("cpu").load_state_dict({**state, "cuda": torch.zeros(16, dtype=torch.uint8)})
    assert len(warnings) == 1 and "random states of cuda are left out" in warnings[0]


def _poisoned(folder, where, name):
    """A real checkpoint with one more entry that a general loader would unpickle."""

    class Marker:
        def __reduce__(self):
            return Path.touch, (where / "ran",)

    folder.mkdir()
    model, inverse_model = make_world_model(ModelConfig.preset("cpu"), 2)
    card = ModelCard(asdict(ModelConfig.preset("cpu")), "two_room", {}, [-1.0, -1.0], [1.0, 1.0], {})
    Checkpoint(**checkpoint_components(model, inverse_model, card)).save(folder / "checkpoint-1.torchrl")
    state = next((folder / "checkpoint-1.torchrl" / "components").glob("*-world_model")) / "state"
    if name == "other.pickle":
        notes = json.loads((state / "meta.json").read_text())
        notes["extra"] = {"type": "NonTensorData", "non_tensor": None}
        notes["_type"] = "<class 'tensordict.tensorclass.NonTensorData'>"
        (state / "meta.json").write_text(json.dumps(notes))
    (state / name).parent.mkdir(exist_ok=True)
    (state / name).write_bytes(pickle.dumps(Marker()))
    return folder / "checkpoint-1.torchrl"


PLACES = {  # of the world model's folder, as a manifest may write it
    "slash": "{folder}/{name}/",
    "dot": "./{folder}/{name}",
    "dots inside": "{folder}/./{name}",
    "two slashes": "{folder}//{name}",
    "backslash": "{folder}\\{name}",
    "upper case": "{folder}/{upper}",
    "deeper": "{folder}/{name}/state",
    "same": "{folder}/{name}",
}


def _claim_place(path, place):
    """Lets an entry of a foreign adapter claim the folder of the world model, which is written in another way."""
    manifest = json.loads((path / "manifest.json").read_text())
    record = manifest["components"]["world_model"]
    folder, name = record["path"].split("/")
    manifest["components"]["mine"] = {**record, "adapter": "mine.lines"}
    record["path"] = place.format(folder=folder, name=name, upper=name.upper())
    record["files"] = [*record["files"], "state/other.pickle"]
    (path / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize("packed", [True, False], ids=["archive", "folder"])
@pytest.mark.parametrize(
    ("name", "place"),
    [
        *((name, None) for name in ("extra/other.pickle", "../state.pt", "../state.tdz", "tensor_x.memmap")),
        *(("other.pickle", place) for place in (None, *PLACES)),
    ],
)
def test_a_checkpoint_with_other_entries_than_ours_is_refused_before_it_is_loaded(tmp_path, name, place, packed):
    """No way of writing its place lets a foreign entry through."""
    path = _poisoned(tmp_path / "run", tmp_path, name)
    if place is not None:
        _claim_place(path, PLACES[place])
    if packed:
        folder = path.rename(tmp_path / "folder")
        shutil.make_archive(str(tmp_path / "packed"), "zip", folder)
        (tmp_path / "packed.zip").rename(path)
    with pytest.raises(ValueError, match="not loaded"):
        load_world_model(path)
    assert not (tmp_path / "ran").exists()


def test_a_tensor_that_the_manifest_does_not_list_is_no_tensor_of_zeros(checkpoint):
    def drop(manifest):
        files = manifest["components"]["world_model"]["files"]
        files.remove(next(file for file in files if file.endswith(".memmap")))

    edit_json(checkpoint, "manifest.json", drop)
    with pytest.raises(ValueError, match="does not list"):
        load_world_model(checkpoint)


def test_a_tensor_file_that_was_cut_is_refused_and_stays_as_it_is(tmp_path):
    path = _poisoned(tmp_path / "run", tmp_path, "extra.json")
    next(path.rglob("extra.json")).unlink()
    load_world_model(path)  # whole
    victim = max(path.rglob("tensor_*.memmap"), key=lambda file: file.stat().st_size)
    content = victim.read_bytes()
    for rest in (content[: len(content) // 2], b""):
        victim.write_bytes(rest)
        with pytest.raises(ValueError, match=f"{victim.name} has {len(rest)} bytes, expected {len(content)}"):
            load_world_model(path)
        assert victim.read_bytes() == rest


def repack(path: Path, edit=None, **settings) -> None:
    """Writes an archive again, with members changed by ``edit(name, content)``, or with other settings."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", **settings) as archive:
        for name, content in members.items():
            archive.writestr(name, content if edit is None else edit(name, content))


def edit_json(path: Path, member: str, change) -> None:
    """Repacks an archive after ``change(value)`` of the JSON in one of its members."""

    def edit(name, content):
        if not name.endswith(member):
            return content
        change(value := json.loads(content))
        return json.dumps(value)

    repack(path, edit)


def with_manifest(content: bytes, path: Path) -> None:
    repack(path, lambda name, old: content if name == "manifest.json" else old, compression=zipfile.ZIP_DEFLATED)


def encrypt(path: Path) -> None:
    """Sets the flag of encryption of every member, in both of its headers."""
    data = bytearray(path.read_bytes())
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = data.find(mark)
        while place >= 0:
            data[place + at] |= 1
            place = data.find(mark, place + 4)
    path.write_bytes(data)


def as_fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def twice(path: Path) -> None:
    """One tensor is referenced repeatedly: loaded, each reference is a copy."""

    def repeat(state):
        state["items"] += [[{"kind": "value", "value": f"more{i}"}, state["items"][0][1]] for i in range(3)]

    edit_json(path, "world_model/state.json", repeat)


def as_link(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("nowhere")


MANIFESTS = {
    "a list": b"[]",
    "null": b"null",
    "text": b"\xff\xfe{",
    "deep": b"[" * 10**5,
    "with metadata of a list": b'{"format": "torchrl.checkpoint", "format_version": 1, "metadata": []}',
    "a bomb": bytes(2**25),
}
ODD = {
    **{f"manifest is {how}": functools.partial(with_manifest, content) for how, content in MANIFESTS.items()},
    "truncated": lambda path: damage(path, "truncated"),
    "flipped": lambda path: damage(path, "flipped"),
    "bzip2": lambda path: repack(path, compression=zipfile.ZIP_BZIP2),
    "encrypted": encrypt,
    "fifo": as_fifo,
    "twice": twice,
    "dangling link": as_link,
}


@pytest.mark.parametrize("how", ODD)
def test_what_is_no_checkpoint_is_refused_in_one_line_and_a_run_goes_on_from_the_one_before(
    run_dir, continue_run, warnings, how
):
    """By its own name; as the newest of a run directory, from which a model is loaded; when the run is continued."""
    earlier, latest = both(run_dir)
    ODD[how](latest)
    (run_dir / "checkpoints" / "elsewhere").unlink(missing_ok=True)
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        load_world_model(latest)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500
    assert find_checkpoint(run_dir) == earlier
    load_world_model(run_dir)
    warnings.clear()
    continue_run(run_dir, 18)
    assert warnings == [f"{latest} is damaged: continuing from {earlier}."]
    assert make_trainer(run_dir).resume() and len(warnings) == 1  # the damaged file was replaced
    assert find_checkpoint(run_dir).name == latest.name


@pytest.mark.parametrize("what", ["pickle", "cut", "fifo", "link"])
def test_a_damaged_folder_is_passed_over_as_a_damaged_archive_is(run_dir, warnings, what):
    earlier, latest = both(run_dir)
    with zipfile.ZipFile(latest) as archive:
        archive.extractall(folder := latest.with_suffix(""))
    latest.unlink()
    assert find_checkpoint(run_dir) == folder
    tensor = next(folder.rglob("tensor_*.memmap"))
    if what == "pickle":
        (tensor.parent / "other.pickle").write_bytes(b"")
    elif what == "cut":
        tensor.write_bytes(b"")
    else:
        tensor.unlink()
        os.mkfifo(tensor) if what == "fifo" else tensor.symlink_to("/dev/zero")
    assert find_checkpoint(run_dir) == earlier
    assert warnings == [f"{folder} is damaged: continuing from {earlier}."]
    with pytest.raises(ValueError, match="not loaded|is damaged|no regular file"):
        load_world_model(folder)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("latent_dim", 8),
        *itertools.product(
            ["image_size", "frame_skip", "latent_dim", "predictor_depth", "predictor_width", "history"],
            [10**9, 10**30, -1, float("nan"), True, "8", None, [1]],
        ),
    ],
)
def test_sizes_of_a_card_that_the_weights_do_not_have_take_no_memory(checkpoint, field, value):
    edit_json(checkpoint, "card/value.json", lambda card: card["model"].update({field: value}))
    with pytest.raises(ValueError, match="not a whole checkpoint of a world model") as caught:
        load_world_model(checkpoint)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [{"model": []}, {"env": 3}, {"action_low": [1.0, 1.0], "action_high": [0.0, 0.0]}, {"action_low": "ab"}, {"config": None}],
)
def test_a_card_with_fields_of_other_types_is_refused(change):
    good = {"model": {}, "env": "two_room", "env_kwargs": {}, "action_low": LOW, "action_high": HIGH, "config": {}}
    ModelCard(**good)
    with pytest.raises(ValueError, match="of a model's card must be"):
        ModelCard(**{**good, **change})


@pytest.mark.parametrize(("buffer", "value"), [("action_std", 0.0), ("action_std", -1.0), ("action_mean", float("nan"))])
def test_statistics_that_no_data_have_are_refused(finished, tmp_path, buffer, value):
    model, inverse_model, card = load_world_model(finished[0])
    model.get_buffer(buffer).fill_(value)
    Checkpoint(**checkpoint_components(model, inverse_model, card)).save(tmp_path / "model")
    with pytest.raises(ValueError, match=f"{buffer} (must be positive|holds a NaN)"):
        load_world_model(tmp_path / "model")


@pytest.mark.parametrize("card", [{}, {"env": "two_room"}])
def test_a_pretrained_folder_without_a_whole_card_is_refused_in_one_line(finished, tmp_path, card):
    pytest.importorskip("safetensors")
    model, inverse_model, whole = load_world_model(finished[0])
    save_pretrained(model, tmp_path, inverse_model, card)
    with pytest.raises(ValueError, match="has no card|its card has no model, env_kwargs") as caught:
        load_world_model(tmp_path)
    assert "\n" not in str(caught.value)
    save_pretrained(model, tmp_path, inverse_model, {**asdict(whole), "note": "of mine"})
    assert load_world_model(tmp_path)[2] == whole


class Lines(CheckpointAdapter):
    """An adapter of a user, with a file of its own kind."""

    adapter_id = "mine.lines"

    def save(self, component, path, *, args, kwargs):
        path.mkdir(parents=True, exist_ok=True)
        (path / "lines.txt").write_text("\n".join(component))

    def load(self, component, path, **settings):
        component[:] = (path / "lines.txt").read_text().split("\n")


def test_a_component_of_the_users_own_adapter_is_resumed(tmp_path):
    lines = ["a", "b"]
    trainer = make_trainer(tmp_path / "run")
    trainer.checkpoint.register("lines", lines, adapter=Lines())
    trainer.train()
    again, read = make_trainer(tmp_path / "run"), []
    again.checkpoint.register("lines", read, adapter=Lines())
    assert again.resume() and read == lines
    load_world_model(tmp_path / "run")


def test_what_a_killed_loader_unpacked_is_removed_a_day_later(finished, tmp_path, monkeypatch):
    """Neither what is newer, which a loader at work may read, nor what a link leads to."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    old, new, link = (tmp_path / f"torchrl-checkpoint-load-{name}" for name in ("old", "new", "link"))
    (aim := tmp_path / "aim").mkdir()
    old.mkdir(), new.mkdir(), link.symlink_to(aim)
    (old / "file").write_text("")
    for path in (old, aim):
        os.utime(path, (0, 0))
    load_world_model(finished[0])
    assert {path.name for path in tmp_path.iterdir()} == {new.name, link.name, "aim"}


def test_a_full_folder_of_temporary_files_is_named(checkpoint, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(checkpoint.with_name("gone")))
    with pytest.raises(OSError, match="model.torchrl cannot be unpacked in .*gone .*set TMPDIR"):
        load_world_model(checkpoint)
