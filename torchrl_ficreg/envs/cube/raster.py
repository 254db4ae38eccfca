"""Fast pictures of Cube on a CPU: a rasterizer in NumPy, without GL.

It draws what MuJoCo draws, with the same camera, colours, lights and shadows, from coarser meshes with flat faces. The
lights do not move, and the one that casts shadows shines straight down: the lit and the shadowed floor are computed
once, and a height map of the scene tells where its shadows are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchrl_ficreg.envs._gl import import_mujoco
from torchrl_ficreg.envs.cube.meshes import cluster_faces
from torchrl_ficreg.envs.cube.physics import NUM_POSITIONS

if TYPE_CHECKING:
    import mujoco

_SAMPLES = 2  # per pixel and axis
_FLOOR_SAMPLES, _LARGE_FLOOR_SAMPLES = 4, 2  # of the floor, per sample and axis, the latter in pictures beyond _LARGE
_LARGE = 128  # pixels
_CELL = 1.5  # pixels, largest cell of the grid that simplifies the meshes
_FINENESS = 0.25  # of a mesh's largest half extent; smaller cells are used below
_VIEW_HEIGHT = 0.66  # m, height of the view at the distance of the table's middle
_NEAR = 0.1  # m
_TILE = 2.0  # m, edge of the floor's texture
_MAP_LOW, _MAP_HIGH = np.array([-0.4, -0.65]), np.array([0.85, 0.65])  # x and y of the height map, m
_BIAS = 0.008  # m, by which something must be higher to cast a shadow
_FACE_BITS = 20  # of a key; the depth has the others
_STEPS = 2.0**24  # of a unit of depth
_FULL_SHINE = 128.0  # OpenGL's exponent at a shininess of 1
_SKY = (15.0, 16.0, 22.0)  # of 255, mean of the starry sky at the upper edge
_BOX = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])  # corners
_BOX_FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # counter-clockwise from outside


class FastScene:
    """Draws pictures of one size.

    Args:
        model (mujoco.MjModel): of :func:`torchrl_ficreg.envs.cube.physics.compiled`; not changed.
        camera (str): name of a camera that does not move.
        size (int): height and width of the pictures, in pixels.

    Raises:
        ValueError: ``size`` is not a positive integer.
    """

    def __init__(self, model: mujoco.MjModel, camera: str, size: int) -> None:
        if not isinstance(size, int) or isinstance(size, bool) or size < 1:
            raise ValueError(f"size must be a positive integer, got {size!r}.")
        self._mujoco = import_mujoco()
        self._model, self._size, self._width = model, size, size * _SAMPLES
        self._data = self._mujoco.MjData(model)
        self._mujoco.mj_kinematics(model, self._data)
        self._mujoco.mj_camlight(model, self._data)
        view = model.camera(camera).id
        right, up, back = self._data.cam_xmat[view].reshape(3, 3).T
        self._eye = self._data.cam_xpos[view].copy()
        self._axes = np.stack([right, -up, -back])  # [3, 3]: columns to the right, rows downwards, depth
        self._focal = 0.5 / np.tan(np.deg2rad(model.cam_fovy[view]) / 2)  # pictures high
        self._step = _VIEW_HEIGHT / self._width  # m, of the height map
        self._map_size = np.ceil((_MAP_HIGH - _MAP_LOW) / self._step).astype(int)  # [2], x and y
        self._lights = _Lights(model, self._data, self._eye, back)
        self._load_geoms()
        self._draw_floor()

    def _load_geoms(self) -> None:
        """Collects the visible geoms, sorted by body, as one list of vertices and one of faces."""
        model, mujoco = self._model, self._mujoco
        scene = mujoco.MjvScene(model, maxgeom=model.ngeom)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, self._data, mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, scene)
        shown = [geom for geom in scene.geoms[: scene.ngeom] if geom.type != mujoco.mjtGeom.mjGEOM_PLANE]
        shown.sort(key=lambda geom: model.geom_bodyid[geom.objid])
        vertices, faces, surfaces, bodies = [], [], [], []
        turn, count = np.empty(9), 0
        for geom in shown:
            if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
                mesh = model.mesh(model.geom_dataid[geom.objid])
                corners = model.mesh_vert[mesh.vertadr.item() :][: mesh.vertnum.item()]
                triangles = model.mesh_face[mesh.faceadr.item() :][: mesh.facenum.item()]
                largest = _VIEW_HEIGHT / self._size * _CELL
                cell = min(largest, max(geom.size.max() * _FINENESS, largest / 3))
                corners, triangles, _ = cluster_faces(corners, triangles, cell)
            else:
                corners, triangles = _BOX * geom.size, _BOX_FACES
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom.objid])
            vertices.append(corners @ turn.reshape(3, 3).T + model.geom_pos[geom.objid])
            faces.append(triangles + count)
            surface = [*geom.rgba[:3], geom.specular, geom.shininess * _FULL_SHINE]
            surfaces.append(np.tile(surface, (len(triangles), 1)))
            body = model.geom_bodyid[geom.objid]
            start = bodies.pop()[1].start if bodies and bodies[-1][0] == body else count
            count += len(corners)
            bodies.append((body, slice(start, count)))
        self._vertices = np.concatenate(vertices)  # [V, 3], in the frame of the body
        self._faces = np.ascontiguousarray(np.concatenate(faces).T)  # [3, F]
        self._surfaces = np.concatenate(surfaces)  # [F, 5]: colour, specular part, exponent
        self._bodies = bodies

    def _make_rays(self, width: int, rows: slice = slice(None)) -> np.ndarray:
        """Directions of the samples in some rows of a picture, [rows * width, 3], one unit deep."""
        centre = (np.arange(width) + 0.5) / width - 0.5
        down, across = np.meshgrid(centre[rows], centre, indexing="ij")  # [rows, width]
        return np.stack([across, down, np.full_like(down, self._focal)], -1).reshape(-1, 3) / self._focal @ self._axes

    def _floor_places(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays [N, 3] meet the plane of the floor, [N, 3] in m, and whether they do, [N] bool."""
        below = rays[:, 2] < 0
        depth = np.where(below, -self._eye[2] / np.where(below, rays[:, 2], -1.0), 0.0)
        place = self._eye + depth[:, None] * rays
        return place, below & (np.abs(place[:, :2]) <= self._model.geom("floor").size[:2]).all(1)

    def _draw_floor(self) -> None:
        """Computes the picture without arm and cube in light and in shadow, and the cells of the height map below."""
        model = self._model
        material = model.mat(model.geom("floor").matid.item())
        texture = model.tex(material.texid[self._mujoco.mjtTextureRole.mjTEXROLE_RGB.value])
        shape = texture.height.item(), texture.width.item(), 3
        texels = model.tex_data[texture.adr.item() :][: np.prod(shape)].reshape(shape)[::-1].astype(np.float64)
        for axis in (0, 1):
            texels = _blur(texels, axis, _VIEW_HEIGHT / self._size / (_TILE / shape[axis]))
        surface = np.array([[1.0, 1.0, 1.0, material.specular.item(), material.shininess.item() * _FULL_SHINE]])
        up = np.array([[0.0, 0.0, 1.0]])

        self._shadowed, self._lit = np.empty((2, 3, self._width, self._width), np.float32)
        fine = _LARGE_FLOOR_SAMPLES if self._size > _LARGE else _FLOOR_SAMPLES
        for row in range(self._width):  # each with several rows of finer samples
            rays = self._make_rays(self._width * fine, slice(row * fine, (row + 1) * fine))
            place, seen = self._floor_places(rays)
            across, down = np.floor((place[:, :2] / _TILE + 0.5) % 1 * shape[:2]).astype(np.int64).T
            ambient, sun = self._lights.shade(place, up, surface)
            for picture, light in ((self._shadowed, ambient), (self._lit, ambient + sun)):
                colours = np.where(seen[:, None], np.minimum(light * texels[down, across], 255.0), _SKY)
                blocks = colours.reshape(fine, self._width, fine, 3)
                picture[:, row] = blocks.mean((0, 2)).T
        self._shadowed, self._lit = self._shadowed.reshape(3, -1), self._lit.reshape(3, -1)

        self._rays = self._make_rays(self._width)  # [W * W, 3]
        place, seen = self._floor_places(self._rays)
        cells = self._map_cells(place)
        self._floor = np.flatnonzero(seen & (cells >= 0))
        self._floor_cells = cells[self._floor]
        self._rays = self._rays.astype(np.float32)

    def _map_cells(self, place: np.ndarray) -> np.ndarray:
        """Flat indices [N] into the height map of places [N, 3], -1 outside."""
        column, row = ((place[:, axis] - _MAP_LOW[axis]) / self._step for axis in (0, 1))
        inside = (column >= 0) & (column < self._map_size[0]) & (row >= 0) & (row < self._map_size[1])
        return np.where(inside, row.astype(np.int64) * self._map_size[0] + column.astype(np.int64), -1)

    def draw(self, state: np.ndarray) -> np.ndarray:
        """Draws one state.

        Args:
            state (np.ndarray): [41] float64.

        Returns:
            [3, size, size] uint8.
        """
        world = self._place_vertices(state)  # [V, 3]
        height = np.maximum(world[:, 2], 0.0)
        heights = _rasterize(np.stack([*((world[:, :2] - _MAP_LOW) / self._step).T, height]), self._faces, *self._map_size)

        seen = self._axes @ (world - self._eye).T  # [3, V]
        nearness = 1.0 / np.where(seen[2] > _NEAR, seen[2], np.nan)  # linear in the picture, unlike the depth
        seen[:2] *= nearness * (self._focal * self._width)
        seen[:2] += self._width / 2
        seen[2] = nearness
        # Rows are counted downwards here: with corners in reverse order visible faces are counter-clockwise again.
        keys = _rasterize(seen, self._faces[::-1], self._width, self._width)  # [W * W]

        picture = self._lit.copy()  # [3, W * W]
        dark = self._floor[heights[self._floor_cells] > _key(_BIAS)]
        picture[:, dark] = self._shadowed[:, dark]
        hit = np.flatnonzero(keys)  # [H]
        keys = keys[hit]
        face = keys & (1 << _FACE_BITS) - 1  # [H]
        place = self._eye + self._rays[hit] * (_STEPS / (keys >> _FACE_BITS))[:, None]  # [H, 3]
        cells = self._map_cells(place)
        lit = (cells < 0) | (heights[cells] < _key(place[:, 2] + _BIAS))  # [H]
        colours, number = self._shade(world, face)  # [3, 2 K], [H]
        picture[:, hit] = colours[:, number + colours.shape[1] // 2 * lit]
        return self._shrink(picture)

    def _place_vertices(self, state: np.ndarray) -> np.ndarray:
        """The vertices at a state, [V, 3] in m."""
        data = self._data
        data.qpos[:] = state[:NUM_POSITIONS]
        self._mujoco.mj_kinematics(self._model, data)
        world = np.empty_like(self._vertices)  # [V, 3]
        for body, rows in self._bodies:
            np.matmul(self._vertices[rows], data.xmat[body].reshape(3, 3).T, out=world[rows])
            world[rows] += data.xpos[body]
        return world

    def _shade(self, world: np.ndarray, face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colours of K visible faces in the shadow and in light, [3, 2 K] of 255, and the index of each sample, [H]."""
        number = np.zeros(self._faces.shape[1], np.int64)  # [F]
        number[face] = 1
        shown = np.flatnonzero(number)  # [K]
        number[shown] = np.arange(len(shown))
        corners = world[self._faces[:, shown]]  # [3, K, 3]
        normal = _unit(_cross(corners[1] - corners[0], corners[2] - corners[0]))
        ambient, sun = self._lights.shade((corners[0] + corners[1] + corners[2]) / 3, normal, self._surfaces[shown])  # [K, 3]
        return np.concatenate([ambient, np.minimum(ambient + sun, 1.0)]).T * 255, number[face]

    def _shrink(self, picture: np.ndarray) -> np.ndarray:
        """Averages the samples [3, W * W] of each pixel."""
        rows = picture.reshape(3, self._size, _SAMPLES, self._width).sum(2)  # [3, size, W]
        total = sum(rows[:, :, start::_SAMPLES] for start in range(_SAMPLES))  # [3, size, size]
        return (total / _SAMPLES**2 + 0.5).astype(np.uint8)


def _key(value: np.ndarray | float) -> np.ndarray:
    """The smallest key of a value."""
    return np.asarray(value * _STEPS).astype(np.int64) << _FACE_BITS


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The cross products of two [N, 3] arrays, much faster than NumPy's for small ones."""
    (a, b, c), (d, e, f) = first.T, second.T
    return np.stack([b * f - c * e, c * d - a * f, a * e - b * d], 1)


def _rasterize(points: np.ndarray, faces: np.ndarray, width: int, height: int) -> np.ndarray:
    """Finds the face with the largest value at each point of a grid.

    Args:
        points (np.ndarray): [3, V]: x and y of the vertices in cells of the grid, and their values, not negative. Faces
            with a vertex at NaN are not drawn.
        faces (np.ndarray): [3, F] int64, drawn where they are counter-clockwise as x and y grow.
        width (int): number of cells along x.
        height (int): number of cells along y.

    Returns:
        [height * width] int64, the value in units of ``1 / _STEPS`` shifted by ``_FACE_BITS``, plus the face; 0 where
        there is none.
    """
    (x0, x1, x2), (y0, y1, y2), (v0, v1, v2) = (row[faces] for row in points)  # [F] each
    area = (y1 - y2) * (x0 - x2) + (x2 - x1) * (y0 - y2)
    left = np.maximum(np.ceil(np.minimum(np.minimum(x0, x1), x2) - 0.5), 0)
    top = np.maximum(np.ceil(np.minimum(np.minimum(y0, y1), y2) - 0.5), 0)
    columns = np.minimum(np.floor(np.maximum(np.maximum(x0, x1), x2) + 0.5), width) - left
    rows = np.minimum(np.floor(np.maximum(np.maximum(y0, y1), y2) + 0.5), height) - top
    kept = np.flatnonzero((area > 1e-9) & (columns > 0) & (rows > 0))  # [K]
    x1, x2, y1, y2, v0, v1, v2, left, top, columns, rows, x0, y0 = (
        part[kept] for part in (x1, x2, y1, y2, v0, v1, v2, left, top, columns, rows, x0, y0)
    )
    scale = 1 / area[kept]
    across, down = left + 0.5 - x2, top + 0.5 - y2
    # Barycentric weights of the first two corners in the box's first cell, and their slopes.
    a0, b0, a1, b1 = (y1 - y2) * scale, (x2 - x1) * scale, (y2 - y0) * scale, (x0 - x2) * scale
    table = np.stack([a0 * across + b0 * down, a0, b0, a1 * across + b1 * down, a1, b1, columns]).astype(np.float32)

    sizes = (columns * rows).astype(np.int64)
    owner = np.repeat(np.arange(len(kept)), sizes)  # [N]
    offset = (np.arange(len(owner)) - np.repeat(np.cumsum(sizes) - sizes, sizes)).astype(np.float32)
    first, first_x, first_y, second, second_x, second_y, wide = (part.take(owner) for part in table)
    row = np.floor((offset + np.float32(0.5)) / wide)
    column = offset - row * wide
    first = first + first_x * column + first_y * row
    second = second + second_x * column + second_y * row
    inside = np.flatnonzero((first >= 0) & (second >= 0) & (first + second <= 1))  # [M]
    owner, first, second = owner[inside], first[inside], second[inside]
    cell = ((top[owner] + row[inside]) * width + left[owner] + column[inside]).astype(np.int64)
    value = v2[owner] + first * (v0 - v2)[owner] + second * (v1 - v2)[owner]
    keys = np.zeros(width * height, np.int64)
    np.maximum.at(keys, cell, _key(value) + kept[owner])
    return keys


class _Lights:
    """OpenGL's lights of a scene, in two parts: those in the shadow, and the one that casts it.

    Args:
        model (mujoco.MjModel): the model.
        data (mujoco.MjData): with the poses of its lights.
        eye (np.ndarray): [3], place of the camera, in m.
        back (np.ndarray): [3], direction against the view.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, eye: np.ndarray, back: np.ndarray) -> None:
        head = model.vis.headlight
        self._eye, self._ambient = eye, head.ambient
        # Direction or place, whether it is a place, diffuse, specular, whether it casts shadows.
        self._lights = [(back, False, head.diffuse[0], head.specular[0], False)]
        for light in range(model.nlight):
            placed = model.light_type[light] != 1
            self._lights.append((
                data.light_xpos[light] if placed else -data.light_xdir[light],
                placed,
                model.light_diffuse[light][0],
                model.light_specular[light][0],
                bool(model.light_castshadow[light]),
            ))

    def shade(self, place: np.ndarray, normal: np.ndarray, surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The brightness of surfaces in the shadow, and what the light that casts it adds.

        Args:
            place (np.ndarray): [N, 3], in m.
            normal (np.ndarray): [N or 1, 3], of unit length.
            surface (np.ndarray): [N or 1, 5]: colour, specular part, exponent.

        Returns:
            two [N, 3] arrays, 1 for white.
        """
        to_eye = _unit(self._eye - place)
        parts = [surface[:, :3] * self._ambient[0], 0.0]
        for where, placed, diffuse, specular, casts in self._lights:
            to_light = _unit(where - place) if placed else where[None]
            slope = np.maximum((normal * to_light).sum(1), 0.0)  # [N or 1]
            colour = surface[:, :3] * (diffuse * slope)[:, None]
            if specular:
                gleam = np.maximum((normal * _unit(to_eye + to_light)).sum(1), 0.0) ** surface[:, 4]
                colour = colour + (np.where(slope > 0, gleam, 0.0) * specular * surface[:, 3])[:, None]
            parts[casts] = parts[casts] + colour
        return np.minimum(parts[0], 1.0), np.minimum(parts[1], 1.0)


def _blur(texels: np.ndarray, axis: int, width: float) -> np.ndarray:
    """Averages texels over the width of a pixel, in texels, as the smaller copies of a texture do in OpenGL."""
    reach = max(1, round(width))
    ends = (0.5, 1.0) if reach > 1 else (0.125, 0.75)
    half = (reach + 1) // 2
    weights = np.full(2 * half + 1, ends[1])
    weights[[0, -1]] = ends[0]
    return sum(w * np.roll(texels, shift - half, axis) for shift, w in enumerate(weights / weights.sum()))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.sqrt(np.einsum("ni,ni->n", vectors, vectors))[:, None]
