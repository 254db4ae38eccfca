"""What PushTEnv adds to the protocol of all environments: draws, success rules, and restoration of contacts."""

from __future__ import annotations

import numpy as np
import pytest
pytest.importorskip("pymunk", reason="PushT needs pymunk")

from torchrl_ficreg.envs.push_t import tasks  # noqa: E402
from torchrl_ficreg.envs.push_t.env import PushTEnv  # noqa: E402
from torchrl_ficreg.envs.push_t.render import render_pixels  # noqa: E402

START = np.array([100.0, 100.0, 300.0, 260.0, 0.1, 0.0, 0.0])


def test_a_restored_contact_continues_within_a_few_pixels():
    """The solver's cached contacts are not part of the published state: the disc repeats exactly, the block nearly."""
    env = PushTEnv(image_size=8, terminate_on_success=False)
    actions = np.random.default_rng(0).normal(0, 0.4, (50, 2)) + 0.6 * np.sin(np.arange(50) / 6)[:, None]

    def play(state, actions):
        states = [env.reset(options={"state": state})[0]["state"]]
        return np.stack(states + [env.step(action)[0]["state"] for action in actions.astype(np.float32)])

    record, apart = play(np.array([200.0, 190.0, 250.0, 250.0, 1.0, 20.0, -30.0]), actions), []
    for begin in range(0, 40, 5):
        again = play(record[begin], actions[begin : begin + 10])[-1]
        np.testing.assert_allclose(again[:2], record[begin + 10, :2], atol=1e-9)
        apart.append(np.linalg.norm(again[2:4] - record[begin + 10, 2:4]))
    assert np.median(apart) < 1.5 and max(apart) < 6


def test_legacy_restoration_steps_once_after_the_goal_and_once_after_the_start():
    """The agent is carried on by 0.01 s of its velocity, and an overlap at the goal pushes the block of the start."""
    goal = np.array([250.0, 250.0, 250.0, 250.0, 1.0, 0.0, 0.0])  # the disc is inside the block
    start = np.array([60.0, 60.0, 250.0, 250.0, 1.0, 100.0, -50.0])
    options = {"state": start, "goal_state": goal}
    env = PushTEnv(image_size=64, legacy_restore=True)
    got = [env.reset(options=options)[0] for _ in range(2)]
    np.testing.assert_allclose(got[0]["state"][:2], [61.0, 59.5], atol=1e-12)
    assert 0.1 < np.abs(got[0]["state"][2:4] - start[2:4]).max() < 5
    assert (got[0]["state"] == got[1]["state"]).all() and (got[0]["goal_state"] == goal).all()
    assert (got[0]["pixels"] == render_pixels(got[0]["state"], size=64)).all()
    exact, _ = PushTEnv(image_size=64).reset(options=options)
    assert (exact["state"] == start).all()


def test_starts_and_goals_fill_their_ranges_and_overlap_nothing():
    states = np.array([tasks.sample_state(np.random.default_rng(seed)) for seed in range(400)])
    assert all(tasks.is_free(state) for state in states) and (states[:, 5:] == 0).all()
    for column, low, high in [(0, 50, 450), (1, 50, 450), (2, 100, 400), (3, 100, 400), (4, 0, 2 * np.pi)]:
        margin = 0.05 * (high - low)
        assert low <= states[:, column].min() < low + margin
        assert high - margin < states[:, column].max() <= high


def test_a_free_scene_does_not_move_by_itself():
    env = PushTEnv(image_size=8, terminate_on_success=False)
    for seed in range(20):
        start = env.reset(seed=seed)[0]["state"]
        after = env.step(np.zeros(2))[0]["state"]
        np.testing.assert_allclose(after[:5], start[:5], atol=1e-9)


def test_published_draws_keep_overlaps():
    """14 in a hundred: 9 with the agent in the block, 5 with the block in a wall (measured over 4000 draws)."""
    rng = np.random.default_rng(0)
    assert 0.83 < np.mean([tasks.is_free(tasks.sample_state(rng, legacy_draws=True)) for _ in range(1000)]) < 0.89


@pytest.mark.parametrize(
    ("state", "free"),
    [
        ([256.0, 184.9, 256.0, 200.0, 0.0], True),  # above the bar, 15.1 px away
        ([256.0, 185.1, 256.0, 200.0, 0.0], False),
        ([286.1, 280.0, 256.0, 200.0, 0.0], True),  # beside the stem, in the corner under the bar
        ([285.9, 280.0, 256.0, 200.0, 0.0], False),
        ([60.0, 60.0, 256.0, 384.0, 0.0], True),  # the stem ends at 504, where the wall begins
        ([60.0, 60.0, 256.0, 384.1, 0.0], False),
        ([60.0, 60.0, 256.0, 384.1, np.pi], True),  # turned over
    ],
)
def test_overlaps_are_detected_to_a_tenth_of_a_pixel(state, free):
    assert tasks.is_free(np.array([*state, 0.0, 0.0])) is free


def offset(**changes):
    state = START.copy()
    for name, value in changes.items():
        state[["agent_x", "agent_y", "block_x", "block_y", "angle"].index(name)] += value
    return state


@pytest.mark.parametrize(
    ("state", "on_state", "on_block"),
    [
        (offset(), True, True),
        (offset(agent_x=19.9), True, True),
        (offset(agent_x=20.0), False, True),
        (offset(agent_x=300.0), False, True),
        (offset(block_y=-19.9), True, True),
        (offset(block_y=-20.0), False, False),
        (offset(agent_x=14.0, agent_y=1.0, block_x=14.0, block_y=-2.0), True, True),  # sqrt(397)
        (offset(agent_x=12.0, agent_y=8.0, block_x=-12.0, block_y=8.0), False, True),  # sqrt(416)
        (offset(block_x=14.2, block_y=14.2), False, False),
        (offset(angle=np.pi / 9 - 1e-6), True, True),
        (offset(angle=np.pi / 9 + 1e-6), False, False),
        (offset(angle=2 * np.pi - 0.3), True, True),  # 0.3 rad the other way, through zero
        (offset(angle=2 * np.pi - 0.4), False, False),
        (offset(angle=np.pi), False, False),
    ],
)
def test_success_at_both_sides_of_its_thresholds(state, on_state, on_block):
    for rule, reached in {"state": on_state, "block": on_block}.items():
        assert tasks.is_success(state, START, success_on=rule) is reached
        assert tasks.is_success(START, state, success_on=rule) is reached
        env = PushTEnv(image_size=8, success_on=rule)
        state[4] %= 2 * np.pi
        assert env.reset(options={"state": state, "goal_state": START})[1]["success"].tolist() == [reached]
