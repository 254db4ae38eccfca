"""Transforms that connect any TorchRL environment or replay buffer to the losses and planners of the package."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Compose, Transform

from torchrl_ficreg.data.action_statistics import ActionStatistics
from torchrl_ficreg.keys import ACTION, GOAL_PIXELS, MASK, PIXELS

_ENDS = ("done", "terminated", "truncated")


class ActionBlocks(Transform):
    """Groups the raw actions of F consecutive steps into one z-scored action block.

    The losses, world models and planners of this package use one action block of F * A numbers between two frames that
    lie F environment steps apart. This transform produces such data from a replay buffer that holds every raw step,
    and lets an environment execute such blocks.

    **On a replay buffer** it maps sampled slices of T * F raw steps to clips of T frames::

        step          0     1     ...   F-1   F     ...   2F-1  2F    ...
        pixels        frame 0                 frame 1           frame 2
        action        [------- block 0 ------)[---- block 1 ---)[---- ...
        next, reward  sum of block 0          sum of block 1

    Root entries are those of the first step of each block. Entries under ``"next"`` are those of its last step, apart
    from the reward, which is summed, and from ``done``, ``terminated`` and ``truncated``, which are true if one step of
    the block has them. Where ``("next", "done")`` is known, ``mask`` is false and the block zero wherever the block, or
    the step to the next frame of the clip, crosses the end of an episode.

    Append it to a :class:`~torchrl.data.ReplayBuffer`, or call it on a batch that was sampled. A
    :class:`~torchrl.data.TensorDictReplayBuffer` writes the indices of the raw steps into its batches and therefore
    cannot hold a transform that changes their length: call the transform on its batches instead. ``extend`` stores raw
    steps as they are.

    **On an environment** the action becomes one block. A step denormalises it, clips it to the bounds of the raw
    action, executes the F actions one after another, sums the rewards and returns the last observation. It ends early
    at ``done``; in a batch of environments the others go on. Transforms in front of this one are applied at every raw
    step, transforms behind it once per block.

    Args:
        frame_skip (int): F, raw steps per block.
        statistics (ActionStatistics, optional): z-scores the actions, for example those of a world model.
            Default: ``None``, actions stay in environment units.

    Keyword Args:
        action_key (NestedKey, optional): the action, [..., A] raw and [..., F * A] as a block. Default: ``"action"``.
        reward_key (NestedKey, optional): the reward under ``"next"`` of sampled steps; an environment names its own.
            Default: ``"reward"``.
        mask_key (NestedKey, optional): the mask of sampled clips, [..., T] bool. Default: ``"mask"``.
        num_frames (int, optional): T of flat slices [B * T * F], as a :class:`~torchrl.data.SliceSampler` returns them;
            clips are then [B, T]. Default: ``None``, the last batch dimension of [..., T * F] is the time, and flat
            slices become flat clips [B * T], in which only blocks that contain an end are masked.

    Raises:
        ValueError: ``frame_skip`` or ``num_frames`` is not a positive integer; or slices that are no whole number of
            blocks, actions that are not vectors or not those of the statistics.
        TypeError: actions are not floating-point numbers.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer, SliceSampler
        >>> steps = TensorDict({"pixels": torch.zeros(60, 3, 8, 8), "action": torch.randn(60, 2)}, [60])
        >>> steps["episode"] = torch.arange(60) // 30
        >>> statistics = ActionStatistics.from_actions(steps["action"])
        >>> buffer = ReplayBuffer(
        ...     storage=LazyTensorStorage(60),
        ...     sampler=SliceSampler(slice_len=4 * 5, traj_key="episode"),
        ...     transform=ActionBlocks(5, statistics, num_frames=4),
        ...     batch_size=8 * 4 * 5,
        ... )
        >>> _ = buffer.extend(steps)
        >>> clips = buffer.sample()
        >>> clips.batch_size, clips["pixels"].shape, clips["action"].shape
        (torch.Size([8, 4]), torch.Size([8, 4, 3, 8, 8]), torch.Size([8, 4, 10]))

        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv
        >>> env = TransformedEnv(ContinuousActionVecMockEnv(), ActionBlocks(5))
        >>> env.base_env.action_spec.shape, env.action_spec.shape
        (torch.Size([7]), torch.Size([35]))
        >>> env.rollout(3)["action"].shape
        torch.Size([3, 35])
    """

    def __init__(
        self,
        frame_skip: int,
        statistics: ActionStatistics | None = None,
        *,
        action_key: NestedKey = ACTION,
        reward_key: NestedKey = "reward",
        mask_key: NestedKey = MASK,
        num_frames: int | None = None,
    ) -> None:
        for name, value in (("frame_skip", frame_skip), ("num_frames", 1 if num_frames is None else num_frames)):
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise ValueError(f"{name} must be a positive integer, got {value!r}.")
        super().__init__(
            in_keys=[action_key], out_keys=[action_key], in_keys_inv=[action_key], out_keys_inv=[action_key]
        )
        self.frame_skip, self.statistics, self.num_frames = frame_skip, statistics, num_frames
        self.action_key, self.reward_key, self.mask_key = (
            unravel_key(key) for key in (action_key, reward_key, mask_key)
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sampled raw steps to clips; see the class.

        Args:
            tensordict (TensorDictBase): [..., T * F] steps, left as they are.

        Returns:
            [..., T].
        """
        steps = self._slices(tensordict)  # [..., T * F]
        blocks = steps.unflatten(-1, (steps.shape[-1] // self.frame_skip, self.frame_skip))  # [..., T, F]
        clips = blocks[..., 0].exclude("next").clone()  # [..., T]
        action = blocks.get(self.action_key).flatten(-2)  # [..., T, F, A] -> [..., T, F * A]
        action = action if self.statistics is None else self.statistics.normalize(action)
        mask = self._mask(blocks)
        if mask is not None:
            clips.set(self.mask_key, mask)
            action = torch.where(mask.reshape(clips.shape).unsqueeze(-1), action, 0.0)
        clips.set(self.action_key, action)
        following = blocks.get("next", None)
        if following is not None:
            last, time = following[..., -1].clone(), blocks.ndim - 1
            if (reward := following.get(self.reward_key, None)) is not None:
                last.set(self.reward_key, reward.sum(time))
            for name in _ENDS:
                if (end := following.get(name, None)) is not None:
                    last.set(name, end.any(time))
            clips.set("next", last)
        return clips

    def _slices(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The steps as [..., T * F], checked."""
        action = tensordict.get(self.action_key, None)
        if action is None:
            raise KeyError(
                f"the batch has no {self.action_key!r}, got {sorted(map(str, tensordict.keys()))}: name it by action_key=."
            )
        self._check_actions(action.dtype, action.shape, tensordict.ndim)
        if not tensordict.ndim:
            raise ValueError(
                "a batch needs a time dimension [..., T * frame_skip], got batch size []: sample slices of steps."
            )
        block, length = self.frame_skip, tensordict.shape[-1]
        if self.num_frames is None:
            if length % block:
                raise ValueError(
                    f"{length} steps are no whole number of blocks of frame_skip={block}: sample T * {block} steps."
                )
            return tensordict
        want = self.num_frames * block
        if tensordict.ndim == 1 and not length % want:
            return tensordict.unflatten(0, (length // want, want))
        if tensordict.ndim == 1 or length != want:
            raise ValueError(
                f"{length} steps are no slices of num_frames * frame_skip = {want}: sample slices of that length "
                "(SliceSampler, strict_length=True)."
            )
        return tensordict

    def _check_actions(self, dtype: torch.dtype, shape: torch.Size, batch_dims: int) -> None:
        if not dtype.is_floating_point:
            raise TypeError(f"only floating-point actions can be joined to blocks, got {self.action_key!r} of {dtype}.")
        if len(shape) != batch_dims + 1:
            raise ValueError(
                f"{self.action_key!r} must be a vector [A] behind {batch_dims} batch dimensions, got shape {list(shape)}: "
                "correct the batch size (tensordict.auto_batch_size_), or flatten the action."
            )
        if self.statistics is not None and shape[-1] != self.statistics.action_dim:
            raise ValueError(f"statistics describe {self.statistics.action_dim} action dimensions, got {shape[-1]}.")

    def _mask(self, blocks: TensorDictBase) -> torch.Tensor | None:
        """[..., T] bool, false where a block or the step to the next frame crosses an end; None where nothing is known."""
        mask, end = blocks.get(self.mask_key, None), blocks.get(("next", "done"), None)
        if mask is not None:
            mask = mask.reshape(blocks.shape).all(-1)  # [..., T]
        if end is None:
            return mask
        end = end.reshape(blocks.shape)  # [..., T, F]
        crosses = end[..., :-1].any(-1)
        if blocks.ndim > 2:  # of flat clips it is unknown which blocks are the last of their clip
            crosses[..., :-1] |= end[..., :-1, -1]
        return ~crosses if mask is None else mask & ~crosses

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """The spec of one block: as the raw action's, z-scored, F times in a row.

        Args:
            action_spec (Composite): all actions of the parent environment.

        Raises:
            TypeError: the action is not a floating-point vector.
            ValueError: the environment has no such action, or the statistics are of another one.
        """
        if self.action_key not in action_spec.keys(True, True):
            # No KeyError, which TorchRL would replace by one of its own.
            raise ValueError(f"the environment has no action {self.action_key!r}: name it by action_key=.")
        raw = action_spec[self.action_key]
        self._check_actions(raw.dtype, raw.shape, action_spec.ndim)
        shape = torch.Size([*raw.shape[:-1], self.frame_skip * raw.shape[-1]])
        if isinstance(raw, Bounded):
            low, high = (self._repeat(bound.expand(raw.shape)) for bound in (raw.space.low, raw.space.high))
            block: TensorSpec = Bounded(low, high, shape=shape, dtype=raw.dtype, device=raw.device)
        else:
            block = Unbounded(shape=shape, dtype=raw.dtype, device=raw.device)
        action_spec[self.action_key] = block
        return action_spec

    def _repeat(self, bound: torch.Tensor) -> torch.Tensor:
        block = bound.repeat(*[1] * (bound.ndim - 1), self.frame_skip)  # [..., F * A]
        return block if self.statistics is None else self.statistics.normalize(block)

    @property
    def _block_key(self) -> str:
        """The raw actions of the block being executed, within one call of `step`; blocks of blocks have two."""
        return f"_raw_action_block_{id(self)}"

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:  # of a replay buffer: `extend` stores raw steps
            return tensordict
        raw, block = self.parent.full_action_spec[self.action_key], tensordict.get(self.action_key)
        want = [*raw.shape[:-1], self.frame_skip * raw.shape[-1]]
        if list(block.shape[-1:]) != want[-1:]:
            raise ValueError(
                f"a step takes one action block {want}, F = {self.frame_skip} actions, got {list(block.shape)}."
            )
        block = block if self.statistics is None else self.statistics.denormalize(block)
        actions = block.to(raw.dtype).unflatten(-1, (self.frame_skip, -1))  # [..., F, A]
        if isinstance(raw, Bounded):  # z-scoring forth and back rounds
            actions = actions.clamp(raw.space.low.unsqueeze(-2), raw.space.high.unsqueeze(-2))
        return tensordict.set(self._block_key, actions).set(self.action_key, actions[..., 0, :])

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        """Executes the second to the last action of the block; the environment has executed the first."""
        parent = self.parent
        actions, stepped = tensordict.pop(self._block_key), tensordict.pop("_step", None)
        going = torch.ones(tensordict.shape, dtype=torch.bool, device=actions.device)
        if stepped is not None:
            going &= stepped.reshape(going.shape)
        for action in actions.unbind(-2)[1:]:
            for key in parent.done_keys:
                going = going & ~next_tensordict.get(key).reshape(*going.shape, -1).any(-1)
            if not going.any():
                break
            current = parent.step_mdp(tensordict.copy().set("next", next_tensordict)).set(self.action_key, action)
            if going.all():
                following = parent.step(current).get("next")
            elif parent.batch_locked:
                following = parent.step(current.set("_step", going)).get("next")
            else:
                following = next_tensordict.clone()
                following[going] = parent.step(current[going]).get("next")
            for key in parent.reward_keys:
                following.set(key, next_tensordict.get(key) + following.get(key))
            next_tensordict = following if going.all() else following.where(going, next_tensordict)
        return next_tensordict


class GoalImage(Transform):
    """Adds a goal frame, ``goal_pixels``, to every observation of an environment with pixels.

    With it :class:`~torchrl_ficreg.MPCPolicy` runs on any environment with pixels. The frame stays the same from one
    reset to the next. On a replay buffer every sampled step gets a goal.

    Args:
        goal (Tensor or callable): the frame, of the shape and dtype of the environment's pixels, for example
            [3, H, W] uint8; in a batch of environments also one frame for each. Or a function without arguments that
            returns one frame: it is called once for every environment that is reset.

    Keyword Args:
        in_key (NestedKey, optional): the pixels, whose spec the goal takes over. Default: ``"pixels"``.
        out_key (NestedKey, optional): the goal. Default: ``"goal_pixels"``.

    Raises:
        KeyError: the environment has no such pixels, or a step is taken without the goal of the reset.
        TypeError: ``goal`` is neither a tensor nor callable.
        ValueError: the goal has another shape or dtype than the pixels, or a transform behind this one changes a goal
            that is sampled, which it would do again at every step.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.testing.mocking_classes import ContinuousActionConvMockEnv
        >>> env = ContinuousActionConvMockEnv(pixel_shape=[3, 7, 7])
        >>> env = TransformedEnv(env, GoalImage(lambda: torch.rand(3, 7, 7)))
        >>> steps = env.rollout(4)
        >>> steps["goal_pixels"].shape, bool((steps["goal_pixels"] == steps["goal_pixels"][0]).all())
        (torch.Size([4, 3, 7, 7]), True)
    """

    def __init__(
        self,
        goal: torch.Tensor | Callable[[], torch.Tensor],
        *,
        in_key: NestedKey = PIXELS,
        out_key: NestedKey = GOAL_PIXELS,
    ) -> None:
        super().__init__(in_keys=[in_key], out_keys=[out_key])
        if not isinstance(goal, torch.Tensor) and not callable(goal):
            raise TypeError(f"goal must be a frame or a function that returns one, got a {type(goal).__name__}.")
        self.sample_goal = None if isinstance(goal, torch.Tensor) else goal
        self.register_buffer("frame", goal if isinstance(goal, torch.Tensor) else None, persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds a goal to every sampled step.

        Args:
            tensordict (TensorDictBase): with the pixels.
        """
        return self._reset(tensordict, tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        pixels = tensordict_reset.get(self.in_keys[0], None)
        if pixels is None:
            raise KeyError(f"there is no {self.in_keys[0]!r} to set a goal for: render pixels, or name them by in_key=.")
        if self.sample_goal is None:
            return tensordict_reset.set(self.out_keys[0], self._checked(self.frame, pixels).expand(pixels.shape))
        reset = tensordict.get("_reset", None)
        lead = tensordict_reset.shape
        fresh = torch.ones(lead, dtype=torch.bool) if reset is None else reset.reshape(*lead, -1).any(-1).cpu()
        goal = torch.zeros_like(pixels)  # those of environments that go on are discarded by TorchRL
        for index in fresh.nonzero():
            place = tuple(index.tolist())
            goal[place] = self._checked(self.sample_goal(), pixels[place])
        return tensordict_reset.set(self.out_keys[0], goal)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self.sample_goal is None:
            return self._reset(tensordict, next_tensordict)
        goal = tensordict.get(self.out_keys[0], None)
        if goal is None:
            raise KeyError(
                f"a step needs the {self.out_keys[0]!r} that the reset wrote: pass what reset and step returned."
            )
        return next_tensordict.set(self.out_keys[0], goal)

    def _checked(self, goal: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        shape = pixels.shape[pixels.ndim - goal.ndim :] if goal.ndim >= 3 else pixels.shape[-3:]
        if goal.shape != shape or goal.dtype != pixels.dtype:
            raise ValueError(
                f"a goal must be a frame {list(pixels.shape[-3:])} of {pixels.dtype}, as the pixels are, got "
                f"{list(goal.shape)} of {goal.dtype}."
            )
        return goal.to(pixels.device)

    def _check_later_transforms(self) -> None:
        """Refuses transforms that change the goal: a step reads it as they left it, and they would change it again."""
        transform, goal = getattr(self.container, "transform", self), unravel_key(self.out_keys[0])
        later = list(transform) if isinstance(transform, Compose) else [transform]
        for each in later[next((i for i, each in enumerate(later) if each is self), len(later)) + 1 :]:
            if goal in map(unravel_key, each.out_keys):
                raise ValueError(
                    f"{type(each).__name__} changes {goal!r} behind GoalImage, at every step again: put GoalImage behind it, "
                    "with goals like the pixels there."
                )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the goal, with the spec of the pixels.

        Args:
            observation_spec (Composite): observations of the parent environment.

        Raises:
            KeyError: there are no such pixels.
            ValueError: the goal has another shape or dtype, or is changed by a later transform.
        """
        pixels = observation_spec.get(self.in_keys[0], None)
        if pixels is None:
            raise KeyError(f"the environment has no {self.in_keys[0]!r}: render pixels, or name them by in_key=.")
        if self.sample_goal is None:
            self._checked(self.frame, pixels.zero())
        else:
            self._check_later_transforms()
        observation_spec[self.out_keys[0]] = pixels.clone()
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Declares a sampled goal as a state, so that worker processes are given it at every step.

        Args:
            input_spec (Composite): inputs of the parent environment.
        """
        if self.sample_goal is not None:
            state = input_spec["full_state_spec"]
            state = Composite(shape=input_spec.shape, device=input_spec.device) if state is None else state
            state[self.out_keys[0]] = self.parent.full_observation_spec[self.in_keys[0]].clone()
            input_spec["full_state_spec"] = state
        return input_spec
