"""A user's mistake ends in one line that says what to do, an exit code other than zero, and nothing on disk."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import hydra
import pytest
from torchrl.checkpoint import Checkpoint

from torchrl_ficreg.trainers import find_checkpoint, load_world_model

RUN = "runs/two_room_cpu_ficreg_seed0"
SCRIPTS = Path(__file__).resolve().parents[2] / "sota-implementations" / "ficreg"


@pytest.fixture
def scripts(monkeypatch):
    """Imports a module of the scripts into this process: a new one for every misspelling would be slow."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    yield importlib.import_module
    for name in ("cli", "utils", "run_dir", "episodes"):
        sys.modules.pop(name, None)


@pytest.fixture
def check(scripts):
    """The check that runs before Hydra."""
    return scripts("cli").check_overrides


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optim.lrr=1", "no field 'optim.lrr' to change; did you mean 'optim.lr'?"),
        ("optm.lr=1", "did you mean 'optim.lr'?"),
        ("+new=1", "no field 'new'"),
        ("++new=1", "no field 'new'"),
        ("+optim.new=1", "no field 'optim.new'"),
        ("~optim.lr", "no field 'optim.lr' to change"),
        ("optim.lr.deeper=1", "no field 'optim.lr.deeper'"),
        ("method=leWM", "method=leWM is unknown: choose one of ['ficreg', 'joint_inverse', 'lewm', 'pldm']"),
        ("env=three_room", "env=three_room is unknown"),
        ("optim.epochs=many", "expected a value like"),
        ("optim.epochs=1.5", "expected a value like"),
        ("optim.epochs=true", "expected a value like"),
        ("optim.lr=[1,2]", "expected a value like 0.0"),
        ("optim.lr=true", "expected a value like"),
        ("model.conv_channels=3", "expected a value like"),
        ("name=[a]", "expected a value like"),
        ("optim=3", "expected a value like"),
        ("seed=null", "expected a value like 0, got None"),
    ],
)
def test_unknown_fields_and_values_of_another_kind_are_refused(check, override, message):
    with pytest.raises(ValueError) as caught:
        check("train", [override])
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "overrides",
    [
        ["optim.lr=1", "optim.epochs=2", "method=lewm"],
        ["model=paper", "model.history=1", "model.conv_channels=[4,8]"],
        ["name=x-1", "name=3", "device=cuda:1"],
        ["hydra.run.dir=elsewhere"],
        ["seed=0,1,2", "method=ficreg,lewm"],
        ["env.kwargs.collision=endpoint"],
    ],
)
def test_what_the_files_declare_may_be_changed(check, overrides):
    assert check("train", overrides) == overrides


@pytest.mark.parametrize(("launcher", "extra"), [("processes", "sweep"), ("slurm", "slurm")])
def test_a_launcher_without_its_package_is_refused(scripts, monkeypatch, launcher, extra):
    cli = scripts("cli")
    monkeypatch.setattr(cli, "_installed", lambda module: False)
    assert cli.check_launcher(["seed=0,1", "hydra/launcher=basic"]) is None
    with pytest.raises(ValueError, match=rf"pip install 'torchrl_ficreg\[{extra}\]'"):
        cli.check_launcher(["seed=0,1", f"hydra/launcher={launcher}"])


def refused(done, *words):
    assert done.returncode != 0
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), done.stderr
    assert all(word in lines[0] for word in words), lines[0]
    assert not done.stdout


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["optim.epochs=0", "optim.lr=-1.0"], "must be positive: optim.epochs=0, optim.lr=-1.0"),
        (["env.data.max_steps=0"], "must be positive: env.data.max_steps=0"),
        (["seed=-1"], "must not be negative nor exceed 63 bits: seed=-1"),
        (["collect.num_workers=-1"], "must not be negative nor exceed 63 bits: collect.num_workers=-1"),
        (["optim.warmup=2.0"], r"optim.warmup must lie in \[0, 1\)"),
        (["optim.precision=fp16"], "unknown precision 'fp16'"),
        (["env.kwargs.collision=soft"], "collision must be one of"),
        (["plan.num_elites=500"], "num_elites must lie between 2 and num_candidates=300"),
        (["plan.bounds=wide"], "unknown bounds 'wide'"),
        (["method.context=dead"], "unknown context 'dead'"),
        (["logger.backend=paper"], "unknown logger.backend 'paper'"),
        (["device=quantum"], "device=quantum cannot be used here"),
        (["model.encoder=mlp"], "unknown encoder 'mlp'"),
        (["loss.sigreg_start=0.1", "loss.sigreg_coeff=0.0"], "must be positive to fall from one to the other"),
        (["evaluation.num_workers=-1"], "must not be negative nor exceed 63 bits: evaluation.num_workers=-1"),
        (["collect.frames=jpeg"], "jpeg"),
    ],
)
def test_settings_out_of_range_are_found_before_anything_is_written(scripts, overrides, message):
    with hydra.initialize_config_dir(str(SCRIPTS / "config"), version_base="1.3"):
        settings = hydra.compose("train", overrides)
    with pytest.raises(ValueError, match=message):
        scripts("utils").check_settings(settings)


@pytest.mark.parametrize(
    ("override", "words"),
    [("optim.lrr=1", ["did you mean 'optim.lr'"]), ("optim.epochs=0", ["must be positive", "optim.epochs=0"])],
)
def test_a_mistake_is_one_line_and_writes_nothing(execute, tmp_path, override, words):
    refused(execute(tmp_path, "train.py", override), *words)
    assert not list(tmp_path.iterdir())


def test_another_configuration_under_the_same_name_is_refused(trained, execute, files):
    before = files(trained)
    done = execute(trained, "train.py", f"name={RUN.split('/')[1]}", "optim.lr=0.1", "loss.idm_coeff=7.0")
    refused(done, "another configuration", "optim.lr: 0.0005 -> 0.1", "loss.idm_coeff", "give another name=")
    assert files(trained) == before


@pytest.mark.parametrize(("setting", "free"), [("checkpoint_activations", True), ("compile", False), ("lr", False)])
def test_only_what_changes_no_number_may_change_while_a_run_goes_on(scripts, setting, free):
    """A compiled graph draws other dropout masks."""
    ours, theirs = ({"optim": {setting: value}} for value in (True, False))
    assert (scripts("run_dir")._differences(ours, theirs) == "") == free


def test_a_name_is_not_lost_to_a_configuration_that_never_trained(trained, execute, tmp_path):
    """A batch larger than the data is found only after the run folder was made; the mended command may use the name."""
    (tmp_path / "data").symlink_to(trained / "data")
    refused(execute(tmp_path, "train.py", "name=mine", "optim.batch_size=100000"), "less than one batch")
    done = execute(tmp_path, "train.py", "name=mine", "env.goal_offset=1")
    assert done.returncode == 0, done.stderr  # and with all pairs solved at the start, there is a report all the same
    assert "of none" in done.stdout


def test_a_dataset_of_other_frames_or_another_environment_is_refused(trained, execute, tmp_path):
    data = trained / "data" / "two_room_32px_20episodes_seed0"
    refused(execute(tmp_path, "train.py", f"dataset={data}", "env=push_t"), "are of two_room: give env=two_room")
    refused(execute(tmp_path, "train.py", f"dataset={data}", "model.image_size=64"), "frames of 32 pixels")
    assert not list(tmp_path.iterdir())


def test_too_few_episodes_for_the_pairs_are_found_before_training(trained, execute, tmp_path):
    (tmp_path / "data").symlink_to(trained / "data")
    refused(execute(tmp_path, "train.py", "evaluation.num_pairs=9999"), "cannot draw 9999 pairs", "Collect more episodes")
    assert not list(tmp_path.rglob("metrics.csv"))


def test_evaluate_names_what_is_missing(trained, execute, files):
    before = files(trained)
    refused(execute(trained, "evaluate.py"), "name the model to evaluate: checkpoint=runs/")
    refused(execute(trained, "evaluate.py", "checkpoint=runs/nowhere"), "no checkpoint at runs/nowhere")
    assert files(trained) == before


def test_a_model_whose_actions_cannot_come_from_the_environment_is_refused(trained, execute, tmp_path):
    """Its statistics say mean 40 where the environment's bounds are -1 and 1."""
    path = find_checkpoint(trained / RUN)
    model, inverse_model, _ = load_world_model(path)
    model.action_mean.fill_(40.0)
    card = Checkpoint(card={}).load(path, components=["card"]).values["card"]
    wrong = tmp_path / "wrong.torchrl"
    Checkpoint(card=card, world_model=model, inverse_model=inverse_model).save(wrong, format="archive")
    done = execute(tmp_path, "evaluate.py", "checkpoint=wrong.torchrl", f"pairs={trained / RUN / 'pairs.json'}")
    refused(done, "action statistics", "was the model trained for another environment?")
    assert [entry.name for entry in tmp_path.iterdir()] == ["wrong.torchrl"]


def test_a_damaged_only_checkpoint_is_not_overwritten(copy, execute, files):
    """Training again from the start would replace what may still be saved."""
    (checkpoint,) = (copy / RUN / "checkpoints").iterdir()
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    before = files(copy / RUN / "checkpoints")
    done = execute(copy, "train.py")
    assert done.returncode == 1
    assert "is damaged and there is no other checkpoint" in done.stderr.splitlines()[-1]
    assert files(copy / RUN / "checkpoints") == before


@pytest.mark.parametrize("name", ["name=", "name=../out", "name=.hidden"])
def test_a_run_stays_below_its_folder(execute, tmp_path, name):
    done = execute(tmp_path, "train.py", name)
    assert done.returncode == 1 and "must be the plain name of a folder" in done.stderr
    assert not list(tmp_path.iterdir())
