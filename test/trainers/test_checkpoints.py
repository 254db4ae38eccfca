"""A checkpoint is small, complete, readable by TorchRL, and enough to plan with: no dataset, no configuration file."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tiny import HIGH, LOW, make_data, make_trainer, SIZES
from torchrl.checkpoint import Checkpoint

from torchrl_ficreg import LatentCEMPlanner, ModelConfig, MPCPolicy, PlanConfig
from torchrl_ficreg.trainers import find_checkpoint, load_world_model


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


def test_a_run_goes_on_from_the_one_before_when_the_latest_is_cut_off(finished, tmp_path):
    """A file that a full disk cut short is no checkpoint; the previous one takes over."""
    run_dir, trainer = finished
    shutil.copytree(run_dir, tmp_path / "run")
    latest = sorted((tmp_path / "run" / "checkpoints").iterdir())[-1]
    damage(latest, "truncated")
    again = make_trainer(tmp_path / "run")
    assert again.resume() and again.step == 18
    again.train()
    assert again.step == 27


def test_a_damaged_latest_is_named_and_nothing_is_touched(finished, tmp_path):
    run_dir, _ = finished
    shutil.copytree(run_dir, tmp_path / "run")
    latest = sorted((tmp_path / "run" / "checkpoints").iterdir())[-1]
    damage(latest, "flipped")
    before = snapshot(tmp_path)
    with pytest.raises(ValueError, match=f"{latest.name} cannot be continued .* move it away"):
        make_trainer(tmp_path / "run").resume()
    assert snapshot(tmp_path) == before


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
