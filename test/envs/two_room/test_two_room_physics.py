"""The two rooms move as published, and with the swept rule nothing passes through a wall."""

from __future__ import annotations

import pytest
import torch

from torchrl_ficreg.envs.two_room.physics import in_wall, is_legal, step, TwoRoomGeometry
from torchrl_ficreg.envs.two_room.tasks import is_success

RULES = ["swept", "endpoint"]


def random_steps(count, seed=0):
    """Legal starts, half of them around the door, and actions up to twice the bounds."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    everywhere = 21 + 182 * unit
    near_door = torch.tensor([94.0, 25.0], dtype=torch.float64) + torch.tensor([36.0, 48.0]) * unit
    starts = torch.where(torch.arange(count)[:, None] % 2 == 0, near_door, everywhere)
    starts = starts[is_legal(starts)]
    actions = 4 * torch.rand(len(starts), 2, generator=generator, dtype=torch.float64) - 2
    return starts, actions


def test_geometry_is_the_published_one():
    """Border, faces, rest positions and door interval of the published environment (its source, 224 px canvas)."""
    geometry = TwoRoomGeometry()
    assert (geometry.low, geometry.high) == (21, 203)
    assert (geometry.face_left, geometry.face_right) == (100, 124)
    assert (geometry.rest_left, geometry.rest_right) == (99.5, 124.5)
    assert (geometry.door_low, geometry.door_high) == (33.25, 64.75)
    assert (geometry.speed, geometry.success_radius) == (5, 16)


@pytest.mark.parametrize(
    ("rules", "start", "action", "end"),
    [
        (RULES, [60, 112], [1, 0], [65, 112]),  # five pixels along each axis
        (RULES, [60, 112], [1, -1], [65, 107]),
        (RULES, [60, 112], [7, -3], [65, 107]),  # clipped
        (RULES, [60, 112], [0, 0], [60, 112]),
        (RULES, [22, 202], [-1, 1], [21, 203]),  # the border stops it one radius before the line
        (RULES, [15, 209], [0, 0], [21, 203]),  # a published start outside is moved in by any step
        (RULES, [98, 150], [1, 1], [99.5, 155]),  # the wall stops it at its rest position and lets it slide
        (RULES, [126, 150], [-1, -1], [124.5, 145]),
        *[(RULES, [98, y], [1, 0], [x, y]) for y, x in ((33.2, 99.5), (33.25, 103), (64.75, 103), (64.8, 99.5))],  # the door
        *[(RULES, [126, y], [-1, 0], [x, y]) for y, x in ((33.2, 124.5), (33.25, 121), (64.75, 121), (64.8, 124.5))],
        # Published: leaving the door's interval inside the corridor costs up to 11.5 px.
        (["endpoint"], [111, 64], [0, 1], [99.5, 69]),
        (["endpoint"], [113, 64], [0, 1], [124.5, 69]),
        (["swept"], [111, 64], [0, 1], [111, 64.75]),
        (["swept"], [113, 34], [0, -1], [113, 33.25]),
        # From (98, 68) to (103, 63) the segment meets the face at y = 66, which is outside the door.
        (["endpoint"], [98, 68], [1, -1], [103, 63]),
        (["swept"], [98, 68], [1, -1], [99.5, 63]),
        # From (103, 64) by (-5, +5) the jamb is met at y = 64.75, before the face at x = 100; else the face comes first.
        (["swept"], [103, 64], [-1, 1], [98, 64.75]),
        (["swept"], [100.5, 64], [-1, 1], [95.5, 69]),
    ],
)
def test_steps_are_the_published_ones_and_those_of_the_swept_rule(rules, start, action, end):
    start, action = (torch.tensor(value, dtype=torch.float64) for value in (start, action))
    assert [step(start, action, collision=rule).tolist() for rule in rules] == [end] * len(rules)


def test_a_swept_step_never_passes_through_the_obstacle_and_is_not_thrown_back():
    """101 points along each of 40,000 segments from the old to the new position are free.

    Each coordinate moves by 5 px at most, while the published rule moves one by over 11.
    """
    starts, actions = random_steps(40_000)
    ends = step(starts, actions)
    share = torch.linspace(0, 1, 101, dtype=torch.float64)[:, None, None]
    x, y = (starts + share * (ends - starts)).unbind(-1)  # [101, N]
    slack = 1e-9  # rounding of the points themselves
    assert not ((x > 100 + slack) & (x < 124 - slack) & ((y < 33.25 - slack) | (y > 64.75 + slack))).any()
    assert is_legal(ends).all() and (ends - starts).abs().max() <= 5 + 1e-9
    assert (step(starts, actions, collision="endpoint") - starts).abs().max() > 11


def test_the_rules_agree_bit_for_bit_away_from_the_jambs():
    """Out of reach of the slab, and well within the door's span, both rules give the same position."""
    starts, actions = random_steps(40_000, seed=2)
    x, y = starts.unbind(-1)
    easy = ((x - 112).abs() > 17) | ((y > 38.25) & (y < 59.75)) | (y < 28.25) | (y > 69.75)
    swept, endpoint = (step(starts, actions, collision=rule) for rule in RULES)
    assert torch.equal(swept[easy], endpoint[easy]) and not torch.equal(swept[~easy], endpoint[~easy])


@pytest.mark.parametrize("collision", RULES)
def test_mirrored_scenes_move_mirrored(collision):
    """The wall is symmetric about x = 112 on the 1/8 px grid, on which mirroring is exact."""
    starts, actions = random_steps(4_000, seed=3)
    starts, actions = (starts * 8).round() / 8, (actions * 8).round() / 8
    off_middle = is_legal(starts) & (starts[:, 0] != 112)
    starts, actions = starts[off_middle], actions[off_middle]
    flip = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    middle = torch.tensor([224.0, 0.0], dtype=torch.float64)
    there = step(middle + flip * starts, flip * actions, collision=collision)
    assert torch.equal(there, middle + flip * step(starts, actions, collision=collision))


@pytest.mark.parametrize("shape", [(), (6,), (2, 3)])
def test_batch_dimensions_and_dtype_are_free_and_inputs_unchanged(shape):
    starts, actions = torch.rand(*shape, 2) * 70 + 21, torch.rand(*shape, 2)
    before = starts.clone(), actions.clone()
    result = step(starts, actions)
    assert result.shape == (*shape, 2) and result.dtype == torch.float32
    one_by_one = [step(start, action) for start, action in zip(starts.reshape(-1, 2), actions.reshape(-1, 2))]
    assert torch.equal(result.reshape(-1, 2), torch.stack(one_by_one))
    assert torch.equal(starts, before[0]) and torch.equal(actions, before[1])


def test_success_is_strictly_closer_than_sixteen_pixels_and_only_the_obstacle_is_illegal():
    goal = torch.tensor([60.0, 60.0], dtype=torch.float64)
    near = goal + torch.tensor([[15.999, 0], [16, 0], [0, -16], [11.3, 11.3]], dtype=torch.float64)
    assert is_success(near, goal).tolist() == [True, False, False, True]
    points = torch.tensor([[100, 150], [124, 150], [112, 33.25], [112, 64.75], [112, 65], [100.01, 150]])
    assert in_wall(points).tolist() == [False, False, False, False, True, True]
    assert is_legal(torch.tensor([[14.0, 210.0], [13.9, 50.0], [float("nan"), 50.0]])).tolist() == [True, False, False]


def test_a_scene_that_steps_could_jump_across_is_refused():
    with pytest.raises(ValueError, match="speed must be positive and below the width of the wall"):
        TwoRoomGeometry(speed=24.0)
    with pytest.raises(ValueError, match="must lie within the border"):
        TwoRoomGeometry(door_center=30.0)
    with pytest.raises(ValueError, match="collision must be one of"):
        step(torch.zeros(2), torch.zeros(2), collision="bounce")
