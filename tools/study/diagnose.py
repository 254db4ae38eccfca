"""Where planning with a trained run fails: in the encoder, in the predictor or in the planner.

    python tools/study/diagnose.py run=runs/two_room_cpu_ficreg_seed0 num_pairs=30

Writes <run>/diagnosis/diagnosis.{json,md,png}:

1. what the latent holds: probes of each quantity of the state, fitted on training episodes, tested on validation episodes;
2. how far predictions are off after 1, 2, ... blocks of recorded actions, decoded by these probes, beside the movement of
   the scene in that time and relative to the latent's standard deviation; and how far off they are for the plans found;
3. open-loop success on pairs of the validation split: with the run's planner; with candidates executed in the simulator and
   compared with the goal by their latents; and with the same search on true states.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Optional

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "sota-implementations" / "ficreg"))

import torch
from cli import one_line
from configs import check_horizon
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from results import find_dataset, result_rows
from run_dir import claim_folder, versions, write_json
from tensordict import TensorDict
from tqdm import tqdm
from utils import get_device, make_dataset, make_policy, open_dataset, settings_of_card

from torchrl_ficreg import ICEMConfig, LatentWorldModel, MPCPolicy
from torchrl_ficreg._utils import write_atomic
from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.data.latents import encode_episodes
from torchrl_ficreg.evaluation import evaluate_mpc, StartGoalPairs
from torchrl_ficreg.evaluation.oracle import DrawnGoalDistance, oracle_policy, Simulator, StateDistance
from torchrl_ficreg.evaluation.probes import measure_states, quantiles, state_quantities, StateProbe
from torchrl_ficreg.keys import ACTION, EPISODE, PIXELS, STATE, STEP
from torchrl_ficreg.pretrained import ModelCard
from torchrl_ficreg.trainers import find_checkpoint, load_world_model

WINDOWS = 2000  # contexts whose future is predicted
PLANNERS = {
    "model": "the run's planner: learned dynamics, latents",
    "latents": "true dynamics, latents",
    "states": "true dynamics, true states",
}


@dataclass
class Settings:
    """Settings of the command line."""

    run: str = "???"  # a run directory of train.py, or one of its checkpoints
    dataset: Optional[str] = None  # folder of the dataset; None: the one of the run
    output: Optional[str] = None  # folder of the results; None: <run>/diagnosis
    num_pairs: int = 30  # start-goal pairs, of the validation split
    budget: Optional[int] = None  # environment steps allowed; None: the budget of the run
    frames: int = 20000  # training frames that the probes are fitted to, at most
    probe_steps: int = 2000  # optimizer steps of the MLP probe
    oracle: bool = True  # also plan with the true dynamics
    candidates: int = 64  # of the oracle's first iteration
    iterations: int = 5  # of the oracle
    std: float = 0.5  # of the oracle's first iteration, in z-scored actions
    guided: bool = True  # the oracle starts from the plans of the run's planner
    num_workers: int = 0  # processes that step the environments of the run's planner; 0: this one
    seed: int = 0  # of pairs, windows and probes
    device: str = "auto"


def main() -> None:
    """Measures, prints and writes."""
    try:
        diagnose(OmegaConf.merge(OmegaConf.structured(Settings), OmegaConf.from_cli()))
    except (ValueError, TypeError, KeyError, ImportError, OSError, OmegaConfBaseException) as error:
        names = ", ".join(field.name for field in fields(Settings))
        hint = f"; settings: {names}" if isinstance(error, OmegaConfBaseException) else ""
        if os.environ.get("FICREG_TRACEBACK") == "1":
            raise
        raise SystemExit(f"error: {one_line(error)}{hint}") from None


def diagnose(cfg: DictConfig) -> None:
    """The three parts, for one run."""
    began = time.perf_counter()
    if OmegaConf.is_missing(cfg, "run"):
        raise ValueError("name the run to diagnose: run=<run directory>.")
    checkpoint = find_checkpoint(cfg.run)
    run_dir = checkpoint.parent.parent
    folder = claim_folder(Path(cfg.output or run_dir / "diagnosis"))
    model, inverse_model, card = load_world_model(checkpoint)
    device = get_device(cfg.device)
    model, inverse_model = model.to(device).eval(), inverse_model.to(device).eval()
    run = settings_of_card(card)
    run.dataset = str(cfg.dataset or find_dataset(run, run_dir))
    run.plan.receding_horizon, run.plan.time_to_go = run.plan.horizon, 0  # open loop, each goal due at the end of a plan
    budget = cfg.budget or run.env.budget
    check_horizon(run.plan, model.frame_skip, budget)
    store, depth = open_dataset(run), run.plan.horizon
    shared = {"batch_size": None, "statistics": model.statistics}
    train = make_dataset(run, store, "train", num_frames=2, **shared)
    ahead = {"num_frames": model.history + depth, "keys": (EPISODE, STEP, ACTION)}
    held_out = make_dataset(run, store, "validation", **ahead, **shared)

    encode = encoder(model)
    latent = encode_episodes(held_out, encode, description="encode validation episodes").cpu()
    state = torch.cat([held_out.episode_data(e, keys=(STATE,))[STATE] for e in held_out.episodes["episode"].tolist()])
    values = measure_states(card.env, state)
    probes = fit_probes(cfg, card, train, encode)
    result: dict[str, Any] = {
        "run": str(cfg.run),
        "checkpoint": checkpoint.name,
        "env": card.env,
        "method": run.method.name,
        "settings": {key: value for key, value in OmegaConf.to_container(cfg).items() if key != "run"},
        "plan": OmegaConf.to_container(run.plan),
        "probes": {kind: probe.score(latent, values) for kind, probe in probes.items()},
    }
    clips = held_out[torch.randint(len(held_out), (WINDOWS,), generator=torch.Generator().manual_seed(cfg.seed))]
    sampled = rows_of(held_out, clips), clips[ACTION][:, :-1], latent, values
    result["prediction"] = measure_predictions(model, probes["mlp"], *sampled)
    result["prediction_from_one_frame"] = measure_predictions(model, probes["mlp"], *sampled, context=1)

    pairs = StartGoalPairs.draw(held_out, card.env, cfg.num_pairs, run.env.goal_offset, cfg.seed)
    policy = make_policy(run.plan, model, inverse_model, card, run_dir)
    result["success"] = measure_success(cfg, card, run.plan, pairs, policy, model, budget)
    result["found_plans"] = measure_found_plans(card, pairs, policy, model, probes["mlp"])
    result["conclusion"] = conclude(result["success"])
    result |= {"pairs_hash": pairs.hash, "goal_offset": run.env.goal_offset, "budget": budget}
    result |= {"seconds": time.perf_counter() - began, "versions": versions()}

    text = tabulate(result)
    print(text)
    write_json(folder / "diagnosis.json", result)
    write_atomic(folder / "diagnosis.md", text)
    draw(result, folder / "diagnosis.png")
    print(f"diagnosis.json, diagnosis.md and diagnosis.png in {folder}")


def encoder(model: LatentWorldModel):
    """Frames [n, 3, H, W] -> latents [n, D], as the planner computes them."""

    @torch.no_grad()
    def encode(pixels: torch.Tensor) -> torch.Tensor:
        return model.encode(pixels.to(model.action_mean.device)).float()

    return encode


def fit_probes(cfg: DictConfig, card: ModelCard, train: OfflineTrajectories, encode) -> dict[str, StateProbe]:
    """A linear and a non-linear probe, fitted to evenly chosen frames of the training episodes."""
    stride = max(1, train.num_steps // cfg.frames)
    latents, states = [], []
    for episode in tqdm(train.episodes["episode"].tolist(), desc="encode training episodes", unit="episode"):
        data = train.episode_data(episode, steps=slice(episode % stride, None, stride), keys=(PIXELS, STATE))
        if len(data):
            latents.append(encode(data[PIXELS]).cpu())
            states.append(data[STATE])
    latent, values = torch.cat(latents), measure_states(card.env, torch.cat(states))
    quantities = state_quantities(card.env)
    return {kind: StateProbe(quantities, kind, steps=cfg.probe_steps, seed=cfg.seed).fit(latent, values) for kind in ("ridge", "mlp")}


def rows_of(data: OfflineTrajectories, clips: TensorDict) -> torch.Tensor:
    """Row numbers [B, T] of the frames of clips, counted episode after episode as :func:`encode_episodes` does."""
    episodes, length = data.episodes["episode"], data.episodes["length"]
    first = torch.zeros(int(episodes.max()) + 1, dtype=torch.long)
    first[episodes] = length.cumsum(0) - length
    return first[clips[EPISODE]] + clips[STEP]


@torch.no_grad()
def measure_predictions(model, probe, rows, action, latent, values, context: int | None = None) -> dict[str, Any]:
    """Errors after each block, from real contexts and with the recorded actions.

    Args:
        model (LatentWorldModel): whose predictor is tested.
        probe (StateProbe): decodes latents.
        rows (Tensor): of ``latent``, those of the frames of B clips [B, H + depth].
        action (Tensor): z-scored blocks between these frames [B, H + depth - 1, F * A].
        latent (Tensor): [N, D].
        values (dict): quantities [N, C] of the same rows.
        context (int, optional): real frames that a prediction starts from. Default: H.
    """
    first = 0 if context is None else model.history - context
    rows, action = rows[:, first:], action[:, first:]  # [B, C + depth], [B, C - 1 + depth, F * A]
    context = context or model.history
    device = model.action_mean.device
    predicted = model.rollout(latent[rows[:, :context]].to(device), action.to(device)).float().cpu()  # [B, depth, D]
    start, after = rows[:, context - 1 : context], rows[:, context:]  # [B, 1], [B, depth]
    real, variance = latent[after], latent.var(0).sum()
    result: dict[str, Any] = {
        "context": context,
        "latent_error": ((predicted - real).square().sum(-1).mean(0) / variance).sqrt().tolist(),
        "latent_movement": ((latent[start] - real).square().sum(-1).mean(0) / variance).sqrt().tolist(),
    }
    true = {name: value[after] for name, value in values.items()}  # each [B, depth, C]
    errors = {
        "prediction": probe.errors(predicted, true),
        "probe": probe.errors(real, true),
        "movement": {q.name: q.error(values[q.name][start], true[q.name]) for q in probe.quantities},
    }
    result["quantities"] = {
        name: {what: [quantiles(column) for column in error[name].unbind(1)] for what, error in errors.items()}
        for name in values
    }
    return result


def measure_success(
    cfg: DictConfig, card: ModelCard, plan: DictConfig, pairs: StartGoalPairs, policy: MPCPolicy, model, budget: int
) -> dict[str, Any]:
    """Open-loop success on the pairs, with each of ``PLANNERS``."""
    shared = {"budget": budget, "image_size": card.model["image_size"], "env_kwargs": card.env_kwargs}
    workers = cfg.num_workers or None
    outcome = evaluate_mpc(policy, pairs, num_workers=workers, description="plan with the model", **shared)
    success = {"model": result_rows("", plan, outcome, outcome)["policy"]}
    show(success)
    if not cfg.oracle:
        return success
    config = ICEMConfig(
        horizon=plan.horizon,
        receding_horizon=plan.horizon,
        num_candidates=cfg.candidates,
        num_elites=max(2, cfg.candidates // 8),
        kept_elites=0.5,
        iterations=cfg.iterations,
        std=cfg.std,
        precision="fp32",
        seed=cfg.seed,
    )
    bounds = (card.action_low, card.action_high)
    for name, cost in (("latents", None), ("states", StateDistance(card.env))):
        with tqdm(desc=f"plan with {PLANNERS[name]}", unit="sequence", dynamic_ncols=True) as bar:
            simulator = make_simulator(card, model, bar.update)
            guide = policy.planner if cfg.guided else None
            oracle = oracle_policy(simulator, model, config, action_bounds=bounds, cost=cost, guide=guide)
            plans = -(-budget // (plan.horizon * model.frame_skip))
            bar.total = len(pairs) * plans * oracle.planner.sequences_per_plan
            outcome = evaluate_mpc(oracle, pairs, progress_bar=False, **shared)
        success[name] = outcome.summary()
        show(success)
    return success


def make_simulator(card: ModelCard, model: LatentWorldModel, on_sequence=None) -> Simulator:
    """The environment of a run as dynamics."""
    return Simulator(
        card.env,
        model.statistics,
        frame_skip=model.frame_skip,
        image_size=card.model["image_size"],
        env_kwargs=card.env_kwargs,
        on_sequence=on_sequence,
    )


@torch.no_grad()
def measure_found_plans(card: ModelCard, pairs: StartGoalPairs, policy: MPCPolicy, model, probe) -> dict[str, Any]:
    """Where the first plans of the run's planner end, predicted and executed: searches prefer plans that are predicted wrongly."""
    simulator = make_simulator(card, model)
    encode = DrawnGoalDistance(model, simulator).encode
    start, goal = torch.from_numpy(pairs.start_state), torch.from_numpy(pairs.goal_state)  # [N, S]
    latent, goal_latent = encode(start), encode(goal)  # [N, D]
    plan = policy.planner.plan(latent, goal_latent, torch.arange(len(pairs)))["plan"]  # [N, H, F * A]
    predicted = model.rollout(latent.unsqueeze(1), plan)[:, -1].float()  # [N, D]
    end = simulator.rollout(start.unsqueeze(1), plan)[:, -1]  # [N, S]
    reached, wanted, begun = (measure_states(card.env, state) for state in (end, goal, start))
    errors = {
        "prediction": probe.errors(predicted.cpu(), reached),
        "to_goal": {q.name: q.error(reached[q.name], wanted[q.name]) for q in probe.quantities},
        "to_goal_at_start": {q.name: q.error(begun[q.name], wanted[q.name]) for q in probe.quantities},
    }
    distance = {"start": latent, "predicted_end": predicted, "executed_end": encode(end)}
    return {
        "latent_distance_to_goal": {k: quantiles((z - goal_latent).norm(dim=-1))["median"] for k, z in distance.items()},
        "quantities": {q.name: {what: quantiles(e[q.name]) for what, e in errors.items()} for q in probe.quantities},
    }


def conclude(success: dict[str, Any]) -> dict[str, Any]:
    """The loss of each part, in success ever, and a sentence about the largest one."""
    rates = {name: row["success_rate"] for name, row in success.items()}
    if len(rates) < len(PLANNERS):
        return {"losses": None, "sentence": "Without the oracle, the losses of encoder, predictor and planner are not known."}
    losses = {
        "predictor": rates["latents"] - rates["model"],
        "encoder": rates["states"] - rates["latents"],
        "planner": 1 - rates["states"],
    }
    largest = max(losses, key=losses.get)
    if losses[largest] <= 0.02:
        return {"losses": losses, "sentence": f"Nothing is lost: {rates['model']:.0%} of the goals are reached."}
    because = {
        "predictor": "planning with the true dynamics on the same latents reaches {latents:.0%} of the goals instead of {model:.0%}",
        "encoder": "with the true dynamics, planning reaches {states:.0%} of the goals on true states and {latents:.0%} on latents",
        "planner": "even with true dynamics and true states, the search reaches only {states:.0%} of the goals",
    }[largest].format(**rates)
    return {"losses": losses, "sentence": f"The largest loss is in the {largest}: {because}."}


def show(success: dict[str, Any]) -> None:
    """Prints the latest success rate."""
    name, row = list(success.items())[-1]
    print(f"{PLANNERS[name]}: {row['success_rate']:.1%} ever, {row['success_rate_at_end']:.1%} at the end")


def number(value: float | None) -> str:
    """Three digits."""
    return "-" if value is None else f"{value:.3g}"


def table(header: list[str], rows: list[list[str]]) -> str:
    """A table of Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def tabulate(result: dict[str, Any]) -> str:
    """The report, in Markdown."""
    success, probes, prediction = result["success"], result["probes"], result["prediction"]
    count, depth = success["model"]["pairs"], len(prediction["latent_error"])
    settings, offset = result["settings"], result["goal_offset"]
    names = list(probes["mlp"])
    parts = [
        f"# Diagnosis of {Path(result['run']).name} ({result['env']}, {result['method']}, {result['checkpoint']})\n",
        f"**{result['conclusion']['sentence']}**\n",
        f"## Success on {count} validation pairs (goal {offset} steps ahead, budget {result['budget']}, open loop)\n",
        table(
            ["plans from", "success", "95 %", "at the end", "solved at start"],
            [
                [
                    PLANNERS[name],
                    f"{row['success_rate']:.0%}",
                    "{:.0%}-{:.0%}".format(*row["success_interval"]),
                    f"{row['success_rate_at_end']:.0%}",
                    str(row["solved_at_start"]),
                ]
                for name, row in success.items()
            ],
        ),
    ]
    if len(success) > 1:
        begin = "from the plans of the run's planner" if settings["guided"] else "from mean actions"
        parts.append(
            f"True dynamics: iCEM with {settings['candidates']} candidates and {settings['iterations']} iterations, started "
            f"{begin}. First row to second: loss of the predictor; second to third: of the encoder; third to 100 %: of the "
            "search, its horizon and the budget.\n"
        )
    rows = []
    for name in names:
        linear, deep = probes["ridge"][name], probes["mlp"][name]
        cells = [f"{number(deep['median'])} / {number(deep['p90'])}", number(deep["r2"])]
        cells += [f"{number(linear['median'])} / {number(linear['p90'])}", number(linear["r2"]), number(deep["constant"])]
        rows.append([name, deep["unit"], tolerance(result["env"], name), *cells])
    header = ["quantity", "unit", "tolerance of success", "MLP: median / 90 %", "R²", "ridge: median / 90 %", "R²", "constant"]
    parts += ["## What one latent holds: error of probes on validation episodes\n", table(header, rows)]
    parts += [
        f"## How far predictions are off (MLP probe; from {prediction['context']} real frames and the recorded actions; median / 90 %)\n"
    ]
    rows = [
        ["latent, relative to its std", what, "-", *map(number, prediction[key])]
        for what, key in (("prediction", "latent_error"), ("movement", "latent_movement"))
    ]
    one = result["prediction_from_one_frame"]
    rows.insert(1, ["", "from one frame", "-", *map(number, one["latent_error"])])
    for name in names:
        unit = probes["mlp"][name]["unit"]
        full, short = prediction["quantities"][name], one["quantities"][name]
        lines = [("prediction", full["prediction"]), ("from one frame", short["prediction"])]
        lines += [("probe on the real frame", full["probe"]), ("movement", full["movement"])]
        for i, (what, cells) in enumerate(lines):
            texts = [f"{number(c['median'])} / {number(c['p90'])}" for c in cells]
            rows.append([f"{name}, {unit}" if i == 0 else "", what, tolerance(result["env"], name), *texts])
    parts.append(table(["quantity", "error of", "tolerance", *(f"{k + 1} block{'s' * (k > 0)}" for k in range(depth))], rows))
    found, rows = result["found_plans"], []
    for name, error in found["quantities"].items():
        cells = [f"{number(error[k]['median'])} / {number(error[k]['p90'])}" for k in ("prediction", "to_goal", "to_goal_at_start")]
        rows.append([name, probes["mlp"][name]["unit"], *cells])
    parts += [
        f"## Plans that the run's planner finds, after {depth} blocks (median / 90 %)\n",
        table(["quantity", "unit", "error of the prediction", "executed: distance to goal", "start: distance to goal"], rows),
        "Latent distance to the goal (median): {start:.3g} at the start, {predicted_end:.3g} at the predicted end, "
        "{executed_end:.3g} at the executed end.\n".format(**found["latent_distance_to_goal"]),
    ]
    return "\n".join(parts)


def tolerance(env: str, name: str) -> str:
    """The largest error of the success rule, as text."""
    (quantity,) = (q for q in state_quantities(env) if q.name == name)
    return number(quantity.tolerance)


def draw(result: dict[str, Any], target: Path) -> None:
    """Error by depth of each quantity, error of the probes, and the success rates."""
    try:
        import matplotlib
    except ImportError:
        print("diagnosis.png is left out: pip install 'torchrl_ficreg[plot]'")
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    names, prediction = list(result["probes"]["mlp"]), result["prediction"]
    panels = len(names) + 3
    columns = min(4, panels)
    figure, axes = pyplot.subplots(-(-panels // columns), columns, figsize=(3.6 * columns, 3 * -(-panels // columns)))
    axes = axes.flatten()
    blocks = range(1, len(prediction["latent_error"]) + 1)
    one = result["prediction_from_one_frame"]
    styles = {"prediction": "C0", "movement": "C7", "probe": "C2"}
    for axis, name in zip(axes, names):
        for what, color in styles.items():
            cells = prediction["quantities"][name][what]
            axis.plot(blocks, [c["median"] for c in cells], color=color, marker="o", ms=3, label=what)
            if what != "movement":
                axis.plot(blocks, [c["p90"] for c in cells], color=color, ls=":", lw=1)
        axis.plot(blocks, [c["median"] for c in one["quantities"][name]["prediction"]], color="C0", ls="--", label="prediction from one frame")
        allowed = tolerance(result["env"], name)
        if allowed != "-":
            axis.axhline(float(allowed), color="C3", lw=0.8, label="tolerance of success")
        axis.set(title=name, xlabel="blocks", ylabel=result["probes"]["mlp"][name]["unit"], ylim=(0, None))
    axes[0].legend(fontsize=6, title="median (dotted: 90 %)", title_fontsize=6)
    latent, probe, rates = axes[len(names) : panels]
    latent.plot(blocks, prediction["latent_error"], color="C0", marker="o", ms=3)
    latent.plot(blocks, one["latent_error"], color="C0", ls="--")
    latent.plot(blocks, prediction["latent_movement"], color="C7", marker="o", ms=3)
    latent.set(title="latent", xlabel="blocks", ylabel="error / std of the latent", ylim=(0, None))
    for shift, kind in ((-0.2, "ridge"), (0.2, "mlp")):
        scores = result["probes"][kind]
        share = [scores[name]["median"] / max(scores[name]["constant"], 1e-12) for name in names]
        probe.barh([i + shift for i in range(len(names))], share, 0.38, label=kind)
    probe.set(title="probes on real latents", xlabel="median error / that of a constant", yticks=range(len(names)))
    probe.set_yticklabels(names, fontsize=7)
    probe.invert_yaxis()
    probe.legend(fontsize=7)
    success = result["success"]
    for i, row in enumerate(success.values()):
        low, high = row["success_interval"]
        rate = row["success_rate"]
        rates.bar(i - 0.2, rate, 0.38, color="C0", yerr=[[max(0, rate - low)], [max(0, high - rate)]], label="ever" if i == 0 else None)
        rates.bar(i + 0.2, row["success_rate_at_end"], 0.38, color="C1", label="at the end" if i == 0 else None)
    labels = {"model": "model,\nlatents", "latents": "simulator,\nlatents", "states": "simulator,\nstates"}
    rates.set(title=f"success, {success['model']['pairs']} pairs", ylim=(0, 1.02), xticks=range(len(success)))
    rates.set_xticklabels([labels[name] for name in success], fontsize=7)
    rates.legend(fontsize=7)
    for axis in axes[panels:]:
        axis.set_axis_off()
    for axis in axes[:panels]:
        axis.grid(alpha=0.3)
    figure.suptitle(result["conclusion"]["sentence"], fontsize=9, wrap=True)
    figure.tight_layout()
    figure.savefig(target, dpi=110)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
