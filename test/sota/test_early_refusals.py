"""Claims about what the scripts say, and when.

1.  Whatever goes wrong ends in one line of bounded length; a traceback is for those who ask by FICREG_TRACEBACK=1.
2.  A mistake in settings, dataset, notes or places is told before the work that it would spoil, and leaves nothing on disk.
3.  Any path can be named: with blanks, brackets, umlauts, ``~``.
4.  A run stays the same run wherever its command is given from.
5.  Evaluations with other settings keep folders of their own; easy pairs are said to be easy.
6.  The card of a checkpoint from elsewhere discloses nothing of this environment.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import signal
import sys
from pathlib import Path

import hydra
import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from torchrl_ficreg.data import EpisodeWriter
from torchrl_ficreg.pretrained import ModelCard
from torchrl_ficreg.trainers import Preempted

SCRIPTS = Path(__file__).resolve().parents[2] / "sota-implementations" / "ficreg"
RUN = "runs/two_room_cpu_ficreg_seed0"
SMALL = ["model.image_size=16", "optim.batch_size=8", "evaluation.num_pairs=2", "env.goal_offset=5", "device=cpu"]
MODULES = ("cli", "convert", "episodes", "evaluate", "planning", "run_dir", "sharded", "train", "train_policy", "utils")


@pytest.fixture
def scripts(monkeypatch):
    """Imports a module of the scripts into this process: a new process for every mistake would be slow."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    for name in ("HYDRA_FULL_ERROR", "FICREG_TRACEBACK"):  # the scripts set the first, and read both when imported
        monkeypatch.setenv(name, "")  # so that what is set meanwhile is taken back
        monkeypatch.delenv(name)
    for name in MODULES:
        sys.modules.pop(name, None)
    yield importlib.import_module
    for name in MODULES:
        sys.modules.pop(name, None)


@pytest.fixture
def refused(scripts, monkeypatch, capsys):
    """``refused("train", "seed=-1")`` is the one line in which a script ends."""

    def call(script: str, *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", [f"{script}.py", *arguments])
        with pytest.raises(SystemExit) as caught:
            scripts(script).main()
        line = caught.value.code
        assert isinstance(line, str) and line.startswith("error: ") and "\n" not in line, line
        assert "Traceback" not in capsys.readouterr().err
        return line

    return call


@pytest.fixture
def config():
    """``config("train", "seed=1")`` is a composed configuration."""

    def compose(name: str, *overrides: str):
        with hydra.initialize_config_dir(str(SCRIPTS / "config"), version_base="1.3"):
            return hydra.compose(name, list(overrides))

    return compose


def two_room_meta(**changes) -> dict:
    meta = {"env": "two_room", "env_kwargs": {}, "action_low": [-1.0, -1.0], "action_high": [1.0, 1.0], **changes}
    return {name: value for name, value in meta.items() if value != "missing"}


def write_dataset(path: Path, size: tuple[int, int] = (16, 16), state: float = 50.0, **changes) -> Path:
    """20 episodes of 30 rows in the left room, with the notes that a recording of TwoRoom has unless changed."""
    rng = np.random.default_rng(0)
    with EpisodeWriter(path, target_episodes=20, meta=two_room_meta(**changes)) as writer:
        for _ in range(20):
            action = np.pad(rng.uniform(-1, 1, (29, 2)), ((0, 1), (0, 0))).astype(np.float32)
            pixels = rng.integers(0, 256, (30, 3, *size), dtype=np.uint8)
            writer.append({"pixels": pixels, "action": action, "state": np.full((30, 2), state)})
    return path


class Panic(BaseException):
    """As libraries in Rust report damage."""


Panic.__name__ = "PanicException"


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("too\nmany\n lines"), "error: too many lines"),
        (KeyError("no column: give one"), "error: no column: give one"),
        (KeyError("env_kwargs"), "error: KeyError: 'env_kwargs' (FICREG"),
        (IndexError("list index out of range"), "error: IndexError: list index out of range (FICREG"),
        (AttributeError("'list' object has no attribute 'get'"), "error: AttributeError: 'list'"),
        (MemoryError(), "error: MemoryError (FICREG"),
        (OverflowError("too large"), "error: OverflowError: too large (FICREG"),
        (ZeroDivisionError("division by zero"), "error: ZeroDivisionError"),
        (RecursionError("maximum recursion depth"), "error: RecursionError"),
        (AssertionError(), "error: AssertionError (FICREG"),
        (ValueError(), "error: ValueError (FICREG"),
        (yaml.YAMLError("line 1\nline 2"), "error: YAMLError: line 1 line 2 (FICREG"),
        (Panic("range end index\n5"), "error: PanicException: range end index 5"),
        (OSError(28, "No space left on device", "/x"), "error: [Errno 28] No space left on device: '/x'"),
        (ValueError("x" * 50_000), "error: xxx"),
    ],
)
@pytest.mark.parametrize("asked", [False, True])
def test_whatever_goes_wrong_ends_in_one_line(scripts, monkeypatch, capsys, tmp_path, error, said, asked):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["convert.py", "source=a", "target=b"])
    if asked:
        monkeypatch.setenv("FICREG_TRACEBACK", "1")

    def main(cfg):
        raise error

    with pytest.raises(SystemExit) as caught:
        scripts("cli").entry_point("convert")(main)()
    line = caught.value.code
    assert line.startswith(said) and "\n" not in line and len(line) < 1100
    assert ("Traceback" in capsys.readouterr().err) == asked


@pytest.mark.parametrize("stop", [Preempted(signal.SIGTERM), KeyboardInterrupt()])
def test_a_stop_is_no_error_also_where_a_library_answers_it_by_one(scripts, monkeypatch, capsys, tmp_path, stop):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["convert.py", "source=a", "target=b"])

    def main(cfg):
        try:
            raise stop
        except BaseException:
            raise RuntimeError("Converting a tensordict to boolean value is not permitted") from None

    with pytest.raises(SystemExit) as caught:
        scripts("cli").entry_point("convert")(main)()
    assert caught.value.code == (85 if isinstance(stop, Preempted) else 130)
    assert "error" not in capsys.readouterr().err


@pytest.mark.parametrize("script", ["evaluate", "train_policy"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_what_starts_over_says_so_when_it_is_stopped(scripts, monkeypatch, capsys, tmp_path, script, number):
    """Only training and recording continue where they stopped."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [f"{script}.py", "checkpoint=x"])
    module = scripts(script)

    def stopped(*_):
        os.kill(os.getpid(), number)

    monkeypatch.setattr(module, "find_checkpoint", stopped)
    with pytest.raises(SystemExit) as caught:
        module.main()
    assert caught.value.code == (85 if number == signal.SIGTERM else 130)
    assert capsys.readouterr().err.strip() == f"stopped by {number.name}: the same command starts over."


@pytest.mark.parametrize(
    ("script", "arguments", "words"),
    [
        ("train", ["env.data.episodes=40", "-m", "seed=0,1"], ["seed=0,1 is out of place", "-m come before"]),
        ("convert", [], ["name source and target"]),
        ("convert", ["source=x"], ["name target: "]),
        ("evaluate", [], ["name the model to evaluate"]),
        ("train_policy", [], ["name the model to train a policy for"]),
        ("train", ["device=gpu"], ["did you mean device=cuda?"]),
        ("train", ["device=gpu:1"], ["did you mean device=cuda:1?"]),
        ("train", ["env=pusht"], ["did you mean push_t?"]),
        ("train", ["method=ficregg"], ["did you mean ficreg?"]),
        ("train", ["seed=[1"], ["'seed=[1' cannot be read: quote the value"]),
        ("train", ["seed"], ["'seed' cannot be read: settings are written name=value"]),
        ("convert", ["source=x.h5", "target=y"], ["no file or folder at x.h5"]),
    ],
)
def test_slips_on_the_command_line_are_told_kindly(refused, monkeypatch, tmp_path, script, arguments, words):
    monkeypatch.chdir(tmp_path)
    line = refused(script, *arguments)
    assert all(word in line for word in words), line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("override", "key", "value"),
    [
        ("collect.options={remote_configs: {num_cpus: 1}}", "collect.options", {"remote_configs": {"num_cpus": 1}}),
        ("collect.options={remote_configs:{num_cpus:1}}", "collect.options.remote_configs.num_cpus", 1),
        ("collect.options.remote_configs.num_cpus=1", "collect.options.remote_configs.num_cpus", 1),
        ("+collect.options.slurm_kwargs={slurm_mem: 4G}", "collect.options.slurm_kwargs.slurm_mem", "4G"),
        ("++collect.options.a=[1,2]", "collect.options.a", [1, 2]),
        ("env.data.kwargs={collision: endpoint}", "env.data.kwargs.collision", "endpoint"),
        ("env.data.kwargs.collision=endpoint", "env.data.kwargs.collision", "endpoint"),
    ],
)
def test_mappings_that_are_declared_empty_take_any_fields(scripts, config, override, key, value):
    accepted = scripts("cli").check_overrides("train", [override, "seed=1"])
    assert accepted[1] == "seed=1"
    found = OmegaConf.select(config("train", *accepted), key)
    assert (OmegaConf.to_container(found) if OmegaConf.is_config(found) else found) == value


@pytest.mark.parametrize("override", ["collect.options=3", "collect.options=[a]", "collect.option.a=1", "~collect.options"])
def test_other_values_and_names_are_still_refused(scripts, override):
    with pytest.raises(ValueError, match="expected a value like|no field"):
        scripts("cli").check_overrides("train", [override])


PLACES = ["/data/Übung/a.h5", "lr=1e-3/a.h5", "run (1).h5", "中文/a.h5", "a&b.h5", "it's.h5", 'say "x".h5', "a, b.h5", "[old]/a.h5"]
PLACES += ["{date}/a.h5", "x+y@z#1.h5", "100%.h5", "a b", " lead.h5", "s3://bucket/a.h5", "C:/data/a.h5", "~/a.h5", "1e3", "null.h5"]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("key", ["source", "target"])
def test_any_path_can_be_named(scripts, config, monkeypatch, place, key):
    """As typed, or quoted for Hydra already; ``~`` is the home folder."""
    cli, home = scripts("cli"), Path.home()
    argument = cli.quoted(f"{key}={place}")
    cfg = config("convert", *cli.check_overrides("convert", [argument]))
    cli.expand_home(cfg)
    assert str(cfg[key]) == place.replace("~", str(home))


@pytest.mark.parametrize("key", ["dataset", "data_dir", "runs_dir", "resume", "plan.policy"])
def test_the_home_folder_is_meant_in_every_setting_that_names_one(scripts, config, key):
    cfg = config("train", scripts("cli").quoted(f"{key}=~/x"))
    scripts("cli").expand_home(cfg)
    assert OmegaConf.select(cfg, key) == str(Path.home() / "x")


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["optim.accumulate=3"], "optim.accumulate=3 must cut"),
        (["optim.accumulate=0"], "optim.accumulate=0"),
        (["distributed.strategy=magic"], "magic"),
        (["collect.collector=x"], "unknown collect.collector 'x'"),
        (["env.data.expert.noise_std=nan"], "noise_std"),
        (["env.data.expert.noise_std=-1"], "noise_std"),
        (["optim.batch_size=1000000"], "less than one batch of optim.batch_size=1000000"),
        (["env.data.episodes=3"], "leave no episode for"),
        (["evaluation.num_pairs=100000"], "cannot draw 100000 pairs"),
        (["env.goal_offset=5000", "env.budget=6000"], "cannot draw"),
        (["model.image_size=1000000"], "lower model.image_size=1000000|make no networks"),
        (["model.predictor_depth=1000000"], "model.predictor_depth=1000000: expected at most 1000 layers"),
        (["method=lewm", "plan.consistency=0.5"], "plan.consistency=0.5 asks the inverse model"),
        (["method=pldm", "method.idm_coeff=0.0", "plan.consistency=0.5"], "asks the inverse model"),
        (["loss.idm_coeff=0.0", "plan.consistency=0.5"], "asks the inverse model"),
        (["env.data.kwargs={colour: red}"], "colour"),
        (["env.kwargs.collision=soft"], "collision must be one of"),
    ],
)
def test_a_setting_that_would_fail_later_is_refused_before_anything_is_written(
    refused, monkeypatch, tmp_path, overrides, words
):
    monkeypatch.chdir(tmp_path)
    line = refused("train", *overrides)
    assert any(word in line for word in words.split("|")), line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "overrides",
    [["method=lewm"], ["method=pldm", "method.idm_coeff=1.0", "plan.consistency=0.5"], ["plan.consistency=0.5"]],
)
def test_an_inverse_model_that_is_trained_may_judge(scripts, config, overrides):
    cfg = config("train", *overrides)
    assert scripts("planning").check_consistency(cfg.plan, cfg) is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"action_high": [float("nan"), 1.0]}, "two lists of 2 finite numbers"),
        ({"action_high": [float("inf"), 1.0]}, "two lists of 2 finite numbers"),
        ({"action_high": "fast"}, "action_high=fast"),
        ({"action_low": [1.0, 1.0], "action_high": [-1.0, -1.0]}, "low <= high"),
        ({"action_low": [-1.0], "action_high": [1.0]}, "two lists of 2 finite numbers"),
        ({"action_low": {"x": -1}}, "action_low="),
        ({"action_low": "missing"}, "does not note action_low"),
        ({"env_kwargs": "missing", "action_high": "missing"}, "does not note env_kwargs, action_high"),
        ({"env_kwargs": {"colour": "red"}}, "which make no environment"),
        ({"env_kwargs": {"image_size": 7}}, "which make no environment"),
        ({"env_kwargs": ["collision"]}, "expected names and values"),
        ({"env": "three_room"}, "are of three_room, in which these scripts cannot plan"),
        ({"env": "push_t"}, "are of push_t: give env=push_t"),
        ({"env": "missing"}, "are of None"),
        ({"state": 1.0}, "holds states that two_room cannot be in"),
        ({"size": (24, 16)}, "frames of 24 x 16 pixels, the encoders see square ones"),
        ({"size": (16, 24)}, "image_size=16"),
        ({"size": (24, 24)}, "give model.image_size=24"),
    ],
)
def test_a_mistake_in_a_dataset_is_told_before_the_run_has_a_folder(refused, monkeypatch, tmp_path, changes, words):
    write_dataset(tmp_path / "data", **changes)
    monkeypatch.chdir(tmp_path)
    line = refused("train", "dataset=data", *SMALL)
    assert words in line and len(line) < 500, line
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_a_read_only_dataset_is_trained_on_up_to_its_pairs(scripts, config, monkeypatch, tmp_path):
    """Its pairs stand in the run's folder only."""
    path, train = write_dataset(tmp_path / "data"), scripts("train")
    monkeypatch.setattr(train, "is_writable", lambda folder: False)
    before = sorted(file.name for file in path.iterdir())
    ((pairs, budget, _),) = train.draw_tests(config("train", f"dataset={path}", *SMALL), path)
    assert len(pairs) == 2 and sorted(file.name for file in path.iterdir()) == before


@pytest.mark.parametrize("start", ["here", "parent", "root", "absolute", "moved", "linked"])
@pytest.mark.parametrize("named", [False, True])
def test_a_run_is_the_same_run_from_any_folder(scripts, config, monkeypatch, tmp_path, start, named):
    run_dir, project = scripts("run_dir"), tmp_path / "project"
    project.mkdir()
    monkeypatch.chdir(project)

    def settings(place: str, **places: str):
        given = {"runs_dir": f"{place}runs", "data_dir": f"{place}data"}
        given |= {"dataset": f"{place}data/mine"} if named else {}
        return config("train", *(f"{key}={value}" for key, value in given.items()), "name=a")

    folder = run_dir.claim_run_dir(settings(""))
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


@pytest.mark.parametrize(
    "text",
    ["", "7", "- a", "{", "a: !!python/object:os.system x", "model: ???\nname: ???", "model: *a", "a: &a [1]\nmodel: *a", "\x00"],
)
def test_a_damaged_configuration_of_a_run_is_named(scripts, config, monkeypatch, tmp_path, text):
    monkeypatch.chdir(tmp_path)
    folder = scripts("run_dir").claim_run_dir(config("train", "name=a"))
    (folder / "metrics.csv").write_text("step\n")
    (folder / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match="config.yaml is damaged|another configuration") as error:
        scripts("run_dir").check_run_dir(config("train", "name=a"))
    assert "\n" not in str(error.value) and len(str(error.value)) < 350


@pytest.mark.parametrize(
    "override",
    ["optim.lr=inf", "refine.lr=inf", "loss.idm_coeff=nan", "plan.effort=inf", "model.predictor_position_std=inf"]
    + ["env.data.expert.noise_std=nan", "env.data.episodes=1000000000000", "model.image_size=1000000000000"]
    + ["model.image_size=100000000", "optim.epochs=1000000000000", "collect.num_workers=100000", "evaluation.num_workers=100000"]
    + ["loss.sigreg_start=x", "loss.sigreg_start=[]", "device=1", "device=[]", "method.name=x"],
)
def test_numbers_and_types_that_no_setting_can_have_are_named(scripts, config, override):
    with pytest.raises(ValueError, match=override.split("=")[0].rpartition(".")[2]) as error:
        scripts("utils").check_settings(config("train", override))
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


@pytest.mark.parametrize("name", ["checkpoints", "wandb", "tensorboard"])
def test_nothing_is_written_through_a_link_in_a_folder_of_a_run(scripts, config, monkeypatch, tmp_path, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "runs" / "a").mkdir(parents=True)
    (tmp_path / "runs" / "a" / name).symlink_to(tmp_path / "thesis")
    with pytest.raises(ValueError, match=f"a/{name} is a link"):
        scripts("run_dir").check_run_dir(config("train", "name=a"))


def test_nothing_is_recorded_through_a_link_in_place_of_a_shard(scripts, config, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "shard-1").symlink_to(tmp_path / "thesis")
    settings = config("collect", "collect.collector=async", "collect.num_workers=2", "env.data.episodes=2")
    with pytest.raises(ValueError, match="shard-1 is a link"):
        scripts("sharded").record_shards(settings, tmp_path / "data", {})
    assert not any((tmp_path / "thesis").iterdir())


@pytest.mark.parametrize("content", ["", "../other", "a b", "a\nb", "x" * 200, None])
def test_an_id_of_wandb_that_is_none_is_named(scripts, tmp_path, content):
    file = tmp_path / "wandb" / "run_id"
    file.parent.mkdir()
    os.mkfifo(file) if content is None else file.write_text(content)
    with pytest.raises(ValueError, match="run_id") as error:
        scripts("loggers")._run_id(tmp_path)
    assert "\n" not in str(error.value)
    file.unlink()
    assert scripts("loggers")._run_id(tmp_path) == scripts("loggers")._run_id(tmp_path)


@pytest.mark.parametrize("value", ["${oc.env:SECRET}", "x${oc.env:SECRET}", "${oc.decode:1}", "${plan.seed}", ["${oc.env:SECRET}"]])
@pytest.mark.parametrize("key", ["dataset", "plan", "env", "new"])
def test_interpolations_of_a_card_are_not_resolved(scripts, config, monkeypatch, key, value):
    monkeypatch.setenv("SECRET", "hunter2")
    settings = OmegaConf.to_container(config("train"), resolve=True)
    if isinstance(settings.get(key), dict):
        settings[key]["policy"] = value
    else:
        settings[key] = value
    card = ModelCard({}, "two_room", {}, [-1.0, -1.0], [1.0, 1.0], settings)
    with pytest.raises(ValueError, match="interpolations of a card are not resolved") as error:
        scripts("utils").settings_of_card(card)
    assert "hunter2" not in str(error.value)


@pytest.mark.parametrize("settings", [{}, {"plan": {}}, {"plan": 3, "env": {}, "method": {}, "model": {}}])
def test_a_card_without_settings_is_named(scripts, settings):
    with pytest.raises(ValueError, match="the checkpoint's card holds no settings of .*(plan|method)"):
        scripts("utils").settings_of_card(ModelCard({}, "two_room", {}, [-1.0], [1.0], settings))


def make_results(**changes) -> dict:
    row = {"pairs": 20, "success_rate": 0.5, "success_rate_at_end": 0.4, "success_interval": [0.3, 0.7], "solved_at_start": 0}
    row |= {"seconds_per_plan": 0.1, "success_rate_unsolved_at_start": 0.5}
    results = {"method": "ficreg", "search": "cem", "policy": row, "random": {**row, "success_rate": 0.1}}
    results |= {"checkpoint": "c", "pairs": "p", "budget": 50, "plan": {"search": "cem", "seed": 0}}
    return {**results, **changes}


def test_evaluations_keep_folders_of_their_own_and_stand_in_one_table(scripts, tmp_path, capsys):
    evaluate = scripts("evaluate")
    settings = [{"plan": {"search": search, "horizon": horizon}} for search in ("cem", "icem") for horizon in (1, 2)]
    names = [evaluate.folder_name(setting) for setting in settings]
    assert len(set(names)) == 4 and names == [evaluate.folder_name(setting) for setting in settings]
    for name, plan in zip(names, ({"search": "cem", "horizon": 1}, {"search": "cem", "horizon": 2})):
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps(make_results(plan=plan)))
    escapes = {"key": make_results(plan={"\x1b[2J": 1, "search": "cem"}), "value": make_results(pairs="\x1b[2J")}
    escapes = {name: json.dumps(results) for name, results in escapes.items()}
    for name, text in {"torn": "{", "list": "[]", "old": json.dumps({"ficreg": {}}), "text": json.dumps(make_results(plan="x")), **escapes}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(text)
    others = evaluate.read_others(tmp_path, names[0])
    assert list(others) == [names[1]]
    assert capsys.readouterr().out.count("left out of the table") == 6
    evaluate.show({names[0]: make_results(plan={"search": "cem", "horizon": 1}), **others})
    out = capsys.readouterr().out
    assert "horizon=1" in out and "horizon=2" in out and out.count("ficreg, cem") == 2


@pytest.mark.parametrize(
    ("policy", "random", "words"),
    [
        ({}, {}, []),
        ({"solved_at_start": 17, "success_rate_unsolved_at_start": 1 / 3}, {}, ["17 of 20 pairs are solved", "33.3% of 3"]),
        ({}, {"success_rate": 0.85}, ["random actions solve 85.0%"]),
        ({"solved_at_start": 20, "success_rate_unsolved_at_start": None}, {}, ["of none", "20 of 20 pairs are solved"]),
    ],
)
def test_easy_pairs_are_said_to_be_easy(scripts, capsys, policy, random, words):
    results = make_results()
    rows = [("ficreg, cem", {**results["policy"], **policy}, ""), ("random", {**results["random"], **random}, "")]
    scripts("utils").report(rows)
    out = capsys.readouterr().out
    assert all(word in out for word in words) and ("warning: " in out) == bool(words)


@pytest.mark.parametrize("script", ["evaluate", "train_policy"])
def test_a_place_that_cannot_be_written_is_found_before_the_work(refused, scripts, monkeypatch, trained, tmp_path, script):
    """A file stands where the folder is to be: also for root, who may write everywhere."""
    (tmp_path / "taken").write_text("")
    module = scripts(script)
    for name in ("evaluate_beside_random", "make_rows"):
        if hasattr(module, name):
            monkeypatch.setattr(module, name, lambda *_, **__: pytest.fail("the work began"))
    monkeypatch.chdir(trained)
    line = refused(script, f"checkpoint={RUN}", f"output={tmp_path / 'taken' / 'out'}", "device=cpu")
    assert "cannot write in" in line and "give output=" in line


@pytest.mark.parametrize("script", ["evaluate", "train_policy"])
def test_nothing_is_written_through_a_link_of_a_run_folder(refused, monkeypatch, copy, tmp_path, script):
    (tmp_path / "victim").mkdir()
    (copy / RUN / {"evaluate": "evaluation", "train_policy": "goal_policy"}[script]).symlink_to(tmp_path / "victim")
    monkeypatch.chdir(copy)
    assert "is a link, through which nothing is written" in refused(script, f"checkpoint={RUN}", "device=cpu")
    assert not list((tmp_path / "victim").iterdir())


def test_a_judge_that_was_not_trained_is_refused_in_an_evaluation_too(refused, scripts, monkeypatch, trained, tmp_path):
    evaluate, utils = scripts("evaluate"), scripts("utils")

    def of_lewm(card):
        config = utils.settings_of_card(card)
        config.method = {"name": "lewm"}
        return config

    monkeypatch.setattr(evaluate, "settings_of_card", of_lewm)
    monkeypatch.chdir(trained)
    for arguments in (["plan.consistency=0.5"], ["plan=icem", "plan.consistency=0.5"]):
        line = refused("evaluate", f"checkpoint={RUN}", f"output={tmp_path / 'out'}", "device=cpu", *arguments)
        assert "asks the inverse model, which method=lewm has not trained" in line
    assert not (tmp_path / "out").exists()


def test_results_can_be_read_by_strict_readers(scripts, tmp_path):
    values = {"rate": float("nan"), "interval": [float("inf"), 1.0], "deep": {"x": (-float("inf"),)}}
    scripts("utils").write_json(tmp_path / "x.json", values)
    found = json.loads((tmp_path / "x.json").read_text(), parse_constant=pytest.fail)
    assert found == {"rate": None, "interval": [None, 1.0], "deep": {"x": [None]}}


def test_a_moved_copy_of_a_dataset_is_named_by_its_own_place(refused, monkeypatch, tmp_path):
    shutil.move(write_dataset(tmp_path / "a", env_kwargs={"colour": "red"}), tmp_path / "b")
    monkeypatch.chdir(tmp_path)
    assert f"{tmp_path / 'b'} (meta.json)" in refused("train", "dataset=b", *SMALL)
