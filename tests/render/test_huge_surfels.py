"""Scale gradients of surfels wider than the picture: each against its own size, as Adam takes them."""

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import RasterOptions
from rtgs.render.reference import surfels as reference
from rtgs.render.surfels import rasterize_surfels

from .scenes import identity_camera
from .strategies import SurfelTensors

OPTIONS = RasterOptions(depth=True, normal=True, distortion=True)
PICTURES = ("features", "alpha", "depth", "normal", "distortion")
WIDTH, HEIGHT, FOCAL = 32, 24, 30.0
CAMERA = identity_camera(WIDTH, HEIGHT, fx=FOCAL, fy=FOCAL, cx=16.3, cy=11.8)


def surfels_of_width(pictures: float, tilt: float, count: int) -> SurfelTensors:
    """Standard deviations of about so many widths of the picture; ``tilt`` in radians, 0 faces the camera."""
    generator = torch.Generator().manual_seed(3)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    depth = 2 + 5 * uniform(count)
    means = torch.cat(((uniform(count, 2) - 0.5) * depth[:, None], depth[:, None]), 1)
    turn, angle = 2 * torch.pi * uniform(count), torch.full((count,), tilt)
    normal = torch.stack((angle.sin() * turn.cos(), angle.sin() * turn.sin(), -angle.cos()), 1)
    tangent_u = torch.nn.functional.normalize(torch.linalg.cross(uniform(count, 3) - 0.5, normal), dim=1)
    scales = pictures * WIDTH / FOCAL * depth[:, None] * (0.5 + uniform(count, 2))
    tangent_v = torch.linalg.cross(normal, tangent_u)
    return SurfelTensors(means, tangent_u, tangent_v, scales, 0.05 + 0.3 * uniform(count), uniform(count, 3))


def scale_gradients(rasterizer, surfels: SurfelTensors, dtype: torch.dtype, camera: Camera = CAMERA) -> Tensor:
    """(N, 2) of a random function of all pictures of each surfel alone: no other one's rounding reaches it."""
    found = []
    for row in range(len(surfels.means)):
        leaves = surfels.rows(torch.tensor([row])).leaves(dtype)
        buffers = rasterizer(*leaves.all(), camera, options=OPTIONS)
        generator = torch.Generator().manual_seed(row)
        pictures = [getattr(buffers, name) for name in PICTURES]
        upstream = [torch.randn(picture.shape, generator=generator).to(dtype) for picture in pictures]
        found += torch.autograd.grad(pictures, [leaves.scales], upstream)
    return torch.cat(found)


@pytest.mark.parametrize("tilt", [0.3, 1.2])
@pytest.mark.parametrize("pictures", [1.0, 30.0, 1e3])
def test_each_scale_gradient_is_exact_relative_to_itself(isa: str, pictures: float, tilt: float):
    surfels = surfels_of_width(pictures, tilt, 24)
    exact = scale_gradients(reference.rasterize_surfels, surfels, torch.float64)
    assert (exact != 0).all()
    found = scale_gradients(rasterize_surfels, surfels, torch.float32)
    error = ((found.double() - exact) / exact).abs()
    assert error.median() < 1e-4
    assert error.max() < 1e-2


def test_the_two_forms_meet_at_their_border(isa: str):
    """Around four pictures, where the kernel changes from one form to the other, nothing jumps."""
    camera = identity_camera(WIDTH, HEIGHT, fx=FOCAL, fy=FOCAL * HEIGHT / WIDTH, cx=16.3, cy=11.8)
    surfels = surfels_of_width(1.0, 0.3, 8)
    border = 4 * WIDTH / FOCAL * surfels.means[:, 2:]
    for factor in (0.999, 1.001):
        here = SurfelTensors(*(border.expand(-1, 2) * factor if t is surfels.scales else t for t in surfels.all()))
        exact = scale_gradients(reference.rasterize_surfels, here, torch.float64, camera)
        found = scale_gradients(rasterize_surfels, here, torch.float32, camera)
        torch.testing.assert_close(found.double(), exact, rtol=5e-3, atol=0)
