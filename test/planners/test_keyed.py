"""Claims about set_keys: planners, MPCPolicy and LatentGoalEnv read and write under renamed and nested keys, and nothing else."""

from __future__ import annotations

import pytest
import torch
from making import make_planner, SEARCHING
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import InitTracker, RenameTransform, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules.planners import CEMPlanner

from torchrl_ficreg import LatentGoalEnv, MPCPolicy
from torchrl_ficreg.envs import make_env

PLANNER_KEYS = {
    "latent": ("seen", "z"),
    "goal_latent": ("wanted", "z"),
    "past_action": ("past", "blocks"),
    "plan_seed": "seed",
    "action": ("out", "block"),
    "plan": ("out", "plan"),
    "plan_cost": ("out", "cost"),
    "trace": "trace_of_plan",
}


@pytest.mark.parametrize("search", SEARCHING)
def test_a_planner_plans_the_same_under_other_keys(tiny_world, search):
    """Nested ones included, with a context and seeds; its in_keys and out_keys follow. Foreign entries are left alone."""
    planner, context = make_planner(search, tiny_world(), trace=True), torch.randn(2, 3, 6)
    inputs = {"latent": context, "goal_latent": torch.randn(2, 6), "past_action": torch.randn(2, 2, 4)}
    inputs["plan_seed"] = torch.tensor([7, 3])
    expected = TensorDict({**inputs, "other": torch.ones(2)}, [2])
    assert isinstance(planner, TensorDictModuleBase) and planner(expected) is expected
    assert set(expected.keys()) == {*inputs, "other", *planner.out_keys}
    plan = planner.plan(*(inputs[name] for name in ("latent", "goal_latent", "plan_seed")), past_action=inputs["past_action"])
    assert plan["plan"].equal(expected["plan"]) and plan["plan"][:, 0].equal(expected["action"])
    assert len(planner.state_dict()) == len(planner.world_model.state_dict())  # the model once
    planner.set_keys(**PLANNER_KEYS)
    assert planner.in_keys == [("seen", "z"), ("wanted", "z")]
    assert planner.out_keys == [("out", "block"), ("out", "plan"), ("out", "cost"), "trace_of_plan"]
    td = planner(TensorDict({PLANNER_KEYS[name]: value for name, value in inputs.items()}, [2]))
    assert set(td.keys()) == {"seen", "wanted", "past", "seed", "out", "trace_of_plan"}
    for name, key in PLANNER_KEYS.items():
        assert (td[key] == expected[name]).all() if name == "trace" else td[key].equal(expected[name]), name
    planner.set_keys(**dict.fromkeys(PLANNER_KEYS))
    assert planner.in_keys == ["latent", "goal_latent"]


def test_a_policy_under_other_keys_drives_an_environment(tiny_world):
    """The same actions as with the default keys, through resets, in env.rollout with nested keys of every entry."""
    policy = MPCPolicy(make_planner("cem", tiny_world()))
    plain = TransformedEnv(make_env("two_room", 2, image_size=16, seed=0, max_episode_steps=3), InitTracker())
    expected = plain.rollout(7, policy, break_when_any_done=False)
    names = {"pixels": ("camera", "rgb"), "goal_pixels": ("camera", "goal")}
    env = TransformedEnv(make_env("two_room", 2, image_size=16, seed=0, max_episode_steps=3), InitTracker(init_key="fresh"))
    env.append_transform(RenameTransform([*names], [*names.values()], ["action"], [("agent", "move")]))
    policy.set_keys(**names, action=("agent", "move"), is_init="fresh", memory=("agent", "memory"))
    assert policy.in_keys == [("camera", "rgb"), ("camera", "goal")]
    assert policy.out_keys == [("agent", "move"), ("agent", "memory")]
    td = env.rollout(7, policy, break_when_any_done=False)
    assert td["agent", "move"].equal(expected["action"])
    assert td["agent", "memory", "count"].tolist() == expected["mpc", "count"].tolist() == [[1, 1, 2, 1, 1, 2, 1]] * 2
    assert "mpc" not in td.keys() and "pixels" not in td.keys()


def test_an_imagined_environment_under_other_keys_steps_the_same(tiny_world):
    """Specs, rewards and TorchRL's planner included."""
    names = {"latent": ("z", "now"), "goal_latent": ("z", "goal"), "past_latent": ("past", "z"), "past_action": ("past", "a")}
    names |= {"past_length": ("past", "length"), "action": ("agent", "block"), "reward": ("agent", "gain")}
    model, latent, goal, action = tiny_world(), *torch.randn(2, 2, 6), torch.randn(2, 4)
    env = LatentGoalEnv(model, action_bounds=([-1, -1], [1, 1]))
    td = env.reset(TensorDict({"latent": latent, "goal_latent": goal}, [2]))
    expected = env.step(td.set("action", action))["next"]
    env.set_keys(**names)
    assert env.action_key == ("agent", "block") and env.reward_key == ("agent", "gain")
    start = TensorDict({("z", "now"): latent, ("z", "goal"): goal}, [2])
    check_env_specs(env, tensordict=env.reset(start))
    result = env.step(env.reset(start).set(("agent", "block"), action))["next"]
    for name in set(names) - {"action"}:
        assert result[names[name]].equal(expected[name]), name
    env.set_keys(action=None)  # TorchRL's planners can use no other key
    planner = CEMPlanner(env, 3, 2, 16, 4, reward_key=("next", "agent", "gain"))
    assert planner(env.reset(start))["action"].shape == (2, 4)


def test_unknown_names_are_refused(tiny_world):
    planner = make_planner("cem", tiny_world())
    for module, known in ((planner, "latent, goal_latent"), (MPCPolicy(planner), "pixels, goal_pixels")):
        with pytest.raises(ValueError, match=f"{type(module).__name__} has no key frames: set_keys changes {known}"):
            module.set_keys(frames="x")
