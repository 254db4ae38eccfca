"""Evaluates a trained model: python evaluate.py checkpoint=runs/two_room_cpu_ficreg_seed0 plan=icem.

Each evaluation has its own folder in the run directory, <run>/evaluation/<search>_<hash of the settings>; the printed
table shows all of them.
"""

from __future__ import annotations

import hashlib
import json
import math
import signal
from pathlib import Path
from typing import Any

from cli import entry_point
from configs import check_consistency, check_horizon
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from results import draw_validation_pairs, evaluate_with_random_baseline, report, result_rows
from run_dir import claim_folder, flatten, versions, write_json
from utils import get_device, make_policy, plan_config, settings_of_card

from torchrl_ficreg._safe_files import checksum_of
from torchrl_ficreg._utils import read_json, write_atomic
from torchrl_ficreg.evaluation import save_episodes_gif, StartGoalPairs
from torchrl_ficreg.trainers import exit_on_signal, find_checkpoint, load_world_model

RESULTS = "results.json"
VALIDATION = "validation"  # in place of a file of pairs
SHARED = ("checkpoint", "weights", "pairs", "budget")  # settings besides the plan
MAX_COUNT = 10**6  # of a count in a plan, and of a budget: more comes from a damaged or hostile card


@entry_point("evaluate")
def main(cfg: DictConfig) -> None:
    """Evaluates. After a signal the same command starts over."""
    with exit_on_signal(signal.SIGTERM, signal.SIGINT, resumes=False):
        evaluate(cfg)


def evaluate(cfg: DictConfig) -> None:
    """Loads, plans on the frozen pairs, prints, writes."""
    if OmegaConf.is_missing(cfg, "checkpoint"):
        raise ValueError("name the model to evaluate: checkpoint=runs/two_room_cpu_ficreg_seed0, say.")
    checkpoint = find_checkpoint(cfg.checkpoint)
    run_dir = checkpoint.parent.parent
    manifest = Path(cfg.pairs or run_dir / "pairs.json")
    if cfg.pairs != VALIDATION and not manifest.exists():
        raise FileNotFoundError(f"no start-goal pairs at {manifest}: let train.py finish, or give pairs=...")
    model, inverse_model, card = load_world_model(checkpoint)
    trained = settings_of_card(card)
    pairs = draw_validation_pairs(trained, run_dir) if cfg.pairs == VALIDATION else StartGoalPairs.load(manifest)
    if pairs.env != card.env:
        raise ValueError(f"the model was trained on {card.env}, the pairs belong to {pairs.env}: give others, pairs=...")
    plan = plan_of_run(cfg, trained)
    budget = cfg.budget or trained.env.get("budget")
    check_sizes(plan, budget)
    plan_config(plan)
    check_horizon(plan, model.frame_skip, budget)
    device = get_device(cfg.device)
    policy = make_policy(plan, model.to(device), inverse_model.to(device), card, run_dir)
    settings = {
        "checkpoint": checkpoint.name,
        "weights": checksum_of(model.state_dict())[:8],
        "env_kwargs": card.env_kwargs,
        "pairs": pairs.hash,
        "budget": budget,
        "plan": OmegaConf.to_container(plan),
    }
    parent = Path(cfg.output or run_dir / "evaluation")
    folder = claim_folder(parent / folder_name(settings), None if cfg.output else parent)
    if (folder / RESULTS).exists():
        print(f"{folder} holds this very evaluation: it is repeated and written anew")
    outcome, random_baseline = evaluate_with_random_baseline(
        policy,
        pairs,
        card,
        budget=budget,
        num_envs=cfg.num_envs,
        num_workers=cfg.num_workers,
        record=cfg.record,
    )
    rows = result_rows(str(trained.method.get("name")), plan, outcome, random_baseline)
    results = {**rows, **settings, "versions": versions()}
    # Printed before anything is written, so that a full disk does not cost the numbers.
    show({folder.name: results, **read_others(parent, folder.name)})
    resolved = {**OmegaConf.to_container(cfg), "budget": budget, "plan": settings["plan"]}
    write_atomic(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(resolved)))
    write_json(folder / RESULTS, results)
    if cfg.record:
        save_episodes_gif(outcome, folder / "episodes.gif")
    print(f"results and pictures in {folder}")


def plan_of_run(cfg: DictConfig, trained: DictConfig) -> DictConfig:
    """The plan of the training run, with the fields of the command line replaced."""
    typed = [override.split("=")[0] for override in HydraConfig.get().overrides.task]
    if "plan" in typed:
        check_consistency(cfg.plan, trained)
        return cfg.plan
    plan = trained.plan.copy()
    for field in typed:
        if field.startswith("plan."):
            OmegaConf.update(plan, field.removeprefix("plan."), OmegaConf.select(cfg, field))
    check_consistency(plan, trained)
    return plan


def check_sizes(plan: DictConfig, budget: Any) -> None:
    """Refuses counts with which an evaluation would never end.

    Raises:
        ValueError: one is too large, or the budget is no positive whole number.
    """
    if isinstance(budget, bool) or not isinstance(budget, int) or budget < 1:
        raise ValueError(f"budget={budget!r} of the training run is no positive whole number: give budget=50, say.")
    counts = {f"plan.{key}": value for key, value in plan.items() if key not in ("seed", "compile")} | {"budget": budget}
    large = [f"{key}={value}" for key, value in counts.items() if isinstance(value, (int, float)) and value > MAX_COUNT]
    if large:
        raise ValueError(f"{', '.join(large)}: expected at most {MAX_COUNT}; give smaller ones on the command line.")


def folder_name(settings: dict[str, Any]) -> str:
    """The search and a hash of everything the outcome depends on."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
    return f"{settings['plan']['search']}_{digest[:8]}"


def read_others(parent: Path, own: str) -> dict[str, dict[str, Any]]:
    """The results of the other evaluations in a folder, by the names of their folders; names the damaged ones."""
    found = {}
    for path in sorted(parent.glob(f"*/{RESULTS}")):
        if path.parent.name == own:
            continue
        try:
            found[path.parent.name] = check_results(read_json(path, "results of an evaluation"))
        except (ValueError, TypeError, KeyError, AttributeError, ArithmeticError, RecursionError, OSError) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:160]
            print(f"left out of the table: {path} ({reason})")
    return found


def check_results(results: Any) -> dict[str, Any]:
    """Results that the table can show.

    Raises:
        ValueError, TypeError, KeyError, AttributeError, OverflowError: a value is missing, or of another kind.
    """
    policy = results["policy"]
    low, high = policy["success_interval"]
    unsolved = policy["success_rate_unsolved_at_start"]
    numbers = [policy[key] for key in ("pairs", "solved_at_start", "success_rate", "success_rate_at_end", "seconds_per_plan")]
    for number in (*numbers, low, high, 0 if unsolved is None else unsolved):
        if isinstance(number, bool) or not isinstance(number, (int, float)) or not math.isfinite(number):
            raise ValueError(f"{str(number)[:40]!r} is no number")
    shared = {key: results[key] for key in SHARED if key != "weights"}  # older results have none
    for key, value in {**shared, **flatten({**results["plan"]})}.items():
        if not f"{key}{str(value)[:24]}".isprintable():  # it could contain control sequences of a terminal
            raise ValueError(f"{key[:40]!r}={str(value)[:24]!r} is no setting")
    if not row_name(results).isprintable() or len(row_name(results)) > 80:
        raise ValueError("method and search are no names")
    return results


def row_name(results: dict[str, Any]) -> str:
    """The name of an evaluation in the table: its method and search."""
    return f"{results['method']}, {results['search']}"


def show(evaluations: dict[str, dict[str, Any]]) -> None:
    """Prints a table over evaluations, by the names of their folders; the first is the one just made."""
    flat = {
        name: {**{key: results.get(key) for key in SHARED}, **flatten(results["plan"], "plan.")}
        for name, results in evaluations.items()
    }
    keys = dict.fromkeys(key for settings in flat.values() for key in settings if key != "plan.search")
    differ = [key for key in keys if len({str(settings[key]) for settings in flat.values() if key in settings}) > 1]
    notes = {
        name: " ".join(f"{key.removeprefix('plan.')}={str(settings[key])[:24]}" for key in differ if key in settings)
        for name, settings in flat.items()
    }
    rows = [(row_name(results), results["policy"], notes[name]) for name, results in evaluations.items()]
    report([*rows, ("random", next(iter(evaluations.values()))["random"], "")])


if __name__ == "__main__":
    main()
