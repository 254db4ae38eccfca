"""Pictures of Reacher without GL: dm_control's scene, in a few hundred array operations.

The scene without the arm does not change and is stored. Links and finger are drawn into it as exact perspective views of
capsules and a sphere, with the lights of the scene, the shadow and the mirror image on the ground. As in GL with
multisampling, coverage is tested at four points of a pixel and light is computed once per pixel.

At 64 px the mean absolute difference from MuJoCo's picture is 0.16 of 255 grey levels; turning both joints by 0.005 rad
changes MuJoCo's picture as much. MuJoCo interpolates light between the corners of its meshes, which are smaller than a
pixel, and the links cast shadows on each other there.
"""

from __future__ import annotations

import functools
import importlib.resources
import math

import numpy as np

LINK, FINGER_DISTANCE = 0.12, 0.12  # m, from shoulder to wrist, and from the wrist to the finger's centre
HAND = 0.10  # m, length of the hand's axis
RADIUS, HEIGHT = 0.01, 0.01  # m, of links and finger, and of their centres above the ground
ROOT_RADIUS, ROOT_HEIGHT = 0.011, 0.02  # m
CAMERA_HEIGHT, LIGHT_HEIGHT = 0.75, 1.0  # m, both above the root, looking down
FIELD_OF_VIEW = math.radians(45.0)

_LINK_COLOR, _FINGER_COLOR = (0.7, 0.5, 0.3), (0.7, 0.4, 0.2)
_ROOT_COLOR = (197.0, 255.0, 255.0)  # lit
_SHADOW_COLOR = (25.5, 51.0, 76.5)  # of the ground where the headlight alone reaches it
_AMBIENT, _HEADLIGHT, _LIGHT = 0.4, 0.8, 0.7
_HEADLIGHT_SHINE, _LIGHT_SHINE = 0.05, 0.15  # specular light times the material's specularity
_SHINE_DOUBLINGS = 6  # shininess 64
_REFLECTANCE = 0.2  # of the ground; the mirror image shows the underside, which ambient light alone reaches

# Multisampling points of a pixel, right and down from its corner, and its middle, where light is computed.
_SAMPLES = np.array([[0.375, 0.875], [0.875, 0.625], [0.125, 0.375], [0.625, 0.125], [0.5, 0.5]])
_SHARE = np.float32(0.25)
_RADIUS, _RADIUS2 = np.float32(RADIUS), np.float32(RADIUS**2)
_LENGTHS = np.array([LINK, HAND, 0.0], np.float32)[:, None, None]  # [3, 1, 1], of the axes
_FAR = 0.0175  # m from the axes of the arm beyond which nothing changes: radius, perspective and mirror image
_BACKGROUND = "background.npz"


def render_pixels(states: np.ndarray, *, size: int = 64) -> np.ndarray:
    """Draws postures of the arm.

    Args:
        states (np.ndarray): [..., 4] or [..., 2], angles of shoulder and wrist in rad first; velocities are not drawn.
        size (int, optional): height and width of the pictures, in pixels. Default: ``64``.

    Returns:
        [..., 3, size, size] uint8, red, green, blue; a new array.

    Raises:
        ValueError: ``size`` is not a positive integer, the shape is wrong, or an angle is not finite.

    Examples:
        >>> picture = render_pixels(np.array([0.0, np.pi / 2]), size=64)
        >>> picture.shape, picture[:, 32, 32].tolist()  # the root
        ((3, 64, 64), [197, 255, 255])
    """
    states = np.asarray(states, dtype=np.float64)
    if states.shape[-1:] not in ((2,), (4,)):
        raise ValueError(f"states must be [..., 4] or [..., 2], got {states.shape}: pass the angles first.")
    angles = states[..., :2].reshape(-1, 2)  # [N, 2]
    if not np.isfinite(angles).all():
        raise ValueError("angles must be finite: look for a NaN in the states.")
    canvas = _canvas(size)
    pictures = np.empty((len(angles), 3, size, size), dtype=np.uint8)
    for (shoulder, wrist), picture in zip(angles.tolist(), pictures, strict=True):
        canvas.draw(shoulder, shoulder + wrist, picture)
    return pictures.reshape(*states.shape[:-1], 3, size, size)


@functools.lru_cache(maxsize=16, typed=True)  # 64.0 and True are not sizes
def _canvas(size: int) -> _Canvas:
    return _Canvas(size)


class _Canvas:
    """Draws pictures of one size. Lengths are in m, in the plane of the arm's axes: x to the right, y up, 0 at the root.

    Three shapes are computed as one batch: the two links, segments with a radius, and the finger, one of length 0.
    """

    def __init__(self, size: int) -> None:
        if not isinstance(size, (int, np.integer)) or isinstance(size, bool) or size < 1:
            raise ValueError(f"size must be a positive integer, got {size!r}.")
        self.size = int(size)
        self.depth = CAMERA_HEIGHT - HEIGHT  # of the plane below the camera
        self.half = self.depth * math.tan(FIELD_OF_VIEW / 2)  # of the width of the view
        self.pixel = 2 * self.half / size
        self.far = _FAR + 0.75 * self.pixel
        self.grid = ((np.arange(size) + 0.5) * self.pixel - self.half).astype(np.float32)  # [size], middles of pixels
        self.right, self.down = ((_SAMPLES - 0.5) * self.pixel).astype(np.float32).T[..., None]  # [5, 1] each
        # A point of the plane, on the ray of a sample, is carried on to the ground and then towards the light; and on
        # to the plane of the mirrored axes below the ground.
        shadow = CAMERA_HEIGHT / self.depth * (LIGHT_HEIGHT - HEIGHT) / LIGHT_HEIGHT
        self.scales = np.array([shadow, (CAMERA_HEIGHT + HEIGHT) / self.depth], np.float32).reshape(2, 1, 1, 1)
        # The root hides the arm: the scene is split into its cover and the floor behind it.
        self.empty = empty_scene(size)  # [3, size, size] uint8
        x, y = self.grid + self.right[:4, :, None], -self.grid[:, None] - self.down[:4, :, None]
        radius = ROOT_RADIUS * self.depth / (CAMERA_HEIGHT - ROOT_HEIGHT)
        self.root = (x * x + y * y < np.float32(radius**2)).mean(0, dtype=np.float32).ravel()  # [size * size]
        behind = self.empty.reshape(3, -1) - self.root * _column(_ROOT_COLOR)
        self.floor = behind / np.maximum(1 - self.root, _SHARE)  # [3, size * size] float32; unused where the root is all

    def draw(self, shoulder: float, hand: float, picture: np.ndarray) -> None:
        """Draws the arm, whose links point to two angles in rad, into ``picture`` [3, size, size] uint8."""
        np.copyto(picture, self.empty)
        first, second = (math.cos(shoulder), math.sin(shoulder)), (math.cos(hand), math.sin(hand))
        wrist = LINK * first[0], LINK * first[1]
        finger = wrist[0] + FINGER_DISTANCE * second[0], wrist[1] + FINGER_DISTANCE * second[1]
        left, right = self._pixels(0.0, wrist[0], finger[0])
        top, bottom = self._pixels(0.0, -wrist[1], -finger[1])
        x, y = self.grid[left:right], -self.grid[top:bottom, None]
        near = _square_distance(x, y, (0.0, 0.0), first, LINK) < self.far**2
        near |= _square_distance(x, y, wrist, second, FINGER_DISTANCE) < self.far**2  # [h, w]
        rows, columns = near.nonzero()  # [P] each
        pixels = (rows + top) * self.size + (columns + left)
        axes = np.array([(0.0, 0.0, *first), (*wrist, *second), (*finger, *second)], np.float32).T[..., None, None]
        colors = self._colors(x[columns] + self.right, y[rows, 0] - self.down, axes, self.floor[:, pixels])
        colors += (_column(_ROOT_COLOR) - colors) * self.root[pixels]
        picture.reshape(3, -1)[:, pixels] = np.rint(colors)

    def _pixels(self, *positions: float) -> tuple[int, int]:
        """First pixel and the one after the last that the arm between some positions along one axis can change."""
        start = int((min(positions) - self.far + self.half) / self.pixel)
        return max(start, 0), int((max(positions) + self.far + self.half) / self.pixel) + 1

    def _colors(self, x: np.ndarray, y: np.ndarray, axes: np.ndarray, floor: np.ndarray) -> np.ndarray:
        """Colours of P pixels.

        Args:
            x, y: [5, P] each, the samples.
            axes: [4, 3, 1, 1], where the axis of each shape begins, x and y, and its direction.
            floor: [3, P], colours without the arm.

        Returns:
            [3, P] float32, in grey levels.
        """
        begin_x, begin_y, along_x, along_y = axes
        # The ray that meets the plane at q passes the point q - v of the plane at the squared distance
        # v.v - k (v.q)^2 with k = 1 / (q.q + depth^2). Here q - v is the point of an axis for which this is least.
        k = 1 / (x * x + y * y + np.float32(self.depth**2))  # [5, P]
        vx, vy = x - begin_x, y - begin_y  # [3, 5, P], as all below
        slope = along_x * x + along_y * y
        bent = slope * k
        where = (vx * along_x + vy * along_y - bent * (vx * x + vy * y)) / (1 - bent * slope)
        where = np.minimum(np.maximum(where, 0), _LENGTHS)
        vx -= where * along_x
        vy -= where * along_y
        inward = vx * x + vy * y
        distance = vx * vx + vy * vy - inward * inward * k
        # All axes are in one plane: the shape nearest to the ray is in front.
        links = np.minimum(distance[0], distance[1])  # [5, P]
        is_finger = distance[2] < links
        cover = (np.minimum(links, distance[2])[:4] < _RADIUS2).sum(0, dtype=np.float32) * _SHARE  # [P]
        is_finger = is_finger[4]  # [P], in the middle of the pixel
        front = np.where(is_finger, 2, distance[1, 4] < distance[0, 4])  # [P], index of the shape
        chosen = front, 4, np.arange(len(front))
        along = along_x[front, 0, 0] * ~is_finger, along_y[front, 0, 0] * ~is_finger
        color = np.where(is_finger, _column(_FINGER_COLOR), _column(_LINK_COLOR))  # [3, P]
        lit = self._lit(x[4], y[4], k[4], vx[chosen], vy[chosen], inward[chosen], *along, color)
        shadow, mirror = self._on_ground(x[:4], y[:4], axes)
        floor += (_column(_SHADOW_COLOR) - floor) * shadow
        floor += color * (mirror * np.float32(255 * _REFLECTANCE * _AMBIENT))
        return floor + (lit - floor) * cover

    def _on_ground(self, x: np.ndarray, y: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Shares [2, P] of pixels in the shadow and in the mirror image of the arm; ``x``, ``y`` [4, P] are samples."""
        begin_x, begin_y, along_x, along_y = axes
        vx, vy = x * self.scales - begin_x, y * self.scales - begin_y  # [2, 3, 4, P]
        where = np.minimum(np.maximum(vx * along_x + vy * along_y, 0), _LENGTHS)
        vx -= where * along_x
        vy -= where * along_y
        hit = (vx * vx + vy * vy < _RADIUS2).any(1)  # [2, 4, P]
        return hit.sum(1, dtype=np.float32) * _SHARE

    def _lit(
        self,
        x: np.ndarray,
        y: np.ndarray,
        k: np.ndarray,
        vx: np.ndarray,
        vy: np.ndarray,
        inward: np.ndarray,
        along_x: np.ndarray,
        along_y: np.ndarray,
        color: np.ndarray,
    ) -> np.ndarray:
        """Colours [3, P] of the shape in front; beyond its outline, those of the outline.

        The arguments are those of :meth:`_colors` in the middle of the pixels, [P] each; the finger has no direction.
        """
        # Of the normal, the part w from the axis to the nearest point of the ray, and the part towards the camera.
        inward = inward * k
        wx, wy, wz = (vx - x * inward) / _RADIUS, (vy - y * inward) / _RADIUS, inward * (self.depth / _RADIUS)
        outside = wx * wx + wy * wy + wz * wz  # beyond 1 outside of the outline
        k = np.sqrt(k)
        slope = (x * along_x + y * along_y) * k
        bx, by, bz = slope * along_x - x * k, slope * along_y - y * k, k * np.float32(self.depth)
        front = np.sqrt(np.maximum(1 - outside, 0) / (bx * bx + by * by + bz * bz))
        shrink = 1 / np.sqrt(np.maximum(outside, 1))
        nx, ny, nz = wx * shrink + front * bx, wy * shrink + front * by, wz * shrink + front * bz
        # The point (px, py, pz) of the surface; camera and light are above the root.
        px, py, pz = x - vx + _RADIUS * nx, y - vy + _RADIUS * ny, np.float32(HEIGHT) + _RADIUS * nz
        to_camera, to_light = np.float32(CAMERA_HEIGHT) - pz, np.float32(LIGHT_HEIGHT) - pz
        across, tilt = px * px + py * py, px * nx + py * ny
        camera_inverse = 1 / np.sqrt(across + to_camera * to_camera)
        light_inverse = 1 / np.sqrt(across + to_light * to_light)
        facing_camera = (to_camera * nz - tilt) * camera_inverse  # cosines, as all below
        facing_light = (to_light * nz - tilt) * light_inverse
        between = (across + to_camera * to_light) * camera_inverse * light_inverse
        spot = to_light * light_inverse
        spot = _power(spot, 3) * spot * spot  # exponent 10
        # The headlight shines straight down. GL limits the sum of its parts to 1.
        shine = _HEADLIGHT_SHINE * _shine(facing_camera + nz, 2 + 2 * to_camera * camera_inverse)
        total = np.minimum(color * (_AMBIENT + _HEADLIGHT * np.maximum(nz, 0)) + shine, 1)
        shine = _LIGHT_SHINE * spot * _shine(facing_camera + facing_light, 2 + 2 * between)
        total += color * (_LIGHT * spot * np.maximum(facing_light, 0)) + shine
        return np.minimum(total, 1) * np.float32(255)


def empty_scene(size: int) -> np.ndarray:
    """MuJoCo's picture of the scene without the arm: root, ground, walls and their mirror images.

    Args:
        size (int): height and width, in pixels.

    Returns:
        [3, size, size] uint8: the stored picture of this size, or else the largest one, sampled at four points of each
        pixel.
    """
    with importlib.resources.files(__package__).joinpath(_BACKGROUND).open("rb") as file, np.load(file) as stored:
        sizes = [int(name) for name in stored.files]
        source = size if size in sizes else max(sizes)
        # Stored as differences between neighbours, which compress to a third.
        picture = stored[str(source)].cumsum(1, dtype=np.uint8).cumsum(2, dtype=np.uint8)
    if source == size:
        return picture
    right, down = ((np.arange(size) + _SAMPLES[:4, :, None]) * (source / size)).astype(int).transpose(1, 0, 2)  # [4, size]
    samples = picture[:, down[:, :, None], right[:, None, :]]  # [3, 4, size, size]
    return np.rint(samples.mean(1, dtype=np.float32)).astype(np.uint8)


def _square_distance(
    x: np.ndarray, y: np.ndarray, begin: tuple[float, float], along: tuple[float, float], length: float
) -> np.ndarray:
    """Squared distances of points from a segment in the plane."""
    along_x, along_y = np.float32(along[0]), np.float32(along[1])
    x, y = x - np.float32(begin[0]), y - np.float32(begin[1])
    where = np.minimum(np.maximum(x * along_x + y * along_y, 0), np.float32(length))
    return np.square(x - where * along_x) + np.square(y - where * along_y)


def _shine(cosines: np.ndarray, square_length: np.ndarray) -> np.ndarray:
    """Blinn's specular factor: the sum of the normal's cosines with view and light, and |view + light|^2."""
    return _power(np.maximum(cosines, 0) / np.sqrt(square_length), _SHINE_DOUBLINGS)


def _power(values: np.ndarray, doublings: int) -> np.ndarray:
    """``values`` to the power of ``2**doublings``."""
    for _ in range(doublings):
        values = values * values
    return values


def _column(color: tuple[float, float, float]) -> np.ndarray:
    return np.array(color, dtype=np.float32)[:, None]
