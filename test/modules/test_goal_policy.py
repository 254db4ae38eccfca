"""Claims about the goal policy.

It answers any batch layout, each row for itself, in the units of its training latents. What it imagines is what it
would do along the world model's own rollout. It recovers a known relation between goals and actions from recorded
episodes. Saved and loaded it is the same to the last bit, and it works with no other world model than its own.
"""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torchrl.objectives import BCLoss

from torchrl_ficreg.data import ActionStatistics, OfflineTrajectories
from torchrl_ficreg.data.latents import encode_episodes, GoalRows
from torchrl_ficreg.modules.goal_policy import GoalNetwork, GoalPolicy, load_goal_policy, save_goal_policy


@pytest.fixture
def policy():
    torch.manual_seed(1)
    return GoalPolicy(latent_dim=6, action_dim=4, hidden_dim=16, depth=2).eval()


# The network


@pytest.mark.parametrize("lead", [(7,), (2, 3)])
def test_any_batch_layout_gives_the_same_answers(policy, lead):
    latent, goal = torch.randn(2, *lead, 6)
    td = policy(TensorDict({"latent": latent, "goal_latent": goal}, lead))
    assert td["action"].shape == (*lead, 4)
    alone = torch.stack([policy.module(z, g) for z, g in zip(latent.reshape(-1, 6), goal.reshape(-1, 6))])
    torch.testing.assert_close(td["action"].reshape(-1, 4), alone)


def test_keys_can_be_changed_and_nested():
    policy = GoalPolicy(6, 4, 8, 1, in_keys=("z", ("goal", "z")), out_key=("plan", "first"))
    td = TensorDict({"z": torch.zeros(3, 6), "goal": {"z": torch.zeros(3, 6)}}, [3])
    assert policy(td)["plan", "first"].shape == (3, 4)
    assert set(td.keys()) == {"z", "goal", "plan"}


def test_the_unit_of_the_latents_makes_no_difference(policy):
    """The same weights on latents in other units, standardised by those, give the same answers."""
    latent, goal, training = torch.randn(2, 6), torch.randn(2, 6), torch.randn(100, 6)
    other = GoalPolicy(**policy.sizes)
    other.load_state_dict(policy.state_dict())
    scale, shift = torch.tensor([1e-3, 1.0, 2.0, 50.0, 1e3, 7.0]), torch.linspace(-5, 5, 6)
    policy.standardize_by(training)
    other.standardize_by(training * scale + shift)
    expected = policy.module(latent, goal)
    answer = other.module(latent * scale + shift, goal * scale + shift)
    torch.testing.assert_close(answer, expected, rtol=1e-3, atol=1e-4)


def test_a_latent_dimension_that_never_changes_is_only_centred(policy):
    training = torch.randn(50, 6)
    training[:, 2] = 3.0
    policy.standardize_by(training)
    assert policy.module.latent_mean[2] == 3 and policy.module.latent_std[2] == 1
    torch.testing.assert_close(policy.module.latent_std[0], training[:, 0].std(correction=0))


@pytest.mark.parametrize("wrong", [torch.zeros(5, 4), torch.zeros(1, 6), torch.zeros(6), torch.full((3, 6), math.nan)])
def test_training_latents_that_cannot_standardise_are_refused(policy, wrong):
    with pytest.raises(ValueError, match="latents"):
        policy.standardize_by(wrong)


class _NoDouble(TorchDispatchMode):
    """Refuses every operation that makes float64, as Apple's GPU does."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        assert not any(isinstance(one, torch.Tensor) and one.dtype == torch.float64 for one in tree_leaves(made)), func
        return made


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_its_input_is_standardised_on_a_device_without_float64(dtype):
    """And as exactly as with it: a mean of 1000 times the spread."""
    network, latent = GoalNetwork(6, 4, hidden_dim=8, depth=1), (1000 + torch.randn(2000, 6)).to(dtype)
    with _NoDouble():
        network.standardize_by(latent)
    std, mean = torch.std_mean(latent.double(), 0, correction=0)
    torch.testing.assert_close(network.latent_mean, mean.float())
    torch.testing.assert_close(network.latent_std, std.float())


def test_sizes_and_shapes_that_make_no_sense_are_refused(policy):
    with pytest.raises(ValueError, match="must be positive, got depth=0"):
        GoalPolicy(6, 4, depth=0)
    for latent, goal in (((2, 5), (2, 5)), ((2, 6), (1, 6))):
        with pytest.raises(ValueError, match=rf"\[..., 6\] of one shape, got \[{latent[0]}, {latent[1]}\] and"):
            policy.module(torch.zeros(latent), torch.zeros(goal))


# Imagined plans


@pytest.mark.parametrize("bounds", [None, (torch.full((4,), -0.2), torch.full((4,), 0.1))])
@pytest.mark.parametrize(("lead", "context"), [((4,), 1), ((4,), 3), ((4,), 5), ((), 2), ((2, 3), 2)])
@pytest.mark.parametrize("history", [1, 3])
def test_imagining_is_stepping_by_hand(tiny_world, policy, history, lead, context, bounds):
    """One answer, one prediction on the last H latents, and so on."""
    model = tiny_world(history=history)
    latent, past, goal = torch.randn(*lead, context, 6), torch.randn(*lead, context - 1, 4), torch.randn(*lead, 6)
    latents, blocks = list(latent.unbind(-2)), list(past.unbind(-2))
    with torch.no_grad():
        for _ in range(5):
            block = policy(latent=latents[-1], goal_latent=goal)
            blocks.append(block if bounds is None else block.clamp(*bounds))
            seen, leading = torch.stack(latents[-history:], -2), torch.stack(blocks[-history:], -2)
            latents.append(model.predict(seen, leading)[..., -1, :])
    with torch.inference_mode():
        plan = policy.rollout(model, latent, past, goal, horizon=5, bounds=bounds)
    torch.testing.assert_close(plan, torch.stack(blocks[context - 1 :], -2))
    assert bounds is None or ((plan == -0.2) | (plan == 0.1)).any()


def test_imagining_leaves_its_inputs_alone_and_keeps_their_dtype(tiny_world, policy):
    """Also where the predictor's weights are in bfloat16, as planners keep them."""
    model = tiny_world(history=3)
    inputs = torch.randn(4, 2, 6), torch.randn(4, 1, 4), torch.randn(4, 6)
    before = [value.clone() for value in inputs]
    with torch.inference_mode():
        exact = policy.rollout(model, *inputs, horizon=3)
        model.predictor.to(torch.bfloat16)
        rough = policy.rollout(model, *inputs, horizon=3)
    assert all(torch.equal(value, kept) for value, kept in zip(inputs, before))
    assert rough.dtype == torch.float32 and torch.equal(rough[:, 0], exact[:, 0])
    torch.testing.assert_close(rough, exact, rtol=0.05, atol=0.05)


SHAPES = r"latents \[..., C, 6\], the C - 1 past blocks \[..., C - 1, 4\]"
RIGHT = ((2, 1, 6), (2, 0, 4), (2, 6), 2)


@pytest.mark.parametrize(
    ("shapes", "bounds", "action_dim", "message"),
    [
        (((2, 1, 6), (2, 1, 4), (2, 6), 3), None, 2, SHAPES),  # a past block too many
        (((2, 0, 6), (2, 0, 4), (2, 6), 3), None, 2, SHAPES),  # no context
        (((2, 2, 6), (2, 1, 3), (2, 6), 3), None, 2, SHAPES),  # another block
        (((2, 1, 6), (2, 0, 4), (3, 6), 3), None, 2, SHAPES),  # other goals
        (((2, 1, 6), (2, 0, 4), (2, 6), 0), None, 2, SHAPES),  # nothing to imagine
        (((6,), (4,), (6,), 3), None, 2, SHAPES),
        (RIGHT, ([0.0], [1.0]), 2, r"bounds must be two vectors \[4\]"),
        (RIGHT, ([0.0] * 4, [1.0] * 3), 2, r"bounds must be two vectors \[4\]"),
        (RIGHT, None, 3, "latents of 6 and action blocks of 4, the world model 6 and 6"),
    ],
)
def test_imagining_with_other_shapes_or_widths_is_refused(tiny_world, policy, shapes, bounds, action_dim, message):
    *inputs, horizon = shapes
    bounds = bounds and tuple(torch.tensor(bound) for bound in bounds)
    with pytest.raises(ValueError, match=message):
        policy.rollout(tiny_world(action_dim), *(torch.zeros(shape) for shape in inputs), horizon, bounds=bounds)


# Learning


@pytest.fixture(scope="module")
def walkers():
    """30 walkers in the plane, straight ahead at one unit a step; frames name episode and step, latents are places."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, 30)
    way = np.stack([np.cos(angle), np.sin(angle)], 1)  # [30, 2]
    place = rng.uniform(-3, 3, (30, 1, 2)) + np.arange(21)[:, None] * way[:, None]  # [30, 21, 2]
    episodes = []
    for number in range(30):
        pixels = np.zeros((21, 3, 2, 2), np.uint8)
        pixels[:, 0], pixels[:, 1] = number, np.arange(21)[:, None, None]
        action = np.repeat(way[number : number + 1], 21, 0).astype(np.float32)
        action[-1] = 0
        episodes.append({"pixels": pixels, "action": action, "state": place[number]})
    plain = ActionStatistics(torch.zeros(2), torch.ones(2))
    dataset = OfflineTrajectories.from_episodes(episodes, split="all", num_frames=2, frame_skip=4, statistics=plain)
    places = torch.from_numpy(place).float()
    latent = encode_episodes(dataset, lambda pixels: places[pixels[:, 0, 0, 0].long(), pixels[:, 1, 0, 0].long()])
    return GoalRows(dataset, latent, max_blocks=4)


@pytest.fixture(scope="module")
def walker(walkers):
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    policy = GoalPolicy(latent_dim=2, action_dim=8, hidden_dim=64, depth=2)
    policy.standardize_by(walkers.latent)
    with pytest.warns(UserWarning, match="target_actor_network_params"):  # BCLoss has none, and TorchRL asks for them
        loss = BCLoss(policy, loss_function="l2")
    optimizer = torch.optim.AdamW(policy.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 6e-3, total_steps=250)
    for _ in range(250):
        loss(walkers.sample(256, generator=generator))["loss_bc"].backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
    return policy.eval()


def test_it_learns_to_walk_towards_the_goal(walkers, walker):
    """Each of the four steps of a block is the unit vector towards the goal, however far that is."""
    rows = walkers.sample(500, generator=torch.Generator().manual_seed(7))
    way = rows["goal_latent"] - rows["latent"]
    expected = (way / way.norm(dim=-1, keepdim=True)).repeat(1, 4)  # [B, 8]
    with torch.no_grad():
        answer = walker.module(rows["latent"], rows["goal_latent"])
    torch.testing.assert_close(rows["action"], expected, atol=1e-5, rtol=0)
    assert (answer - expected).square().mean() < 0.01 * expected.square().mean()


def test_a_plan_imagined_by_a_walker_arrives(walkers, walker, linear_world):
    """Three blocks away, three blocks: in a world where latents move by the actions, the goal is reached."""
    world = linear_world(frame_skip=4)
    rows = walkers.sample(800, generator=torch.Generator().manual_seed(8))
    rows = rows[rows["blocks"] == 3]
    start, goal = rows["latent"].unsqueeze(1), rows["goal_latent"]
    with torch.inference_mode():
        plan = walker.rollout(world, start, torch.zeros(len(rows), 0, 8), goal, horizon=3)
        end = world.rollout(start, plan)[:, -1]
    missed = (end - goal).norm(dim=-1)
    assert len(rows) > 50 and missed.median() < 1.0, "of twelve steps of one unit"


# Files


@pytest.fixture
def saved(tiny_world, policy, tmp_path):
    policy.standardize_by(torch.randn(20, 6))
    return save_goal_policy(policy, tmp_path / "policy", tiny_world())


def test_saved_and_loaded_it_is_the_same_to_the_last_bit(tiny_world, policy, saved):
    loaded = load_goal_policy(saved, tiny_world())
    assert not loaded.training and loaded.sizes == policy.sizes
    state = loaded.state_dict()
    assert state.keys() == policy.state_dict().keys()
    assert all(torch.equal(state[name], value) for name, value in policy.state_dict().items())
    latent, goal = torch.randn(2, 3, 6)
    assert torch.equal(loaded.module(latent, goal), policy.module(latent, goal))
    assert sorted(path.name for path in saved.iterdir()) == ["policy.json", "policy.safetensors"]


def test_a_world_model_of_other_sizes_is_refused(tiny_world, policy, saved, tmp_path):
    for other in (tiny_world(3), tiny_world(latent_dim=5)):
        with pytest.raises(ValueError, match="latents of 6 and action blocks of 4, the world model"):
            load_goal_policy(saved, other)
        with pytest.raises(ValueError, match="train a policy for this model"):
            save_goal_policy(policy, tmp_path / "new", other)
    assert not (tmp_path / "new").exists()


def test_a_world_model_of_the_same_size_and_other_latents_is_refused(tiny_world, saved):
    """It would load, and answer nonsense. A predictor trained on changes nothing for the policy."""
    trained_on, other_units, refitted = tiny_world(), tiny_world(), tiny_world()
    with torch.no_grad():
        next(trained_on.encoder.parameters()).add_(1e-4)
        next(refitted.predictor.parameters()).add_(1e-4)
    other_units.statistics = ActionStatistics(torch.zeros(2), torch.full((2,), 0.5))
    for other in (trained_on, other_units):
        with pytest.raises(ValueError, match="another encoder or other action statistics"):
            load_goal_policy(saved, other)
    assert load_goal_policy(saved, refitted)


@pytest.mark.parametrize(
    "sizes",
    [
        {"latent_dim": 6, "action_dim": 4, "hidden_dim": 16, "depth": 3},
        {"latent_dim": 6, "action_dim": 4, "hidden_dim": 32, "depth": 2},
        {"latent_dim": 6, "heads": 4},
        None,
        *(
            {"latent_dim": 6, "action_dim": 4, "hidden_dim": 16, "depth": 2, field: size}
            for field in ("latent_dim", "hidden_dim", "depth")
            for size in (10**7, 10**30, -1, float("nan"), True, "3", [1])
        ),
    ],
)
def test_sizes_that_the_weights_do_not_have_are_refused_before_anything_is_built(tiny_world, saved, sizes):
    content = json.loads((saved / "policy.json").read_text())
    (saved / "policy.json").write_text(json.dumps({**content, "sizes": sizes}))
    with pytest.raises(ValueError, match="do not belong together") as caught:
        load_goal_policy(saved, tiny_world())
    assert "\n" not in str(caught.value)


def test_a_spread_of_zero_is_refused(tiny_world, policy, tmp_path):
    policy.module.latent_std.zero_()
    with pytest.raises(ValueError, match="latent_std must be positive"):
        load_goal_policy(save_goal_policy(policy, tmp_path, tiny_world()), tiny_world())
