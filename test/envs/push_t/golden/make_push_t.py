"""Pictures and motion of the published PushT, to compare ours with; runs where that package is installed.

Steps, in an environment of its own (the package's other dependencies are not needed for this one task)::

    python -m venv published && . published/bin/activate
    pip install pygame opencv-python-headless "pymunk==7.3.1" gymnasium shapely loguru numpy
    pip install --no-deps stable-worldmodel==0.0.6
    python test/envs/push_t/golden/make_push_t.py golden test/envs/push_t/golden/push_t.npz
    python test/envs/push_t/golden/make_push_t.py render states.npz pictures.npz

``golden`` writes the file that the tests read. ``render`` draws a list of states: it reads ``state`` [N, 7] from one
npz file and writes ``pixels`` [N, 3, 224, 224] uint8 to the other. ``serve`` does so one by one: 7 doubles in on stdin,
150,528 bytes out on stdout; ``push_t_published_pictures.py`` asks it.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import os
import sys
import types
from pathlib import Path

import numpy as np

SCENES = 6
STEPS = 60


def published_env():
    """The published environment, loaded without the rest of its package, which would want a GPU stack."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    root = Path(importlib.util.find_spec("stable_worldmodel").origin).parent
    for name, folder in {"": "", ".envs": "envs", ".envs.pusht": "envs/pusht"}.items():
        package = types.ModuleType(f"stable_worldmodel{name}")
        package.__path__ = [str(root / folder)]
        sys.modules[package.__name__] = package
    package = sys.modules["stable_worldmodel"]
    package.spaces = importlib.import_module("stable_worldmodel.spaces")
    env = importlib.import_module("stable_worldmodel.envs.pusht.env").PushT()
    env.goal_state, env._goal = np.zeros(7), None  # its reset() would draw them
    env._setup()
    return env


def random_states(rng, count):
    """Scenes [count, 7] from the published draws, agent and block wherever they fall."""
    states = np.zeros((count, 7))
    states[:, :2] = rng.uniform(50, 450, (count, 2))
    states[:, 2:4] = rng.uniform(100, 400, (count, 2))
    states[:, 4] = rng.uniform(0, 2 * np.pi, count)
    return states


def draw(env, states):
    """Pictures [N, 3, 224, 224] uint8 of states [N, 7]."""
    pictures = []
    for state in states:
        env._setup()
        # A restoration ends with a physics step, which moves an agent that has a velocity; the first step of a new
        # space moves nothing else.
        env._set_state(np.concatenate([state[:5], [0.0, 0.0]]))
        pictures.append(env.render().transpose(2, 0, 1))
    return np.array(pictures)


def push(env, rng):
    """A start [7], actions [STEPS, 2] that run into the block, and all states [STEPS + 1, 7]."""
    start = np.array([100.0, 110.0, 250.0, 220.0, 0.3, 0.0, 0.0])
    env._setup()
    env._set_state(start)
    states, actions = [env._get_obs()], rng.normal(0, 0.3, (STEPS, 2))
    for action in actions:
        action += (states[-1][2:4] + (0, 40) - states[-1][:2]) / 200  # towards the block
        env.step(action)
        states.append(env._get_obs())
    return start, actions, np.array(states)


def restore(env, scenes):
    """What states [N, 7] a reset makes of pairs of goal and start [N, 2, 7]."""
    restored = []
    for goal, start in scenes:
        env._setup()
        env._set_state(goal)
        env._set_state(start)
        restored.append(env._get_obs())
    return np.array(restored)


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    golden = commands.add_parser("golden", help="write the file that the tests read")
    golden.add_argument("out", type=Path)
    render = commands.add_parser("render", help="draw the states of a file")
    render.add_argument("states", type=Path)
    render.add_argument("out", type=Path)
    commands.add_parser("serve", help="draw states from stdin to stdout")
    args = parser.parse_args()
    env = published_env()
    if args.command == "serve":
        while len(state := sys.stdin.buffer.read(7 * 8)) == 7 * 8:
            sys.stdout.buffer.write(draw(env, np.frombuffer(state).reshape(1, 7)).tobytes())
            sys.stdout.buffer.flush()
        return
    args.out.parent.mkdir(parents=True, exist_ok=True)
    if args.command == "render":
        np.savez_compressed(args.out, pixels=draw(env, np.load(args.states)["state"]))
        return
    rng = np.random.default_rng(0)
    states = random_states(rng, SCENES)
    start, actions, pushed = push(env, rng)
    scenes = random_states(rng, 16).reshape(8, 2, 7)
    scenes[:4, 0, :2] = scenes[:4, 0, 2:4]  # half of the goals overlap: their push reaches the start
    scenes[:, 1, 5:] = rng.normal(0, 50, (8, 2))
    np.savez_compressed(
        args.out,
        state=states,
        pixels=draw(env, states),
        push_start=start,
        push_action=actions,
        push_state=pushed,
        restore_asked=scenes,
        restore_got=restore(env, scenes),
    )


if __name__ == "__main__":
    main()
