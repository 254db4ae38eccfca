"""Claims about the command line of the scripts.

1.  An unknown field, choice or type, and a number out of range, is one line that names the setting; the exit code is 2.
2.  Whatever else goes wrong is one line of bounded length; FICREG_TRACEBACK=1 shows the traceback above it.
3.  A stop by a signal is no error, and says whether the same command continues.
4.  Any path can be named: with blanks, brackets, umlauts, ``~``.
5.  A sweep that cannot run is refused before it starts.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from pathlib import Path

import cli
import pytest
import yaml
from hydra.errors import MissingConfigException
from omegaconf import OmegaConf

from torchrl_ficreg.trainers import Preempted

AT_LEAST_ONE = ("optim.epochs", "optim.accumulate", "loss.prediction_steps", "env.data.max_steps")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optim.lrr=1", "no field 'optim.lrr' to change; did you mean 'optim.lr'?"),
        ("optm.lr=1", "no field 'optm.lr' to change; did you mean 'optim.lr'?"),
        *((f"+{field}=1", f"no field '{field}'") for field in ("new", "optim.new")),
        *((f"{field}=1", f"no field '{field}'") for field in ("plan.noise_beta", "method.new", "env.data.kwarg.a")),
        *((field, "a field cannot be removed") for field in ("~optim.lr", "~env.data.kwargs")),
        ("method=leWM", "method=leWM is unknown: choose one of ['ficreg', 'joint_inverse', 'lewm', 'pldm']"),
        ("method=ficregg", "did you mean ficreg? Choose one of"),
        ("env=pusht", "did you mean push_t?"),
        ("recipe=x", "recipe=x is unknown"),
        ("optim.epochs=many", "'optim.epochs=many': Value 'many' of type 'str' could not be converted to Integer"),
        *((setting, "could not be converted to Integer") for setting in ("optim.epochs=1.5", "collect.ray=x")),
        *((setting, "converted to Float") for setting in ("optim.lr.deeper=1", "optim.lr=[1,2]", "loss.sigreg_start=x")),
        ("model.conv_channels=3", "int is not a ListConfig, list or tuple"),
        *((setting, "Cannot convert 'list' to string") for setting in ("name=[a]", "device=[]")),
        ("optim=3", "int is not a subclass of Optim"),
        ("env.kwargs=3", "Cannot assign int"),
        ("env.data.kwargs=[a]", "Cannot merge DictConfig with ListConfig"),
        ("seed=null", "field 'seed' is not Optional"),
        ("seed=[1", "'seed=[1' cannot be read: quote the value"),
        ("seed", "'seed' cannot be read: settings are written name=value"),
        ("seed=-1", "seed=-1: expected 0 to 2^63 - 1"),
        *((f"{field}=0", f"{field}=0: expected at least 1") for field in AT_LEAST_ONE),
        ("refine.num_frames=1", "refine.num_frames=1: expected at least 2"),
        *((f"{field}.num_workers=-1", "num_workers=-1: expected at least 0") for field in ("collect", "evaluation")),
        ("optim.warmup=2.0", "optim.warmup=2.0: expected a number in [0, 1)"),
        ("optim.precision=fp16", "optim.precision=fp16: expected one of ['auto', 'fp32', 'bf16']"),
        ("optim.lr=inf", "optim.lr=inf: expected a finite number"),
        *((f"{field}=nan", f"{field}=nan: expected a finite") for field in ("loss.idm_coeff", "env.data.expert.noise_std")),
        *((f"{field}={10**12}", f"{field}={10**12}: expected at most") for field in ("env.data.episodes", "model.image_size")),
        ("collect.num_workers=100000", "collect.num_workers=100000: expected at most 1024"),
        ("logger.backend=paper", "logger.backend=paper: expected one of ['csv', 'wandb', 'tensorboard']"),
        *((f"name={name}", "expected the plain name of a folder") for name in ("", "../out", ".hidden")),
    ],
)
def test_a_wrong_setting_is_one_line_and_writes_nothing(refused, tmp_path, override, message):
    assert message in refused("train.py", override, code=2)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("script", ["train", "collect", "evaluate", "train_policy", "convert"])
def test_a_script_runs_its_main_function(script):
    """The tests that call it in this process show what the command does."""
    file = Path(importlib.import_module(script).__file__)
    assert file.read_text().endswith('\n\nif __name__ == "__main__":\n    main()\n')


def test_a_mistake_is_one_line_in_a_process_of_its_own_too(spawn, tmp_path):
    done = spawn(tmp_path, "train.py", "optim.epochs=0", "optim.lr=-1.0")
    assert done.returncode == 2 and not done.stdout and not list(tmp_path.iterdir())
    assert done.stderr == "error: optim.lr=-1.0: expected more than 0; optim.epochs=0: expected at least 1.\n"


@pytest.mark.parametrize(
    ("script", "arguments", "words"),
    [
        ("train", ["env.data.episodes=40", "-m", "seed=0,1"], ["seed=0,1 is out of place", "-m come before"]),
        ("convert", [], ["name source and target"]),
        ("convert", ["source=x"], ["name target: "]),
        ("convert", ["source=x.h5", "target=y"], ["no file or folder at x.h5"]),
        ("evaluate", [], ["name the model to evaluate: checkpoint=runs/"]),
        ("evaluate", ["checkpoint=runs/nowhere"], ["no checkpoint at runs/nowhere"]),
        ("evaluate", ["checkpoint=runs/nowhere", "num_envs=0"], ["num_envs=0: expected at least 1"]),
        ("train_policy", [], ["name the model to train a policy for"]),
        ("train", ["device=gpu"], ["did you mean device=cuda?"]),
        ("train", ["device=gpu:1"], ["did you mean device=cuda:1?"]),
        ("train", ["device=1"], ["device=1 cannot be used here"]),
        ("train", ["seed=0,1"], ["Ambiguous value for argument 'seed=0,1'"]),
    ],
)
def test_slips_on_the_command_line_are_named(refused, tmp_path, script, arguments, words):
    line = refused(f"{script}.py", *arguments)
    assert all(word in line for word in words), line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "overrides",
    [
        ["optim.lr=1", "optim.epochs=2", "method=lewm"],
        ["model=paper", "model.history=1", "model.conv_channels=[4,8]", "model.predictor_dropout=0"],
        ["name=x-1", "device=cuda:1", "optim.clip_norm=inf", "env.kwargs.collision=endpoint"],
        ["experiment=lewm_paper", "plan=icem", "plan.noise_beta=1.0", "loss.sigreg_start=0.1"],
    ],
)
def test_declared_fields_may_be_changed(config, overrides):
    cfg = config("train", *cli.prepare(overrides))
    cli.check_ranges(cfg)
    for key, value in (override.split("=") for override in overrides if "." in override.split("=")[0]):
        assert str(OmegaConf.select(cfg, key)).replace(" ", "") in (value, f"{value}.0")


@pytest.mark.parametrize(
    ("override", "key", "value"),
    [
        ("env.data.kwargs={collision: endpoint}", "env.data.kwargs", {"collision": "endpoint"}),
        ("env.data.kwargs={a:{b:1}}", "env.data.kwargs.a.b", 1),
        ("env.data.kwargs.a.b=1", "env.data.kwargs.a.b", 1),
        ("+env.data.kwargs.a={b: 4G}", "env.data.kwargs.a.b", "4G"),
        ("++env.data.expert.a=[1,2]", "env.data.expert.a", [1, 2]),
        ("env.kwargs.new=1", "env.kwargs.new", 1),
    ],
)
def test_arguments_of_constructors_take_any_name(config, override, key, value):
    found = OmegaConf.select(config("train", *cli.prepare([override])), key)
    assert (OmegaConf.to_container(found) if OmegaConf.is_config(found) else found) == value


PLACES = ["/data/Übung/a.h5", "lr=1e-3/a.h5", "run (1).h5", "中文/a.h5", "a&b.h5", "it's.h5", 'say "x".h5', "a, b.h5", "1e3"]
PLACES += ["{date}/a.h5", "x+y@z#1.h5", "100%.h5", "a b", " lead.h5", "s3://bucket/a.h5", "C:/data/a.h5", "~/a.h5", "null.h5"]
PLACES += ["[old]/a.h5"]


@pytest.mark.parametrize("place", PLACES)
def test_any_path_can_be_named(config, place):
    """As typed, or quoted for Hydra already; ``~`` is the home folder."""
    quoted = place.replace('"', '\\"')
    cfg = config("convert", *cli.prepare([f"source={place}", f'target="{quoted}"']))
    cli.expand_home(cfg)
    assert str(cfg.source) == str(cfg.target) == place.replace("~", str(Path.home()))


def test_the_home_folder_is_meant_in_every_setting_that_names_one(config):
    keys = ["dataset", "data_dir", "runs_dir", "resume", "plan.policy"]
    cfg = config("train", *cli.prepare([f"{key}=~/x" for key in keys]))
    cli.expand_home(cfg)
    assert {OmegaConf.select(cfg, key) for key in keys} == {str(Path.home() / "x")}


@pytest.mark.parametrize(("launcher", "extra"), [("processes", "sweep"), ("slurm", "slurm")])
def test_a_launcher_without_its_package_is_refused(refused, config, launcher, extra):
    try:
        config("train", f"hydra/launcher={launcher}", return_hydra_config=True)
    except MissingConfigException:
        line = refused("train.py", "-m", "seed=0,1", f"hydra/launcher={launcher}", code=2)
        assert f"pip install 'torchrl_ficreg[{extra}]'" in line
    else:
        pytest.skip("its package is installed")


def test_a_sweep_under_torchrun_is_refused_by_every_process(refused, monkeypatch):
    """The process group of the second run would find the store of the first, and wait for ever."""
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    monkeypatch.setenv("WORLD_SIZE", "2")
    for rank in "01":
        monkeypatch.setenv("RANK", rank)
        assert "under torchrun a sweep is one command for each run" in refused("train.py", "-m", "seed=0,1")


@pytest.fixture
def end(monkeypatch, tmp_path, capsys):
    """``end(error)`` is the exit code and stderr of a script whose main function raises it."""

    def call(error: BaseException, after: BaseException | None = None) -> tuple[int, str]:
        def main(cfg):
            try:
                if after is not None:
                    raise after
            except BaseException:
                raise error from None
            raise error

        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("HYDRA_FULL_ERROR", "")
        monkeypatch.setattr(sys, "argv", ["convert.py", "source=a", "target=b"])
        with pytest.raises(SystemExit) as caught:
            cli.entry_point("convert")(main)()
        return caught.value.code, capsys.readouterr().err

    return call


class Panic(BaseException):
    """As libraries in Rust report damage."""


Panic.__name__ = "PanicException"


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("too\nmany\n lines"), "too many lines"),
        (KeyError("no column: give one"), "no column: give one"),
        (KeyError("env_kwargs"), "KeyError: 'env_kwargs' (FICREG"),
        (IndexError("list index out of range"), "IndexError: list index out of range (FICREG"),
        (AttributeError("'list' object has no attribute 'get'"), "AttributeError: 'list'"),
        (MemoryError(), "MemoryError (FICREG"),
        (OverflowError("too large"), "OverflowError: too large (FICREG"),
        (RecursionError("maximum recursion depth"), "RecursionError"),
        (AssertionError(), "AssertionError (FICREG"),
        (ValueError(), "ValueError (FICREG"),
        (yaml.YAMLError("line 1\nline 2"), "YAMLError: line 1 line 2 (FICREG"),
        (Panic("range end index\n5"), "PanicException: range end index 5"),
        (OSError(28, "No space left on device", "/x"), "[Errno 28] No space left on device: '/x'"),
        (ValueError("x" * 50_000), "xxx"),
    ],
)
@pytest.mark.parametrize("asked", [False, True])
def test_whatever_goes_wrong_ends_in_one_line(end, monkeypatch, error, said, asked):
    monkeypatch.setenv("FICREG_TRACEBACK", "1" if asked else "")
    code, err = end(error)
    line = err.splitlines()[-1]
    assert code == 1 and line.startswith(f"error: {said}") and len(line) < 1100
    assert ("Traceback" in err) == asked and (asked or err == f"{line}\n")


@pytest.mark.parametrize("stop", [Preempted(signal.SIGTERM), KeyboardInterrupt()])
def test_a_stop_is_no_error_also_where_a_library_answers_it_by_one(end, stop):
    code, err = end(RuntimeError("Converting a tensordict to boolean value is not permitted"), after=stop)
    assert code == (85 if isinstance(stop, Preempted) else 130) and "error" not in err


@pytest.mark.parametrize("script", ["evaluate", "train_policy"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_scripts_that_start_over_say_so_when_they_are_stopped(execute, monkeypatch, tmp_path, script, number):
    """Only training and recording continue where they stopped."""
    monkeypatch.setattr(importlib.import_module(script), "find_checkpoint", lambda *_: os.kill(os.getpid(), number))
    done = execute(tmp_path, f"{script}.py", "checkpoint=x")
    assert done.returncode == (85 if number == signal.SIGTERM else 130)
    assert done.stderr.strip() == f"stopped by {number.name}: the same command starts over."
