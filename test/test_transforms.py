"""Claims about ActionBlocks and GoalImage: any TorchRL buffer feeds the losses, any environment with pixels is planned on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from _losses import TINY
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, LazyTensorStorage, ReplayBuffer, SliceSampler, Unbounded
from torchrl.envs import Compose, DTypeCastTransform, EnvBase, InitTracker, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_ficreg import ActionBlocks, CEMConfig, FICRegLoss, GoalImage, LatentCEMPlanner, make_world_model, MPCPolicy
from torchrl_ficreg.data import ActionStatistics, OfflineTrajectories

STATISTICS = ActionStatistics(torch.tensor([0.1, -0.2]), torch.tensor([0.5, 2.0]))
SCALE = 10  # brightness per unit of the plane


class Plane(EnvBase):
    """A point in the plane, moved by its action; the reward is the sum of the action, the border ends an episode."""

    def __init__(self, batch_size=(), batch_locked=True, border=3.0):
        super().__init__(batch_size=batch_size)
        self.__dict__["_batch_locked"] = batch_locked
        self.border, batch = border, self.batch_size
        position, pixels = Unbounded((*batch, 2)), Unbounded((*batch, 3, 4, 4), dtype=torch.uint8)
        self.observation_spec = Composite(position=position, pixels=pixels, shape=batch)
        self.state_spec = Composite(position=position.clone(), shape=batch)
        self.action_spec = Bounded(-1, 1, (*batch, 2))
        self.reward_spec = Unbounded((*batch, 1))

    @staticmethod
    def draw(position):
        pixels = torch.zeros(*position.shape[:-1], 3, 4, 4, dtype=torch.uint8)
        pixels[..., 0, 0, :2] = (position * SCALE + 100).round().to(torch.uint8)
        return pixels

    def _reset(self, tensordict=None):
        batch = self.batch_size if self.batch_locked or tensordict is None else tensordict.batch_size
        position = torch.zeros(*batch, 2)
        return TensorDict({"position": position, "pixels": self.draw(position)}, batch)

    def _step(self, tensordict):
        action = tensordict["action"]
        assert (action.abs() <= 1).all()
        position = tensordict["position"] + action
        done = position.abs().amax(-1, keepdim=True) >= self.border
        step = {"position": position, "pixels": self.draw(position), "reward": action.sum(-1, keepdim=True), "done": done}
        return TensorDict(step, tensordict.batch_size)

    def _set_seed(self, seed):
        torch.manual_seed(seed)


def draw_goal():
    return torch.randint(0, 255, (3, 4, 4), dtype=torch.uint8)


ENVS = {
    "single": Plane,
    "vectorised": lambda: Plane((3,)),
    "unlocked": lambda: Plane(batch_locked=False),
    "serial": lambda: SerialEnv(3, Plane),
}


def steps_of(lengths, seed=0):
    """Raw steps of some episodes in TorchRL's layout, flat, with a frame at every step."""
    torch.manual_seed(seed)
    episodes = []
    for number, length in enumerate(lengths):
        pixels = torch.randint(0, 255, (length + 1, 3, 16, 16), dtype=torch.uint8)
        done = torch.zeros(length, 1, dtype=torch.bool)
        done[-1] = True
        following = TensorDict({"pixels": pixels[1:], "reward": torch.randn(length, 1), "done": done}, [length])
        steps = {"pixels": pixels[:-1], "action": torch.randn(length, 2), "next": following}
        episodes.append(TensorDict({**steps, "episode": torch.full((length,), number), "step": torch.arange(length)}, [length]))
    return torch.cat(episodes)


def make_buffer(steps, num_frames=4, frame_skip=5, clips=8, flat=False):
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(len(steps)),
        sampler=SliceSampler(slice_len=num_frames * frame_skip, traj_key="episode", strict_length=True),
        transform=ActionBlocks(frame_skip, STATISTICS, num_frames=None if flat else num_frames),
        batch_size=clips * num_frames * frame_skip,
    )
    buffer.extend(steps)
    return buffer


def test_clips_of_a_replay_buffer_are_those_of_our_own_dataset():
    """Same frames, same blocks, same z-scores, wherever the clip begins."""
    steps = steps_of([40, 30])
    episodes = []
    for number in range(2):
        rows = steps[steps["episode"] == number]
        action = np.concatenate([rows["action"].numpy(), np.zeros((1, 2), np.float32)])
        pixels = torch.cat([rows["pixels"], rows["next", "pixels"][-1:]]).numpy()
        episodes.append({"pixels": pixels, "action": action, "state": np.zeros((len(action), 1))})
    dataset = OfflineTrajectories.from_episodes(
        episodes, split="all", num_frames=4, frame_skip=5, keys=("pixels", "action", "episode", "step"), statistics=STATISTICS
    )
    ours = {(int(clip["episode"][0]), int(clip["step"][0])): clip for clip in (dataset[i] for i in range(len(dataset)))}
    for clip in make_buffer(steps).sample():
        want = ours[int(clip["episode"][0]) + 1, int(clip["step"][0])]
        assert torch.equal(clip["pixels"], want["pixels"])
        torch.testing.assert_close(clip["action"][:-1], want["action"][:-1])
        assert clip["mask"][:-1].all()


def test_what_follows_a_block_is_what_follows_its_last_step():
    steps = steps_of([40])
    clip = ActionBlocks(5)(steps.unsqueeze(0))
    assert clip.batch_size == (1, 8)
    assert torch.equal(clip["next", "pixels"][0], steps["next", "pixels"][4::5])
    torch.testing.assert_close(clip["next", "reward"][0], steps["next", "reward"].unflatten(0, (8, 5)).sum(1))
    assert clip["next", "done"].flatten().tolist() == [False] * 7 + [True]
    assert torch.equal(clip["action"][0], steps["action"].reshape(8, 10))  # no statistics: environment units


@pytest.mark.parametrize(("length", "good"), [(7, [1, 0, 1, 1]), (10, [1, 0, 1, 1]), (15, [1, 1, 0, 1])])
def test_blocks_that_cross_an_end_are_masked_and_zero(length, good):
    """Whether the end lies within the block or between it and the next frame."""
    steps = steps_of([length, 20])[:20]
    before = steps.clone()
    clip = ActionBlocks(5, STATISTICS)(steps.unsqueeze(0))
    assert clip["mask"].tolist() == [[bool(value) for value in good]]
    assert ((clip["action"] == 0).all(-1) == ~clip["mask"]).all()
    assert (before == steps).all(), "the input was written to"


def test_a_mask_of_the_steps_is_kept():
    steps = steps_of([20]).exclude("next")
    steps["mask"] = torch.arange(20) != 7
    assert ActionBlocks(5)(steps.unsqueeze(0))["mask"].tolist() == [[True, False, True, True]]


def test_a_replay_buffer_feeds_the_loss():
    """Flat or as clips, the loss is the same; and it trains the encoder."""
    steps = steps_of([60, 50])
    values = []
    for flat in (False, True):
        torch.manual_seed(0)
        model, inverse_model = make_world_model(replace(TINY, frame_skip=5), action_dim=2)
        loss = FICRegLoss(model.encoder, model.predictor, inverse_model, num_frames=4)
        clips = make_buffer(steps, flat=flat).sample()
        assert clips.batch_size == ((32,) if flat else (8, 4))
        values.append(sum(value for key, value in loss(clips).items() if key.startswith("loss_")))
    assert torch.equal(*values)
    values[0].backward()
    values[1].backward()
    assert all(param.grad.abs().sum() > 0 for param in loss.encoder_params.parameters() if param.ndim > 1)


@pytest.mark.parametrize(
    ("settings", "change", "error", "message"),
    [
        ({"frame_skip": 0}, None, ValueError, "frame_skip must be a positive integer, got 0"),
        ({"num_frames": 2.5}, None, ValueError, "num_frames must be a positive integer, got 2.5"),
        ({"action_key": "control"}, None, KeyError, "no 'control', got .*name it by action_key="),
        ({"frame_skip": 6}, None, ValueError, "20 steps are no whole number of blocks of frame_skip=6"),
        ({"num_frames": 3}, None, ValueError, r"20 steps are no slices of num_frames \* frame_skip = 15"),
        ({}, lambda steps: steps[0, 0], ValueError, r"needs a time dimension .* got batch size \[\]"),
        ({}, lambda steps: steps.set("action", torch.zeros(2, 20, 2, 2)), ValueError, "must be a vector .* flatten the action"),
        ({}, lambda steps: steps.set("action", torch.zeros(2, 20, 4)), ValueError, "describe 2 action dimensions, got 4"),
        ({}, lambda steps: steps.set("action", torch.zeros(2, 20, 2, dtype=torch.long)), TypeError, "floating-point actions"),
    ],
)
def test_unfit_batches_are_refused_in_one_line(settings, change, error, message):
    steps = steps_of([40]).unflatten(0, (2, 20))
    with pytest.raises(error, match=message) as raised:
        ActionBlocks(**{"frame_skip": 5, "statistics": STATISTICS, **settings})(change(steps) if change else steps)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ENVS)
@pytest.mark.parametrize("goal", [draw_goal, torch.zeros(3, 4, 4, dtype=torch.uint8)], ids=["drawn", "fixed"])
def test_specs_are_right(name, goal):
    env = TransformedEnv(ENVS[name](), Compose(StepCounter(), ActionBlocks(4, STATISTICS), GoalImage(goal), InitTracker()))
    check_env_specs(env)
    assert env.action_spec.shape == (*env.batch_size, 8)
    low = STATISTICS.normalize(torch.tensor([-1.0, -1.0]).repeat(4)).expand(env.action_spec.shape)
    torch.testing.assert_close(env.action_spec.space.low, low)


def test_unbounded_actions_stay_unbounded():
    base = Plane()
    base.action_spec = Unbounded(2)
    assert TransformedEnv(base, ActionBlocks(4)).action_spec == Unbounded(8)


@pytest.mark.parametrize("name", ENVS)
def test_a_block_is_its_actions_one_after_another_up_to_the_end(name):
    env = TransformedEnv(ENVS[name](), Compose(StepCounter(), ActionBlocks(4, STATISTICS)))
    reset = env.reset(TensorDict(batch_size=[3]) if name == "unlocked" else None)
    right = torch.tensor([[1.0, 0.0], [1.0, 0.0], [1.0, 0.5], [-1.0, 1.0]])  # the border is reached by the third
    raw = right.expand(*reset.batch_size, 4, 2).clone()
    if reset.ndim:
        raw[1] = 0.25
    block = STATISTICS.normalize(raw.flatten(-2))
    step = env.step(reset.set("action", block))
    rows = list(step["next"]) if reset.ndim else [step["next"]]
    for number, row in enumerate(rows):
        want = ([1.0, 1.0], 2.0, False, 4) if number == 1 else ([3.0, 0.5], 3.5, True, 3)
        torch.testing.assert_close(row["position"], torch.tensor(want[0]))
        torch.testing.assert_close(row["reward"], torch.tensor([want[1]]))
        assert (row["done"].item(), row["step_count"].item()) == want[2:]
        assert torch.equal(row["pixels"], Plane.draw(row["position"]))
    assert torch.equal(step["action"], block) and "_step" not in step.keys()


def test_actions_beyond_the_bounds_are_clipped():
    env = TransformedEnv(Plane(), ActionBlocks(2, STATISTICS))
    step = env.step(env.reset().set("action", STATISTICS.normalize(torch.tensor([5.0, -5.0, 0.5, 0.5]))))
    assert step["next", "position"].tolist() == [1.5, -0.5]


def test_blocks_of_blocks_are_executed_in_order():
    env = TransformedEnv(Plane(), Compose(ActionBlocks(2, STATISTICS), ActionBlocks(3)))
    raw = torch.tensor([[0.5, 0.0], [0.5, 1.0], [-1.0, 0.25], [0.0, 0.0], [1.0, -1.0], [0.25, 0.5]])
    step = env.step(env.reset().set("action", STATISTICS.normalize(raw.flatten())))
    torch.testing.assert_close(step["next", "position"], raw.sum(0))
    torch.testing.assert_close(step["next", "reward"], raw.sum().reshape(1))
    assert set(step.keys()) == {*env.reset().keys(), "action", "next"}


def test_environments_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="no action 'control'"):
        TransformedEnv(Plane(), ActionBlocks(4, action_key="control")).action_spec
    discrete = Plane()
    discrete.action_spec = Categorical(3, shape=(1,))
    with pytest.raises(TypeError, match="only floating-point actions"):
        TransformedEnv(discrete, ActionBlocks(4)).action_spec
    env = TransformedEnv(Plane(), ActionBlocks(4))
    with pytest.raises(ValueError, match=r"one action block \[8\], F = 4 actions, got \[2\]"):
        env.step(env.reset().set("action", torch.zeros(2)))


@pytest.mark.parametrize("name", [*ENVS, "in workers"])
def test_a_goal_stays_until_the_reset_of_its_environment(name):
    if name == "in workers":
        env = SerialEnv(3, lambda: TransformedEnv(Plane(), GoalImage(draw_goal)))
    else:
        env = TransformedEnv(ENVS[name](), GoalImage(draw_goal))
    torch.manual_seed(0)
    first = env.reset()
    step = env.rand_step(first)
    assert torch.equal(step["next", "goal_pixels"], first["goal_pixels"])
    after = step["next"].exclude("reward")
    reset = torch.tensor([False, True, False]).unsqueeze(-1) if env.batch_size else torch.ones(1, dtype=torch.bool)
    again = env.reset(after.clone().set("_reset", reset))["goal_pixels"]
    changed = (again != first["goal_pixels"]).flatten(-3).any(-1)
    assert torch.equal(changed, reset.squeeze(-1))


def test_a_fixed_goal_is_every_observations_and_every_samples():
    goal = draw_goal()
    steps = TransformedEnv(Plane(), GoalImage(goal)).rollout(3)
    assert (steps["goal_pixels"] == goal).all() and (steps["next", "goal_pixels"] == goal).all()
    each = torch.stack([draw_goal() for _ in range(3)])
    assert torch.equal(TransformedEnv(Plane((3,)), GoalImage(each)).reset()["goal_pixels"], each)
    assert (GoalImage(goal)(steps.exclude("goal_pixels"))["goal_pixels"] == goal).all()


@pytest.mark.parametrize(
    "goal", [torch.zeros(3, 5, 4, dtype=torch.uint8), torch.zeros(3, 4, 4), torch.zeros(4, dtype=torch.uint8)]
)
def test_goals_unlike_the_pixels_are_refused(goal):
    for given in (goal, lambda: goal):
        with pytest.raises(ValueError, match=r"a goal must be a frame \[3, 4, 4\] of torch.uint8"):
            TransformedEnv(Plane(), GoalImage(given)).reset()


def test_goals_need_pixels_and_a_reset():
    with pytest.raises(TypeError, match="a frame or a function that returns one, got a str"):
        GoalImage("goal.png")
    with pytest.raises(KeyError, match="no 'image'"):
        TransformedEnv(Plane(), GoalImage(draw_goal(), in_key="image")).reset()
    env = TransformedEnv(Plane(), GoalImage(draw_goal))
    with pytest.raises(KeyError, match="needs the 'goal_pixels' that the reset wrote"):
        env.rand_step(env.reset().exclude("goal_pixels"))


def test_a_transform_that_would_change_a_sampled_goal_again_at_every_step_is_refused():
    keys = ["pixels", "goal_pixels"]
    with pytest.raises(ValueError, match="DTypeCastTransform changes 'goal_pixels' behind GoalImage, at every step again"):
        cast = DTypeCastTransform(torch.uint8, torch.float32, in_keys=keys)
        TransformedEnv(Plane(), Compose(GoalImage(draw_goal), cast)).reset()
    for goal, order in ((draw_goal(), 1), (lambda: draw_goal().float(), -1)):  # a fixed goal, or in front
        cast = DTypeCastTransform(torch.uint8, torch.float32, in_keys=keys if order > 0 else keys[:1])
        steps = TransformedEnv(Plane(), Compose(*[GoalImage(goal), cast][::order])).rollout(3)
        assert steps["goal_pixels"].dtype == torch.float32
        assert (steps["next", "goal_pixels"] == steps["goal_pixels"][0]).all()


@pytest.mark.parametrize("name", ["single", "vectorised", "serial"])
@pytest.mark.parametrize("blocks", [False, True], ids=["raw actions by MPCPolicy", "blocks by the planner"])
def test_a_foreign_environment_is_planned_on(linear_world, name, blocks):
    """The world model is exact, so the goal of the picture is reached."""
    model = linear_world(frame_skip=2, std=(1 / SCALE, 1 / SCALE))
    config = CEMConfig(horizon=1, receding_horizon=1, num_candidates=100, num_elites=10, iterations=8, std=5.0)
    planner = LatentCEMPlanner(model, config, action_bounds=([-1.0, -1.0], [1.0, 1.0]))
    goal = torch.tensor([1.2, -0.8])
    env = TransformedEnv(ENVS[name](), Compose(GoalImage(Plane.draw(goal)), InitTracker()))
    if not blocks:
        steps = env.rollout(4, MPCPolicy(planner))
    else:
        env.append_transform(ActionBlocks(2, model.statistics))

        def policy(td):
            latents = (model.encode(td[key].reshape(-1, 3, 4, 4)) for key in ("pixels", "goal_pixels"))
            found = planner(TensorDict(dict(zip(("latent", "goal_latent"), latents)), [td.numel()]))
            return td.set("action", found["action"].reshape(*td.shape, -1))

        steps = env.rollout(2, policy)
    assert ((steps["next", "position"][..., -1, :] - goal).abs() < 0.2).all()
