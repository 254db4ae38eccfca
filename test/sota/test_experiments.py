"""Named experiments are whole sets of runs, and a sweep keeps every run in a folder of its own."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig
from utils import model_config

from torchrl_ficreg import ModelConfig

CONFIG = Path(__file__).resolve().parents[2] / "sota-implementations" / "ficreg" / "config"
ENVIRONMENTS = ("two_room", "push_t", "reacher", "cube")


@pytest.fixture(scope="module")
def train(config) -> Callable[..., DictConfig]:
    """``train("env=push_t")`` is a composed configuration of train.py."""
    return partial(config, "train")


@pytest.fixture(scope="module")
def runs(train) -> Callable[..., list[list[str]]]:
    """The runs that ``python train.py -m`` would start, as Hydra's own sweeper lists them."""

    def split(*overrides: str) -> list[list[str]]:
        params = train(*overrides[:1], return_hydra_config=True).hydra.sweeper.params
        given = [*(f"{key}={value}" for key, value in params.items()), *overrides]
        return BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(given), None)[0]

    return split


@pytest.mark.parametrize(
    ("experiment", "method"),
    [("ficreg_paper", "ficreg_live"), ("ficreg", "ficreg_detached"), ("lewm_paper", "lewm")],
)
def test_an_experiment_is_four_environments_times_three_seeds(train, runs, experiment, method):
    found = runs(f"experiment={experiment}")
    assert len(found) == 12
    names = {train(*overrides).name for overrides in found}
    assert names == {f"{env}_paper_{method}_seed{seed}" for env in ENVIRONMENTS for seed in range(3)}


@pytest.mark.parametrize(("experiment", "context"), [("ficreg_paper", "live"), ("ficreg", "detached")])
@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_the_published_code_is_run_to_the_letter(train, experiment, context, env):
    """Context of the judgement, length of the schedule, epochs, initialisation and precision of the authors' code."""
    cfg = train(f"experiment={experiment}", f"env={env}")
    assert (cfg.method.context, cfg.optim.schedule_epochs, cfg.optim.epochs) == (context, 100, 15)
    assert (cfg.evaluation.every, cfg.evaluation.epoch, cfg.plan.precision) == (1, 10, "fp32")
    assert (cfg.model.encoder_init, cfg.model.predictor_position_std) == ("published", 1.0)
    assert [list(goal) for goal in cfg.evaluation.also] == ([[100, 150]] if env == "two_room" else [])


@pytest.mark.parametrize("other", ["model=paper", "experiment=ficreg"])
def test_every_setting_in_which_the_published_code_stands_apart_is_in_the_tables(train, other):
    docs = CONFIG.parents[2] / "docs" / "source"
    tables = "".join((docs / name).read_text() for name in ("scaling.rst", "planning.rst"))
    for env in ENVIRONMENTS:
        ours, theirs = (train(choice, f"env={env}") for choice in ("experiment=ficreg_paper", other))
        for group in set(ours) - {"name"}:
            for field in ours[group] if isinstance(ours[group], DictConfig) else ():
                assert ours[group][field] == theirs[group][field] or f"{group}.{field}" in tables, f"{group}.{field}"


def test_the_command_line_narrows_it_down(train, runs):
    """Without -m, an experiment is one run."""
    assert len(runs("experiment=ficreg_paper", "env=push_t", "seed=0,1")) == 2
    cfg = train("experiment=lewm_paper", "env=push_t", "seed=2")
    assert (cfg.env.name, cfg.model.preset, cfg.method.name, cfg.seed) == ("push_t", "paper", "lewm", 2)


@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_the_papers_recipe_to_the_letter(train, env):
    """Numbers of arXiv 2603.19312 and of FICReg's appendix; where code and text differ, those of the code."""
    cfg = train("model=paper", f"env={env}")
    model, optim, plan = cfg.model, cfg.optim, cfg.plan
    assert (model.encoder, model.image_size, model.latent_dim, model.frame_skip) == ("vit", 224, 192, 5)
    assert model.history == (1 if env == "two_room" else 3)
    assert (model.predictor_depth, model.predictor_heads, model.predictor_dim_head) == (6, 16, 64)
    assert (model.predictor_mlp_dim, model.predictor_dropout, model.inverse_hidden_dim) == (2048, 0.1, 512)
    assert (optim.batch_size, optim.epochs, optim.lr, optim.weight_decay) == (128, 10, 5e-5, 1e-3)
    assert (optim.clip_norm, optim.warmup) == (1.0, 0.01)
    assert (cfg.loss.sigreg_coeff, cfg.loss.idm_coeff, cfg.loss.consistency_coeff) == (0.09, 0.1, 0.1)
    assert (plan.num_candidates, plan.num_elites, plan.iterations) == (300, 30, 30 if env == "push_t" else 10)
    assert (plan.horizon, plan.receding_horizon, plan.std, plan.bounds) == (5, 5, 1.0, "none")
    assert plan.history == "one_frame"
    assert (cfg.env.goal_offset, cfg.env.budget) == (25, 50)
    assert cfg.env.data.episodes == (18685 if env == "push_t" else 10000)


def test_a_recipe_overrides_the_common_file(train):
    """And is overridden on the command line. The paper's planning belongs to CEM alone, and its pictures are the published."""
    assert train("env=push_t").refine.epochs == 5
    assert train("env=push_t", "refine.epochs=0").refine.epochs == 0
    assert train("env=reacher").env.kwargs.detail == "fast"
    assert train("env=reacher", "model=paper").env.kwargs.detail == "published"
    assert train("model=paper", "env=push_t", "plan=policy").plan.bounds == "environment"


@pytest.mark.parametrize(
    ("launcher", "plugin"),
    [
        ("basic", "hydra"),
        pytest.param("processes", "hydra_plugins.hydra_joblib_launcher", marks=pytest.mark.slow),
        pytest.param("submitit_local", "hydra_plugins.hydra_submitit_launcher", marks=pytest.mark.slow),
    ],
)
def test_a_sweep_over_seeds_makes_a_run_of_each(execute, spawn, tmp_path, launcher, plugin):
    """One after another, side by side, and pickled as SLURM's launcher pickles them; one that fails stops no other."""
    pytest.importorskip(plugin)
    small = ("evaluation.num_pairs=2", "evaluation.record=1")
    run, seeds = (execute, "-1,0,1") if launcher == "basic" else (spawn, "0,1")
    done = run(tmp_path, "train.py", f"seed={seeds}", *small, f"hydra/launcher={launcher}", "-m")
    assert done.returncode == (launcher == "basic"), done.stderr
    if launcher == "basic":
        assert "seed=-1: expected 0 to 2^63 - 1. (job 0 of the sweep)" in done.stderr and "Traceback" not in done.stderr
        assert done.stderr.strip().splitlines()[-1].startswith("error: not all runs of the sweep succeeded")
    folders = sorted(path.name for path in (tmp_path / "runs").iterdir() if path.is_dir() and path.name[0] != ".")
    assert folders == ["two_room_cpu_ficreg_seed0", "two_room_cpu_ficreg_seed1"]
    results = [json.loads((tmp_path / "runs" / name / "results.json").read_text()) for name in folders]
    assert results[0]["policy"]["pairs_hash"] == results[1]["policy"]["pairs_hash"]
    assert (tmp_path / "runs" / folders[0] / "checkpoints").is_dir()


@pytest.mark.parametrize("preset", ["cpu", "paper", "gpu_short"])
def test_a_model_is_the_preset_of_the_package(train, preset):
    cfg = train(f"model={preset}", "env=reacher")  # whose recipe leaves the model alone
    assert cfg.model.preset == preset and model_config(cfg) == ModelConfig.preset(preset)


def test_every_field_is_commented():
    """Once: the files that change other files need not repeat it."""
    for path in (path for group in (".", "env", "method", "plan") for path in (CONFIG / group).glob("*.yaml")):
        for line in path.read_text().split("\nhydra:")[0].splitlines():
            field = re.match(r" *([a-z_]+): *[^#\s]", line)
            if field and field[1] not in ("defaults", "name", "search"):
                assert "#" in line, f"{path.name}: {line}"
