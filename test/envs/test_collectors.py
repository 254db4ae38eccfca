"""Episodes that come through TorchRL's collectors are those of a recording in one process, byte for byte."""

from __future__ import annotations

import numpy as np
import pytest
from torchrl.envs.utils import check_env_specs

from torchrl_ficreg.data import EpisodeStore, EpisodeWriter
from torchrl_ficreg.data.shards import open_store
from torchrl_ficreg.envs import collect_episodes
from torchrl_ficreg.envs.collect import EpisodeRecorder
from torchrl_ficreg.envs.collectors import collect_shards, ExpertEpisodesEnv
from torchrl_ficreg.envs.registry import find_entry

COUNT, STEPS = 5, 60


@pytest.fixture(scope="module")
def recorder() -> EpisodeRecorder:
    """Of TwoRoom, where episodes end at their goals and so have different lengths."""
    return EpisodeRecorder(
        entry=find_entry("two_room"),
        seed=3,
        max_steps=STEPS,
        stop_at_success=True,
        expert_kwargs={"noise_std": 0.5},
        env_kwargs={"image_size": 16},
    )


@pytest.fixture(scope="module")
def expected() -> list[dict[str, np.ndarray]]:
    """The same episodes, recorded in this process."""
    settings = {"seed": 3, "num_workers": 0, "image_size": 16, "max_steps": STEPS, "expert_kwargs": {"noise_std": 0.5}}
    return list(collect_episodes("two_room", COUNT, **settings))


def same(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> bool:
    return all(ours[key].dtype == theirs[key].dtype and np.array_equal(ours[key], theirs[key]) for key in theirs)


def test_the_environment_of_a_share_keeps_torchrls_contract(recorder):
    check_env_specs(ExpertEpisodesEnv(recorder, range(100), 0), seed=None)


def test_shards_hold_the_episodes_of_one_process(recorder, expected, tmp_path):
    shares = [range(shard, COUNT, 2) for shard in range(2)]
    writers = [
        EpisodeWriter(tmp_path / f"shard-{shard}", target_episodes=len(share), meta={}) for shard, share in enumerate(shares)
    ]
    for shard, episode in collect_shards(recorder, shares):
        assert same(episode, expected[shares[shard][writers[shard].num_episodes]])
        writers[shard].append(episode)
    for writer in writers:
        writer.finish()
    assert open_store(tmp_path).fingerprint == EpisodeStore.from_episodes(expected).fingerprint


def test_an_episode_that_begins_at_its_goal_has_one_row_and_no_action(recorder, monkeypatch):
    env = ExpertEpisodesEnv(recorder, range(1), 0)
    begin = env.recorder.begin

    def at_goal(index):
        *rest, info = begin(index)
        return *rest, {**info, "success": np.array([True])}

    monkeypatch.setattr(env.recorder, "begin", at_goal, raising=False)
    start = env.reset()
    assert start["at_goal"].item() and not start["expert_action"].any()
    assert env.step(start.set("action", start["expert_action"]))["next", "done"].item()


def test_shares_that_are_done_ask_for_no_worker(recorder):
    assert list(collect_shards(recorder, [range(0), []])) == []


def test_an_unknown_kind_is_refused(recorder):
    with pytest.raises(ValueError, match="unknown kind of collector 'mpi'"):
        next(collect_shards(recorder, [range(1)], kind="mpi"))


@pytest.mark.parametrize("kind", ["ray", "submitit"])
def test_a_missing_package_is_named(recorder, kind, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, kind, None)
    with pytest.raises(ImportError, match=f"pip install {kind}"):
        next(collect_shards(recorder, [range(1)], kind=kind))
