"""Evaluation on start-goal pairs: tests, success rates, pictures, the table of results and the logger."""

from __future__ import annotations

import re
import secrets
from contextlib import closing
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from run_dir import flatten, is_writable, recorded_paths, REFINE
from torchrl import torchrl_logger
from torchrl.record.loggers import get_logger, Logger
from utils import dataset_path, make_dataset, make_policy

from torchrl_ficreg import InverseDynamicsModel, LatentWorldModel, MPCPolicy
from torchrl_ficreg._utils import read_bytes, write_atomic
from torchrl_ficreg.data import EpisodeStore
from torchrl_ficreg.data.shards import open_store
from torchrl_ficreg.envs.registry import find_entry
from torchrl_ficreg.evaluation import (
    evaluate_mpc,
    Evaluation,
    latent_distance,
    plot_latent_distance,
    plot_learning_curve,
    save_episodes_gif,
    StartGoalPairs,
    UniformPolicy,
)
from torchrl_ficreg.keys import STATE
from torchrl_ficreg.pretrained import ModelCard
from torchrl_ficreg.trainers import TolerantLogger
from torchrl_ficreg.trainers.offline import METRICS

EASY_START, EASY_RANDOM = 0.2, 0.5  # shares of pairs, solved at the start or by random actions, above which a test is easy
Networks = tuple[LatentWorldModel, InverseDynamicsModel]
Test = tuple[StartGoalPairs, int]  # and the budget, in environment steps


def draw_tests(
    cfg: DictConfig, data: EpisodeStore, env_kwargs: dict[str, Any], goals: list[tuple[int, int]]
) -> list[Test]:
    """Frozen start-goal pairs for each goal offset and budget, kept beside the dataset where it can be written.

    Raises:
        ValueError: too few episodes, or states that the environment does not accept.
    """
    held_out = make_dataset(cfg, data, "evaluation")
    count, seed, tests = cfg.evaluation.num_pairs, cfg.evaluation.seed, []
    for offset, budget in goals:
        manifest = data.path / f"pairs_{count}x{offset}_seed{seed}.json"
        if not manifest.exists() and not is_writable(data.path):  # then they are in the run directory only
            pairs = StartGoalPairs.draw(held_out, cfg.env.name, count, offset, seed)
        else:
            pairs = StartGoalPairs.frozen(manifest, held_out, cfg.env.name, count, offset, seed)
        tests.append((pairs, budget))
        try:
            with closing(find_entry(pairs.env).load_env()(**env_kwargs)) as env:
                for state in (*pairs.start_state, *pairs.goal_state):
                    env.check_state(STATE, state)
        except ValueError as error:
            reason = str(error).rstrip(".")
            raise ValueError(
                f"{data.path} holds states that {pairs.env} cannot be in ({reason}): correct its env, or convert it again."
            ) from error
    return tests


def find_dataset(trained: DictConfig, run_dir: Path) -> Path:
    """The folder of a run's dataset, by its place relative to the run or to the working directory.

    Args:
        trained: the configuration of the run.
        run_dir: its folder.

    Raises:
        FileNotFoundError: it is not there.
    """
    named, recorded = trained.get("dataset"), recorded_paths(run_dir)
    own = dataset_path(trained) if named is None else Path(named).expanduser()
    places = [own]
    if named is not None and "dataset" in recorded:
        places.insert(0, recorded["dataset"])
    elif named is None and "data_dir" in recorded:
        places.insert(0, recorded["data_dir"] / own.name)
    for path in places:
        if path.is_dir():
            return path.resolve()
    raise FileNotFoundError(f"the episodes of the run are not at {places[0]}: put them there.")


def draw_validation_pairs(trained: DictConfig, run_dir: Path) -> StartGoalPairs:
    """As many start-goal pairs as a run is evaluated on, from the validation episodes of its dataset.

    Args:
        trained: the configuration of the run.
        run_dir: its folder.

    Raises:
        FileNotFoundError: the dataset is not where it was at training.
    """
    data = open_store(find_dataset(trained, run_dir))
    settings, held_out = trained.evaluation, make_dataset(trained, data, "validation")
    return StartGoalPairs.draw(held_out, trained.env.name, settings.num_pairs, trained.env.goal_offset, settings.seed)


def validate(cfg: DictConfig, data: EpisodeStore, card: ModelCard, run_dir: Path, networks: Networks) -> dict[str, float]:
    """Success rates on pairs of the validation split; the best checkpoint is chosen by the first, of goals ever reached."""
    settings = cfg.evaluation
    held_out = make_dataset(cfg, data, "validation")
    outcome = evaluate_mpc(
        make_policy(cfg.plan, *networks, card, run_dir),
        StartGoalPairs.draw(held_out, cfg.env.name, settings.every_pairs, cfg.env.goal_offset, settings.seed),
        budget=cfg.env.budget,
        image_size=card.model["image_size"],
        num_envs=settings.num_envs,
        num_workers=settings.num_workers or None,
        env_kwargs=card.env_kwargs,
        progress_bar=False,
    )
    return {"success_rate": outcome.success_rate, "success_rate_at_end": outcome.success_rate_at_end}


def evaluate_tests(
    cfg: DictConfig, data: EpisodeStore, card: ModelCard, run_dir: Path, networks: Networks, tests: list[Test]
) -> dict[str, Any]:
    """Plans on the pairs of every test, prints the numbers, measures latent distances and draws the pictures.

    Returns:
        the results of the first test, ``latent_distance``, and the results of the other tests by their names.
    """
    policy, settings = make_policy(cfg.plan, *networks, card, run_dir), cfg.evaluation
    tables, first = {}, None
    for pairs, budget in tests:
        name = f"goals_{pairs.goal_offset}_steps_ahead_within_{budget}"
        pairs.save(run_dir / (f"pairs_{name}.json" if tables else "pairs.json"))
        outcome, random_baseline = evaluate_with_random_baseline(
            policy,
            pairs,
            card,
            budget=budget,
            num_envs=settings.num_envs,
            num_workers=settings.num_workers,
            record=0 if tables else settings.record,  # the GIF shows the first test
        )
        first = first or outcome
        rows = tables[name] = result_rows(cfg.method.name, cfg.plan, outcome, random_baseline)
        # Printed before anything is written, so that a full disk does not cost the numbers.
        if len(tests) > 1:
            print(f"\n{name.replace('_', ' ')}, {budget} steps allowed:")
        report([(f"{cfg.method.name}, {cfg.plan.search}", rows["policy"], ""), ("random", rows["random"], "")])
    profile = latent_distance(networks[0], make_dataset(cfg, data, "evaluation"))
    try:
        for folder in (run_dir, run_dir / REFINE):
            if (folder / METRICS).exists():
                plot_learning_curve(folder / METRICS, folder / "learning_curve.png")
        plot_latent_distance(profile, run_dir / "latent_distance.png", unit=cfg.env.state_unit)
        save_episodes_gif(first, run_dir / "episodes.gif")
    except ImportError as error:  # the plot extra is optional
        print(f"pictures are skipped: {error}")
    name, *others = tables
    return {**tables[name], "latent_distance": profile.summary(), **{name: tables[name] for name in others}}


def evaluate_with_random_baseline(
    policy: MPCPolicy, pairs: StartGoalPairs, card: ModelCard, *, record: int, num_workers: int, **settings: Any
) -> tuple[Evaluation, Evaluation]:
    """A policy and uniformly random actions on the same pairs, in the environment that the model was trained on."""
    shared = {"image_size": card.model["image_size"], "env_kwargs": card.env_kwargs, **settings}
    shared["num_workers"] = num_workers or None
    outcome = evaluate_mpc(policy, pairs, record=record, description="plan", **shared)
    random = evaluate_mpc(UniformPolicy(card.action_low, card.action_high), pairs, description="random", **shared)
    return outcome, random


def result_rows(method: str, plan: DictConfig, outcome: Evaluation, random_baseline: Evaluation) -> dict[str, Any]:
    """The entries of ``results.json`` that every evaluation has, under the same keys for every method."""
    return {"method": method, "search": plan.search, "policy": outcome.summary(), "random": random_baseline.summary()}


def report(rows: list[tuple[str, dict[str, Any], str]]) -> None:
    """Prints a table of success rates: of goals ever reached, with its interval, and of those reached at the end.

    Args:
        rows: name, summary and differing settings of each policy; the first one is the one just evaluated, the last one
            the random baseline on the same pairs.
    """
    width = max(14, *(len(name) + 2 for name, _, _ in rows))
    print(
        f"\n{'policy':<{width}}{'ever':>8}{'95 % interval':>18}{'at the end':>12}{'of those not solved at start':>30}"
        f"{'s / plan':>10}" + ("  settings that differ" if any(note for _, _, note in rows) else "")
    )
    for name, row, note in rows:
        low, high = row["success_interval"]
        count, rate = row["pairs"] - row["solved_at_start"], row["success_rate_unsolved_at_start"]
        unsolved = "of none" if rate is None else f"{rate:.1%} of {count}"  # None: every pair was solved at the start
        line = (
            f"{name:<{width}}{row['success_rate']:>8.1%}{f'{low:.1%} - {high:.1%}':>18}{row['success_rate_at_end']:>12.1%}"
            f"{unsolved:>30}{row['seconds_per_plan']:>10.2f}  {note}"
        )
        print(line.rstrip())
    first, random_baseline = rows[0][1], rows[-1][1]
    print(f"{first['pairs']} frozen held-out pairs")
    reasons = []
    if first["solved_at_start"] > EASY_START * first["pairs"]:
        reasons.append(f"{first['solved_at_start']} of {first['pairs']} pairs are solved at the start")
    if random_baseline["success_rate"] > EASY_RANDOM:
        reasons.append(f"random actions solve {random_baseline['success_rate']:.1%}")
    if reasons:
        print(f"warning: {' and '.join(reasons)}: these pairs are too easy; draw harder ones (env.goal_offset, env.budget).")


def make_logger(cfg: DictConfig, run_dir: Path) -> TolerantLogger | None:
    """The TorchRL logger of ``logger.backend``, beside ``metrics.csv``. If it fails, the run goes on without it.

    Raises:
        ImportError: its package is missing.
        ValueError: wandb is not set up.
    """
    backend, extra = cfg.logger.backend, {}
    if backend == "csv":
        return None
    if backend == "wandb":
        extra["wandb_kwargs"] = {"mode": cfg.logger.mode, "project": cfg.logger.project, "id": _wandb_id(run_dir)}
    try:
        logger = TolerantLogger(get_logger(backend, logger_name=str(run_dir / backend), experiment_name=cfg.name, **extra))
    except Exception as error:  # backends raise errors of any kind
        if type(error).__name__ == "UsageError":  # wandb has no API key
            raise ValueError(f"wandb: {error} Log in with `wandb login`, or choose logger.mode=offline.") from error
        torchrl_logger.warning(f"{backend} cannot be reached ({error}): the run goes on without it.")
        return None
    settings = flatten(OmegaConf.to_container(cfg, resolve=True))
    plain = (int, float, str, bool)  # the types that tensorboard takes
    logger.log_hparams({key: value if isinstance(value, plain) else str(value) for key, value in settings.items()})
    return logger


def _wandb_id(run_dir: Path) -> str:
    """The id of the run in wandb, kept when the run is continued.

    Raises:
        ValueError: the file holds something else.
    """
    path = run_dir / "wandb" / "run_id"
    if not path.exists():
        path.parent.mkdir(exist_ok=True)
        write_atomic(path, secrets.token_hex(4))
    run_id = read_bytes(path, most=128).decode(errors="replace").strip()
    if not re.fullmatch(r"[\w-]+", run_id, re.ASCII):
        raise ValueError(f"{path} holds {run_id[:40]!r}, which is no id of a run of wandb: remove it to get another one.")
    return run_id


def log_results(logger: TolerantLogger | None, results: dict[str, dict[str, Any]], run_dir: Path) -> None:
    """Logs the summary of each policy, by its name; wandb also gets a table, the pictures and the rollouts."""
    if logger is not None:
        logger.attempt(_log_results, logger, results, run_dir)
        logger.shutdown()


def _log_results(logger: Logger, results: dict[str, dict[str, Any]], run_dir: Path) -> None:
    rows = {name: {k: v for k, v in row.items() if isinstance(v, (int, float))} for name, row in results.items()}
    for name, row in rows.items():
        for key, value in row.items():
            logger.log_scalar(f"evaluation/{name}/{key}", value, step=0)
    if not (run_dir / "wandb").is_dir():
        return
    import wandb

    columns = list(dict.fromkeys(key for row in rows.values() for key in row))
    values = [[name, *(row.get(key) for key in columns)] for name, row in rows.items()]
    media = {path.name: wandb.Image(str(path)) for path in run_dir.glob("*.png")}
    media |= {path.name: wandb.Video(str(path), format="gif") for path in run_dir.glob("*.gif")}
    logger.experiment.log({"results": wandb.Table(columns=["policy", *columns], data=values), **media})
