"""The distance profile of known encoders, and pictures that can be opened."""

from __future__ import annotations

import csv

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from scenes import make_pairs, same_room_pairs, Walker

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.evaluation import (
    evaluate_mpc,
    latent_distance,
    plot_latent_distance,
    plot_learning_curve,
    save_episodes_gif,
)


class Positions:
    """A world model whose latent is the state itself, which the first two pixels spell out."""

    action_mean = torch.zeros(2)

    def __init__(self, scale: float = 1.0) -> None:
        self.scale = scale

    def encode(self, pixels: torch.Tensor) -> torch.Tensor:
        """[N, 3, H, W] -> [N, 2]."""
        return self.scale * pixels[:, 0, 0, :2].float()


@pytest.fixture(scope="module")
def walks() -> OfflineTrajectories:
    """Ten episodes of whole-number states, written into the pixels."""
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(10):
        state = rng.integers(0, 256, (30, 2))
        pixels = np.zeros((30, 3, 4, 4), np.uint8)
        pixels[:, 0, 0, :2] = state
        action = np.pad(rng.normal(size=(29, 2)), ((0, 1), (0, 0))).astype(np.float32)
        episodes.append({"pixels": pixels, "action": action, "state": state.astype(float)})
    return OfflineTrajectories.from_episodes(episodes, split="all", num_frames=2, frame_skip=1)


def test_a_latent_that_is_the_state_follows_it_perfectly(walks):
    profile = latent_distance(Positions(scale=0.1), walks, num_frames=100)
    assert profile.rank_correlation == pytest.approx(1, abs=1e-6)
    assert len(profile.true) == 100 * 99 / 2
    assert profile.latent == pytest.approx(0.1 * profile.true, rel=1e-5)


def test_a_collapsed_encoder_gives_no_slope(walks):
    assert latent_distance(Positions(scale=0.0), walks).rank_correlation == 0


def test_the_same_frames_are_compared_every_time_and_never_more_than_there_are(walks):
    first, again = (latent_distance(Positions(), walks, num_frames=50, seed=1) for _ in range(2))
    assert np.array_equal(first.true, again.true)
    assert not np.array_equal(first.true, latent_distance(Positions(), walks, num_frames=50, seed=2).true)
    assert len(latent_distance(Positions(), walks, num_frames=10_000).true) == 300 * 299 / 2


def test_bins_hold_equally_many_pairs_and_ordered_quantiles(walks):
    center, spread = latent_distance(Positions(), walks).bins(count=10)
    assert center.shape == (10,) and spread.shape == (10, 3)
    assert (np.diff(center) > 0).all() and (np.diff(spread, axis=1) >= 0).all()


@pytest.fixture(scope="module")
def recorded():
    return evaluate_mpc(Walker(), same_room_pairs(5), budget=30, image_size=16, record=3, progress_bar=False)


def test_the_gif_shows_every_step_of_every_recorded_episode(recorded, tmp_path):
    """Three tiles and a blank in one row, 30 + 1 steps and a second to look at the end, at ten frames a second."""
    save_episodes_gif(recorded, tmp_path / "episodes.gif", scale=2, fps=10, columns=4)
    pictures = imageio.imread(tmp_path / "episodes.gif")
    assert pictures.shape[1:] == (2 * 16 + 8, 4 * (2 * 2 * 16 + 8), 3)
    durations = [imageio.immeta(tmp_path / "episodes.gif", index=i)["duration"] for i in range(len(pictures))]
    assert sum(durations) == (31 + 10) * 100  # equal neighbours may be stored as one longer frame


def test_a_tile_shows_the_view_beside_the_goal_and_turns_green_once_reached(recorded, tmp_path):
    """Pixels in the file agree with the recorded frames up to the palette; the frame colour changes and stays."""
    save_episodes_gif(recorded, tmp_path / "episodes.gif", scale=1, columns=3)
    pictures = imageio.imread(tmp_path / "episodes.gif").astype(int)
    view = pictures[0, 4:20, 4:20].transpose(2, 0, 1)
    assert np.abs(view - recorded.frames[0][0]).mean() < 8
    goal = pictures[0, 4:20, 20:36].transpose(2, 0, 1)
    assert np.abs(goal - recorded.goals[0]).mean() < 8
    first, last = pictures[0, 2, 10], pictures[-1, 2, 10]
    assert abs(first[0] - first[1]) < 20  # grey
    assert last[1] > last[0] + 60  # green


def test_no_recorded_episode_is_a_clear_error(tmp_path):
    outcome = evaluate_mpc(Walker(), make_pairs([[60, 60]], [[60, 80]]), budget=1, image_size=8, progress_bar=False)
    with pytest.raises(ValueError, match="no episode was recorded: evaluate with record"):
        save_episodes_gif(outcome, tmp_path / "none.gif")
    assert not list(tmp_path.iterdir())


def test_plots_are_pictures_of_the_size_they_should_have(walks, tmp_path):
    """Two loss terms: two panels, 3.4 inches each at 120 dots per inch; none of it is blank."""
    with open(tmp_path / "metrics.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["step", "split", "grad_norm", "loss_pred", "loss_sigreg"])
        writer.writerows([[step, "train", 1.0, 1 / step, 2 / step] for step in range(1, 20)])
        writer.writerow([19, "validation", "", 0.1, 0.2])
    plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
    plot_latent_distance(latent_distance(Positions(), walks), tmp_path / "distance.png")
    curve, distance = (imageio.imread(tmp_path / name) for name in ("curve.png", "distance.png"))
    assert curve.shape[:2] == (336, 816)
    assert distance.shape[:2] == (408, 540)
    assert curve.std() > 10 and distance.std() > 10


def test_a_table_without_losses_is_a_clear_error(tmp_path):
    (tmp_path / "metrics.csv").write_text("step,split\n1,train\n")
    with pytest.raises(ValueError, match="metrics.csv holds no loss"):
        plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
