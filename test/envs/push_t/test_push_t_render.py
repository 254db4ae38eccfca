"""PushT's pictures: close to the published ones, the same scene at every size, the same bits every time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_ficreg.envs.push_t.render import render_pixels

# Made from the published package by test/envs/push_t/golden/make_push_t.py.
GOLDEN = np.load(Path(__file__).parent / "golden" / "push_t.npz")
AWAY = [2000.0, 2000.0, 2000.0, 2000.0, 0.0, 0.0, 0.0]  # agent and block out of the picture


def scenes(count, seed=0):
    rng = np.random.default_rng(seed)
    states = rng.uniform(30, 480, (count, 7))
    states[:, 4] = rng.uniform(0, 2 * np.pi, count)
    return states


def difference(first, second):
    """Mean absolute difference of grey levels, per picture."""
    return np.abs(first.astype(float) - second).mean((-3, -2, -1))


def test_pictures_differ_from_the_published_ones_by_less_than_half_a_grey_level():
    """0.40 over 300 scenes: 0.19 from aliased edges on whole pixels, the rest from bilinear against area resizing."""
    ours, published = render_pixels(GOLDEN["state"], size=224), GOLDEN["pixels"]
    assert difference(ours, published).mean() < 0.45 and difference(ours, published).max() < 0.55
    assert (np.abs(ours.astype(float) - published) > 64).mean() < 2e-3


@pytest.mark.parametrize("axis", [0, 1, 2, 3])
def test_nothing_is_displaced_against_the_published_picture(axis):
    """A pixel of the window more or less, for agent or block, makes the pictures differ more."""
    states, published = GOLDEN["state"], GOLDEN["pixels"]
    shifts = [shift * np.eye(7)[axis] for shift in (-1.0, 0.0, 1.0)]
    assert np.argmin([difference(render_pixels(states + shift, size=224), published).mean() for shift in shifts]) == 1


def test_flat_parts_have_the_published_colours():
    """The pixels of the golden pictures whose neighbourhood is of one colour: ours have that colour too."""
    published, ours = GOLDEN["pixels"].astype(int), render_pixels(GOLDEN["state"], size=224).astype(int)
    windows = np.lib.stride_tricks.sliding_window_view(published, (5, 5), axis=(2, 3))
    flat = (np.ptp(windows, axis=(4, 5)) == 0).all(1)  # [N, 220, 220]
    seen = published[:, :, 2:-2, 2:-2].transpose(0, 2, 3, 1)[flat]
    assert {(255, 255, 255), (144, 238, 144), (143, 163, 184), (78, 126, 255)} <= set(map(tuple, seen.tolist()))
    assert (ours[:, :, 2:-2, 2:-2].transpose(0, 2, 3, 1)[flat] == seen).all()


def test_the_agent_covers_the_block_and_walls_cover_everything():
    state = np.array([300.0, 300.0, 300.0, 260.0, 0.0, 0.0, 0.0])
    assert render_pixels(state, size=512)[:, 300, 300].tolist() == [78, 126, 255]
    on_wall = render_pixels(np.array([5.0, 100.0, 300.0, 300.0, 0.0, 0.0, 0.0]), size=512)
    assert on_wall[:, 100, 5].tolist() == [211, 211, 211] and on_wall[:, 100, 12].tolist() == [78, 126, 255]


def test_velocities_and_what_is_outside_are_not_drawn():
    states = scenes(3)
    assert (render_pixels(states, size=64) == render_pixels(states * [1, 1, 1, 1, 1, 0, 0], size=64)).all()
    empty = render_pixels(np.array(AWAY), size=64)
    for x in (-172.0, -20.0, 1e4):
        assert (render_pixels(np.array([x, 256.0, *AWAY[2:]]), size=64) == empty).all()
    half = render_pixels(np.array([0.0, 256.0, 512.0, 256.0, 1.0, 0.0, 0.0]), size=64)
    assert (half != empty).any()


def test_the_green_t_can_be_left_out_and_has_no_seam():
    """Its pixels inside are pure, where bar and stem meet too: window pixel (256 - 21, 256 + 21) is on that line."""
    green = (render_pixels(np.array(AWAY), size=64) == np.array([144, 238, 144])[:, None, None]).all(0)
    assert green.sum() > 50
    assert (render_pixels(np.array(AWAY), size=64, draw_goal=False)[:, green] == 255).all()
    assert render_pixels(np.array(AWAY), size=512)[:, 277, 235].tolist() == [144, 238, 144]


@pytest.mark.parametrize("size", [16, 64, 128])
def test_a_small_picture_is_the_area_average_of_a_large_one(size):
    states, fold = scenes(12), 1024 // size
    large = render_pixels(states, size=1024).astype(float)
    average = large.reshape(12, 3, size, fold, size, fold).mean((3, 5))
    errors = np.abs(render_pixels(states, size=size) - average)
    assert errors.mean() < 0.1  # of 255 grey levels; rounding alone may make 0.25 in non-flat parts
    assert np.quantile(errors, 0.999) < 4


@pytest.mark.parametrize("size", [8, 63, 64, 224])
def test_pictures_move_smoothly(size):
    """A thousandth of a pixel of the window changes no grey level by more than one."""
    states = scenes(5)
    moved = states + 1e-3 * np.array([1, 1, 1, 1, 0.01, 0, 0])
    assert np.abs(render_pixels(states, size=size).astype(int) - render_pixels(moved, size=size)).max() <= 1


@pytest.mark.parametrize("size", [8, 64, 224])
def test_batches_equal_single_pictures_to_the_bit(size):
    states = scenes(6)
    batch = render_pixels(states.reshape(2, 3, 7), size=size)
    assert batch.shape == (2, 3, 3, size, size) and batch.dtype == np.uint8
    for state, picture in zip(states, batch.reshape(6, 3, size, size), strict=True):
        assert (render_pixels(state, size=size) == picture).all()


def test_states_are_arrays_or_tensors_which_are_left_alone_and_pictures_belong_to_the_caller():
    states = scenes(2)
    given = states.copy()
    first = render_pixels(states, size=32)
    kept = first.copy()
    first[:] = 0
    assert (render_pixels(torch.from_numpy(states), size=32) == kept).all() and (states == given).all()
    assert render_pixels(np.empty((0, 7)), size=32).shape == (0, 3, 32, 32)
    for wrong, size, message in (
        (np.zeros(5), 32, r"states must be \[..., 7\], got \(5,\)"),
        (np.full(7, np.nan), 32, "states must be finite"),
        (states, 0, "size must be a positive integer, got 0"),
        (states, 2.5, "size must be a positive integer, got 2.5"),
    ):
        with pytest.raises(ValueError, match=message):
            render_pixels(wrong, size=size)
