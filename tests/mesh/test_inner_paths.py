"""Paths of light mirrored inside an object: on a sphere, whose angles and lengths are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from shapes import box, sphere

from rtgs.core.cameras import Camera
from rtgs.mesh import inner_paths
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.mesh.inner_paths import InnerGuide, InnerPaths

RADIUS, AWAY = 0.5, 2.0


def camera(width: int = 24, height: int = 20) -> Camera:
    """At z = -AWAY, looking along +z at the origin."""
    there = torch.tensor([0.0, 0.0, AWAY], dtype=torch.float64)
    return Camera(torch.eye(3, dtype=torch.float64), there, 36.0, 36.0, width / 2, height / 2, width, height)


def paths_of(mesh: ObjectMesh, bounces: int, glass: torch.Tensor | None = None) -> InnerPaths:
    every = torch.ones(len(mesh.mesh.faces), dtype=torch.bool)
    return InnerGuide(mesh, every if glass is None else glass, bounces).paths(camera(), ObjectGuide(mesh))


@pytest.fixture(scope="module")
def ball() -> ObjectMesh:
    return ObjectMesh(sphere(RADIUS, rings=96), "given", voxel=0.01, flat=False)


def test_on_a_sphere_every_leg_has_the_angle_and_the_length_of_the_chord(ball: ObjectMesh):
    found = paths_of(ball, 3)
    rays = camera().rays(torch.float64)
    unit = torch.nn.functional.normalize(rays.directions.reshape(-1, 3)[found.pixels], dim=1)
    off = torch.linalg.cross(rays.origin.expand_as(unit), unit).norm(dim=1)  # of the ray from the centre
    cosine = (1 - (off / RADIUS) ** 2).clamp_min(0).sqrt().float()
    inner = cosine > 0.25
    assert int(inner.sum()) > 100
    assert len(found.legs) == 3
    torch.testing.assert_close(found.cosine[inner], cosine[inner], atol=0.01, rtol=0)
    rows = torch.arange(len(cosine))
    for leg in found.legs:
        rows = rows[leg.parent]
        kept = inner[rows]
        torch.testing.assert_close(leg.cosine[kept], cosine[rows][kept], atol=0.04, rtol=0)
        torch.testing.assert_close(leg.length[kept], 2 * RADIUS * cosine[rows][kept], atol=0.04, rtol=0)
        assert float((leg.origin.norm(dim=1) - RADIUS).abs().max()) < 0.01
        assert float((leg.exit[kept].norm(dim=1) - RADIUS).abs().max()) < 0.01
        torch.testing.assert_close(leg.direction.norm(dim=1), torch.ones(len(leg.length)), atol=1e-5, rtol=0)


def test_in_a_box_light_comes_back_along_its_way_and_its_mirror_image():
    mesh = ObjectMesh(box((-0.6, -0.5, -0.4), (0.6, 0.5, 0.4)), "given", voxel=0.01, flat=False)
    found = paths_of(mesh, 1)
    rays = camera().rays(torch.float64)
    unit = torch.nn.functional.normalize(rays.directions.reshape(-1, 3)[found.pixels], dim=1).float()
    starts = found.legs[0].origin
    back = (starts[:, 2] - 0.4).abs() < 1e-5  # mirrored at the wall z = 0.4, and not at its edges
    back &= (starts[:, 0].abs() < 0.59) & (starts[:, 1].abs() < 0.49)
    assert int(back.sum()) > 100
    flipped = unit * torch.tensor([1.0, 1.0, -1.0])
    torch.testing.assert_close(found.legs[0].direction[back], flipped[back], atol=1e-5, rtol=0)
    front = back & (found.legs[0].exit[:, 2] + 0.4).abs().lt(1e-4)
    torch.testing.assert_close(found.legs[0].length[front], 0.8 / unit[front][:, 2], atol=1e-3, rtol=0)


def test_a_subset_of_pixels_has_the_paths_it_has_among_all(ball: ObjectMesh):
    every = paths_of(ball, 3)
    outside = torch.tensor([0])
    wanted = torch.cat((every.pixels[5::7].flip(0), outside, every.pixels[:3]))
    rows, some = every.take(wanted)
    assert torch.equal(some.pixels, wanted[rows])
    assert len(rows) == len(wanted) - 1
    alone = [dict(zip(["pixel", "leg"], (each, k))) for each in some.pixels.tolist() for k in range(3)]
    for item in alone:
        assert torch.equal(*(_ends(paths, item["pixel"], item["leg"]) for paths in (every, some)))


def _ends(paths: InnerPaths, pixel: int, level: int) -> torch.Tensor:
    """(K, 3) where the legs of a pixel's path end at this level: one, or none."""
    rows = (paths.pixels == pixel).nonzero()[:, 0]
    for k, leg in enumerate(paths.legs[: level + 1]):
        rows = rows if k == 0 else torch.isin(leg.parent, rows).nonzero()[:, 0]
    return paths.legs[level].exit[rows]


def test_no_light_is_mirrored_where_the_mesh_is_no_glass(ball: ObjectMesh):
    centers = ball.mesh.vertices[ball.mesh.faces].mean(1)
    glass = torch.from_numpy(centers[:, 0] < 0)  # the left half
    every, left = paths_of(ball, 2), paths_of(ball, 2, glass)
    assert 0.3 < len(left.pixels) / len(every.pixels) < 0.7
    assert float(left.legs[0].origin[:, 0].max()) < 0.02
    ends = left.legs[0].exit[:, 0]
    goes_on = torch.zeros(len(ends), dtype=torch.bool).index_fill(0, left.legs[1].parent, True)
    assert bool((ends[goes_on] < 0.02).all())
    assert bool((ends[~goes_on] > -0.02).all())
    assert bool((left.legs[0].cosine[~goes_on] == 0).all()), "what is no glass lets nothing through"
    assert 0 < int(goes_on.sum()) < len(ends)


def test_a_camera_is_looked_up_once_and_no_bounce_is_refused(ball: ObjectMesh, monkeypatch: pytest.MonkeyPatch):
    every = torch.ones(len(ball.mesh.faces), dtype=torch.bool)
    paths, guide = InnerGuide(ball, every, 1), ObjectGuide(ball)
    first = paths.paths(camera(), guide)
    monkeypatch.setattr(ball.rays, "intersect", lambda *given: pytest.fail("cast again"))
    assert paths.paths(camera(), guide) is first
    with pytest.raises(ValueError, match="bounces is 0"):
        InnerGuide(ball, every, 0)


def test_the_oldest_cameras_go_when_the_paths_take_too_much(ball: ObjectMesh, monkeypatch: pytest.MonkeyPatch):
    every = torch.ones(len(ball.mesh.faces), dtype=torch.bool)
    paths, guide = InnerGuide(ball, every, 1), ObjectGuide(ball)
    cameras = [camera(width) for width in (24, 26, 28)]
    one = paths.paths(cameras[0], guide).bytes
    monkeypatch.setattr(inner_paths, "CACHED_BYTES", 2 * one + one // 2)
    kept = [paths.paths(each, guide) for each in cameras]
    found = []
    real = ball.rays.along
    monkeypatch.setattr(ball.rays, "along", lambda *given: found.append(given) or real(*given))
    assert paths.paths(cameras[2], guide) is kept[2]
    assert paths.paths(cameras[1], guide) is kept[1]
    assert not found
    assert paths.paths(cameras[0], guide) is not kept[0]
    assert paths.paths(cameras[1], guide) is kept[1], "used last but one: the third has gone"
    assert paths.paths(cameras[2], guide) is not kept[2]


def test_a_leg_that_finds_no_wall_has_no_length():
    half = sphere(RADIUS, rings=32)
    centers = half.vertices[half.faces].mean(1)
    open_ball = type(half)(half.vertices, half.faces[(centers[:, 0] < 0.2)])
    mesh = ObjectMesh(open_ball, "given", voxel=0.01, flat=False)
    (leg,) = paths_of(mesh, 1).legs
    lost = leg.length == 0
    assert 0 < int(lost.sum()) < len(lost)
    assert bool((leg.cosine[lost] == 1).all())
    assert torch.equal(leg.wall == 0, lost)
    assert bool(np.isfinite(leg.exit.numpy()).all())


def test_an_opening_ends_a_path_and_reflects_nothing(ball: ObjectMesh):
    every = torch.ones(len(ball.mesh.faces), dtype=torch.bool)
    opened = torch.from_numpy(ball.mesh.vertices[ball.mesh.faces].mean(1)[:, 0] > 0)  # the right half
    found = InnerGuide(ball, every, 2, opened).paths(camera(), ObjectGuide(ball))
    first, second = found.legs
    assert float(first.origin[:, 0].max()) < 0.02, "nothing is mirrored at the opening"
    leaves = first.wall == 0
    assert 0 < int(leaves.sum()) < len(leaves)
    assert bool((first.exit[leaves, 0] > -0.02).all())
    assert bool((first.cosine[leaves] > 0).all()), "it lets light through"
    assert not bool(leaves[second.parent].any())
