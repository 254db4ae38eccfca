"""The picture at 224 px is the published one; other sizes show the same scene."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_ficreg.envs.two_room.render import background, render_pixels

AGENT = torch.tensor([60.0, 160.0], dtype=torch.float64)


def test_walls_door_and_border_lie_on_the_published_pixels():
    """Wall columns 107-117, door rows 35-63, border lines at 10-13 and 210-213 (from the published drawing code)."""
    dark = background(224) == 0
    lines = [*range(10, 14), *range(210, 214)]
    assert torch.equal(background(224).unique(), torch.tensor([0.0, 255.0]))
    assert torch.nonzero(dark[100]).flatten().tolist() == sorted([*lines, *range(107, 118)])
    assert torch.nonzero(~dark[14:210, 112]).flatten().add(14).tolist() == list(range(35, 64))
    assert torch.nonzero(dark[:, 60]).flatten().tolist() == lines
    assert dark[0, 10:14].all()  # the lines reach the edge of the picture


def test_the_agent_is_a_soft_red_disc_with_a_pure_centre():
    """alpha = exp(-d^2 / (2 * 7^2)); on white, red stays 255 and the others are 255 * (1 - alpha), truncated.

    On the wall the disc lifts red from black.
    """
    picture = render_pixels(AGENT)
    for x, y, distance in ((60, 160, 0.0), (67, 160, 7.0), (63, 164, 5.0)):
        other = math.floor(255 * (1 - math.exp(-(distance**2) / 98)))
        assert picture[:, y, x].tolist() == [255, other, other]
    alpha = math.exp(-(10.5**2 - 0.25) / 98)  # column 110; divided by the alpha of the nearest column, 0.5 px away
    on_wall = render_pixels(torch.tensor([99.5, 160.0]))
    assert on_wall[:, 160, 110].tolist() == [math.floor(255 * alpha), 0, 0]


@pytest.mark.parametrize("size", [64, 96, 224])
def test_the_pixel_nearest_to_the_agent_is_pure_red_at_any_size(size):
    positions = 25 + 70 * torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pictures = render_pixels(positions, size=size)
    column, row = ((positions + 0.5) * size / 224 - 0.5).round().long().unbind(-1)
    centre = pictures[torch.arange(50), :, row, column]
    assert centre.tolist() == [[255, 0, 0]] * 50


@pytest.mark.parametrize("size", [56, 64, 112])
def test_a_smaller_background_is_the_average_of_the_published_one(size):
    """Its mean is kept at sizes that do not divide too."""
    torch.testing.assert_close(background(size).mean(), background(224).mean())
    if 224 % size == 0:
        pooled = torch.nn.functional.avg_pool2d(background(224)[None], 224 // size)[0]
        torch.testing.assert_close(background(size), pooled)


def test_the_disc_follows_the_agent_between_coarse_pixels():
    """At 64 px the centre of mass of the disc is where the agent is, to a tenth of a canvas pixel."""
    centers = (torch.arange(64, dtype=torch.float64) + 0.5) * 3.5 - 0.5
    for x in (58.0, 58.9, 60.3):
        picture = render_pixels(torch.tensor([x, 160.0], dtype=torch.float64), size=64)
        ink = 255.0 - picture[1, 40:52, 8:26].double()
        found = (ink.sum(0) * centers[8:26]).sum() / ink.sum()
        assert abs(found - x) < 0.1


def test_batches_equal_single_pictures_and_keep_their_shape():
    positions = torch.rand(2, 300, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 180 + 21
    pictures = render_pixels(positions, size=32)
    assert pictures.shape == (2, 300, 3, 32, 32) and pictures.dtype == torch.uint8
    for at in ((1, 299), (0, 7)):
        assert torch.equal(pictures[at], render_pixels(positions[at], size=32))


def test_the_goal_is_green_beneath_the_agent_and_absent_by_default():
    goal = torch.tensor([60.0, 40.0], dtype=torch.float64)
    assert render_pixels(AGENT, goal=goal)[:, 40, 60].tolist() == [0, 255, 0]
    assert render_pixels(AGENT, goal=AGENT)[:, 160, 60].tolist() == [255, 0, 0]
    assert render_pixels(AGENT)[:, 40, 60].tolist() == [255, 255, 255]


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="size must be a positive integer"):
        render_pixels(AGENT, size=0)
    with pytest.raises(ValueError, match="position must be"):
        render_pixels(torch.zeros(3))
    with pytest.raises(ValueError, match="goal must have the shape"):
        render_pixels(AGENT, goal=torch.zeros(4, 2))
