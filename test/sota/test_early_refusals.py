"""Claims about what the scripts refuse, and when.

1.  A mistake in settings, dataset, run directory or paths is found before the work that it would spoil, and leaves nothing
    on disk.
2.  A run stays the same run from whatever folder its command is given.
3.  Evaluations with other settings keep folders of their own; a warning says that pairs are too easy.
4.  A model is evaluated on pictures of the same detail as those of its dataset.
5.  The card of a foreign checkpoint discloses no environment variables.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import configs
import evaluate
import numpy as np
import pytest
import results
import run_dir
import utils
from omegaconf import OmegaConf
from torchrl.checkpoint import Checkpoint

from torchrl_ficreg.data import EpisodeWriter
from torchrl_ficreg.data.dataset import split_episodes
from torchrl_ficreg.data.shards import open_store
from torchrl_ficreg.pretrained import ModelCard
from torchrl_ficreg.trainers import find_checkpoint, load_world_model

RUN = "runs/two_room_cpu_ficreg_seed0"
SMALL = ["model.image_size=16", "optim.batch_size=8", "evaluation.num_pairs=2", "env.goal_offset=5", "device=cpu"]


def write_dataset(path: Path, size: tuple[int, int] = (16, 16), state: float = 50.0, short=(), **changes) -> Path:
    """20 episodes of 30 rows in the left room, 12 where ``short``, with the notes of a recording of TwoRoom unless changed."""
    meta = {"env": "two_room", "env_kwargs": {}, "action_low": [-1.0, -1.0], "action_high": [1.0, 1.0], **changes}
    meta = {name: value for name, value in meta.items() if value != "missing"}
    rng = np.random.default_rng(0)
    with EpisodeWriter(path, target_episodes=20, meta=meta) as writer:
        for number in range(1, 21):
            rows = 12 if number in short else 30
            action = np.pad(rng.uniform(-1, 1, (rows - 1, 2)), ((0, 1), (0, 0))).astype(np.float32)
            pixels = rng.integers(0, 256, (rows, 3, *size), dtype=np.uint8)
            writer.append({"pixels": pixels, "action": action, "state": np.full((rows, 2), state)})
    return path


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["optim.accumulate=3"], "optim.accumulate=3 must divide"),
        (["collect.frames=jpeg"], "jpeg"),
        (["env.data.expert.noise_std=-1"], "noise_std"),
        (["env.data.kwargs={colour: red}"], "colour"),
        (["env.kwargs.collision=soft"], "collision must be one of"),
        (["optim.batch_size=1000000"], "less than one batch of optim.batch_size=1000000"),
        (["refine.batch_size=1000000", "refine.epochs=1"], "less than one batch of refine.batch_size=1000000"),
        (["loss.prediction_steps=200"], "the clips of loss are 1000 steps long"),
        (["env.data.episodes=3"], "leave no episode for"),
        (["evaluation.num_pairs=100000"], "cannot draw 100000 pairs"),
        (["evaluation.also=[[25,50]]"], "evaluation.also must have other goal offsets"),
        (["evaluation.also=[3]"], "evaluation.also must list pairs"),
        (["evaluation.epoch=7"], "evaluation.epoch must be null or an epoch from 1 to optim.epochs=6"),
        (["evaluation.epoch=1", "refine.epochs=3"], "leaves no use for refine.epochs=3"),
        (["optim.schedule_epochs=5"], "optim.schedule_epochs must be null or at least optim.epochs=6"),
        (["model.encoder=mlp"], "unknown encoder 'mlp'"),
        (["model.image_size=100000000"], "image_size"),
        (["model.image_size=1000000"], "lower model.image_size=1000000|make no networks"),
        (["model.predictor_depth=1000000"], "model.predictor_depth=1000000: expected at most 1000 layers"),
        (["method.context=dead"], "unknown context 'dead'"),
        (["method.name=x"], "method.name=x is unknown"),
        (["method.consistency_steps=2", "loss.num_frames=2"], "method.consistency_steps=2 needs clips of at least 3 frames"),
        (["loss.prediction_steps=3", "loss.num_frames=3"], "loss.prediction_steps=3 needs clips of at least 4 frames"),
        (["refine.prediction_steps=3", "refine.num_frames=3"], "refine.prediction_steps=3 needs clips of at least 4 frames"),
        (["refine.prediction_steps=200", "refine.epochs=3"], "the clips of refine are 1000 steps long"),
        (["loss.sigreg_start=0.1", "loss.sigreg_coeff=0.0"], "must be positive to fall from one to the other"),
        (["refine.lr=-1"], "refine.lr must be positive"),
        (["plan.num_elites=500"], "num_elites must lie between 2 and num_candidates=300"),
        (["plan.bounds=wide"], "unknown bounds 'wide'"),
        (["plan.horizon=11"], "plan.horizon=11 blocks of 5 steps reach beyond the budget of 50 steps"),
        (["method=lewm", "plan.consistency=0.5"], "plan.consistency=0.5 asks the inverse model"),
        (["method=pldm", "method.idm_coeff=0.0", "plan.consistency=0.5"], "asks the inverse model"),
        (["loss.idm_coeff=0.0", "plan.consistency=0.5"], "asks the inverse model"),
    ],
)
def test_a_setting_that_would_fail_later_is_refused_before_anything_is_written(refused, tmp_path, overrides, words):
    line = refused("train.py", *overrides, code=1)
    assert any(word in line for word in words.split("|")) and len(line) < 600, line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "overrides",
    [["method=lewm"], ["method=pldm", "method.idm_coeff=1.0", "plan.consistency=0.5"], ["plan.consistency=0.5"]],
)
def test_a_trained_inverse_model_may_take_part_in_planning(config, overrides):
    cfg = config("train", *overrides)
    assert configs.check_consistency(cfg.plan, cfg) is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"action_high": [float("nan"), 1.0]}, "two lists of 2 finite numbers"),
        ({"action_high": "fast"}, "action_high=fast"),
        ({"action_low": [1.0, 1.0], "action_high": [-1.0, -1.0]}, "low <= high"),
        ({"action_low": [-1.0], "action_high": [1.0]}, "two lists of 2 finite numbers"),
        ({"action_low": "missing"}, "does not note action_low"),
        ({"env_kwargs": "missing", "action_high": "missing"}, "does not note env_kwargs, action_high"),
        ({"env_kwargs": {"colour": "red"}}, "which make no environment"),
        ({"env_kwargs": {"image_size": 7}}, "which make no environment"),
        ({"env_kwargs": ["collision"]}, "expected names and values"),
        ({"env": "three_room"}, "are of three_room, in which these scripts cannot plan"),
        ({"env": "push_t"}, "are of push_t: give env=push_t"),
        ({"env": "missing"}, "are of None"),
        ({"state": 1.0}, "holds states that two_room cannot be in"),
        ({"size": (24, 16)}, "frames of 24 x 16 pixels, the encoders take square ones"),
        ({"size": (16, 24)}, "image_size=16"),
        ({"size": (24, 24)}, "give model.image_size=24"),
        ({"optim.batch_size": 1300}, "less than one batch of 1300"),  # a setting that does not suit the data
        ({"evaluation.num_pairs": 190}, "Collect more episodes, or ask for fewer pairs"),
    ],
)
def test_a_mistake_in_a_dataset_is_found_before_the_run_has_a_folder(refused, tmp_path, changes, words):
    settings = [f"{name}={value}" for name, value in changes.items() if "." in name]
    write_dataset(tmp_path / "data", **({} if settings else changes))
    line = refused("train.py", "dataset=data", *SMALL, *settings)
    assert words in line and len(line) < 500, line
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize("split", ["train", "validation"])
def test_clips_of_refine_that_no_episode_holds_are_found_before_the_training(refused, tmp_path, split):
    write_dataset(tmp_path / "data", short=split_episodes(20, split))
    line = refused("train.py", "dataset=data", *SMALL, "refine.epochs=1", "refine.prediction_steps=3", "refine.batch_size=8")
    assert "a clip needs 16 rows" in line, line
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize(
    ("noted", "overrides", "detail"),
    [
        ({"detail": "fast"}, [], "fast"),
        ({"detail": "published"}, [], "published"),
        ({}, [], None),  # recorded before there was a choice: the default of the environment
        ({}, ["env.kwargs.detail=fast"], None),
        ({"detail": "fast"}, ["model=paper", "model.image_size=16"], "fast"),
    ],
)
def test_pictures_of_an_evaluation_are_as_detailed_as_those_of_the_dataset(config, tmp_path, noted, overrides, detail):
    for name in ("mujoco", "dm_control"):
        pytest.importorskip(name)
    path = write_dataset(tmp_path / "data", env="reacher", env_kwargs={"wrap": False, **noted})
    cfg = config("train", "env=reacher", f"dataset={path}", *SMALL, *overrides)
    card = utils.make_card(cfg, utils.make_dataset(cfg, path, "train"))
    assert card.env_kwargs.get("detail") == detail
    assert card.env_kwargs["wrap"] is cfg.env.kwargs.wrap


def test_a_moved_copy_of_a_dataset_is_named_by_its_own_place(refused, tmp_path):
    shutil.move(write_dataset(tmp_path / "a", env_kwargs={"colour": "red"}), tmp_path / "b")
    assert f"{tmp_path / 'b'} (meta.json)" in refused("train.py", "dataset=b", *SMALL)


def test_a_read_only_dataset_is_trained_on_up_to_its_pairs(config, monkeypatch, tmp_path):
    """Its pairs are in the run directory only."""
    path = write_dataset(tmp_path / "data")
    monkeypatch.setattr(results, "is_writable", lambda folder: False)
    before = sorted(file.name for file in path.iterdir())
    ((pairs, budget),) = results.draw_tests(config("train", f"dataset={path}", *SMALL), open_store(path), {}, [(5, 50)])
    assert len(pairs) == 2 and sorted(file.name for file in path.iterdir()) == before


def test_another_configuration_under_the_same_name_is_refused(trained, refused, files):
    before, settings = files(trained), [f"name={RUN.split('/')[1]}", "optim.lr=0.1", "loss.idm_coeff=7.0"]
    line = refused("train.py", *settings, folder=trained, code=1, tiny=True)
    words = ["another configuration", "optim.lr: 0.0005 -> 0.1", "loss.idm_coeff", "give another name="]
    assert all(word in line for word in words), line
    assert files(trained) == before


@pytest.mark.parametrize(("setting", "free"), [("checkpoint_activations", True), ("compile", False), ("lr", False)])
def test_only_what_changes_no_number_may_change_while_a_run_goes_on(setting, free):
    """A compiled graph draws other dropout masks."""
    ours, theirs = ({"optim": {setting: value}} for value in (True, False))
    assert (run_dir._differences(ours, theirs) == "") == free


@pytest.mark.parametrize("encoder", ["conv", "keypoint"])
def test_sizes_of_another_encoder_do_not_matter(encoder):
    """A default of one encoder may change without ending the runs of another."""
    ours, theirs = ({"model": {"encoder": encoder, "keypoint_channels": value}} for value in ([8], [16]))
    assert (run_dir._differences(ours, theirs) == "") == (encoder == "conv")


@pytest.mark.parametrize("start", ["here", "parent", "root", "absolute", "moved", "linked"])
@pytest.mark.parametrize("named", [False, True])
def test_a_run_is_the_same_run_from_any_folder(config, monkeypatch, tmp_path, start, named):
    project = tmp_path / "project"
    project.mkdir()
    monkeypatch.chdir(project)

    def settings(place: str, **places: str):
        given = {"runs_dir": f"{place}runs", "data_dir": f"{place}data"}
        given |= {"dataset": f"{place}data/mine"} if named else {}
        return config("train", *(f"{key}={value}" for key, value in given.items()), "name=a")

    with run_dir.claim_run_dir(settings("")) as folder:
        (folder / "metrics.csv").write_text("step\n")
    if start == "moved":
        monkeypatch.chdir(tmp_path)
        project.rename(tmp_path / "other")
        monkeypatch.chdir(tmp_path / "other")
    elif start == "linked":
        (tmp_path / "link").symlink_to(project)
        monkeypatch.chdir(tmp_path)
    else:
        monkeypatch.chdir({"here": project, "parent": tmp_path}.get(start, "/"))
    place = {"parent": "project/", "root": f"{project}/", "absolute": f"{project}/", "linked": "link/"}.get(start, "")
    assert run_dir.check_run_dir(settings(place)).resolve().name == "a"
    other = settings(place)
    other.data_dir = f"{place}elsewhere"
    with pytest.raises(ValueError, match="another configuration .data_dir"):
        run_dir.check_run_dir(other)


def test_a_run_directory_belongs_to_one_process_at_a_time(config, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    cfg = config("train", "name=a")
    with run_dir.claim_run_dir(cfg), pytest.raises(RuntimeError, match="another process is at work in runs/a"):
        with run_dir.claim_run_dir(cfg):
            pass
    with run_dir.claim_run_dir(cfg):
        pass


ODD = ["", "7", "- a", "{", "\x00", "a: !!python/object:os.system x"]
ODD += ["model: ???\nname: ???", "model: *a", "a: &a [1]\nmodel: *a"]


@pytest.mark.parametrize("text", ODD)
def test_a_damaged_configuration_of_a_run_is_named(config, monkeypatch, tmp_path, text):
    monkeypatch.chdir(tmp_path)
    with run_dir.claim_run_dir(config("train", "name=a")) as folder:
        (folder / "metrics.csv").write_text("step\n")
        (folder / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match="config.yaml is damaged|another configuration") as error:
        run_dir.check_run_dir(config("train", "name=a"))
    assert "\n" not in str(error.value) and len(str(error.value)) < 350


@pytest.mark.parametrize("name", ["checkpoints", "refine", "refine/checkpoints", "wandb", "tensorboard"])
def test_nothing_is_written_through_a_link_in_a_folder_of_a_run(config, monkeypatch, tmp_path, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "runs" / "a" / name).parent.mkdir(parents=True)
    (tmp_path / "runs" / "a" / name).symlink_to(tmp_path / "thesis")
    with pytest.raises(ValueError, match=f"a/{name} is a link"):
        run_dir.check_run_dir(config("train", "name=a"))


@pytest.mark.parametrize("content", ["", "../other", "a b", "a\nb", "x" * 200, None])
def test_an_invalid_id_of_wandb_is_named(tmp_path, content):
    file = tmp_path / "wandb" / "run_id"
    file.parent.mkdir()
    os.mkfifo(file) if content is None else file.write_text(content)
    with pytest.raises(ValueError, match="run_id") as error:
        results._wandb_id(tmp_path)
    assert "\n" not in str(error.value)
    file.unlink()
    assert results._wandb_id(tmp_path) == results._wandb_id(tmp_path)


SECRET = "${oc.env:SECRET}"


@pytest.mark.parametrize("value", [SECRET, f"x{SECRET}", [SECRET], "${oc.decode:1}", "${plan.seed}"])
@pytest.mark.parametrize("key", ["dataset", "plan", "env", "new"])
def test_interpolations_of_a_card_are_not_resolved(config, monkeypatch, key, value):
    monkeypatch.setenv("SECRET", "hunter2")
    settings = OmegaConf.to_container(config("train"), resolve=True)
    if isinstance(settings.get(key), dict):
        settings[key]["policy"] = value
    else:
        settings[key] = value
    card = ModelCard({}, "two_room", {}, [-1.0, -1.0], [1.0, 1.0], settings)
    with pytest.raises(ValueError, match="interpolations of a card are not resolved") as error:
        utils.settings_of_card(card)
    assert "hunter2" not in str(error.value)


@pytest.mark.parametrize("settings", [{}, {"plan": {}}, {"plan": 3, "env": {}, "method": {}, "model": {}}])
def test_a_card_without_settings_is_named(settings):
    with pytest.raises(ValueError, match="the checkpoint's card holds no settings of .*(plan|method)"):
        utils.settings_of_card(ModelCard({}, "two_room", {}, [-1.0], [1.0], settings))


def test_a_model_whose_actions_cannot_come_from_the_environment_is_refused(trained, refused, tmp_path):
    """Its statistics have mean 40 where the environment's bounds are -1 and 1."""
    path = find_checkpoint(trained / RUN)
    model, inverse_model, _ = load_world_model(path)
    model.action_mean.fill_(40.0)
    card = Checkpoint(card={}).load(path, components=["card"]).values["card"]
    wrong = tmp_path / "wrong.torchrl"
    Checkpoint(card=card, world_model=model, inverse_model=inverse_model).save(wrong, format="archive")
    line = refused("evaluate.py", "checkpoint=wrong.torchrl", f"pairs={trained / RUN / 'pairs.json'}")
    assert "action statistics" in line and "was the model trained for another environment?" in line
    assert [entry.name for entry in tmp_path.iterdir()] == ["wrong.torchrl"]


def test_an_untrained_inverse_model_is_refused_in_an_evaluation_too(refused, monkeypatch, trained, tmp_path):
    def of_lewm(card):
        config = utils.settings_of_card(card)
        config.method = {"name": "lewm"}
        return config

    monkeypatch.setattr(evaluate, "settings_of_card", of_lewm)
    for arguments in (["plan.consistency=0.5"], ["plan=icem", "plan.consistency=0.5"]):
        line = refused("evaluate.py", f"checkpoint={RUN}", f"output={tmp_path / 'out'}", *arguments, folder=trained)
        assert "asks the inverse model, which method=lewm has not trained" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("script", ["evaluate", "train_policy"])
def test_a_place_that_cannot_be_written_is_found_before_the_work(refused, monkeypatch, trained, tmp_path, script):
    """A file stands where the folder is to be: also for root, who may write everywhere."""
    (tmp_path / "taken").write_text("")
    work = {"evaluate": "evaluate.evaluate_with_random_baseline", "train_policy": "train_policy.make_rows"}[script]
    monkeypatch.setattr(work, lambda *_, **__: pytest.fail("the work began"))
    line = refused(f"{script}.py", f"checkpoint={RUN}", f"output={tmp_path / 'taken' / 'out'}", folder=trained)
    assert "cannot write in" in line and "give output=" in line


@pytest.mark.parametrize("script", ["evaluate", "train_policy"])
def test_nothing_is_written_through_a_link_of_a_run_folder(refused, copy, tmp_path, script):
    (tmp_path / "victim").mkdir()
    (copy / RUN / {"evaluate": "evaluation", "train_policy": "goal_policy"}[script]).symlink_to(tmp_path / "victim")
    line = refused(f"{script}.py", f"checkpoint={RUN}", folder=copy)
    assert "is a link, through which nothing is written" in line
    assert not list((tmp_path / "victim").iterdir())


def make_results(**changes) -> dict:
    row = {"pairs": 20, "success_rate": 0.5, "success_rate_at_end": 0.4, "success_interval": [0.3, 0.7], "solved_at_start": 0}
    row |= {"seconds_per_plan": 0.1, "success_rate_unsolved_at_start": 0.5}
    results = {"method": "ficreg", "search": "cem", "policy": row, "random": {**row, "success_rate": 0.1}}
    results |= {"checkpoint": "c", "pairs": "p", "budget": 50, "plan": {"search": "cem", "seed": 0}}
    return {**results, **changes}


def test_evaluations_keep_folders_of_their_own_and_stand_in_one_table(tmp_path, capsys):
    settings = [{"plan": {"search": search, "horizon": horizon}} for search in ("cem", "icem") for horizon in (1, 2)]
    names = [evaluate.folder_name(setting) for setting in settings]
    assert len(set(names)) == 4 and names == [evaluate.folder_name(setting) for setting in settings]
    for name, plan in zip(names, ({"search": "cem", "horizon": 1}, {"search": "cem", "horizon": 2})):
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps(make_results(plan=plan)))
    others = evaluate.read_others(tmp_path, names[0])
    assert list(others) == [names[1]]
    evaluate.show({names[0]: make_results(plan={"search": "cem", "horizon": 1}), **others})
    out = capsys.readouterr().out
    assert "horizon=1" in out and "horizon=2" in out and out.count("ficreg, cem") == 2


def test_results_that_cannot_be_shown_are_left_out_of_the_table(tmp_path, capsys):
    """Whatever is found in their place, the evaluation at hand is shown."""
    whole = make_results()
    wrong = [[], None, 3, {}, {"ficreg": {}}, {**whole, "plan": "x"}, {**whole, "policy": None}, {**whole, "method": "a\nb"}]
    wrong += [{key: value for key, value in whole.items() if key != "budget"}, {**whole, "pairs": "\x1b[2J"}]
    wrong += [make_results(plan={"\x1b[2J": 1, "search": "cem"})]
    wrong += [{**whole, "policy": {**whole["policy"], key: None}} for key in ("success_interval", "success_rate", "pairs")]
    texts = [json.dumps(value) for value in wrong] + ["", "{", "[" * 10**5, '{"policy": ' * 500 + "1" + "}" * 500, "1e999"]
    for name, text in [("whole", json.dumps(whole)), *((f"odd{number}", text) for number, text in enumerate(texts))]:
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(text)
    (tmp_path / "fifo").mkdir()
    os.mkfifo(tmp_path / "fifo" / "results.json")
    found = evaluate.read_others(tmp_path, "mine")
    assert list(found) == ["whole"]
    assert capsys.readouterr().out.count("left out of the table") == len(texts) + 1
    evaluate.show({"mine": whole, **found})


@pytest.mark.parametrize(
    ("policy", "random", "words"),
    [
        ({}, {}, []),
        ({"solved_at_start": 17, "success_rate_unsolved_at_start": 1 / 3}, {}, ["17 of 20 pairs are solved", "33.3% of 3"]),
        ({}, {"success_rate": 0.85}, ["random actions solve 85.0%"]),
        ({"solved_at_start": 20, "success_rate_unsolved_at_start": None}, {}, ["of none", "20 of 20 pairs are solved"]),
    ],
)
def test_a_warning_says_that_pairs_are_too_easy(capsys, policy, random, words):
    rows = make_results()
    results.report([("ficreg, cem", {**rows["policy"], **policy}, ""), ("random", {**rows["random"], **random}, "")])
    out = capsys.readouterr().out
    assert all(word in out for word in words) and ("warning: " in out) == bool(words)


def test_results_can_be_read_by_strict_readers(tmp_path):
    values = {"rate": float("nan"), "interval": [float("inf"), 1.0], "deep": {"x": (-float("inf"),)}}
    run_dir.write_json(tmp_path / "x.json", values)
    found = json.loads((tmp_path / "x.json").read_text(), parse_constant=pytest.fail)
    assert found == {"rate": None, "interval": [None, 1.0], "deep": {"x": [None]}}
