"""Success rates: an oracle gets 100 %, outcomes belong to the pair alone, and every way of counting is kept apart."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest
import torch
from scenes import make_pairs, same_room_pairs, Walker
from tensordict import TensorDict

from torchrl_ficreg import CEMConfig, LatentCEMPlanner, MPCPolicy
from torchrl_ficreg.envs.two_room import render_pixels
from torchrl_ficreg.envs.two_room.env import TwoRoomEnv
from torchrl_ficreg.evaluation import evaluate_mpc, save_episodes_gif, UniformPolicy

BOX = ([-1.0, -1.0], [1.0, 1.0])


def same_frames(ours, theirs) -> bool:
    return all(np.array_equal(one, other) for one, other in zip(ours, theirs, strict=True))


def evaluate(policy, pairs, **settings):
    return evaluate_mpc(policy, pairs, **{"budget": 8, "image_size": 16, "progress_bar": False, **settings})


@pytest.fixture
def planner(tiny_world):
    """CEM over a tiny untrained model: it plans badly, but it plans."""
    config = CEMConfig(num_candidates=16, num_elites=4, iterations=2, horizon=2, receding_horizon=1)
    return MPCPolicy(LatentCEMPlanner(tiny_world(history=1), config, action_bounds=BOX))


@pytest.mark.parametrize("num_envs", [1, 3, 50])
def test_an_oracle_reaches_every_goal_and_stays(num_envs):
    outcome = evaluate(Walker(), same_room_pairs(), budget=40, num_envs=num_envs)
    assert outcome.success_rate == 1
    assert outcome.success[:, -1].all() and not outcome.at_start.any()


def test_the_oracle_arrives_when_physics_says():
    """80 px at 5 px a step, reached closer than 16 px: 60 is at 13 steps (65 px walked, 15 left), not before."""
    pairs = make_pairs([[60, 60]], [[60, 140]])
    outcome = evaluate(Walker(), pairs, budget=20)
    assert outcome.success[0].argmax() == 13 and outcome.summary()["first_success_step"] == [13]
    assert evaluate(Walker(), pairs, budget=12).success_rate == 0


@pytest.mark.parametrize("policy", ["random", "planner"])
def test_an_outcome_depends_on_the_pair_alone(policy, planner):
    """Whatever the global random state, 1, 3 or all side by side, in worker processes, the first three alone.

    The same frames, hence the same actions, to the last pixel; groups of three find used environments.
    """
    chosen, pairs, runs = planner if policy == "planner" else UniformPolicy(*BOX), same_room_pairs(), []
    for seed, settings in enumerate(({"num_envs": 7}, {"num_envs": 1}, {"num_envs": 3}, {"num_envs": 3, "num_workers": 2})):
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        runs.append(evaluate(chosen, pairs, record=len(pairs), **settings))
    for other in runs[1:]:
        assert np.array_equal(other.success, runs[0].success) and len(other.frames) == len(pairs)
        assert same_frames(other.frames, runs[0].frames) and same_frames(other.goals, runs[0].goals)
    part = evaluate(chosen, make_pairs(pairs.start_state[:3], pairs.goal_state[:3]), record=3)
    assert same_frames(part.frames, runs[0].frames[:3])


def test_the_random_baseline_is_uniform_between_the_bounds_and_seeded():
    policy = UniformPolicy([-1.0, 2.0], [1.0, 6.0], seed=3)
    td = TensorDict({"plan_seed": torch.arange(50)}, [50])
    actions = torch.cat([policy(td)["action"].clone() for _ in range(40)])  # [2000, 2]
    assert (actions >= torch.tensor([-1.0, 2.0])).all() and (actions <= torch.tensor([1.0, 6.0])).all()
    assert actions.mean(0).tolist() == pytest.approx([0, 4], abs=0.1)
    assert actions.std(0).tolist() == pytest.approx([2 / 12**0.5, 4 / 12**0.5], rel=0.05)
    assert len(actions.unique(dim=0)) == 2000
    again = UniformPolicy([-1.0, 2.0], [1.0, 6.0], seed=3)(TensorDict({"plan_seed": torch.arange(50)}, [50]))["action"]
    assert torch.equal(again, actions[:50])


def test_reaching_a_goal_and_staying_there_are_counted_apart():
    """A policy that always walks down passes through a goal 50 px below and is long gone at the end."""
    outcome = evaluate(Walker(stop=False), make_pairs([[60, 40]], [[60, 90]]), budget=25)
    assert (outcome.success_rate, outcome.summary()["success_rate_at_end"]) == (1, 0)
    assert outcome.success[0].nonzero()[0].tolist() == list(range(7, 14))  # |50 - 5 k| < 16


def test_pairs_solved_at_the_start_are_counted_apart():
    """One starts in its goal, one 20 px above it, one far away; walking down solves the first two."""
    pairs = make_pairs([[60, 60], [60, 60], [60, 60]], [[60, 65], [60, 80], [30, 200]])
    outcome = evaluate(Walker(stop=False), pairs, budget=4)
    summary = outcome.summary()
    assert outcome.at_start.tolist() == [True, False, False] and summary["solved_at_start"] == 1
    rates = [summary["success_rate"], summary["success_rate_unsolved_at_start"]]
    assert rates == pytest.approx([2 / 3, 1 / 2]) and summary["first_success_step"] == [1, 1, -1]


def test_a_goal_left_by_the_first_step_is_no_success_of_the_policy():
    """15 px below the goal at the start and walking away."""
    outcome = evaluate(Walker(stop=False), make_pairs([[60, 95]], [[60, 80]]), budget=3)
    assert outcome.at_start.all() and outcome.success_rate == 0
    assert outcome.summary()["success_rate_unsolved_at_start"] is None


@pytest.mark.parametrize("record", [0, 2])
def test_a_summary_is_plain_json(planner, record):
    pairs = same_room_pairs(3)
    outcome = evaluate(planner, pairs, record=record)
    summary = outcome.summary()
    assert json.loads(json.dumps(summary, allow_nan=False)) == {**summary, "success_interval": [*summary["success_interval"]]}
    assert summary["pairs"] == 3 and summary["budget"] == 8 and summary["pairs_hash"] == pairs.hash
    assert outcome.seconds_per_plan > 0 == evaluate(UniformPolicy(*BOX), pairs).seconds_per_plan  # which does not plan


@pytest.mark.parametrize(("history", "receding", "frames"), [(1, 2, 2), (1, 1, 4), (2, 2, 4)])
def test_only_frames_that_are_read_or_recorded_are_drawn(monkeypatch, tiny_world, history, receding, frames):
    """Budget 7, blocks of 2: one frame for each plan, or each block with a history. The actions do not depend on it."""
    draws, actions = [], []
    draw, move = TwoRoomEnv._draw, TwoRoomEnv._step_physics
    monkeypatch.setattr(TwoRoomEnv, "_draw", lambda env, state: draws.append(1) or draw(env, state))
    monkeypatch.setattr(TwoRoomEnv, "_step_physics", lambda env, a: actions.append(a.tolist()) or move(env, a))
    config = CEMConfig(num_candidates=16, num_elites=4, iterations=2, horizon=2, receding_horizon=receding)
    policy = MPCPolicy(LatentCEMPlanner(tiny_world(history=history), config, action_bounds=BOX))
    pairs = same_room_pairs(3)
    for record, drawn in ((0, frames), (3, 8)):
        evaluate(policy, pairs, budget=7, record=record)
        assert len(draws) == 3 * (drawn + 1)  # and the goal
        draws.clear()
    assert actions[:21] == actions[21:]
    evaluate(UniformPolicy(*BOX), pairs, budget=7)
    assert len(draws) == 3 * 2


def test_recorded_frames_are_the_rendered_states():
    """The first frame shows the start state, the last one where the walker ended, the goal the goal state."""
    pairs = same_room_pairs(5)
    outcome = evaluate(Walker(), pairs, budget=40, num_envs=2, record=3)
    assert len(outcome.recorded) == len(outcome.frames) == len(outcome.goals) == 3
    for row, frames, shown_goal in zip(outcome.recorded, outcome.frames, outcome.goals):
        assert frames.shape == (41, 3, 16, 16) and frames.dtype == np.uint8
        assert np.array_equal(frames[0], render_pixels(torch.from_numpy(pairs.start_state[row]), size=16).numpy())
        goal = render_pixels(torch.from_numpy(pairs.goal_state[row]), size=16).numpy()
        assert np.array_equal(shown_goal, goal)
        assert np.abs(frames[-1].astype(int) - goal).max() <= 1


@pytest.mark.parametrize(
    ("record", "rows"), [(0, []), (1, [0]), (3, [0, 2, 4]), (4, [0, 1, 3, 5]), (7, list(range(7))), (9, list(range(7)))]
)
def test_recorded_pairs_are_spread_evenly_over_the_list(record, rows):
    """Neighbours in the list start in the same recorded episode."""
    outcome = evaluate(Walker(), same_room_pairs(7), budget=1, num_envs=3, record=record)
    assert outcome.recorded == rows and len(outcome.frames) == len(outcome.goals) == len(rows)


def test_the_gif_frames_the_successes_of_the_recorded_pairs(tmp_path):
    """Rows 0 and 2 are shown, row 1 alone reaches its goal: no frame turns green. Rows 0 and 1: the second does."""
    imageio = pytest.importorskip("imageio.v3")
    starts, goals = [[60, 40]] * 4, [[60, 200], [60, 62], [60, 200], [60, 200]]
    outcome = evaluate(Walker(stop=False), make_pairs(starts, goals), budget=3, record=2)
    assert outcome.recorded == [0, 2] and outcome.ever.tolist() == [False, True, False, False]
    for rows, green in (([0, 2], [False, False]), ([0, 1], [False, True])):
        outcome.recorded = rows
        save_episodes_gif(outcome, tmp_path / "episodes.gif", scale=1, columns=2)
        last = imageio.imread(tmp_path / "episodes.gif", index=None)[-1].astype(int)  # [h, w, 3]
        border = last[1, [2, last.shape[1] // 2 + 2]]  # of the left and of the right tile
        assert (border[:, 1] > border[:, 0] + 50).tolist() == green


def test_an_environment_that_draws_at_its_reset_is_seeded_by_the_pair():
    """What TwoRoom would draw next depends on the pair and not on who ran before in the same environment."""
    drawn = {}

    class Spy(TwoRoomEnv):
        def _is_success(self, state, goal_state):
            drawn.setdefault(key, []).append(self.np_random.bit_generator.state["state"]["state"])
            return super()._is_success(state, goal_state)

    gymnasium.register("test/Spy-v0", Spy)
    for key in (1, 4):  # noqa: B007  environments side by side
        evaluate(Walker(), make_pairs([[60, 60]] * 4, [[60, 90]] * 4, env="test/Spy-v0"), num_envs=key, budget=1)
    del gymnasium.registry["test/Spy-v0"]
    assert len(set(drawn[1])) == 4 and set(drawn[1]) == set(drawn[4])


def test_environment_arguments_arrive():
    """Only under the published rule is an agent at a jamb thrown back, and the two rules part ways."""
    pairs = make_pairs([[111, 64]], [[150, 100]])
    swept, endpoint = (
        evaluate(Walker(stop=False), pairs, record=1, budget=2, env_kwargs={"collision": rule})
        for rule in ("swept", "endpoint")
    )
    assert not np.array_equal(swept.frames[0], endpoint.frames[0])


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"budget": 0}, "must be positive"),
        ({"num_envs": 0}, "must be positive"),
        ({"num_workers": 0}, "num_workers must be None or at least 1, got 0"),
        ({"env_kwargs": {"image_size": 8}}, r"must not hold \['image_size'\]"),
    ],
)
def test_settings_out_of_range_are_refused(setting, message):
    with pytest.raises(ValueError, match=message):
        evaluate(Walker(), same_room_pairs(1), **setting)
