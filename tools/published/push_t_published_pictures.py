"""Success rate of a model trained on this package's PushT images, planning on the published ones.

Steps: set up the published environment as ``test/envs/push_t/golden/make_push_t.py`` says, train, then::

    python tools/published/push_t_published_pictures.py runs/push_t_cpu_ficreg_seed0 PUBLISHED_PYTHON [PAIRS]

where PUBLISHED_PYTHON is the interpreter of that environment. Plans on the run's own start-goal pairs, once on this
package's images and once on the published ones, rendered at 224 pixels and scaled down; writes ``published_pictures.json``
beside the run's results.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import gymnasium
import numpy as np
import torch

from torchrl_ficreg import CEMConfig, LatentCEMPlanner, MPCPolicy
from torchrl_ficreg.envs.push_t.env import PushTEnv
from torchrl_ficreg.evaluation import evaluate_mpc, StartGoalPairs
from torchrl_ficreg.trainers import load_world_model

DRAWER = Path(__file__).resolve().parents[2] / "test" / "envs" / "push_t" / "golden" / "make_push_t.py"
SIZE = 224


class PublishedPictures(PushTEnv):
    """PushT with this package's physics and the published images."""

    server: subprocess.Popen

    def _draw(self, state: np.ndarray) -> np.ndarray:
        self.server.stdin.write(state.tobytes())
        self.server.stdin.flush()
        picture = np.frombuffer(self.server.stdout.read(3 * SIZE * SIZE), np.uint8).reshape(1, 3, SIZE, SIZE)
        size = (self.image_size, self.image_size)
        small = torch.nn.functional.interpolate(torch.tensor(picture).float(), size, mode="bilinear", antialias=True)
        return small[0].round().clamp(0, 255).to(torch.uint8).numpy()


def main() -> None:
    """Evaluates twice and compares."""
    run, python = Path(sys.argv[1]), sys.argv[2]
    model, _, card = load_world_model(run)
    pairs = StartGoalPairs.load(run / "pairs.json")
    count = int(sys.argv[3]) if len(sys.argv) > 3 else len(pairs)
    rows = slice(0, count)
    pairs = replace(
        pairs,
        episode=pairs.episode[rows],
        step=pairs.step[rows],
        start_state=pairs.start_state[rows],
        goal_state=pairs.goal_state[rows],
    )
    known = {field.name for field in fields(CEMConfig)}
    plan = {key: value for key, value in card.config["plan"].items() if key in known}
    planner = LatentCEMPlanner(model, CEMConfig(**plan), action_bounds=(card.action_low, card.action_high))
    gymnasium.register("PublishedPictures-v0", PublishedPictures)
    results = {"pairs": count}
    with subprocess.Popen([python, str(DRAWER), "serve"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as server:
        PublishedPictures.server = server
        ours, theirs = PushTEnv(image_size=card.model["image_size"]), PublishedPictures(image_size=card.model["image_size"])
        pictures = [np.stack([env._draw(state) for state in pairs.start_state]) for env in (ours, theirs)]
        with torch.no_grad():
            latents = [model.encode(torch.from_numpy(frames)) for frames in pictures]
        results["mean_absolute_difference"] = float(np.abs(pictures[0].astype(int) - pictures[1]).mean())
        results["latent_distance"] = float((latents[0] - latents[1]).norm(dim=-1).mean())
        results["latent_distance_of_other_scenes"] = float((latents[0] - latents[0].roll(1, 0)).norm(dim=-1).mean())
        for name, env in {"ours": "push_t", "published": "PublishedPictures-v0"}.items():
            outcome = evaluate_mpc(
                MPCPolicy(planner),
                replace(pairs, env=env),
                budget=card.config["env"]["budget"],
                image_size=card.model["image_size"],
                num_envs=count,
                env_kwargs=card.env_kwargs,
                description=name,
            )
            results[name] = outcome.summary()
        server.stdin.close()
    (run / "published_pictures.json").write_text(json.dumps(results, indent=2) + "\n")
    print({name: results[name]["success_rate"] for name in ("ours", "published")}, results)


if __name__ == "__main__":
    main()
