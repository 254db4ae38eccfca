"""Records expert episodes: python collect.py env=two_room. Run again after an interruption, it continues."""

from __future__ import annotations

from cli import entry_point
from episodes import collect_dataset
from omegaconf import DictConfig
from utils import check_settings

from torchrl_ficreg.data import OfflineTrajectories


@entry_point("collect")
def main(cfg: DictConfig) -> None:
    """Records what is missing and says what is there."""
    check_settings(cfg, training=False)
    path = collect_dataset(cfg)
    dataset = OfflineTrajectories(path, split="all", num_frames=2, frame_skip=1)
    print(f"{path}: {len(dataset.episodes)} episodes, {dataset.num_steps} steps")


if __name__ == "__main__":
    main()
