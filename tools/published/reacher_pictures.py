"""Compares fast pictures of Reacher with those of MuJoCo: docs/results/reacher_pictures.json.

Random postures are drawn by both. The report holds the mean and the largest absolute difference of a value of a picture, in
grey levels, the worst picture's mean, and the mean difference that a turn of both joints by 0.005 rad makes to MuJoCo's
picture. Needs GL; 100 postures take half a minute of CPU time.

``--background`` writes the stored pictures of the scene without the arm again; they depend on the GL library by one grey
level.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from torchrl_ficreg.envs.reacher import ReacherEnv, render, tasks

ROOT = Path(__file__).resolve().parents[2]
SIZES = (64, 112, 224)
STORED = (64, 112, 224, 448)
ARM = ("arm", "hand", "finger")
TURN = 0.005  # rad


def main() -> None:
    """Draws, compares and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--postures", type=int, default=100)
    parser.add_argument("--background", action="store_true")
    parser.add_argument("--out", type=Path, default=ROOT / "docs/results/reacher_pictures.json")
    arguments = parser.parse_args()
    if arguments.background:
        pictures = {str(size): differences_of_neighbours(draw_empty(size)) for size in STORED}
        np.savez_compressed(ROOT / "torchrl_ficreg/envs/reacher/background.npz", **pictures)
        return
    rng = np.random.default_rng(0)
    states = np.stack([tasks.sample_state(rng) for _ in range(arguments.postures)])
    report = {"postures": len(states), **{str(size): compare(states, size) for size in SIZES}}
    arguments.out.write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(report, indent=2))


def compare(states: np.ndarray, size: int) -> dict[str, float]:
    """The numbers of one size."""
    env = ReacherEnv(image_size=size)
    ours = render.render_pixels(states, size=size).astype(int)
    theirs, turned = (np.stack([env._draw(state + [turn, turn, 0, 0]) for state in states]).astype(int) for turn in (0.0, TURN))
    env.close()
    errors = np.abs(ours - theirs)
    return {
        "mean": round(errors.mean().item(), 4),
        "worst_picture": round(errors.mean((1, 2, 3)).max().item(), 4),
        "largest": errors.max().item(),
        "turn": round(np.abs(turned - theirs).mean().item(), 4),
    }


def draw_empty(size: int) -> np.ndarray:
    """MuJoCo's picture of the scene without the arm, [3, size, size] uint8."""
    env = ReacherEnv(image_size=size)
    for index in (env._model.geom(name).id for name in ARM):
        env._model.geom_matid[index], env._model.geom_rgba[index] = -1, 0.0
    picture = env._draw(np.zeros(4))
    env.close()
    return picture


def differences_of_neighbours(picture: np.ndarray) -> np.ndarray:
    """What :func:`torchrl_ficreg.envs.reacher.render.empty_scene` sums up, modulo 256."""
    zero = np.uint8(0)
    return np.diff(np.diff(picture, axis=2, prepend=zero), axis=1, prepend=zero)


if __name__ == "__main__":
    main()
