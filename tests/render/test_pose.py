"""Gradients by a camera's pose: of the float64 twins against finite differences, of the kernels against the twins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.activate import activate_gaussians
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.surfels import Surfels, activate
from rtgs.render import ellipsoids, surfels
from rtgs.render.buffers import EllipsoidOptions, RasterOptions
from rtgs.render.pose import NUMBERS, Pose, moved, rotation_of, seen_from
from rtgs.render.reference import ellipsoids as reference_ellipsoids
from rtgs.render.reference import surfels as reference_surfels

WIDTH, HEIGHT, UNIT = 26, 20, 3.0
SURFEL_MAPS = RasterOptions(depth=True, normal=True, distortion=True)
STEP = 1e-6  # of finite differences


def case_camera() -> Camera:
    """Off the origin, turned about all axes, with fx != fy."""
    turn = rotation_of(torch.tensor([0.2, -0.4, 0.3, 0.1, 0.2, -0.5], dtype=torch.float64))
    center = torch.tensor([0.7, -0.4, -3.0], dtype=torch.float64)
    return Camera(turn, -turn @ center, 24.0, 21.0, 0.52 * WIDTH, 0.47 * HEIGHT, WIDTH, HEIGHT)


@dataclass(frozen=True)
class Case:
    """Gaussians before :func:`case_camera`, and weights of a loss over every map they have."""

    gaussians: Gaussians
    weights: dict[str, Tensor]

    def loss(self, pose: Pose, *, native: bool = False) -> Tensor:
        camera = pose.of(case_camera())
        if native:
            rows = activate_gaussians(self.gaussians, pose.center.float(), 3)
        else:
            rows = activate(self.gaussians, pose.center, 3)
        rows = seen_from(pose, rows)
        shape = (rows.means, rows.tangent_u, rows.tangent_v, rows.scales, rows.opacities, rows.colors)
        if isinstance(self.gaussians, Surfels):
            room = surfels if native else reference_surfels
            found = room.rasterize_surfels(*shape, camera, options=SURFEL_MAPS)
        else:
            room = ellipsoids if native else reference_ellipsoids
            found = room.rasterize_ellipsoids(*shape, camera, options=EllipsoidOptions(depth=True))
        maps = {name: getattr(found, name) for name in self.weights}
        if "normal" in maps:  # as all losses have it: in the camera's frame
            maps["normal"] = torch.einsum("cw,whx->chx", camera.rotation.to(maps["normal"].dtype), maps["normal"])
        return sum(((self.weights[name].to(each) * each).sum() for name, each in maps.items()), torch.zeros(()))


def of_rows(kind: type[Gaussians], rows: Sequence[Tensor]) -> Gaussians:
    means, scales, quaternions, logits, sh_dc, sh_rest = (each.detach().requires_grad_() for each in rows)
    return kind(means, scales, quaternions, logits, sh_dc, sh_rest)


def made(kind: type[Gaussians], dtype: torch.dtype = torch.float64, seed: int = 3, count: int = 14) -> Case:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator).to(dtype)

    camera = case_camera()
    local = torch.cat((0.8 * normal(count, 2), normal(count, 1).abs() + 2.5), 1).double()
    means = ((local - camera.translation) @ camera.rotation).to(dtype)
    scales = math.log(0.35) + 0.4 * normal(count, kind.axis_count)
    raw = (means, scales, normal(count, 4), normal(count), normal(count, 3), 0.4 * normal(count, 15, 3))
    gaussians = of_rows(kind, raw)
    size = {"features": (3, HEIGHT, WIDTH), "alpha": (HEIGHT, WIDTH), "depth": (HEIGHT, WIDTH)}
    if kind is Surfels:
        size |= {"normal": (3, HEIGHT, WIDTH), "distortion": (HEIGHT, WIDTH)}
    return Case(gaussians, {name: normal(*shape) for name, shape in size.items()})


def gradient(case: Case, delta: Tensor, *, native: bool = False) -> Tensor:
    delta = delta.clone().requires_grad_()
    (found,) = torch.autograd.grad(case.loss(moved(case_camera(), delta, UNIT), native=native), delta)
    return found


DELTAS = {
    "at rest": torch.zeros(NUMBERS, dtype=torch.float64),
    "moved": 0.03 * torch.tensor([1.0, -2.0, 0.5, 1.5, -1.0, 0.7, -0.3, 1.0, 2.0], dtype=torch.float64),
}


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
@pytest.mark.parametrize("where", DELTAS)
def test_the_twins_gradient_is_that_of_finite_differences(kind: type[Gaussians], where: str):
    case, delta = made(kind), DELTAS[where]
    found = gradient(case, delta)
    with torch.no_grad():
        sides = [
            [float(case.loss(moved(case_camera(), delta + sign * STEP * unit, UNIT))) for sign in (1, -1)]
            for unit in torch.eye(NUMBERS, dtype=torch.float64)
        ]
    expected = torch.tensor([(up - down) / (2 * STEP) for up, down in sides], dtype=torch.float64)
    assert float(expected.abs().max()) > 10
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max()))


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
@pytest.mark.parametrize("where", DELTAS)
def test_the_kernels_gradient_is_that_of_the_twins(kind: type[Gaussians], where: str):
    single = made(kind, torch.float32)
    double = replace(single, gaussians=of_rows(kind, [each.double() for _, each in single.gaussians.items()]))
    found, expected = gradient(single, DELTAS[where], native=True), gradient(double, DELTAS[where])
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
def test_a_pose_changes_no_bit_of_the_picture_and_of_other_gradients(kind: type[Gaussians]):
    case = made(kind, torch.float32)
    still = moved(case_camera(), DELTAS["at rest"], UNIT)
    assert torch.equal(still.rotation, case_camera().rotation)
    assert torch.equal(still.translation, case_camera().translation)
    taught = moved(case_camera(), DELTAS["at rest"].clone().requires_grad_(), UNIT)
    leaves = [each for _, each in case.gaussians.items()]
    with_pose, without = (case.loss(pose, native=True) for pose in (taught, still))
    assert float(with_pose.detach()) == float(without.detach())
    pairs = zip(torch.autograd.grad(with_pose, leaves), torch.autograd.grad(without, leaves), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)


def test_rotations_are_rotations():
    numbers = 0.3 * torch.randn(50, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for each in numbers:
        turn = rotation_of(each)
        torch.testing.assert_close(turn @ turn.T, torch.eye(3, dtype=torch.float64))
        assert float(torch.linalg.det(turn)) == pytest.approx(1)


def test_a_motion_is_one_of_the_camera_in_its_own_frame():
    """A motion along the camera's x axis by a tenth of the unit moves its centre so far along that axis."""
    delta = torch.tensor([0.1, *[0.0] * 8], dtype=torch.float64)
    camera = case_camera()
    shift = moved(camera, delta, UNIT).center - camera.center
    torch.testing.assert_close(shift, 0.1 * UNIT * camera.rotation[0])
