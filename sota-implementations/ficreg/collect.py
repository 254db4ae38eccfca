"""Records expert episodes: python collect.py env=two_room. The same command continues an interrupted recording."""

from __future__ import annotations

from cli import entry_point
from configs import check_settings
from omegaconf import DictConfig
from utils import collect_dataset

from torchrl_ficreg.data import OfflineTrajectories


@entry_point("collect")
def main(cfg: DictConfig) -> None:
    """Records missing episodes and prints the number of all."""
    check_settings(cfg, training=False)
    path = collect_dataset(cfg)
    dataset = OfflineTrajectories(path, split="all", num_frames=2, frame_skip=1)
    print(f"{path}: {len(dataset.episodes)} episodes, {dataset.num_steps} steps")


if __name__ == "__main__":
    main()
