"""Sculpted shapes: lumps given by signed distances, joined smoothly, cut, roughened, and turned into a mesh."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtgs.scenes.synthetic.description import Part, Shape
from rtgs.scenes.synthetic.textures import fractal_noise

Grid = NDArray[np.floating]


def sculpt(shape: Shape) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """Vertices (V, 3) in the shape's frame, unit outward normals (V, 3), faces (F, 3).

    The zero set of the joined distances on a grid of ``shape.cell``, by marching cubes; normals are the gradient.

    Raises:
        ValueError: nothing is left after the cuts.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates
    from skimage.measure import marching_cubes

    low, high = _bounds(shape)
    axes = [np.arange(low[k], high[k] + shape.cell, shape.cell, dtype=np.float32) for k in range(3)]
    field = signed_distance(shape, *np.meshgrid(*axes, indexing="ij", sparse=True))
    if field.min() >= 0:
        raise ValueError(f"shape {shape.name!r}: nothing is left of its parts on a grid of {shape.cell} m")
    corners, faces, _, _ = marching_cubes(field, 0.0)
    smooth = gaussian_filter(field, 1.0)  # facets of the grid would show in a mirror
    slope = [np.gradient(smooth, axis=k) for k in range(3)]
    normals = np.stack([map_coordinates(s, corners.T, order=1) for s in slope], -1).astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    a, b, c = (corners[faces[:, k]] for k in range(3))
    outward = np.einsum("fk,fk->", np.cross(b - a, c - a), normals[faces[:, 0]]) > 0
    vertices = low + corners.astype(np.float64) * shape.cell
    return vertices, normals, np.ascontiguousarray(faces if outward else faces[:, ::-1]).astype(np.int32)


def signed_distance(shape: Shape, x: Grid, y: Grid, z: Grid) -> Grid:
    """Joined distance of all parts at points that broadcast to (X, Y, Z); negative inside. Exact near single lumps."""
    field = None
    for part in shape.parts:
        distance = _part_distance(part, x, np.abs(y) if part.mirror else y, z)
        if field is None:
            field = distance
        elif part.cut:
            field = -_smooth_minimum(-field, distance, part.blend)
        else:
            field = _smooth_minimum(field, distance, part.blend)
    assert field is not None, "read_description refuses a sculpt without parts"
    size = tuple(np.broadcast_shapes(x.shape, y.shape, z.shape))
    field = np.array(np.broadcast_to(field, size), np.float32)
    return field + _relief(shape, x, y, z) if shape.relief else field


def _part_distance(part: Part, x: Grid, y: Grid, z: Grid) -> Grid:
    x, y, z = x - part.position[0], y - part.position[1], z - part.position[2]
    if part.turn:
        cosine, sine = np.cos(np.radians(part.turn)), np.sin(np.radians(part.turn))
        x, y = cosine * x + sine * y, cosine * y - sine * x
    if part.tilt:
        cosine, sine = np.cos(np.radians(part.tilt)), np.sin(np.radians(part.tilt))
        x, z = cosine * x - sine * z, cosine * z + sine * x
    a, b, c = part.size
    if part.form == "ellipsoid":
        near = np.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2)
        slope = np.sqrt((x / a**2) ** 2 + (y / b**2) ** 2 + (z / c**2) ** 2)
        return near * (near - 1) / np.maximum(slope, 1e-6)
    if part.form == "box":
        return _rounded((np.abs(x) - a, np.abs(y) - b, np.abs(z) - c), part.round)
    bulge = np.maximum(1 - part.taper * z - part.bow * x**2, 0.1)
    return _rounded((_polygon_distance(part.outline, x, z), np.abs(y) - b * bulge), part.round)


def _rounded(sides: tuple[Grid, ...], radius: float) -> Grid:
    """Distance to the intersection of half spaces at right angles with edges of ``radius``."""
    outside = sum(np.maximum(side + radius, 0) ** 2 for side in sides)
    inside = sides[0]
    for side in sides[1:]:
        inside = np.maximum(inside, side)
    return np.sqrt(outside) + np.minimum(inside + radius, 0) - radius


def _polygon_distance(outline: tuple[tuple[float, float], ...], x: Grid, z: Grid) -> Grid:
    """Signed distance to a closed polygon with its corners cut five times (Chaikin 1974): a smooth curve inside it."""
    points = np.asarray(outline, np.float32)
    for _ in range(5):
        following = np.roll(points, -1, axis=0)
        points = np.stack((0.75 * points + 0.25 * following, 0.25 * points + 0.75 * following), 1).reshape(-1, 2)
    points = np.concatenate((points, points[:1]))
    shape = np.broadcast_shapes(x.shape, z.shape)
    nearest, winding = np.full(shape, np.inf, np.float32), np.zeros(shape, bool)
    for (ax, az), (bx, bz) in pairwise(points):
        ex, ez = bx - ax, bz - az
        along = np.clip(((x - ax) * ex + (z - az) * ez) / max(ex * ex + ez * ez, 1e-12), 0, 1)
        nearest = np.minimum(nearest, (x - ax - along * ex) ** 2 + (z - az - along * ez) ** 2)
        crosses = ((az <= z) != (bz <= z)) & ((ex * (z - az) - (x - ax) * ez) * np.sign(ez) > 0)
        winding = winding ^ crosses
    return np.where(winding, -1, 1).astype(np.float32) * np.sqrt(nearest)


def _smooth_minimum(first: Grid, second: Grid, width: float) -> Grid:
    if width <= 0:
        return np.minimum(first, second)
    share = np.clip(0.5 + 0.5 * (second - first) / width, 0, 1)
    return second + (first - second) * share - width * share * (1 - share)


def _relief(shape: Shape, x: Grid, y: Grid, z: Grid) -> Grid:
    """Random hills of ``relief`` metres: three crossed noise pictures, which is cheaper than noise in space."""
    from scipy.ndimage import map_coordinates

    rng = np.random.default_rng(len(shape.name) + 31 * len(shape.parts))
    size = 128
    waves = 4.0  # the longest wave of the noise is a quarter of the picture
    total = np.zeros(np.broadcast_shapes(x.shape, y.shape, z.shape), np.float32)
    for first, second in ((x, y), (y, z), (z, x)):
        picture = fractal_noise(size, rng, octaves=6, periodic_power=1.6) - 0.5
        scale = size / (waves * shape.relief_size)
        where = np.stack(np.broadcast_arrays(first * scale, second * scale))
        total += map_coordinates(picture, where, order=1, mode="grid-wrap").astype(np.float32)
    return total * np.float32(shape.relief)


def _bounds(shape: Shape) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A box around all joined parts, with room for blends and relief."""
    lows, highs = [], []
    for part in shape.parts:
        if part.cut:
            continue
        reach = np.asarray(part.size, float)
        center = np.asarray(part.position, float)
        if part.form == "outline":
            corners = np.asarray(part.outline)
            (x0, z0), (x1, z1) = corners.min(0), corners.max(0)
            low, high = center + np.array((x0, -reach[1], z0)), center + np.array((x1, reach[1], z1))
        else:
            reach = np.full(3, np.linalg.norm(reach)) if part.turn or part.tilt else reach
            low, high = center - reach, center + reach
        if part.mirror:
            low[1], high[1] = min(low[1], -high[1]), max(high[1], -low[1])
        lows.append(low - part.blend / 4)
        highs.append(high + part.blend / 4)
    margin = 2 * shape.cell + 1.5 * shape.relief
    return np.min(lows, 0) - margin, np.max(highs, 0) + margin
