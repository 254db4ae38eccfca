"""A checkpoint is small, complete, readable by TorchRL, and enough to plan with: no dataset, no configuration file."""

from __future__ import annotations

import json
import pickle
import random
import shutil
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tiny import HIGH, LOW, make_data, make_trainer, record, same, SIZES, weights
from torchrl import torchrl_logger
from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState
from torchrl.data import ListStorage, ReplayBuffer

from torchrl_ficreg import LatentCEMPlanner, make_world_model, ModelConfig, MPCPolicy, PlanConfig
from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.trainers import checkpoint_components, find_checkpoint, load_world_model, ModelCard
from torchrl_ficreg.trainers.checkpoint import latest_whole
from torchrl_ficreg.trainers.rng import RandomState
from torchrl_ficreg.trainers.stream import ReplayStream


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished run, and its trainer."""
    run_dir = tmp_path_factory.mktemp("finished") / "run"
    trainer = make_trainer(run_dir)
    trainer.train()
    return run_dir, trainer


def snapshot(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_two_checkpoints_are_kept_and_nothing_else(finished):
    run_dir, _ = finished
    assert len(list((run_dir / "checkpoints").iterdir())) == 2
    assert {path.name for path in run_dir.iterdir()} == {"checkpoints", "metrics.csv"}


def test_torchrl_reads_them(finished):
    """By its own class, component by component, straight into a fresh loss."""
    run_dir, trainer = finished
    path = find_checkpoint(run_dir)
    manifest = Checkpoint.manifest(path)
    assert {"loss_module", "optimizer", "rng", "collector", "card", "world_model"} <= set(manifest["components"])
    fresh = make_trainer().loss_module
    Checkpoint(loss_module=fresh).load(path, components=["loss_module"])
    for name, value in trainer.loss_module.state_dict().items():
        assert torch.equal(fresh.state_dict()[name], value), name


def test_the_dataset_is_not_inside(tmp_path):
    """Ten times the data does not make the file larger."""
    sizes = []
    for episodes in (10, 100):
        make_trainer(tmp_path / str(episodes), epochs=1, data=make_data(episodes=episodes)).train()
        sizes.append(find_checkpoint(tmp_path / str(episodes)).stat().st_size)
    assert sizes[1] - sizes[0] < 2000
    assert sizes[1] < 100 * 24 * 3 * 16 * 16 / 4


@pytest.mark.parametrize("what", ["run", "checkpoints", "file"])
def test_a_model_comes_back_whole_from_whatever_the_user_names(finished, what):
    """Weights, action statistics and card, in eval mode; the same latents as the trained model."""
    run_dir, trainer = finished
    latest = sorted((run_dir / "checkpoints").iterdir())[-1]
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


def test_a_loaded_model_plans_although_the_dataset_is_gone(finished, tmp_path):
    run_dir, _ = finished
    (copy := tmp_path / "model.torchrl").write_bytes(find_checkpoint(run_dir).read_bytes())
    model, _, card = load_world_model(copy)
    config = PlanConfig(num_candidates=8, num_elites=2, iterations=1)
    policy = MPCPolicy(LatentCEMPlanner(model, config, action_bounds=(card.action_low, card.action_high)))
    frame = torch.zeros(2, 3, 16, 16, dtype=torch.uint8)
    action = policy(TensorDict({"pixels": frame, "goal_pixels": frame}, [2]))["action"]
    assert action.shape == (2, 2) and action.abs().max() <= 4


@pytest.mark.parametrize("where", ["nowhere", "empty", "text.txt", "~no_such_user/x"])
def test_an_absent_checkpoint_is_reported_by_its_path(tmp_path, where):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.txt").write_text("no checkpoint")
    target = where if where.startswith("~") else tmp_path / where
    with pytest.raises((FileNotFoundError, RuntimeError), match="no checkpoint at|home directory"):
        load_world_model(target)


def damage(path: Path, how: str) -> None:
    data = bytearray(path.read_bytes())
    if how == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif how == "flipped":  # every 97th byte of the payloads; the zip's directory at the end stays readable
        with zipfile.ZipFile(path) as archive:
            end, manifest = archive.start_dir, archive.getinfo("manifest.json")
        for at in range(200, min(end, manifest.header_offset), 97):
            data[at] ^= 0xFF
        path.write_bytes(data)
    elif how == "without the card":
        with zipfile.ZipFile(path) as archive:
            kept = [(info, archive.read(info)) for info in archive.infolist() if "card" not in info.filename]
        with zipfile.ZipFile(path, "w") as archive:
            for info, content in kept:
                archive.writestr(info, content)
    else:
        Checkpoint(something={"else": 1}).save(path, format="archive")


@pytest.mark.parametrize("how", ["truncated", "flipped", "without the card", "foreign"])
def test_a_damaged_or_foreign_checkpoint_is_refused_in_one_line(finished, tmp_path, how):
    target = tmp_path / "model.torchrl"
    target.write_bytes(find_checkpoint(finished[0]).read_bytes())
    damage(target, how)
    before = snapshot(tmp_path)
    expected = FileNotFoundError if how == "truncated" else ValueError
    with pytest.raises(expected, match="model.torchrl"):
        load_world_model(target)
    assert snapshot(tmp_path) == before


def test_a_checkpoint_of_other_sizes_than_its_card_is_refused(finished, tmp_path):
    """The card says latent_dim 8, the weights have 4."""
    model, inverse_model, card = load_world_model(finished[0])
    wrong = {"model": {**card.model, "latent_dim": 8}, "env": "two_room", "env_kwargs": {}, "config": {}}
    parts = {"world_model": model, "inverse_model": inverse_model}
    path = tmp_path / "wrong"
    Checkpoint(card={**wrong, "action_low": LOW, "action_high": HIGH}, **parts).save(path)
    with pytest.raises(ValueError, match="not a whole checkpoint of a world model"):
        load_world_model(path)
    Checkpoint(card={"model": {"latent_dim": 8}}, **parts).save(tmp_path / "thin")
    with pytest.raises(ValueError, match="not a whole checkpoint of a world model"):
        load_world_model(tmp_path / "thin")


@pytest.mark.parametrize("how", ["truncated", "flipped"])
def test_a_run_goes_on_from_the_one_before_when_the_latest_is_damaged(finished, tmp_path, monkeypatch, how):
    """Cut short by a full disk, or with other bytes than were written: the previous one takes over, with one warning.

    Trained again, the run ends with the same weights and replaces the damaged file.
    """
    run_dir, trainer = finished
    shutil.copytree(run_dir, tmp_path / "run")
    earlier, latest = sorted((tmp_path / "run" / "checkpoints").iterdir())
    damage(latest, how)
    said = []
    monkeypatch.setattr(torchrl_logger, "warning", lambda text, *_: said.append(text))
    again = make_trainer(tmp_path / "run")
    assert again.resume() and again.step == 18
    assert said == [f"{latest} is damaged: continuing from {earlier}."]
    again.train()
    assert again.step == 27
    assert same(weights(again), weights(trainer))
    assert make_trainer(tmp_path / "run").resume() and len(said) == 1


@pytest.mark.parametrize("how", ["truncated", "flipped"])
def test_damaged_checkpoints_that_are_all_there_is_are_named_and_not_touched(finished, tmp_path, how):
    run_dir, _ = finished
    shutil.copytree(run_dir, tmp_path / "run")
    first, last = sorted((tmp_path / "run" / "checkpoints").iterdir())
    damage(last, how), damage(first, "flipped")
    before = snapshot(tmp_path)
    with pytest.raises(ValueError, match=f"{first.name} is damaged and there is no other checkpoint: move it away"):
        make_trainer(tmp_path / "run").resume()
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("at", range(0, 60, 3))
def test_a_flipped_byte_in_the_header_of_an_archive_member_is_damage_too(finished, tmp_path, at):
    """Whatever zipfile makes of it: the run goes on from one checkpoint or the other, or says which is damaged."""
    (tmp_path / "run").mkdir()
    shutil.copytree(finished[0] / "checkpoints", tmp_path / "run" / "checkpoints")
    earlier, latest = sorted((tmp_path / "run" / "checkpoints").iterdir())
    data = bytearray(latest.read_bytes())
    data[at] ^= 0xFF
    latest.write_bytes(data)
    rotation = CheckpointRotation(latest.parent, keep_last=2)
    found = latest_whole(rotation)
    assert found in (earlier, latest)
    if found == latest:
        assert make_trainer(tmp_path / "run").resume()


def test_training_in_a_used_folder_without_resume_is_refused(finished, tmp_path):
    """It would write every row twice and replace the checkpoints. Resumed, the finished run has nothing left to do."""
    run_dir, _ = finished
    before = snapshot(run_dir)
    trainer = make_trainer(run_dir)
    with pytest.raises(ValueError, match=r"holds checkpoints of a run: call resume\(\) .* another run_dir"):
        trainer.train()
    assert trainer.step == 0 and snapshot(run_dir) == before
    trainer.resume()
    trainer.train()
    assert trainer.step == 27 and snapshot(run_dir) == before


def test_other_data_of_as_many_clips_cannot_continue_a_run(finished):
    """One value of one state differs. Fingerprints are in the checkpoint; the same data is accepted."""
    run_dir, _ = finished
    episodes = record()
    episodes[0]["state"][0] += 1
    data = OfflineTrajectories.from_episodes(episodes, split="train", num_frames=2, frame_skip=2, batch_size=16)
    before = snapshot(run_dir)
    with pytest.raises(ValueError, match="cannot be continued .*the checkpoint belongs to other data") as caught:
        make_trainer(run_dir, data=data).resume()
    assert "\n" not in str(caught.value)
    assert snapshot(run_dir) == before
    assert make_trainer(run_dir).resume()


def test_a_position_without_a_fingerprint_is_taken_on_trust():
    """Older checkpoints have none, and replay buffers of other kinds know none."""
    buffer = make_data()
    stream = ReplayStream(buffer, torch.device("cpu"))
    next(iter(stream))
    state = stream.state_dict()
    assert state["fingerprint"] == buffer.fingerprint
    old = {key: value for key, value in state.items() if key != "fingerprint"}
    again = ReplayStream(make_data(), torch.device("cpu"))
    again.load_state_dict(old)
    assert again.replay_buffer.batches == 1
    plain = ReplayStream(ReplayBuffer(storage=ListStorage(4), batch_size=1), torch.device("cpu"))
    assert "fingerprint" not in plain.state_dict()
    plain.load_state_dict({**plain.state_dict(), "fingerprint": "of something"})


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


@pytest.fixture
def said(monkeypatch):
    """Warnings."""
    texts = []
    monkeypatch.setattr(torchrl_logger, "warning", lambda text, *_: texts.append(text))
    return texts


def draw() -> tuple[float, float, float]:
    return random.random(), np.random.rand(), torch.rand(()).item()


def test_the_state_of_the_device_trained_on_is_kept_and_goes_to_the_one_trained_on_now(monkeypatch, said):
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
    assert not said


@pytest.mark.parametrize(("devices", "left_out"), [(0, "cuda:0, cuda:1, cuda:2"), (2, "cuda:2"), (3, None)])
def test_states_of_absent_devices_are_left_out_with_one_warning(monkeypatch, said, devices, left_out):
    """Checkpoints of TorchRL's component have all devices; every other state is restored."""
    state = GlobalRNGState().state_dict()
    expected = draw()
    state["torch_cuda"] = [torch.tensor([7 + number], dtype=torch.uint8) for number in range(3)]
    here = Cuda(monkeypatch, devices)
    RandomState("cpu").load_state_dict(state)
    assert draw() == expected
    assert here.numbers == [7, 8, 9][:devices]
    assert len(said) == (left_out is not None)
    assert left_out is None or f"random states of {left_out} are left out" in said[0]


def test_a_run_begun_on_cuda_goes_on_where_there_is_none(finished, tmp_path, said):
    """Random state and tensors say they come from cuda:0, as in a checkpoint made there."""
    run_dir, trainer = finished
    shutil.copytree(run_dir, tmp_path / "run")
    earlier, latest = sorted((tmp_path / "run" / "checkpoints").iterdir())
    with zipfile.ZipFile(latest) as archive:
        members = [(info, archive.read(info)) for info in archive.infolist()]
    with zipfile.ZipFile(latest, "w") as archive:
        for info, content in members:
            archive.writestr(info, content.replace(b'"device":"cpu"', b'"device":"cuda:0"'))
    again = make_trainer(tmp_path / "run")
    assert again.resume() and again.step == 27 and not said
    assert same(weights(again), weights(trainer))
    state = RandomState().state_dict()
    RandomState("cpu").load_state_dict({**state, "cuda": torch.zeros(16, dtype=torch.uint8)})
    assert len(said) == 1 and "random states of cuda are left out" in said[0]


def test_litter_of_killed_processes_is_harmless_and_swept(finished, tmp_path):
    run_dir, _ = finished
    shutil.copytree(run_dir, tmp_path / "run")
    folder = tmp_path / "run" / "checkpoints"
    (folder / ".checkpoint-000000000999.torchrl.stage-ab" / "components").mkdir(parents=True)
    (folder / ".checkpoint-000000000999.torchrl.archive-cd").write_bytes(b"PK")
    load_world_model(tmp_path / "run")
    trainer = make_trainer(tmp_path / "run")
    assert trainer.resume() and trainer.step == 27
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


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


@pytest.mark.parametrize("packed", [True, False], ids=["archive", "folder"])
@pytest.mark.parametrize("name", ["other.pickle", "extra/other.pickle", "../state.pt", "../state.tdz", "tensor_x.memmap"])
def test_a_checkpoint_with_other_entries_than_ours_is_refused_before_it_is_loaded(tmp_path, name, packed):
    path = _poisoned(tmp_path / "run", tmp_path, name)
    if packed:
        folder = path.rename(tmp_path / "folder")
        shutil.make_archive(str(tmp_path / "packed"), "zip", folder)
        (tmp_path / "packed.zip").rename(path)
    with pytest.raises(ValueError, match="not loaded"):
        load_world_model(path)
    assert not (tmp_path / "ran").exists()


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
