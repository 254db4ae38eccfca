"""Angles on the circle, for every environment that compares or stores them."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

_TURN = 2 * np.pi

Angle = TypeVar("Angle", float, np.ndarray)


def wrap_angle(angle: Angle, low: float = -np.pi) -> Angle:
    """Brings angles into one turn, ``[low, low + 2 pi)``.

    Args:
        angle (float or np.ndarray): [...], in rad.
        low (float, optional): lower end of the turn, in rad. Default: ``-pi``.

    Returns:
        [...], as ``angle``; with ``low=0``, angles that are in the turn already keep their bits.

    Examples:
        >>> wrap_angle(-1e-20, low=0.0), wrap_angle(7.0, low=0.0) == 7.0 - 2 * np.pi
        (0.0, True)
        >>> wrap_angle(np.array([0.1 - 6.2, 3.0])).round(3).tolist()
        [0.183, 3.0]
    """
    wrapped = (angle - low) % _TURN
    return wrapped - _TURN * (wrapped >= _TURN) + low  # the remainder of a tiny negative number rounds up to the turn
