"""The mask of pixels on a discontinuity: each rule once, on and off."""

import math

import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.render.buffers import RasterOptions
from rtgs.render.discontinuities.surfels import DiscontinuityBands, discontinuity_mask

from .scenes import ALL_OUTPUTS, identity_camera, join, surfel
from .strategies import Recipe, SurfelTensors, build

PLAIN = RasterOptions()


def flagged(surfels: SurfelTensors, camera: Camera | None = None, options: RasterOptions = ALL_OUTPUTS) -> bool:
    """Whether the middle pixel is flagged."""
    camera = camera or identity_camera()
    return bool(discontinuity_mask(*surfels.all(), camera, options=options)[camera.height // 2, camera.width // 2])


def turned_camera() -> Camera:
    c, s = math.cos(0.3), math.sin(0.3)
    return Camera(torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]]), torch.zeros(3), 10.0, 10.0, 4.5, 3.5, 9, 7)


def test_nothing_is_flagged_away_from_thresholds():
    stack = join(surfel((0.01, 0.012, 2.0), scales=(5, 5)), surfel((0, 0, 4.0), scales=(9, 8), opacity=0.3))
    assert not discontinuity_mask(*stack.all(), identity_camera(), options=ALL_OUTPUTS)[0, 0]


@pytest.mark.parametrize("level", [1 / 255, 0.99])
def test_alpha_near_the_cut_or_the_clamp(level: float):
    shape = {"mean": (0.01, 0.0, 2.0), "scales": (2.0, 2.0)}
    gain = 1 / math.exp(-0.5 * 0.005**2)
    assert flagged(surfel(opacity=gain * (level + 0.9e-4), **shape))
    assert flagged(surfel(opacity=gain * (level - 0.9e-4), **shape))
    assert not flagged(surfel(opacity=gain * (level - 1.1e-4), **shape))
    assert not flagged(surfel(opacity=gain * (level + 1.1e-4), **shape))


def stack_to(transmittance: float, count: int) -> SurfelTensors:
    """``count`` surfels after which T at the middle pixel is ``transmittance``, and one more behind them."""
    depths = range(1, count + 1)
    peak = (1 - transmittance ** (1 / count)) / math.exp(-0.5 * (0.03 / 5) ** 2)  # hits lie 0.3 pixels off the centre
    front = [surfel((0.03 * z, 0.0, z), opacity=peak, scales=(5.0 * z, 5.0 * z)) for z in depths]
    return join(*front, surfel((0.0, 0.6, 20.0), opacity=0.3, scales=(50.0, 50.0)))


def test_transmittance_at_the_cutoff():
    assert flagged(stack_to(1e-4 * (1 + 5e-5), 6))
    assert flagged(stack_to(1e-4 * (1 - 5e-5), 6))
    assert not flagged(stack_to(1e-4 * (1 + 5e-3), 6))


def test_transmittance_at_one_half_matters_to_the_median_only():
    assert flagged(stack_to(0.5 * (1 + 5e-5), 2))
    assert not flagged(stack_to(0.5 * (1 + 5e-5), 2), options=PLAIN)
    assert not flagged(stack_to(0.505, 2))


def test_branches_that_meet():
    camera = identity_camera()
    scale = math.sqrt(0.5) * 2.0 / 10.0  # the low-pass, in world units at z = 2
    assert flagged(surfel((0.1, 0.0, 2.0), scales=(scale, scale)), camera)
    assert not flagged(surfel((0.1, 0.0, 2.0), scales=(scale * 1.1, scale * 1.1)), camera)


def test_equal_depths_unless_exactly_equal_in_float32_as_well():
    first, shape = (0.01, 0.0, 3.0), {"scales": (5.0, 5.0), "opacity": 0.3}
    row = turned_camera().rotation[2]
    along = torch.linalg.cross(row, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))  # keeps z
    moved = tuple((torch.tensor(first, dtype=torch.float64) + 0.1 * along).tolist())
    tied = join(surfel(first, **shape), surfel(moved, **shape))  # type: ignore[arg-type]
    twice = join(surfel(first, **shape), surfel(first, **shape))
    apart = join(surfel(first, **shape), surfel((0.01, 0.0, 3.001), **shape))
    assert flagged(tied, turned_camera())
    assert not flagged(twice, turned_camera())
    assert not flagged(apart, turned_camera())
    assert not flagged(join(surfel(first, **shape), surfel((0.1, 0.05, 3.0), **shape)), identity_camera())


def test_tie_with_an_unseen_surfel_is_no_tie():
    shape = {"scales": (0.05, 0.05), "opacity": 0.3}
    camera = turned_camera()
    ray = camera.rotation.T @ torch.tensor([0.06, 0.0, 3.0], dtype=torch.float64)
    aside = [camera.rotation.T @ torch.tensor([1.3, 0.0, z], dtype=torch.float64) for z in (3 - 5e-7, 3 + 5e-7)]
    assert not flagged(join(*(surfel(tuple(p.tolist()), **shape) for p in (ray, *aside))), camera, options=PLAIN)


def test_centre_and_hit_at_the_near_plane():
    wide = {"tangent_u": (1.0, 0.0, -1.0), "scales": (5.0, 5.0), "opacity": 0.5}  # the middle pixel's hit is at 0.26
    assert flagged(surfel((0.06, 0, 0.2 + 1e-8), **wide), options=PLAIN)
    assert flagged(surfel((0.06, 0, 0.2 - 1e-8), **wide), options=PLAIN)
    assert not flagged(surfel((0.06, 0, 0.2001), **wide), options=PLAIN)
    for z_hit, expected in (
        (0.2 * (1 + 5e-5), True),
        (0.2 * (1 - 5e-5), True),
        (0.2 * 1.01, False),
        (0.2 * 0.99, False),
    ):
        # the plane through (0, 0, z_hit) with slope 1 in y, centred 1 unit up it
        tilted = surfel((0.0, 1.0, z_hit + 1), tangent_u=(1, 0, 0), tangent_v=(0, 1, 1), scales=(3.0, 3.0), opacity=0.5)
        assert flagged(tilted, options=PLAIN) is expected


def test_edge_on_surfel_matters_to_normals_only():
    edge = surfel((0.05, 0.0, 2.0), tangent_u=(0.0, 1.0, 0.0), tangent_v=(0.05, 0.0, 2.0))
    assert flagged(edge)
    assert not flagged(edge, options=PLAIN)


def test_ordinary_pictures_are_hardly_flagged_and_bands_widen():
    scene = build(Recipe("ordinary", 1, 40, 30, 20, 3))
    values = scene.surfels.leaves(torch.float64).all()
    narrow = discontinuity_mask(*values, scene.camera, options=ALL_OUTPUTS)
    wide = discontinuity_mask(*values, scene.camera, options=ALL_OUTPUTS, bands=DiscontinuityBands(alpha=1e-3))
    assert narrow.double().mean() < 0.1
    assert (wide | ~narrow).all()
    assert wide.sum() > narrow.sum()
