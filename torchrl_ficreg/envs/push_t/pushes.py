"""Where the T can be pushed, and where a push takes it.

Contacts have no friction and the block rests unless it is touched, so a disc that moves by s along the inward normal n
of a face turns the block by a constant twist in the block's frame: with the lever tau = r x n about the centre of
gravity and the ratio k = moment / mass,

    centre:  s n / (1 + tau^2 / k)        angle:  (s tau / k) / (1 + tau^2 / k).

The disc is supposed to stay on the same point of the face, which then moves on a circle.
"""

from __future__ import annotations

import numpy as np

from torchrl_ficreg.envs.push_t.geometry import CENTER, leave
from torchrl_ficreg.envs.push_t.physics import BLOCK_MASS, BLOCK_MOMENT
from torchrl_ficreg.envs.push_t.shapes import AGENT_RADIUS

RATIO = BLOCK_MOMENT / BLOCK_MASS  # px^2
STAND_OFF = 14.0  # px between the disc's edge and the face where an approach ends

# first and last x (of horizontal faces) or y (of vertical ones), the other coordinate, number of contacts, inward normal
_FACES = (
    ((-52, 52), 0, 13, (0, 1)),  # top of the bar
    ((6, 24), 60, 3, (-1, 0)),  # ends of the bar
    ((6, 24), -60, 3, (1, 0)),
    ((31, 52), 30, 4, (0, -1)),  # underside of the bar, from the concave corners outwards
    ((-52, -31), 30, 4, (0, -1)),
    ((46, 112), 15, 9, (-1, 0)),  # sides of the stem
    ((46, 112), -15, 9, (1, 0)),
    ((-8, 8), 120, 3, (0, -1)),  # end of the stem
)


def _contacts() -> tuple[np.ndarray, np.ndarray]:
    points, normals = [], []
    for (first, last), other, number, normal in _FACES:
        for along in np.linspace(first, last, number):
            points.append((along, other) if normal[0] == 0 else (other, along))
            normals.append(normal)
    return np.array(points, float), np.array(normals, float)


POINTS, NORMALS = _contacts()  # [N, 2] each, in the block's frame; normals point into the block
LEVERS = (POINTS[:, 0] - CENTER[0]) * NORMALS[:, 1] - (POINTS[:, 1] - CENTER[1]) * NORMALS[:, 0]  # [N], px
STANDS = np.stack([leave(place) for place in POINTS - (AGENT_RADIUS + STAND_OFF) * NORMALS])  # [N, 2]


def pushed(pose: np.ndarray, contact: int | np.ndarray, depth: float | np.ndarray) -> np.ndarray:
    """The pose after a push.

    Args:
        pose: [3], of the block.
        contact: index of the contact, or an array of them.
        depth: px that the disc moves along the normal; broadcast against ``contact``.

    Returns:
        [..., 3]; the angle is not wrapped.

    Examples:
        Through the centre of gravity the block follows the disc; at a lever of 52 px it turns:

        >>> pushed(np.array([200.0, 200.0, 0.0]), 6, 10.0).tolist()
        [200.0, 210.0, 0.0]
        >>> pushed(np.array([200.0, 200.0, 0.0]), 12, 10.0).round(2).tolist()
        [203.86, 205.44, 0.09]
    """
    levers, normals = LEVERS[contact], NORMALS[contact]
    share = depth / (1 + levers**2 / RATIO)
    turn = share * levers / RATIO
    # Chord of the arc: half the turn, and shorter than the arc.
    chord = (share * np.sinc(turn / (2 * np.pi)))[..., None] * _turned(normals, pose[2] + turn / 2)
    angle = pose[2] + turn
    center = _turned(CENTER, pose[2]) + pose[:2] + chord
    origin = center - _turned(CENTER, angle)
    return np.concatenate([origin, np.asarray(angle)[..., None]], axis=-1)


def _turned(vectors: np.ndarray, angle: float | np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
