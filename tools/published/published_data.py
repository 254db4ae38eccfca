"""The two commands of check_published_data.sh. They run in different environments, so imports are inside the functions."""

from __future__ import annotations

import shutil
import sys
import types
from pathlib import Path

import numpy as np

TASKS = {"two_room": ("swm/TwoRoom-v1", 60), "push_t": ("swm/PushT-v1", 60)}
EPISODES, SIZE, SEED = 6, 64, 0
OUR_ENV = {"two_room": {"collision": "endpoint"}, "push_t": {}}  # TwoRoom's published collision rule
FRAME_TOLERANCE = {"hdf5": 0.0, "lance": 1.0}  # mean over pixels; Lance keeps JPEG of quality 95


def collect(folder: Path) -> None:
    """Records a few random episodes with stable-worldmodel, as plain arrays and in both of its formats."""
    if "torchvision" not in sys.modules:
        stand_in = types.ModuleType("torchvision")
        stand_in.tv_tensors = types.ModuleType("torchvision.tv_tensors")
        stand_in.__spec__ = None
        sys.modules.update({"torchvision": stand_in, "torchvision.tv_tensors": stand_in.tv_tensors})
    import stable_worldmodel as swm
    from stable_worldmodel.data.format import get_format

    class Keep:
        """A writer that stores the episodes in memory."""

        def __enter__(self):
            self.episodes = []
            return self

        def __exit__(self, *_):
            pass

        def write_episodes(self, episodes):
            self.episodes = list(episodes)

    for name, (env, steps) in TASKS.items():
        world = swm.World(env, num_envs=2, image_shape=(SIZE, SIZE), max_episode_steps=steps)
        policy = swm.policy.RandomPolicy(seed=SEED)
        world.set_policy(policy)
        keep = Keep()
        world.collect(writer=keep, episodes=EPISODES, seed=SEED, progress=False)
        keys = ("pixels", "action", "state")
        arrays = {key: np.concatenate([np.stack(episode[key]) for episode in keep.episodes]) for key in keys}
        np.savez(folder / f"{name}.npz", lengths=[len(ep["action"]) for ep in keep.episodes], **arrays)
        for kind, suffix in (("hdf5", ".h5"), ("lance", ".lance")):
            path = folder / f"{name}{suffix}"
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
            with get_format(kind).open_writer(path) as writer:
                writer.write_episodes(iter(keep.episodes))
        print(f"{name}: {len(keep.episodes)} episodes, {len(arrays['action'])} rows, columns {sorted(keep.episodes[0])}")


def compare(folder: Path) -> None:
    """Converts the files and compares them with the plain arrays; exits with an error if they differ."""
    from torchrl_ficreg.data import EpisodeStore
    from torchrl_ficreg.data.convert import convert, open_source, verify_alignment

    wrong = []
    for name in TASKS:
        truth = np.load(folder / f"{name}.npz")
        ends = truth["lengths"].cumsum()
        action = truth["action"].astype(np.float32)
        action[ends - 1] = 0
        for kind, suffix in (("hdf5", ".h5"), ("lance", ".lance")):
            target = folder / f"{name}_{kind}"
            shutil.rmtree(target, ignore_errors=True)
            with open_source(folder / f"{name}{suffix}", env=name) as source:
                lags = verify_alignment(source)
                convert(source, target, progress=False)
            store = EpisodeStore.open(target, verify="full")
            got = store.arrays
            frames = abs(got["pixels"].astype(int) - truth["pixels"].transpose(0, 3, 1, 2))
            states = abs(got["state"] - truth["state"]).max()
            same = np.array_equal(got["action"], action) and np.array_equal(store.length, truth["lengths"])
            shares = " ".join(f"{share:.3f}" for share in lags.r2.values())
            print(
                f"{name} {kind}: actions {'equal' if same else 'DIFFER'}, states within {states:.1e}, frames off by "
                f"{frames.mean():.2f} on average and {frames.max()} at most, explained at lag -1 0 1: {shares}"
            )
            if not same or states > 1e-4 or frames.mean() > FRAME_TOLERANCE[kind] or lags.lag != 0:
                wrong.append(f"{name} {kind}")
        replay(name, got, ends)
    if wrong:
        sys.exit(f"not as it was recorded: {', '.join(wrong)}")


def replay(name: str, rows: dict[str, np.ndarray], ends: np.ndarray) -> None:
    """Prints the distance of one step of our environment from the next recorded state."""
    from torchrl_ficreg.envs.registry import find_entry

    env = find_entry(name).load_env()(image_size=SIZE, **OUR_ENV[name])
    away = []
    for row in sorted(set(range(int(ends[-1]))) - set((ends - 1).tolist())):
        state = rows["state"][row]
        try:
            env.reset(options={"state": state, "goal_state": state})
        except ValueError:
            continue  # the published environment allows starts in the border
        observation = env.step(rows["action"][row])[0]
        away.append(abs(observation["state"] - rows["state"][row + 1]).max())
    env.close()
    print(f"{name}: one step of our environment ends within {np.median(away):.1e} (median), {max(away):.1e} (worst of "
          f"{len(away)}) of the recorded next state")


if __name__ == "__main__":
    {"collect": collect, "compare": compare}[sys.argv[1]](Path(sys.argv[2]))
