"""Statistics of the PushT expert's episodes beside those of the official data: docs/results/push_t_{data.json,expert.gif}."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np

from torchrl_ficreg.envs._angles import wrap_angle
from torchrl_ficreg.envs.push_t import render_pixels, sample_state
from torchrl_ficreg.envs.push_t.expert import PushTExpert
from torchrl_ficreg.envs.push_t.geometry import AGENT_RADIUS, overshoot, part_distances, to_block, WINDOW
from torchrl_ficreg.envs.push_t.physics import PushTWorld
from torchrl_ficreg.envs.push_t.tasks import is_success

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"
SEED, EPISODES, STEPS = 0, 300, 150
OFFSET, BUDGET, PAIRS = 25, 50, 400
FILMED, COLUMNS, SIZE, SKIP = 6, 3, 128, 2  # of the GIF: episodes, episodes in a row, px, steps per frame

# Published statistics of the data of arXiv 2603.19312.
OFFICIAL = {
    "action_mean": [-0.0087, 0.0068],
    "action_std": [0.2019, 0.2002],
    "action_range": [-1.495, 2.043],
    "share_of_actions_beyond_1": 0.00124,
    "action_displacement_correlation": 0.995,
    "mean_episode_steps": 125.1,
    "share_of_windows_solved_at_start": 0.0022,
    "random_actions_success": 0.04,
}


def main() -> None:
    """Measures seeded episodes and draws the GIF."""
    episodes = [record(SEED, index) for index in range(EPISODES)]
    aimed = [record(SEED, index, goal_share=1.0, random_share=0.0, free_share=0.0) for index in range(100)]
    report = {
        "settings": {"seed": SEED, "episodes": EPISODES, "steps": STEPS, "offset": OFFSET, "budget": BUDGET},
        "official": OFFICIAL,
        "pusher": {
            **of_actions(episodes),
            **of_windows(episodes),
            **of_states(episodes),
            "random_actions_success": random_success(episodes),
            "share_of_own_targets_reached": own_targets_reached(episodes),
            "share_of_goals_reached_in_150_steps": float(np.mean([block_arrives(*episode) for episode in aimed])),
            "cpu_ms_per_call": float(1e3 * np.median([episode[3] for episode in episodes])),
        },
    }
    report["pusher"] = {key: rounded(value) for key, value in report["pusher"].items()}
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "push_t_data.json").write_text(json.dumps(report, indent=2) + "\n")
    film(episodes[:FILMED], RESULTS / "push_t_expert.gif")


def record(seed: int, index: int, **options: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """One episode of the expert.

    Returns:
        States [T + 1, 7], actions [T, 2], the expert's targets [T, 3] (row 0 is the goal's pose if ``goal_share=1``), and CPU
        seconds per call.
    """
    task, noise = (np.random.default_rng(part) for part in np.random.SeedSequence((seed, index)).spawn(2))
    world, state, goal = PushTWorld(), sample_state(task), sample_state(task)
    expert = PushTExpert(rng=noise, **options)
    world.set_state(state)
    states, actions, targets, seconds = [state], [], [], 0.0
    for _ in range(STEPS):
        begin = time.process_time()
        actions.append(expert(states[-1], goal))
        seconds += time.process_time() - begin
        targets.append(expert.target.copy())
        world.step(actions[-1].astype(np.float64))
        states.append(world.get_state())
    return np.stack(states), np.stack(actions), np.stack(targets), seconds / STEPS


def of_actions(episodes: list[tuple]) -> dict:
    """Mean, std and range of the actions, and their correlation with the agent's displacement."""
    actions = np.concatenate([episode[1] for episode in episodes])
    moves = np.concatenate([np.diff(episode[0][:, :2], axis=0) for episode in episodes])
    return {
        "action_mean": actions.mean(0).tolist(),
        "action_std": actions.std(0).tolist(),
        "action_range": [float(actions.min()), float(actions.max())],
        "share_of_actions_beyond_1": float((np.abs(actions) > 1).mean()),
        "action_displacement_correlation": float(np.corrcoef(actions.ravel(), moves.ravel())[0, 1]),
        "mean_episode_steps": float(np.mean([len(episode[1]) for episode in episodes])),
        "agent_px_per_step": float(np.linalg.norm(moves, axis=1).mean()),
    }


def windows(episodes: list[tuple]) -> tuple[np.ndarray, np.ndarray]:
    """First and last states of all windows of OFFSET steps, [N, 7] each."""
    starts = np.concatenate([episode[0][:-OFFSET] for episode in episodes])
    return starts, np.concatenate([episode[0][OFFSET:] for episode in episodes])


def of_windows(episodes: list[tuple]) -> dict:
    """Statistics of windows of OFFSET steps."""
    starts, ends = windows(episodes)
    block = np.linalg.norm(ends[:, 2:4] - starts[:, 2:4], axis=1)
    turn = np.degrees(wrap_angle(ends[:, 4] - starts[:, 4]))
    agent = np.linalg.norm(ends[:, :2] - starts[:, :2], axis=1)
    solved = [is_success(start, end) for start, end in zip(starts, ends)]
    return {
        "block_displacement_mean_px": float(block.mean()),
        "block_displacement_median_px": float(np.median(block)),
        "share_of_windows_block_over_10px": float((block > 10).mean()),
        "share_of_windows_turn_over_10deg": float((np.abs(turn) > 10).mean()),
        "share_of_windows_both": float(((block > 10) & (np.abs(turn) > 10)).mean()),
        "share_of_windows_block_still": float(((block < 1) & (np.abs(turn) < 1)).mean()),
        "share_of_windows_clockwise_over_10deg": float((turn > 10).mean()),
        "share_of_windows_counterclockwise_over_10deg": float((turn < -10).mean()),
        "turn_mean_deg": float(np.abs(turn).mean()),
        "agent_displacement_mean_px": float(agent.mean()),
        "share_of_windows_solved_at_start": float(np.mean(solved)),
    }


def of_states(episodes: list[tuple]) -> dict:
    """Contact and coverage; cells are 50 px, 50 px and 30 degrees over the range of the block's start poses."""
    states = np.concatenate([episode[0] for episode in episodes])
    local = np.stack([to_block(state[2:5], state[:2]) for state in states])
    gap = np.minimum(*part_distances(local[:, 0], local[:, 1])) - AGENT_RADIUS
    touching = gap < 0.5
    moved = np.concatenate([np.abs(np.diff(episode[0][:, 2:5], axis=0)).max(1) > 1e-3 for episode in episodes])
    ranges = [(100, 400), (100, 400), (0, 2 * np.pi)]
    cells, _ = np.histogramdd(states[:, 2:5], bins=(6, 6, 12), range=ranges)
    agent_cells, _ = np.histogramdd(states[:, :2], bins=(10, 10), range=[(6, 506), (6, 506)])
    x, y = local[touching].T
    top, end, under = y < 0, np.abs(x) > 60, (y > 30) & (np.abs(x) > 30.5)
    foot = y > 120
    faces = {"top": top, "bar_ends": end & ~top, "underside": under & ~end, "stem_end": foot}
    faces["stem_sides"] = ~np.any(list(faces.values()), axis=0)
    return {
        "contact_share_of_steps": float(touching.mean()),
        "block_moves_share_of_steps": float(moved.mean()),
        "contact_shares_of_faces": {name: float(face.mean()) for name, face in faces.items()},
        "starts_closer_than_10px": float(np.mean([_start_gap(episode[0][0]) < 10 for episode in episodes])),
        "occupied_block_cells_of_432": float((cells > 0).mean()),
        "occupied_agent_cells_of_100": float((agent_cells > 0).mean()),
        "agent_outside_window_share": float((np.abs(states[:, :2] - WINDOW / 2).max(1) > WINDOW / 2).mean()),
        "block_at_wall_share": float((overshoot(states[:, 2:5], 8.0) > 0).mean()),
    }


def _start_gap(state: np.ndarray) -> float:
    return float(np.minimum(*part_distances(*to_block(state[2:5], state[:2])))) - AGENT_RADIUS


def random_success(episodes: list[tuple]) -> float:
    """Share of pairs OFFSET steps apart that uniform random actions solve at some time within the budget."""
    rng = np.random.default_rng(SEED)
    starts, ends = windows(episodes)
    picks = rng.choice(len(starts), PAIRS, replace=False)
    return float(np.mean([random_actions_reach(starts[pick], ends[pick], rng) for pick in picks]))


def random_actions_reach(state: np.ndarray, goal: np.ndarray, rng: np.random.Generator) -> bool:
    """Whether one run of random actions reaches the goal."""
    world = PushTWorld()
    world.set_state(state)
    for _ in range(BUDGET):
        if is_success(world.get_state(), goal):
            return True
        world.step(rng.uniform(-1, 1, size=2))
    return is_success(world.get_state(), goal)


def own_targets_reached(episodes: list[tuple]) -> float:
    """Share of finished targets at which the block was within 20 px and 20 degrees when the next one was chosen."""
    arrivals = []
    for states, _, targets, _ in episodes:
        changes = np.flatnonzero((np.diff(targets, axis=0) != 0).any(axis=1)) + 1
        arrivals += [is_there(states[row], targets[row - 1]) for row in changes]
    return float(np.mean(arrivals))


def block_arrives(states: np.ndarray, actions: np.ndarray, targets: np.ndarray, seconds: float) -> bool:
    """Whether the block reaches the first target within the episode."""
    return any(is_there(state, targets[0]) for state in states)


def is_there(state: np.ndarray, pose: np.ndarray) -> bool:
    """Whether the block of a state [7] is within 20 px and 20 degrees of a pose [3]."""
    return is_success(state, np.array([0.0, 0.0, *pose, 0.0, 0.0]), success_on="block")


def rounded(value: object) -> object:
    """Rounds numbers to four decimals, also inside lists and dictionaries."""
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    return [round(entry, 4) for entry in value] if isinstance(value, list) else round(value, 4)


def film(episodes: list[tuple], target: Path) -> None:
    """Draws episodes side by side; the pale red T is the expert's current target."""
    import imageio.v3 as imageio

    tiles = []
    for states, _, targets, _ in episodes:
        pictures = render_pixels(states[:-1:SKIP], size=SIZE, draw_goal=False)
        ghosts = np.zeros((len(targets[::SKIP]), 7))
        ghosts[:, :2], ghosts[:, 2:5] = -100.0, targets[::SKIP]
        shade = 255 - render_pixels(ghosts, size=SIZE, draw_goal=False).min(axis=1)  # [T, H, W], dark where the ghost is
        bare = pictures.min(axis=1) > 250
        weight = 0.5 * (bare & (shade > 40))
        tint = np.array([255, 120, 110])[:, None, None]
        tiles.append((pictures * (1 - weight[:, None]) + tint * weight[:, None]).astype(np.uint8))
    rows = [np.concatenate(tiles[i : i + COLUMNS], axis=3) for i in range(0, len(tiles), COLUMNS)]
    frames = np.concatenate(rows, axis=2).transpose(0, 2, 3, 1)
    imageio.imwrite(target, frames, duration=100 * SKIP // 2, loop=0)


if __name__ == "__main__":
    main()
