"""Pictures that can be opened and show what they should."""

from __future__ import annotations

import sys

import imageio.v3 as imageio
import numpy as np
import pytest
from scenes import make_pairs, same_room_pairs, Walker

from torchrl_ficreg.evaluation import (
    DistanceProfile,
    evaluate_mpc,
    plot_latent_distance,
    plot_learning_curve,
    save_episodes_gif,
)


@pytest.fixture(scope="module")
def recorded():
    return evaluate_mpc(Walker(), same_room_pairs(5), budget=30, image_size=16, record=3, progress_bar=False)


def test_the_gif_shows_every_step_of_every_recorded_episode(recorded, tmp_path):
    """Three tiles and a blank in one row, 30 + 1 steps and one second of the last frame, at ten frames a second."""
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


@pytest.mark.parametrize(("module", "draw"), [("imageio", save_episodes_gif), ("matplotlib", plot_latent_distance)])
def test_a_missing_package_is_named(recorded, monkeypatch, tmp_path, module, draw):
    for name in (module, f"{module}.v3"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=rf"needs {module}: pip install 'torchrl_ficreg\[plot\]'"):
        draw(recorded, tmp_path / "picture")


def test_what_cannot_be_drawn_is_refused(tmp_path):
    outcome = evaluate_mpc(Walker(), make_pairs([[60, 60]], [[60, 80]]), budget=1, image_size=8, progress_bar=False)
    with pytest.raises(ValueError, match="no episode was recorded: evaluate with record"):
        save_episodes_gif(outcome, tmp_path / "none.gif")
    (tmp_path / "metrics.csv").write_text("step,split\n1,train\n")
    with pytest.raises(ValueError, match="metrics.csv holds no loss"):
        plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.csv"]


def test_plots_are_pictures_of_the_size_they_should_have(tmp_path):
    """Two loss terms that are not zero: two panels, 3.4 inches each at 120 dots per inch; none of it is blank."""
    rows = ["step,split,grad_norm,loss_idm,loss_pred,loss_sigreg"]
    rows += [f"{step},train,1.0,{1 / step},{2 / step},0" for step in range(1, 20)]
    (tmp_path / "metrics.csv").write_text("\n".join([*rows, "19,validation,,0.1,0.2,0"]))
    plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
    distances = np.random.default_rng(0).uniform(size=(2, 1000))
    plot_latent_distance(DistanceProfile(*distances), tmp_path / "distance.png")
    for name, size in (("curve.png", (336, 816)), ("distance.png", (408, 540))):
        picture = imageio.imread(tmp_path / name)
        assert picture.shape[:2] == size and picture.std() > 10
