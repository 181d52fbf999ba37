"""Shapes with known surfaces, and cameras around them."""

import numpy as np
import torch

from rtgs.core.cameras import Camera
from rtgs.mesh.triangles import TriangleMesh

_CUBE_FACES = [  # corners of [0, 1]^3 numbered by bits x + 2 y + 4 z, counter-clockwise from outside
    (0, 2, 3, 1),
    (4, 5, 7, 6),
    (0, 1, 5, 4),
    (2, 6, 7, 3),
    (0, 4, 6, 2),
    (1, 3, 7, 5),
]


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriangleMesh:
    """An axis-aligned box, outward orientation."""
    corners = np.array([[(k >> axis) & 1 for axis in range(3)] for k in range(8)], np.float64)
    vertices = np.array(low) + corners * (np.array(high) - np.array(low))
    faces = [triangle for a, b, c, d in _CUBE_FACES for triangle in ((a, b, c), (a, c, d))]
    return TriangleMesh(vertices.astype(np.float32), np.array(faces, np.int32))


def sphere(radius: float, rings: int = 96, center: tuple[float, float, float] = (0, 0, 0)) -> TriangleMesh:
    """A latitude-longitude sphere, outward orientation; inside the true one by radius * (pi / rings)^2 / 2 at most."""
    theta = np.linspace(0, np.pi, rings + 1)[1:-1]
    phi = np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    ring = np.stack(
        [
            np.sin(theta)[:, None] * np.cos(phi),
            np.sin(theta)[:, None] * np.sin(phi),
            np.broadcast_to(np.cos(theta)[:, None], (len(theta), len(phi))),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.concatenate([[[0, 0, 1]], ring, [[0, 0, -1]]]) * radius + np.array(center)
    columns = len(phi)
    faces, south = [], len(vertices) - 1
    for k in range(columns):
        following = (k + 1) % columns
        faces.append((0, 1 + k, 1 + following))
        for row in range(len(theta) - 1):
            a, b = 1 + row * columns + k, 1 + row * columns + following
            faces += [(a, a + columns, b + columns), (a, b + columns, b)]
        last = 1 + (len(theta) - 1) * columns
        faces.append((south, last + following, last + k))
    return TriangleMesh(vertices.astype(np.float32), np.array(faces, np.int32))


def join(*meshes: TriangleMesh) -> TriangleMesh:
    """Several meshes as one."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return TriangleMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets)]),
    )


def camera_at(center, target=(0.0, 0.0, 0.0), width: int = 64, height: int = 48, focal: float = 70.0) -> Camera:
    """A camera that looks at ``target``; principal point off the centre, non-square pixels."""
    center, target = np.array(center, float), np.array(target, float)
    forward = (target - center) / np.linalg.norm(target - center)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = torch.tensor(np.stack([right, np.cross(forward, right), forward]))
    translation = -rotation @ torch.tensor(center)
    principal = (width / 2 + 2.3, height / 2 - 1.7)
    return Camera(rotation, translation, focal, focal * 1.05, *principal, width, height, "test")


def sphere_depths(camera: Camera, radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W) z-depths of the entry into and exit from the sphere about the origin; inf where the ray misses."""
    rays = camera.rays(torch.float64)
    a = rays.directions.square().sum(-1)
    b = (rays.directions * rays.origin).sum(-1)
    c = rays.origin.square().sum() - radius**2
    discriminant = b * b - a * c
    root = discriminant.clamp_min(0).sqrt()
    miss = torch.full_like(root, torch.inf)
    return (torch.where(discriminant > 0, (-b - root) / a, miss), torch.where(discriminant > 0, (-b + root) / a, miss))


def box_depths(camera: Camera, low, high) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W) z-depths of entry into and exit from an axis-aligned box by the slab method; inf where the ray misses."""
    rays = camera.rays(torch.float64)
    bounds = [(torch.tensor(side, dtype=torch.float64) - rays.origin) / rays.directions for side in (low, high)]
    near = torch.minimum(*bounds).amax(-1)
    far = torch.maximum(*bounds).amin(-1)
    miss = torch.full_like(near, torch.inf)
    return torch.where(near < far, near, miss), torch.where(near < far, far, miss)


def cylinder(radius: float, half: float, sides: int = 96) -> TriangleMesh:
    """A closed cylinder about z from -half to half, outward orientation."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    levels = [np.column_stack([ring, np.full(sides, z)]) for z in (-half, half)]
    vertices = np.concatenate([*levels, [[0, 0, -half], [0, 0, half]]])
    faces = []
    for k in range(sides):
        a, b = k, (k + 1) % sides
        faces += [(a, b, b + sides), (a, b + sides, a + sides)]
        faces += [(2 * sides, b, a), (2 * sides + 1, a + sides, b + sides)]
    return TriangleMesh(vertices.astype(np.float32), np.array(faces, np.int32))


def pane(width: float, height: float, cells: int = 4) -> TriangleMesh:
    """A rectangle in the plane y = 0 about the origin, facing -y."""
    x, z = np.meshgrid(np.linspace(-width / 2, width / 2, cells + 1), np.linspace(-height / 2, height / 2, cells + 1))
    vertices = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, 3)
    faces = []
    for row in range(cells):
        for column in range(cells):
            a = row * (cells + 1) + column
            faces += [(a, a + 1, a + cells + 2), (a, a + cells + 2, a + cells + 1)]
    return TriangleMesh(vertices.astype(np.float32), np.array(faces, np.int32))
