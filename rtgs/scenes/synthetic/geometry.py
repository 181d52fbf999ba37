"""Triangle meshes made in code: vertices, faces, UVs, in the shape's own frame, then placed in the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtgs.scenes.synthetic.description import Part, Shape
from rtgs.scenes.synthetic.sculpt import sculpt

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mesh:
    vertices: Array  # (V, 3) world
    normals: Array  # (V, 3) unit, outward
    uvs: Array  # (V, 2)
    faces: NDArray[np.int32]  # (F, 3)


def _grid_faces(rows: int, columns: int) -> NDArray[np.int32]:
    """Two triangles for each cell of a (rows x columns) vertex grid."""
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (r * columns + c).ravel()
    quads = np.stack((a, a + 1, a + columns + 1, a + columns), -1)
    return np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]])).astype(np.int32)


def _grid_mesh(points: Array, normals: Array, flip: bool = False) -> Mesh:
    """A mesh from a (rows, columns, 3) grid of points; UV = (column, row) over the unit square."""
    rows, columns, _ = points.shape
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    faces = _grid_faces(rows, columns)
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    unit = normals / np.maximum(lengths, 1e-12)
    return Mesh(
        points.reshape(-1, 3),
        unit.reshape(-1, 3),
        np.stack((u, v), -1).reshape(-1, 2),
        faces[:, ::-1] if flip else faces,
    )


def _smooth_profile(profile: tuple[tuple[float, float], ...], samples: int) -> Array:
    """(samples, 2) points on the polyline through the profile, corners rounded by a centripetal spline."""
    from scipy.interpolate import PchipInterpolator

    knots = np.asarray(profile, float)
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))))
    return PchipInterpolator(lengths, knots, axis=0)(np.linspace(0, lengths[-1], samples))


def lathe(profile: tuple[tuple[float, float], ...], arc: float = 360.0, columns: int = 128, samples: int = 96) -> Mesh:
    """Surface of revolution about z of (radius, height) pairs: cups, bottles, jars. Open where the profile is, and
    beyond ``arc`` degrees."""
    curve = _smooth_profile(profile, samples)
    slope = np.gradient(curve, axis=0)
    angle = np.linspace(0, np.radians(arc), columns)
    radius, height = curve[:, :1], curve[:, 1:]
    points = np.stack((radius * np.cos(angle), radius * np.sin(angle), height + 0 * angle), -1)
    normals = np.stack((slope[:, 1:] * np.cos(angle), slope[:, 1:] * np.sin(angle), -slope[:, :1] + 0 * angle), -1)
    normals[np.linalg.norm(normals, axis=-1) < 1e-9] = (0, 0, -1)
    return _grid_mesh(points, normals)


def sphere(radius: float, rows: int = 96, columns: int = 192) -> Mesh:
    polar = np.linspace(np.pi, 0, rows)[:, None]
    angle = np.linspace(0, 2 * np.pi, columns)
    unit = np.stack((np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar) + 0 * angle), -1)
    return _grid_mesh(radius * unit, unit)


def knot(scale: float, rows: int = 400, columns: int = 32, p: int = 2, q: int = 3) -> Mesh:
    """A (p, q) torus knot tube: the irregular content of a container."""
    t = np.linspace(0, 2 * np.pi, rows)
    r = 0.6 + 0.25 * np.cos(q * t)
    center = np.stack((r * np.cos(p * t), r * np.sin(p * t), 0.35 * np.sin(q * t)), -1)
    tangent = np.gradient(center, t, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent, (0.0, 0.0, 1.0))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    a = np.linspace(0, 2 * np.pi, columns)[None, :, None]
    normal = np.cos(a) * side[:, None] + np.sin(a) * up[:, None]
    return _grid_mesh(scale * (center[:, None] + 0.17 * normal), normal, flip=True)


def plane(half: tuple[float, float, float], cells: int = 48) -> Mesh:
    """A rectangle in x, y facing +z, in cells x cells squares: light is kept at vertices."""
    x, y = np.meshgrid(*(np.linspace(-h, h, cells + 1) for h in half[:2]))
    points = np.stack((x, y, np.zeros_like(x)), -1)
    return _grid_mesh(points, np.broadcast_to((0.0, 0.0, 1.0), points.shape).copy())


def box(half: tuple[float, float, float], inward: bool = False, cells: int = 32) -> Mesh:
    """A box, each face in cells x cells squares over the whole UV square. ``inward`` turns it into a room."""
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            grid_u, grid_v = np.meshgrid(*(np.linspace(-half[k], half[k], cells + 1) for k in (u, v)))
            points = np.zeros((cells + 1, cells + 1, 3))
            points[..., axis], points[..., u], points[..., v] = sign * half[axis], grid_u, grid_v
            normal = np.zeros(3)
            normal[axis] = -sign if inward else sign
            outward_winding = sign > 0
            sides.append(
                _grid_mesh(points, np.broadcast_to(normal, points.shape).copy(), flip=outward_winding == inward)
            )
    return merge(sides)


def dome(radius: float, rows: int = 48, columns: int = 128) -> Mesh:
    """Upper half sphere seen from inside: a sky. UV = (azimuth, elevation)."""
    elevation = np.linspace(0, np.pi / 2, rows)[:, None]
    angle = np.linspace(0, 2 * np.pi, columns)
    unit = np.stack(
        (np.cos(elevation) * np.cos(angle), np.cos(elevation) * np.sin(angle), np.sin(elevation) + 0 * angle), -1
    )
    return _grid_mesh(radius * unit, -unit, flip=True)


def kernels(shape: Shape, forms: int = 6, lumps: int = 6) -> Mesh:
    """A heap of irregular kernels inside the profile: a few forms, each some balls grown together, turned at random."""
    rng = np.random.default_rng(shape.count)
    profile = np.asarray(shape.profile, float)
    templates = [box_mapped(*sculpt(_kernel(shape.size[0], lumps, rng))) for _ in range(forms)]
    heights = np.linspace(profile[0, 1], profile[-1, 1], 64)
    radii = np.interp(heights, profile[:, 1], profile[:, 0])
    volume = np.cumsum(radii**2) / np.sum(radii**2)
    meshes = []
    for number in range(shape.count):
        height = np.interp((number + rng.random()) / shape.count, volume, heights)
        reach = np.interp(height, heights, radii)
        angle, distance = 2.39996 * number + rng.normal(0, 0.3), reach * rng.random() ** 0.3
        center = np.array((distance * np.cos(angle), distance * np.sin(angle), height))
        form = templates[number % forms]
        turned = _rotation(rng.uniform(0, 360), rng.uniform(0, 360))
        vertices, normals = form.vertices @ turned.T + center, form.normals @ turned.T
        meshes.append(Mesh(vertices, normals, form.uvs + rng.random(2), form.faces))
    return merge(meshes)


def _kernel(radius: float, lumps: int, rng: np.random.Generator) -> Shape:
    """Balls around a middle, within 1.3 ``radius``."""
    parts = [Part(size=(0.5 * radius, 0.5 * radius, 0.5 * radius))]
    for _ in range(lumps):
        offset = rng.normal(0, 1, 3)
        offset *= rng.uniform(0.5, 0.8) * radius / np.linalg.norm(offset)
        place = (float(offset[0]), float(offset[1]), float(offset[2]))
        reach = rng.uniform(0.35, 0.5) * radius
        parts.append(Part(position=place, size=(reach, reach, reach), blend=0.15 * radius))
    return Shape("kernel", "sculpt", parts=tuple(parts), cell=0.11 * radius)


def box_mapped(vertices: Array, normals: Array, faces: NDArray[np.int32]) -> Mesh:
    """A mesh with UVs in metres, each face seen along the axis it faces most; seams double their vertices."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    axis = np.abs(np.cross(b - a, c - a)).argmax(1)
    meshes = []
    for k in range(3):
        used, renumbered = np.unique(faces[axis == k], return_inverse=True)
        uv = vertices[used][:, [(k + 1) % 3, (k + 2) % 3]]
        if k == 1:
            uv = uv[:, ::-1]  # x across, z up, as on the other upright side
        meshes.append(Mesh(vertices[used], normals[used], uv, renumbered.reshape(-1, 3).astype(np.int32)))
    return merge([mesh for mesh in meshes if len(mesh.faces)])


def merge(meshes: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.uvs for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets)]).astype(np.int32),
    )


def _rotation(tilt: float, turn: float) -> Array:
    a, b = np.radians(tilt), np.radians(turn)
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_z = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    return about_z @ about_x


def build(shape: Shape) -> Mesh:
    """The mesh of a described shape, in the world."""
    match shape.kind:
        case "lathe":
            mesh = lathe(shape.profile, shape.arc)
        case "box":
            mesh = box(shape.size, shape.inward)
        case "sphere":
            mesh = sphere(shape.size[0])
        case "knot":
            mesh = knot(shape.size[0])
        case "plane":
            mesh = plane(shape.size)
        case "dome":
            mesh = dome(shape.size[0])
        case "sculpt":
            mesh = box_mapped(*sculpt(shape))
        case "kernels":
            mesh = kernels(shape)
        case other:
            raise ValueError(f"shape {shape.name!r}: unknown kind {other!r}")
    rotation = _rotation(shape.tilt, shape.turn)
    vertices, normals = mesh.vertices @ rotation.T, mesh.normals @ rotation.T
    places = (shape.position, *shape.copies)
    return merge([Mesh(vertices + np.asarray(place), normals, mesh.uvs, mesh.faces) for place in places])


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """``count`` points uniform by area, (count, 3), their UVs (count, 2) and the unit normals of their faces."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    face = rng.choice(len(area), size=count, p=area / area.sum())
    r1, r2 = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    weights = np.concatenate((1 - r1, r1 * (1 - r2), r1 * r2), 1)[..., None]
    corners = mesh.faces[face]
    return (
        (weights * mesh.vertices[corners]).sum(1),
        (weights * mesh.uvs[corners]).sum(1),
        cross[face] / area[face, None],
    )
