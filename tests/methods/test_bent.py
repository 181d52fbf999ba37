"""Walls that move: gradients by finite differences, and a sphere, on which what becomes of every path is known."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.mesh.displacement import Displacement
from rtgs.mesh.inner_paths import InnerGuide, InnerPaths, Leg
from rtgs.mesh.meetings import Meetings, meetings
from rtgs.mesh.triangles import TriangleMesh
from rtgs.methods.shading.bent import GRAZING, Bend, bent_paths, seen_wall
from rtgs.methods.shading.mirror import SurfacePixels, mirror_rays_twin
from rtgs.train.parameters import ParameterGroup, Rate

RADIUS, AWAY, VOXEL = 0.5, 2.0, 0.02


def sphere(radius: float, rings: int = 64) -> TriangleMesh:
    """Outward oriented, its poles along x."""
    theta, phi = np.linspace(0, np.pi, rings + 1)[1:-1], np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    t, p = (each.reshape(-1) for each in np.meshgrid(theta, phi, indexing="ij"))
    ring = np.stack([np.cos(t), np.sin(t) * np.cos(p), np.sin(t) * np.sin(p)], axis=1)
    vertices, columns = np.concatenate([[[1, 0, 0]], ring, [[-1, 0, 0]]]), len(phi)
    faces, south = [], len(vertices) - 1
    for k in range(columns):
        n = (k + 1) % columns
        faces.append((0, 1 + k, 1 + n))
        for row in range(rings - 2):
            a, b = 1 + row * columns, 1 + (row + 1) * columns
            faces += [(a + k, b + k, b + n), (a + k, b + n, a + n)]
        last = 1 + (rings - 2) * columns
        faces.append((south, last + n, last + k))
    return TriangleMesh((radius * vertices).astype(np.float32), np.array(faces, np.int32))


def camera(turn: float = 0.0, width: int = 24, height: int = 20) -> Camera:
    """At a distance of AWAY, looking at the origin, turned about the vertical axis."""
    c, s = float(np.cos(turn)), float(np.sin(turn))
    rotation = torch.tensor([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]], dtype=torch.float64)
    there = torch.tensor([0.0, 0.0, AWAY], dtype=torch.float64)
    return Camera(rotation, there, 36.0, 36.0, width / 2, height / 2, width, height)


def paths_of(mesh: ObjectMesh, bounces: int = 2) -> InnerPaths:
    every = torch.ones(len(mesh.mesh.faces), dtype=torch.bool)
    return InnerGuide(mesh, every, bounces, moving=True).paths(camera(), ObjectGuide(mesh))


def wide(paths: InnerPaths) -> InnerPaths:
    """In float64."""

    def of(each):
        values = {f.name: getattr(each, f.name) for f in fields(each)}
        changed = {k: v.double() for k, v in values.items() if isinstance(v, Tensor) and v.is_floating_point()}
        met = values.get("met")
        return replace(each, **changed, **({} if met is None else {"met": of(met)}))

    return replace(of(paths), legs=tuple(of(leg) for leg in paths.legs))


@pytest.fixture(scope="module")
def ball() -> Displacement:
    return Displacement(ObjectMesh(sphere(RADIUS), "given", VOXEL, flat=False), spacing=8.0)


def bend_of(field: Displacement, values: Tensor) -> Bend:
    heights = field.spread(values)
    return Bend(torch.cat((heights[:, None], field.slopes(heights).reshape(-1, 3)), dim=1))


def seen(mesh: ObjectMesh, eye: Camera) -> tuple[Meetings, Tensor, Tensor]:
    """Where the camera's rays meet the mesh first, their depths and directions (L, 3)."""
    found = ObjectGuide(mesh).surfaces(eye)
    pixels, rays = found.hit.flatten().nonzero()[:, 0], eye.rays(torch.float64)
    depth, view = found.near.flatten()[pixels].double(), rays.directions.reshape(-1, 3)[pixels]
    points = (rays.origin + depth[:, None] * view).numpy()
    triangle, normal = found.triangle.flatten()[pixels].long().numpy(), found.normal.flatten(1)[:, pixels].T
    return meetings(mesh.mesh, mesh.corners, triangle, points, normal.numpy()), depth, view


def mirror_at(normal: Tensor, depth: Tensor) -> SurfacePixels:
    """Pixels with these normals (P, 3) and depths, and nothing else."""
    none = torch.zeros(0)
    return SurfacePixels(none, none, none, none, normal.T, depth)


def outputs(paths: InnerPaths) -> list[Tensor]:
    legs = [getattr(leg, name) for leg in paths.legs for name in ("origin", "direction", "length", "cosine")]
    return [paths.cosine, *legs]


def test_what_has_not_moved_is_what_it_was(ball: Displacement):
    paths = paths_of(ball.base)
    still = Bend(torch.zeros(len(ball.normals), 4))
    for ours, before in zip(outputs(bent_paths(paths, still)), outputs(paths), strict=True):
        torch.testing.assert_close(ours, before, atol=3e-6, rtol=1e-5)
    met, depth, view = seen(ball.base, camera())
    near, normal = seen_wall(still, met, depth.float(), view.float())
    torch.testing.assert_close(near, depth.float())
    torch.testing.assert_close(normal, met.normal, atol=2e-3, rtol=0)  # those of the guide are in half precision


def test_gradients_of_normals_and_of_all_hit_points_are_right(ball: Displacement):
    chosen = torch.arange(0, 200, 29)
    _, paths = paths_of(ball.base).take(paths_of(ball.base).pixels[chosen])
    paths = wide(paths)
    assert paths.met is not None
    assert [len(leg.length) for leg in paths.legs] == [len(chosen)] * 2
    met, depth, view = seen(ball.base, camera())
    met, depth, view = met.rows(chosen), depth[chosen], view[chosen]
    used = torch.unique(
        torch.cat([m.vertices.flatten() for m in (met, paths.met, *(leg.met for leg in paths.legs)) if m])
    )
    generator = torch.Generator().manual_seed(1)
    given = 1e-3 * torch.randn(len(used), 4, generator=generator, dtype=torch.float64)

    def found(rows: Tensor) -> tuple[Tensor, ...]:
        field = torch.zeros(len(ball.normals), 4, dtype=torch.float64).index_copy(0, used.long(), rows)
        bend = Bend(field)
        near, normal = seen_wall(bend, met, depth, view)
        pixels = mirror_at(normal, near)
        rays = mirror_rays_twin(pixels, torch.tensor([0.0, 0.0, -AWAY], dtype=torch.float64), view.T)
        inner = bent_paths(paths, bend)
        return (
            near,
            normal,
            rays.origins,
            rays.directions,
            rays.cosine,
            *outputs(inner),
            *(leg.exit for leg in inner.legs),
        )

    assert torch.autograd.gradcheck(found, (given.requires_grad_(),), eps=1e-7, atol=1e-6)


def test_paths_are_those_of_the_moved_mesh_to_first_order(ball: Displacement):
    """All of a path, with the curvature of the walls: what is left falls with the square of the heights."""
    generator = torch.Generator().manual_seed(3)
    values = torch.randn(ball.controls, generator=generator, dtype=torch.float64)
    paths = paths_of(ball.base, 1)
    inner = (paths.cosine > 0.5) & (paths.legs[0].cosine > 0.5)
    assert int(inner.sum()) > 50
    left: dict[tuple[str, float], float] = {}
    for size in (0.4, 0.1):
        moved = paths_of(ball.moved((size * values).numpy()), 1)
        rows = torch.isin(moved.pixels, paths.pixels[inner])
        ours = bent_paths(wide(paths), bend_of(ball, size * values))
        for name in ("origin", "direction", "length", "cosine", "exit"):
            found, exact, before = (
                getattr(each.legs[0], name)[at].double().reshape(int(inner.sum()), -1)
                for each, at in ((ours, inner), (moved, rows), (paths, inner))
            )
            change = float((before - exact).norm(dim=1).median())
            left[name, size] = float((found - exact).norm(dim=1).median())
            assert left[name, size] < (0.3 if size > 0.2 else 0.15) * change, (name, size)
        torch.testing.assert_close(ours.cosine[inner].float(), moved.cosine[rows], atol=0.05, rtol=0)
    for name in ("direction", "exit"):
        assert left[name, 0.1] < 0.15 * left[name, 0.4], name


def test_a_sphere_of_another_radius_has_its_chords(ball: Displacement):
    height = 0.5 * VOXEL
    bend = bend_of(ball, torch.full((ball.controls,), 0.5, dtype=torch.float64))
    met, depth, view = seen(ball.base, camera())
    near, _ = seen_wall(bend, met, depth, view)
    unit = view / view.norm(dim=1, keepdim=True)
    origin = torch.tensor([0.0, 0.0, -AWAY], dtype=torch.float64)
    along = -(unit * origin).sum(1)
    square = origin.square().sum() - along.square()  # of the distance between ray and centre
    inner = square < (0.8 * RADIUS) ** 2
    exact = (along - ((RADIUS + height) ** 2 - square).clamp_min(0).sqrt()) / view.norm(dim=1)
    assert float((near - exact)[inner].abs().max()) < 0.1 * float((depth - exact)[inner].abs().min())
    assert GRAZING < 0.6  # where the walls above are met


def test_known_offsets_are_found_again_from_reflected_directions(ball: Displacement):
    """The mesh of a sphere with waves on it; mirror rays of the true sphere, seen from six sides, take them off."""
    generator, waves = torch.Generator().manual_seed(5), Displacement(ball.base, spacing=16.0)
    wrong = torch.randn(waves.controls, generator=generator).numpy()
    bumpy = waves.moved(wrong)
    field = Displacement(bumpy, spacing=8.0)
    eyes = [camera(turn, 32, 28) for turn in np.arange(6) * np.pi / 3]
    cases = []
    for eye in eyes:
        met, depth, view = seen(bumpy, eye)
        points = eye.center + depth[:, None] * view
        inner = ((points / RADIUS) * view / view.norm(dim=1, keepdim=True)).sum(1) < -0.4
        true = torch.nn.functional.normalize(points[inner], dim=1)
        cases.append((met.rows(inner.nonzero()[:, 0]), depth[inner], view[inner], eye.center, true))

    def off(bend: Bend) -> tuple[Tensor, Tensor]:
        """Mean square of the reflected directions' errors; median angle of the normals, degrees."""
        square, angles = [], []
        for met, depth, view, centre, true in cases:
            near, normal = seen_wall(bend, met, depth.float(), view.float())
            pixels = mirror_at(normal, near)
            rays = mirror_rays_twin(pixels, centre.float(), view.float().T)
            wanted = mirror_rays_twin(replace(pixels, normal=true.float().T), centre.float(), view.float().T)
            square.append((rays.directions - wanted.directions).square().sum(1))
            angles.append(torch.rad2deg((normal * true.float()).sum(1).clamp(-1, 1).arccos()))
        return torch.cat(square).mean(), torch.cat(angles).median()

    group = ParameterGroup("vertices", {"heights": torch.zeros(field.controls)}, Rate(0.03, 0.003, 150))
    _, before = off(bend_of(field, group["heights"].detach()))
    for step in range(150):
        off(bend_of(field, group["heights"]))[0].backward()
        group.step(step)
    _, after = off(bend_of(field, group["heights"].detach()))
    assert float(before) > 1.5
    assert float(after) < 0.3 * float(before)
    recovered = field.heights(group["heights"].detach().numpy())
    seen_part = np.abs(bumpy.mesh.vertices[:, 1]) < 0.3 * RADIUS
    lost = waves.heights(wrong) + recovered  # 0 where the wave was taken off, up to one constant: normals see no size
    assert np.std(lost[seen_part]) < 0.5 * np.std(waves.heights(wrong)[seen_part])
    flat = field.moved(group["heights"].detach().numpy())
    assert isinstance(flat, ObjectMesh)
    assert isinstance(paths_of(flat, 1).legs[0], Leg)
