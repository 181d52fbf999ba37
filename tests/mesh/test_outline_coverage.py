"""Coverage of pixels at an outline: against a sphere's own formula, thin things, pixels in the middle, its cache."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from shapes import box, sphere

from rtgs.core.cameras import Camera
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.mesh.coverage import CoverageGuide
from rtgs.mesh.triangles import TriangleMesh

RADIUS, DISTANCE = 0.5, 2.0


def camera(width: int = 32, height: int = 24) -> Camera:
    """Looks along +z at the origin, a little off the middle of the picture."""
    rotation, back = torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, DISTANCE], dtype=torch.float64)
    return Camera(rotation, back, 30.0, 31.0, width / 2 + 0.3, height / 2 - 0.2, width, height)


def guide_of(mesh: TriangleMesh) -> ObjectGuide:
    return ObjectGuide(ObjectMesh(mesh, "given", voxel=0.01, flat=False))


def exact(camera: Camera, side: int) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W, S) hits of the true sphere and cosines there, on a grid of ``side`` x ``side`` points in each pixel."""
    fine = camera.resized(camera.width * side, camera.height * side).rays(torch.float64)
    unit = torch.nn.functional.normalize(fine.directions, dim=-1)
    along = -(unit * fine.origin).sum(-1)
    off = fine.origin.square().sum() - along.square()
    hit = off < RADIUS**2
    cosine = (1 - off.clamp_max(RADIUS**2) / RADIUS**2).sqrt()

    def by_pixel(values: torch.Tensor) -> torch.Tensor:
        tiles = values.reshape(camera.height, side, camera.width, side).permute(0, 2, 1, 3)
        return tiles.reshape(camera.height, camera.width, -1)

    return by_pixel(hit), by_pixel(cosine)


@pytest.mark.parametrize("side", [2, 4, 8])
def test_shares_and_angles_are_those_of_the_sphere(side: int):
    view = camera()
    found = CoverageGuide(guide_of(sphere(RADIUS, 192)), side).coverage(view)
    hit, cosine = exact(view, side)
    hit, cosine = (each.flatten(0, 1)[found.pixels] for each in (hit, cosine))
    met = found.triangle >= 0
    assert float((met != hit).float().mean()) < 0.01, "the same samples meet it"
    both = met & hit & (cosine > 0.1)
    assert float((found.cosine.double() - cosine).abs()[both].max()) < 0.01
    assert bool((found.cosine[~met] == 1).all())
    truth = exact(view, 32)[0].double().mean(-1).flatten()[found.pixels]
    assert float((found.share - truth).abs().max()) < 1.2 / side
    assert float((found.share - truth).abs().mean()) < 0.25 / side


def test_all_pixels_that_are_partly_covered_are_there_and_few_others():
    view = camera()
    found = CoverageGuide(guide_of(sphere(RADIUS, 192)), 4).coverage(view)
    share = exact(view, 4)[0].double().mean(-1).flatten()
    partly = ((share > 0) & (share < 1)).nonzero()[:, 0]
    assert int(torch.isin(partly, found.pixels).sum()) >= len(partly) - 1  # one sample may fall beside the mesh
    assert len(found.pixels) < 4 * len(partly)
    assert bool((found.pixels.diff() > 0).all())
    assert bool((found.share > 0).all())


def test_pixels_whose_centre_misses_have_a_sample_of_their_own():
    view, guide = camera(), guide_of(sphere(RADIUS, 192))
    outlined = CoverageGuide(guide, 4)
    centers, found = guide.surfaces(view), outlined.surfaces(view)
    added = found.hit & ~centers.hit
    assert int(added.sum()) > 5
    kept = centers.hit
    for name in ("near", "far", "second", "triangle"):
        assert torch.equal(getattr(found, name)[kept], getattr(centers, name)[kept]), name
    assert torch.equal(found.normal[:, kept], centers.normal[:, kept])
    assert bool((found.triangle[added] >= 0).all())
    assert bool((found.near[added] > DISTANCE - RADIUS).all())
    assert bool((found.far[added] >= found.near[added]).all())
    torch.testing.assert_close(found.normal[:, added].norm(dim=0), torch.ones(int(added.sum())))


def test_rows_of_wanted_pixels_in_any_order():
    found = CoverageGuide(guide_of(sphere(RADIUS)), 2).coverage(camera())
    wanted = torch.cat((found.pixels[[5, 2]], torch.tensor([0]), found.pixels[[9]]))
    here, rows = found.rows(wanted)
    assert here.tolist() == [0, 1, 3]
    assert rows.tolist() == [5, 2, 9]


def test_where_nothing_is_seen_there_is_no_outline():
    view = camera()
    away = guide_of(box((50.0, 50.0, 50.0), (51.0, 51.0, 51.0)))
    found = CoverageGuide(away, 4)
    assert len(found.coverage(view).pixels) == 0
    assert [len(each) for each in found.coverage(view).rows(torch.arange(7))] == [0, 0]
    assert not bool(found.surfaces(view).hit.any())


def test_a_camera_is_sampled_once():
    guide = guide_of(sphere(RADIUS))
    outlined = CoverageGuide(guide, 2)
    first = outlined.coverage(camera())
    assert outlined.coverage(camera()) is first
    assert outlined.coverage(camera(30)) is not first
    assert np.isclose(float(first.share.max()), 1.0)


def test_a_pixel_has_a_sample():
    with pytest.raises(ValueError, match="side is 0"):
        CoverageGuide(guide_of(sphere(RADIUS)), 0)
