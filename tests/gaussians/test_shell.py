"""The far shell: even, far, around the cameras; and joined to the points of a base set."""

from dataclasses import replace

import pytest
import torch

from rtgs.gaussians.initialize import gaussians_from_points, surfels_from_points
from rtgs.gaussians.settings import InitSettings
from rtgs.gaussians.shell import far_shell
from rtgs.gaussians.surfels import Surfels


def test_the_shell_is_even_and_far() -> None:
    centers = torch.tensor([[1.0, 2.0, 3.0], [3.0, 2.0, 5.0]])
    away = far_shell(500, 5.0, centers, extent=2.0) - centers.mean(0)
    assert torch.allclose(away.norm(dim=1), torch.tensor(10.0), rtol=1e-5)
    assert away.mean(0).norm() < 0.01 * 10
    nearest = torch.cdist(away, away).fill_diagonal_(torch.inf).min(1).values
    assert nearest.min() > 0.5 * nearest.max()


def test_more_points_join_the_others() -> None:
    points, colors = torch.rand(30, 3), torch.rand(30, 3)
    more = (torch.rand(7, 3) + 50, torch.full((7, 3), 0.25))
    made = gaussians_from_points(Surfels, points, colors, InitSettings(), torch.Generator(), more=more)
    own = surfels_from_points(points, colors, InitSettings(), torch.Generator())
    assert torch.equal(made.means, torch.cat((points, more[0])))
    assert torch.equal(made.sh_dc[:30], own.sh_dc)
    assert torch.equal(made.log_scales[:30], own.log_scales)  # the shell is nobody's neighbour
    assert (made.log_scales[30:].exp() < 1).all()


def test_more_points_do_not_widen_the_box_of_random_ones() -> None:
    points, more = torch.rand(30, 3), (torch.full((5, 3), 90.0), torch.zeros(5, 3))
    settings = InitSettings(random_points=200)
    made = gaussians_from_points(Surfels, points, points, settings, torch.Generator(), more=more)
    assert len(made) == 205
    assert made.means[:200].max() < 2


def test_more_points_do_not_count_for_the_least_number() -> None:
    points = torch.rand(3, 3)
    with pytest.raises(Exception, match="only 3 of 3 points are usable"):
        gaussians_from_points(Surfels, points, points, InitSettings(), torch.Generator(), more=(points, points))


@pytest.mark.parametrize(("key", "value"), [("shell_points", -1), ("shell_distance", 0.0)])
def test_a_shell_that_cannot_be_is_refused(key, value) -> None:
    with pytest.raises(ValueError, match=key):
        replace(InitSettings(), **{key: value})
