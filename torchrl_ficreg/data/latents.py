"""Latents of recorded episodes: encoded once by a frozen encoder, and sampled as pairs of frame and goal."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from tensordict import TensorDict
from tqdm import tqdm

from torchrl_ficreg.data.clips import check_latents
from torchrl_ficreg.data.dataset import OfflineTrajectories
from torchrl_ficreg.keys import ACTION, GOAL_LATENT, LATENT, PIXELS

BLOCKS = "blocks"


@torch.no_grad()
def encode_episodes(
    dataset: OfflineTrajectories,
    encode: Callable[[torch.Tensor], torch.Tensor],
    *,
    batch_size: int = 256,
    description: str | None = None,
) -> torch.Tensor:
    """The latent of every frame of a split, each frame encoded once.

    Args:
        dataset (OfflineTrajectories): the episodes; its clips are not used.
        encode (callable): frames [n, 3, H, W] uint8 -> latents [n, D]. It handles device and precision; the latents stay
            on the device of its result.

    Keyword Args:
        batch_size (int, optional): frames encoded at once. Default: ``256``.
        description (str, optional): text of the progress bar. Default: ``None``, no bar.

    Returns:
        float32 [N, D], episode after episode in the order of ``dataset.episodes``: the ``latent`` of another
        :class:`OfflineTrajectories` of the same split.

    Raises:
        ValueError: ``batch_size`` is not positive, or ``encode`` returns another shape or a non-finite number.

    Examples:
        >>> import numpy as np
        >>> rng = np.random.default_rng(0)
        >>> episode = {
        ...     "pixels": rng.integers(0, 256, (12, 3, 4, 4), dtype=np.uint8),
        ...     "action": np.pad(rng.normal(size=(11, 2)), ((0, 1), (0, 0))).astype(np.float32),
        ...     "state": np.zeros((12, 1)),
        ... }
        >>> dataset = OfflineTrajectories.from_episodes([episode] * 4, split="all", num_frames=2, frame_skip=5)
        >>> encode_episodes(dataset, lambda pixels: pixels.float().mean((-1, -2))).shape
        torch.Size([48, 3])
    """
    if batch_size < 1:
        raise ValueError(f"batch_size must be positive, got {batch_size}.")
    latents = []
    with tqdm(
        total=dataset.num_steps, desc=description, unit="frame", dynamic_ncols=True, disable=description is None
    ) as bar:
        for pixels in _frames(dataset, batch_size):  # [n, 3, H, W]
            latent = encode(pixels).float()
            if latent.ndim != 2 or len(latent) != len(pixels):
                raise ValueError(f"encode must map {len(pixels)} frames to latents [n, D], got {list(latent.shape)}.")
            if not latent.isfinite().all():
                raise ValueError("the encoder returned a NaN or an infinity: its weights are damaged or it diverged.")
            latents.append(latent)
            bar.update(len(pixels))
    return torch.cat(latents)


def _frames(dataset: OfflineTrajectories, batch_size: int) -> Iterator[torch.Tensor]:
    """All frames in order, ``batch_size`` at a time; a batch may hold frames of several episodes."""
    table = dataset.episodes
    waiting = []
    missing = batch_size
    for episode, length in zip(table["episode"].tolist(), table["length"].tolist()):
        start = 0
        while start < length:
            piece = dataset.episode_data(episode, steps=slice(start, start + missing), keys=(PIXELS,))[PIXELS]
            waiting.append(piece)
            start, missing = start + len(piece), missing - len(piece)
            if not missing:
                yield torch.cat(waiting)
                waiting, missing = [], batch_size
    if waiting:
        yield torch.cat(waiting)


def _actions_and_blocks(dataset: OfflineTrajectories) -> tuple[torch.Tensor, torch.Tensor]:
    """Z-scored actions [N, A] and the number of whole action blocks that follow each row, int64 [N]."""
    table = dataset.episodes
    episodes, length = table["episode"].tolist(), table["length"]  # [E]
    raw = torch.cat([dataset.episode_data(episode, keys=(ACTION,))[ACTION] for episode in episodes])  # [N, A]
    step = torch.cat([torch.arange(rows) for rows in length.tolist()])  # [N], within its episode
    # The last row of an episode has no action, so no block contains it; its frame may follow one.
    blocks = (length.repeat_interleave(length) - 1 - step) // dataset.frame_skip
    return dataset.statistics.normalize(raw), blocks


class GoalRows:
    """Training data of a goal-conditioned policy: a frame, a later frame as its goal, and the action block between them.

    A row begins at any step s of an episode from which a whole action block stays inside the episode. Its goal is the
    frame k blocks later, k uniform in 1 ... ``max_blocks`` up to the end of the episode::

        step     s           s+F         ...         s+kF
        latent   latent                              goal_latent
        action   [--action--)

    :meth:`sample` draws s and k anew each time, so there are no epochs.

    Args:
        dataset (OfflineTrajectories): the episodes; its statistics z-score the actions.
        latent (Tensor): [N, D], the result of :func:`encode_episodes` for them.

    Keyword Args:
        max_blocks (int): the most distant goal, in action blocks.

    Attributes:
        reach: int64 [M], the largest k of each of the M starts.

    Raises:
        ValueError: ``max_blocks`` is not positive, or the latents belong to other episodes.

    Examples:
        >>> import numpy as np
        >>> step = np.arange(12)
        >>> episode = {
        ...     "pixels": np.zeros((12, 3, 4, 4), np.uint8),
        ...     "action": np.where(step < 11, step, 0).astype(np.float32)[:, None],
        ...     "state": np.zeros((12, 1)),
        ... }
        >>> dataset = OfflineTrajectories.from_episodes([episode] * 4, split="all", num_frames=2, frame_skip=5)
        >>> rows = GoalRows(dataset, torch.zeros(48, 16), max_blocks=3)
        >>> len(rows), rows.reach[:7].tolist()  # 7 starts in each: two blocks fit from steps 0 and 1
        (28, [2, 2, 1, 1, 1, 1, 1])
        >>> rows.sample(32)["action"].shape
        torch.Size([32, 5])
    """

    def __init__(self, dataset: OfflineTrajectories, latent: torch.Tensor, *, max_blocks: int) -> None:
        if max_blocks < 1:
            raise ValueError(f"max_blocks must be positive, got {max_blocks}.")
        check_latents(latent, dataset.num_steps, f"the {dataset.split!r} split has")
        self.frame_skip, self.latent = dataset.frame_skip, latent
        self.action, blocks = _actions_and_blocks(dataset)  # [N, A], [N]
        self.action = self.action.to(latent.device)
        self._start = blocks.nonzero().squeeze(-1)  # [M]
        self.reach = blocks[self._start].clamp(max=max_blocks)

    def __len__(self) -> int:
        return len(self._start)

    def sample(self, batch_size: int, *, generator: torch.Generator | None = None) -> TensorDict:
        """Draws rows, with replacement.

        Args:
            batch_size (int): B.

        Keyword Args:
            generator (torch.Generator, optional): of the draws, on the CPU: they do not depend on the device of the
                latents. Default: ``None``, the global one.

        Returns:
            [B]: ``latent`` and ``goal_latent`` [B, D], z-scored ``action`` [B, F * A] and ``blocks`` [B] int64, the k
            of each row.
        """
        pick = torch.randint(len(self), (batch_size,), generator=generator)
        chance = torch.rand(batch_size, dtype=torch.float64, generator=generator)
        blocks = 1 + (chance * self.reach[pick]).long()  # [B]
        start = self._start[pick]
        device = self.latent.device
        steps = (start.unsqueeze(-1) + torch.arange(self.frame_skip)).to(device)  # [B, F]
        goal = (start + blocks * self.frame_skip).to(device)
        row = {
            LATENT: self.latent[start.to(device)],
            GOAL_LATENT: self.latent[goal],
            ACTION: self.action[steps].flatten(1),  # [B, F, A] -> [B, F * A]
            BLOCKS: blocks.to(device),
        }
        return TensorDict(row, [batch_size])
