"""A goal-conditioned policy on frozen latents, and how it is saved and loaded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from torchrl_ficreg._safe_files import (
    check_kinds,
    check_shapes,
    check_sizes,
    CHECKSUM,
    checksum_of,
    open_model_folder,
    read_tensors,
    require_safetensors,
    save_model,
)
from torchrl_ficreg.keys import ACTION, GOAL_LATENT, LATENT
from torchrl_ficreg.modules.feed import sort_keys
from torchrl_ficreg.modules.layers import keep_arguments
from torchrl_ficreg.modules.world_model import LatentWorldModel


_SMALLEST_STD = 1e-6  # below it a latent dimension counts as constant


class GoalNetwork(nn.Module):
    """Hidden layers with LayerNorm on a standardised latent and goal latent.

    Without BatchNorm: the output for a latent does not depend on the rest of the batch.

    Args:
        latent_dim (int): D.
        action_dim (int): F * A, width of an action block.
        hidden_dim (int, optional): width of each hidden layer. Default: ``512``.
        depth (int, optional): number of hidden layers. Default: ``3``.

    Raises:
        ValueError: a size that is not positive.
    """

    @keep_arguments
    def __init__(self, latent_dim: int, action_dim: int, hidden_dim: int = 512, depth: int = 3) -> None:
        super().__init__()
        sizes = {"latent_dim": latent_dim, "action_dim": action_dim, "hidden_dim": hidden_dim, "depth": depth}
        small = [f"{name}={size}" for name, size in sizes.items() if size < 1]
        if small:
            raise ValueError(f"sizes of a goal policy must be positive, got {', '.join(small)}.")
        self.latent_dim, self.action_dim = latent_dim, action_dim
        self.register_buffer("latent_mean", torch.zeros(latent_dim))
        self.register_buffer("latent_std", torch.ones(latent_dim))
        layers: list[nn.Module] = []
        for width in [2 * latent_dim] + [hidden_dim] * (depth - 1):
            layers += [nn.Linear(width, hidden_dim), nn.LayerNorm(hidden_dim), nn.GELU()]
        self.layers = nn.Sequential(*layers, nn.Linear(hidden_dim, action_dim))

    def forward(self, latent: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """Latents [..., D] and goal latents [..., D] -> action blocks [..., F * A], z-scored.

        Raises:
            ValueError: other shapes.
        """
        if latent.shape != goal.shape or latent.shape[-1] != self.latent_dim:
            raise ValueError(
                f"the policy reads latents and goal latents [..., {self.latent_dim}] of one shape, got "
                f"{list(latent.shape)} and {list(goal.shape)}: use the world model that it was trained with."
            )
        both = torch.stack([latent, goal], dim=-2)  # [..., 2, D]
        return self.layers(((both - self.latent_mean) / self.latent_std).flatten(-2))

    @torch.no_grad()
    def standardize_by(self, latent: torch.Tensor) -> None:
        """Sets mean and standard deviation of the input to those of training latents; constant dimensions are only centred.

        Args:
            latent (Tensor): [N, D].

        Raises:
            ValueError: another width, fewer than two latents, or one that is not finite.
        """
        if latent.ndim != 2 or len(latent) < 2 or latent.shape[1] != self.latent_dim:
            raise ValueError(f"expected at least 2 latents [N, {self.latent_dim}], got {list(latent.shape)}.")
        rows = latent if latent.dtype in (torch.float32, torch.float64) else latent.float()
        rows = rows.cpu().numpy().astype(np.float64)  # NumPy sums in float64, which MPS has not
        with np.errstate(invalid="ignore"):  # checked below
            mean, std = rows.mean(0), rows.std(0)  # [D], [D]
        if not np.isfinite([mean, std]).all():
            raise ValueError("the training latents hold a NaN or an infinity: leave those rows out.")
        std[std < _SMALLEST_STD] = 1
        for buffer, value in ((self.latent_mean, mean), (self.latent_std, std)):
            buffer.copy_(torch.tensor(value.tolist(), dtype=buffer.dtype))


FORMAT, VERSION = "torchrl_ficreg.goal_policy", 1
CONFIG_FILE, WEIGHTS_FILE = "policy.json", "policy.safetensors"

Bounds = tuple[torch.Tensor, torch.Tensor]


class GoalPolicy(TensorDictModule):
    """``latent`` and ``goal_latent`` [..., D] -> ``action`` [..., F * A], one z-scored action block.

    A deterministic regressor. Trained on the rows of :class:`~torchrl_ficreg.data.latents.GoalRows`, it predicts the mean
    of the blocks that the recorded agent executed on its way from one latent to the other, whatever their distance
    (arXiv 2605.08732 also conditions on the distance). It is a policy without planning; rolled out in a world model, see
    :meth:`rollout`, it proposes whole plans to a planner.

    Args:
        latent_dim (int): D.
        action_dim (int): F * A, width of an action block.
        hidden_dim (int, optional): width of each hidden layer. Default: ``512``.
        depth (int, optional): number of hidden layers. Default: ``3``.
        in_keys (tuple of NestedKey, optional): where the latent and the goal latent are read. Their order matters only
            where their names do not say which is which. Default: ``("latent", "goal_latent")``.
        out_key (NestedKey, optional): where the action block is written. Default: ``"action"``.

    Raises:
        ValueError: a size that is not positive.

    Examples:
        >>> import torch
        >>> policy = GoalPolicy(latent_dim=16, action_dim=10)
        >>> policy(latent=torch.zeros(2, 3, 16), goal_latent=torch.zeros(2, 3, 16)).shape
        torch.Size([2, 3, 10])
    """

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        hidden_dim: int = 512,
        depth: int = 3,
        *,
        in_keys: tuple[NestedKey, NestedKey] = (LATENT, GOAL_LATENT),
        out_key: NestedKey = ACTION,
    ) -> None:
        network = GoalNetwork(latent_dim, action_dim, hidden_dim, depth)
        keys = sort_keys("policy", in_keys, LATENT, GOAL_LATENT)
        super().__init__(network, in_keys=keys, out_keys=[out_key])

    @property
    def sizes(self) -> dict[str, int]:
        """The arguments that build the same policy: ``latent_dim``, ``action_dim``, ``hidden_dim`` and ``depth``."""
        return dict(self.module.arguments)

    def standardize_by(self, latent: torch.Tensor) -> None:
        """Sets mean and standard deviation of the input to those of training latents.

        Args:
            latent (Tensor): [N, D].

        Raises:
            ValueError: another width, fewer than two latents, or one that is not finite.
        """
        self.module.standardize_by(latent)

    def check_fits(self, world_model: LatentWorldModel) -> None:
        """Checks that a world model has latents and action blocks of the policy's widths.

        Raises:
            ValueError: a width differs.
        """
        ours, theirs = self.module, world_model
        if (ours.latent_dim, ours.action_dim) != (theirs.latent_dim, theirs.block_dim):
            raise ValueError(
                f"the policy has latents of {ours.latent_dim} and action blocks of {ours.action_dim}, the world model "
                f"{theirs.latent_dim} and {theirs.block_dim}: train a policy for this model."
            )

    def rollout(
        self,
        world_model: LatentWorldModel,
        latent: torch.Tensor,
        past_action: torch.Tensor,
        goal: torch.Tensor,
        horizon: int,
        *,
        bounds: Bounds | None = None,
    ) -> torch.Tensor:
        """The plan that the policy follows in the world model.

        Block by block, the policy chooses an action block for the newest latent and the world model predicts the next
        latent from the last H, as :meth:`~torchrl_ficreg.LatentWorldModel.rollout` does for the finished plan.

        Args:
            world_model (LatentWorldModel): the dynamics, in eval mode.
            latent (Tensor): context [..., C, D], oldest first.
            past_action (Tensor): z-scored blocks [..., C - 1, F * A] executed between the context frames.
            goal (Tensor): [..., D].
            horizon (int): N, number of blocks.
            bounds (tuple of Tensor, optional): (low [F * A], high [F * A]), z-scored, to which every block is clamped.
                Default: None.

        Returns:
            the plan [..., N, F * A], z-scored, in the dtype of ``latent``.

        Raises:
            ValueError: other shapes, a horizon below 1, or a world model of other widths.

        Examples:
            >>> import torch
            >>> from torchrl_ficreg import make_world_model, ModelConfig
            >>> model, _ = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
            >>> policy, start, goal = GoalPolicy(16, 10), torch.randn(4, 1, 16), torch.randn(4, 16)
            >>> with torch.inference_mode():
            ...     plan = policy.rollout(model.eval(), start, torch.zeros(4, 0, 10), goal, horizon=5)
            >>> plan.shape
            torch.Size([4, 5, 10])
        """
        self.check_fits(world_model)
        self._check_context(latent, past_action, goal, horizon, bounds)
        # Planners may keep the predictor in another precision.
        predictor = getattr(world_model, "predictor", world_model)
        history, dtype = world_model.history, next(predictor.parameters(), latent).dtype
        own = next(self.module.parameters()).dtype
        seen, done = latent[..., -history:, :], past_action[..., max(0, past_action.shape[-2] - history + 1) :, :]
        plan: list[torch.Tensor] = []
        while True:
            block = self.module(seen[..., -1, :].to(own), goal.to(own)).to(latent.dtype)  # [..., F * A]
            block = block if bounds is None else block.clamp(*bounds)
            plan.append(block)
            if len(plan) == horizon:
                return torch.stack(plan, dim=-2)
            done = torch.cat([done, block.unsqueeze(-2)], dim=-2)[..., -history:, :]  # as many as seen
            following = world_model.rollout(seen.to(dtype), done.to(dtype))  # [..., 1, D]
            seen = torch.cat([seen, following.to(latent.dtype)], dim=-2)[..., -history:, :]

    def _check_context(
        self, latent: torch.Tensor, past_action: torch.Tensor, goal: torch.Tensor, horizon: int, bounds: Bounds | None
    ) -> None:
        if (
            horizon < 1
            or min(latent.ndim, past_action.ndim) < 2
            or latent.shape[-2] < 1
            or goal.shape != (*latent.shape[:-2], self.module.latent_dim)
            or past_action.shape != (*latent.shape[:-2], latent.shape[-2] - 1, self.module.action_dim)
        ):
            raise ValueError(
                f"rollout takes latents [..., C, {self.module.latent_dim}], the C - 1 past blocks "
                f"[..., C - 1, {self.module.action_dim}], goals [..., {self.module.latent_dim}] and a horizon >= 1, got "
                f"{list(latent.shape)}, {list(past_action.shape)}, {list(goal.shape)} and {horizon}."
            )
        if bounds is not None and any(bound.shape != (self.module.action_dim,) for bound in bounds):
            got = " and ".join(str(list(bound.shape)) for bound in bounds)
            raise ValueError(f"bounds must be two vectors [{self.module.action_dim}], low and high, got {got}.")


def save_goal_policy(policy: GoalPolicy, folder: Path | str, world_model: LatentWorldModel) -> Path:
    """Writes ``policy.safetensors`` and ``policy.json``, readable without running anything that is in them.

    A checksum of the encoder's weights and the action statistics, on which the policy depends, is saved with it. Weights
    are written in float32. Keys are not saved: a loaded policy reads and writes the default ones.

    Args:
        policy (GoalPolicy): the policy.
        folder (str or Path): created if missing; a policy already there is replaced.
        world_model (LatentWorldModel): the model on whose latents it was trained.

    Returns:
        the folder.

    Raises:
        ImportError: safetensors is not installed.
        ValueError: the policy does not fit the world model.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_ficreg import make_world_model, ModelConfig
        >>> model, _ = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> policy, latent = GoalPolicy(16, 10), torch.randn(3, 16)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     same = load_goal_policy(save_goal_policy(policy, folder, model), model)
        >>> torch.equal(same.module(latent, -latent), policy.module(latent, -latent))
        True
    """
    require_safetensors()
    policy.check_fits(world_model)
    content = {"format": FORMAT, "version": VERSION, "sizes": policy.sizes, "world_model": _checksum(world_model)}
    folder = Path(folder).expanduser()
    save_model(folder, WEIGHTS_FILE, policy.module.state_dict(), CONFIG_FILE, content)
    return folder


def load_goal_policy(
    folder: Path | str, world_model: LatentWorldModel, *, device: torch.device | str = "cpu"
) -> GoalPolicy:
    """Reads what :func:`save_goal_policy` wrote, for the world model it was trained with.

    Args:
        folder (str or Path): with ``policy.json`` and ``policy.safetensors``.
        world_model (LatentWorldModel): the model whose latents the policy reads.
        device (torch.device or str, optional): device of the policy. Default: ``"cpu"``.

    Returns:
        the policy, in eval mode.

    Raises:
        ImportError: safetensors is not installed.
        FileNotFoundError: no such files.
        ValueError: another format or version, damaged files, files that do not belong together, or a world model of
            other widths, encoder weights or action statistics than the policy's own.
    """
    folder = Path(folder).expanduser()
    advice = {"writer": "save_goal_policy or train_policy.py", "instead": "give a folder that save_goal_policy wrote."}
    weights, _, content, shapes = open_model_folder(folder, WEIGHTS_FILE, CONFIG_FILE, FORMAT, VERSION, **advice)
    try:
        sizes, checksum = content["sizes"], content["world_model"]
        check_sizes(sizes, len(shapes))
        with torch.device("meta"):
            wanted = GoalPolicy(**sizes).module.state_dict()
        check_shapes(wanted, shapes)
    # A missing or unknown field, or tensors of another network.
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:160]
        raise ValueError(
            f"{folder}: {CONFIG_FILE} and {WEIGHTS_FILE} do not belong together ({reason}): train the policy again."
        ) from error
    tensors = read_tensors(weights, content.get(CHECKSUM))
    check_kinds(wanted, tensors)
    policy = GoalPolicy(**sizes)
    policy.module.load_state_dict(tensors)
    policy.check_fits(world_model)
    if checksum != _checksum(world_model):
        raise ValueError(
            f"{folder} holds a policy that was trained on another encoder or other action statistics: train one for "
            "this model (with train_policy.py: overwrite=true)."
        )
    return policy.to(device).eval()


def _checksum(world_model: LatentWorldModel) -> str:
    """Checksum of the encoder's weights and the action statistics."""
    return checksum_of({**world_model.encoder.state_dict(), **dict(world_model.named_buffers(recurse=False))})
