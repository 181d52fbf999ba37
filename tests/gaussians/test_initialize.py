"""Initial surfels: numbers of method.md 2, degenerate clouds, errors."""

import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.gaussians.activate import activate_gaussians
from rtgs.gaussians.initialize import (
    neighbor_distance,
    points_box,
    random_points,
    surface_orientations,
    surfels_from_points,
)
from rtgs.gaussians.settings import InitSettings


def cloud(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, 3, generator=generator), torch.rand(count, 3, generator=generator)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


def test_numbers():
    points, colors = cloud(100)
    surfels = surfels_from_points(points, colors, InitSettings(), generator())
    assert torch.equal(surfels.means, points)
    assert all(values.requires_grad and values.dtype == torch.float32 for _, values in surfels.items())
    activated = activate_gaussians(surfels, torch.tensor([9.0, 9, 9]), 3)
    torch.testing.assert_close(activated.opacities, torch.full((100,), 0.1))
    torch.testing.assert_close(activated.colors, colors)
    assert ((surfels.quaternions >= 0) & (surfels.quaternions <= 1)).all()
    assert surfels.sh_rest.shape == (100, 15, 3)
    assert (surfels.sh_rest == 0).all()
    distance = torch.cdist(points.double(), points.double()).square()
    expected = distance.sort(dim=1).values[:, 1:4].mean(dim=1).sqrt().float()
    torch.testing.assert_close(activated.scales, expected[:, None].expand(-1, 2), rtol=1e-5, atol=0)


def test_same_generator_same_surfels():
    first, second = (surfels_from_points(*cloud(20), InitSettings(), generator()) for _ in range(2))
    assert all(torch.equal(a, b) for (_, a), (_, b) in zip(first.items(), second.items()))


def test_does_not_share_memory_with_the_points():
    points, colors = cloud(20)
    surfels = surfels_from_points(points, colors, InitSettings(), generator())
    with torch.no_grad():
        surfels.means += 1
    assert torch.equal(points, cloud(20)[0])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_degree(degree):
    surfels = surfels_from_points(*cloud(12), InitSettings(sh_degree=degree), generator())
    assert surfels.sh_degree == degree


def test_duplicates_get_the_floor():
    points = torch.zeros(30, 3)
    points[20:] = cloud(10)[0]
    surfels = surfels_from_points(points, torch.rand(30, 3), InitSettings(), generator())
    torch.testing.assert_close(surfels.log_scales[:20].exp(), torch.full((20, 2), 1e-7**0.5))
    assert torch.isfinite(surfels.log_scales).all()


def test_few_points():
    torch.testing.assert_close(neighbor_distance(torch.tensor([[0.0, 0, 0], [3.0, 4, 0]]), 3), torch.tensor([5.0, 5.0]))
    torch.testing.assert_close(neighbor_distance(torch.zeros(1, 3), 3), torch.tensor([1e-7**0.5]))
    assert neighbor_distance(torch.zeros(0, 3), 3).shape == (0,)
    surfels = surfels_from_points(torch.zeros(1, 3), torch.zeros(1, 3), InitSettings(min_points=1), generator())
    assert len(surfels) == 1


def test_bad_points_are_left_out():
    points, colors = cloud(20)
    points[3, 1] = float("nan")
    colors[5, 0] = float("inf")
    surfels = surfels_from_points(points, colors, InitSettings(), generator())
    assert len(surfels) == 18
    assert torch.isfinite(surfels.means).all()


def test_too_few_points_say_how_many():
    points, colors = cloud(5)
    points[0] = float("nan")
    with pytest.raises(ValueError, match=r"only 4 of 5 points are usable, but init.min_points is 10.*random_points"):
        surfels_from_points(points, colors, InitSettings(), generator())


def test_random_points_fill_the_box():
    box = torch.tensor([[-1.0, 0, 2], [1.0, 4, 3]])
    surfels = surfels_from_points(*cloud(0), InitSettings(random_points=500), generator(), box=box)
    assert len(surfels) == 500
    assert (surfels.means >= box[0]).all()
    assert (surfels.means <= box[1]).all()
    torch.testing.assert_close(surfels.means.mean(0), box.mean(0), atol=0.2, rtol=0)


def test_random_points_in_the_box_of_the_points():
    points, colors = cloud(1000)
    points[0] = 1e6  # an outlier
    surfels = surfels_from_points(points, colors, InitSettings(random_points=50), generator())
    assert surfels.means.abs().max() < 4


@pytest.mark.parametrize(
    ("points", "message"), [(torch.zeros(0, 3), "no points"), (torch.ones(20, 3), "all 20 points are at")]
)
def test_random_points_without_a_box(points, message):
    with pytest.raises(ValueError, match=message):
        surfels_from_points(points, torch.zeros_like(points), InitSettings(random_points=50), generator())
    assert points_box(torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])).shape == (2, 3)


def test_bad_arguments():
    points, colors = cloud(20)
    with pytest.raises(ValueError, match=r"must both be \(P, 3\)"):
        surfels_from_points(points, colors[:10], InitSettings(), generator())
    with pytest.raises(ValueError, match=r"init.opacity 1.0"):
        surfels_from_points(points, colors, InitSettings(opacity=1.0), generator())
    with pytest.raises(ValueError, match=r"init.neighbors 0"):
        surfels_from_points(points, colors, InitSettings(neighbors=0), generator())
    with pytest.raises(ValueError, match="low corner first"):
        random_points(5, torch.tensor([[1.0, 0, 0], [0.0, 1, 1]]), generator())


def test_pca_lays_discs_on_the_surface_of_the_points():
    """A plane that no axis belongs to, with noise a hundredth of the spacing: normals within a degree or two."""
    source = generator()
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8]), dim=0)
    flat = torch.randn(400, 3, generator=source)
    points = flat - (flat @ normal)[:, None] * normal + 1e-3 * torch.randn(400, 1, generator=source) * normal
    settings = InitSettings(orientation="pca")
    made = surfels_from_points(points, torch.rand(400, 3, generator=source), settings, generator())
    active = activate_gaussians(made, torch.zeros(3), 0)
    third = torch.linalg.cross(active.tangent_u, active.tangent_v)
    assert float((third @ normal).abs().quantile(0.02)) > 0.999
    again = surfels_from_points(points, torch.rand(400, 3), settings, torch.Generator().manual_seed(1))
    assert torch.equal(made.quaternions, again.quaternions), "nothing is drawn"
    assert all(tensor.is_contiguous() for _, tensor in made.items()), "or Adam would move copies"


def test_pca_of_few_or_equal_points_stays_finite():
    for points in (torch.zeros(12, 3), torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.zeros(1, 3)):
        found = surface_orientations(points)
        torch.testing.assert_close(found.norm(dim=1), torch.ones(len(points)))


def test_an_unknown_orientation_is_refused():
    with pytest.raises(RtgsError, match=r"init\.orientation='pcs' is unknown: .*did you mean 'pca'"):
        InitSettings(orientation="pcs")  # type: ignore[arg-type]
