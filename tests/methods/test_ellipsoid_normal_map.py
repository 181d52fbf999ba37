"""The map of normals of ellipsoids: closed forms, the surfels' map where they are flat, gradients against the twin."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from training_cases import look_at_origin, small_method, small_scene, small_schedule

from rtgs.core.cameras import Camera
from rtgs.gaussians.activate import activate_gaussians
from rtgs.gaussians.channels import Channel
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.normals import NORMAL_RESIDUAL, normal_residual_channel
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.surfels import Surfels, activate
from rtgs.methods import Mode, RenderOptions, create_method
from rtgs.methods.model import Model
from rtgs.methods.parts.kinds import ELLIPSOIDS, SURFELS, GaussianKind, RasterRequest
from rtgs.methods.parts.part import Frame, Rows
from rtgs.render.buffers import EllipsoidOptions, RasterBuffers
from rtgs.render.features import NORMAL, named_features
from rtgs.render.reference.ellipsoids import rasterize_ellipsoids as twin
from rtgs.render.settings import RenderSettings
from rtgs.train.seeds import generator_for

CAMERA = look_at_origin(0.4)
WANTED = RenderOptions(normal=True)
FLAT = -9.0  # log of the third scale


def gaussians(kind: type[Gaussians], means: Tensor, quaternions: Tensor, size: float = 0.25) -> Gaussians:
    """Grey ones of opacity 0.9, the first two scales ``size``; the third of ellipsoids is next to nothing."""
    count = len(means)
    scales = torch.full((count, kind.axis_count), math.log(size))
    scales[:, 2:] = FLAT
    return kind(means, scales, quaternions, torch.full((count,), 2.2), torch.zeros(count, 3), torch.zeros(count, 0, 3))


def shown(kind: GaussianKind, made: Gaussians, wanted: RenderOptions = WANTED, channels: int = 3) -> RasterBuffers:
    rows = activate_gaussians(made, CAMERA.center.float(), 0)
    background = torch.full((channels,), 0.5)
    request = RasterRequest(CAMERA, wanted, False, None, background, RenderSettings(), 4.4)
    return kind.rasterize(rows, rows.colors[:, :1].expand(-1, channels), request)


def turned(degrees: float) -> Tensor:
    """(1, 4) rotation about the world's y axis."""
    half = math.radians(degrees) / 2
    return torch.tensor([[math.cos(half), 0.0, math.sin(half), 0.0]])


def axis_towards_camera(degrees: float) -> Tensor:
    """The third axis under :func:`turned`, on the side of the camera: it looks from far away at the origin."""
    angle = math.radians(degrees)
    axis = torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
    return axis if float(axis @ CAMERA.center.float()) > 0 else -axis


@pytest.mark.parametrize("degrees", [0.0, 50.0, 160.0, 200.0])
def test_one_ellipsoid_shows_its_shortest_axis_times_its_weight(degrees: float):
    buffers = shown(ELLIPSOIDS, gaussians(Ellipsoids, torch.zeros(1, 3), turned(degrees)))
    assert buffers.normal is not None
    assert float(buffers.alpha.max()) > 0.7
    expected = buffers.alpha * axis_towards_camera(degrees)[:, None, None]
    torch.testing.assert_close(buffers.normal, expected, atol=2e-6, rtol=0)


def test_ellipsoids_behind_each_other_are_composited_with_their_weights():
    """sum of w n, front to back: a_1 n_1 + (1 - a_1) a_2 n_2."""
    front = 0.7 * torch.nn.functional.normalize(CAMERA.center.float(), dim=0)
    means, poses = torch.stack((front, -front)), (20.0, -40.0)
    alone = [gaussians(Ellipsoids, mean[None], turned(pose)) for mean, pose in zip(means, poses)]
    first, second = (shown(ELLIPSOIDS, made).alpha for made in alone)
    both = gaussians(Ellipsoids, means, torch.cat([turned(pose) for pose in poses]))
    n_1, n_2 = (axis_towards_camera(pose)[:, None, None] for pose in poses)
    found = shown(ELLIPSOIDS, both).normal
    assert found is not None
    torch.testing.assert_close(found, first * n_1 + (1 - first) * second * n_2, atol=3e-6, rtol=0)
    assert float(((1 - first) * second).max()) > 0.1


def test_flat_ellipsoids_have_the_normals_of_surfels():
    """Apart from each other, turned at random, from both sides: the same direction, and length alpha in both maps."""
    generator = torch.Generator().manual_seed(5)
    grid = torch.cartesian_prod(torch.linspace(-1, 1, 4), torch.linspace(-0.7, 0.7, 3))
    across = CAMERA.rotation[:2].float()
    poses = torch.nn.functional.normalize(torch.randn(12, 4, generator=generator), dim=1)
    maps = []
    for kind, type_ in ((ELLIPSOIDS, Ellipsoids), (SURFELS, Surfels)):
        maps.append(shown(kind, gaussians(type_, grid @ across, poses, size=0.09)))
    seen = torch.stack([buffers.alpha for buffers in maps]).amin(0) > 0.3
    assert int(seen.sum()) > 60
    units = []
    for buffers in maps:
        assert buffers.normal is not None
        units.append(buffers.normal[:, seen] / buffers.alpha[seen])
        torch.testing.assert_close(units[-1].norm(dim=0), torch.ones(int(seen.sum())), atol=2e-2, rtol=0)
    degrees = torch.rad2deg((units[0] * units[1]).sum(0).clamp(-1, 1).acos())
    assert float(degrees.max()) < 2.0


def test_the_map_changes_no_bit_of_the_others_and_is_only_made_where_asked_for(monkeypatch: pytest.MonkeyPatch):
    generator = torch.Generator().manual_seed(1)
    made = gaussians(Ellipsoids, 0.5 * torch.randn(40, 3, generator=generator), torch.randn(40, 4, generator=generator))
    for channels in (3, 29):
        plain = shown(ELLIPSOIDS, made, RenderOptions(depth=True), channels)
        whole = shown(ELLIPSOIDS, made, RenderOptions(depth=True, normal=True), channels)
        assert plain.normal is None
        assert whole.normal is not None
        assert whole.normal.shape == (3, CAMERA.height, CAMERA.width)
        for name in ("features", "alpha", "depth"):
            assert torch.equal(getattr(plain, name), getattr(whole, name)), name
    with pytest.raises(ValueError, match="1 to 32 columns in all"):
        shown(ELLIPSOIDS, made, WANTED, channels=30)
    monkeypatch.setattr("rtgs.methods.parts.kinds.shortest_axes", None)
    shown(ELLIPSOIDS, made, RenderOptions(depth=True))


def method_of(*channels: Channel) -> tuple[Model, Camera]:
    """3dgs with long and short axes, and these channels in its set."""
    scene = small_scene(points=40)
    method = create_method(small_method("3dgs"), scene, small_schedule(), generator_for(0, "initialise"))
    assert isinstance(method, Model)
    generator = torch.Generator().manual_seed(2)
    (part,) = method.sets
    part.adopt(part.gaussians.with_channels(*channels))
    with torch.no_grad():
        part.gaussians.log_scales += 0.4 * torch.randn(40, 3, generator=generator)
        if channels:
            part.gaussians[NORMAL_RESIDUAL] += 0.4 * torch.randn(40, 3, generator=generator)
    return method, scene.train[0].camera


def exact_map(made: Gaussians, camera: Camera, settings: RenderSettings, near: float) -> Tensor:
    """The map by the readable twins alone, from raw parameters, in their dtype."""
    rows = activate(made, camera.center.to(made.means), 0)
    layout, features = named_features(made, rows.colors, normals_seen_from=camera.center)
    options = EllipsoidOptions(near=near, dilation=settings.dilation)
    parts = (rows.means, rows.tangent_u, rows.tangent_v, rows.scales, rows.opacities)
    return layout.split(twin(*parts, features, camera, options=options).features)[NORMAL]


@pytest.mark.parametrize("channels", [(), (normal_residual_channel(1e-3),)], ids=["plain", "residual"])
def test_gradients_are_those_of_the_twin_and_of_finite_differences(channels: tuple[Channel, ...]):
    method, camera = method_of(*channels)
    (part,) = method.sets
    upstream = torch.randn(3, camera.height, camera.width, generator=torch.Generator().manual_seed(3))
    found = method.render(camera, 0, Mode.EVALUATE, WANTED).buffers.normal
    assert found is not None
    (found * upstream).sum().backward()

    exact = part.gaussians.like({name: tensor.detach().double() for name, tensor in part.gaussians.items()})
    near = method.settings.render.near * method.extent

    def value(made: Gaussians) -> Tensor:
        return (exact_map(made, camera, method.settings.render, near) * upstream.double()).sum()

    expected = exact_map(exact, camera, method.settings.render, near)
    torch.testing.assert_close(found.detach().double(), expected, atol=1e-4, rtol=0)
    value(exact.requires_grad_()).backward()
    generator = torch.Generator().manual_seed(4)
    for name in ("means", "log_scales", "quaternions", "opacity_logits", *(channel.name for channel in channels)):
        gradient, mine = exact[name].grad, part.gaussians[name].grad
        assert gradient is not None
        assert mine is not None
        assert float((mine.double() - gradient).abs().max()) <= 2e-3 * float(gradient.abs().max()), name
        way = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        with torch.no_grad():
            ends = [value(exact.like({**dict(exact.items()), name: exact[name] + s * 1e-6 * way})) for s in (1, -1)]
        along = float((gradient * way).sum())
        assert float(ends[0] - ends[1]) / 2e-6 == pytest.approx(along, rel=2e-3, abs=1e-3), name


def test_rows_that_a_part_appends_have_normals_without_a_residual():
    method, camera = method_of(normal_residual_channel(1e-3))
    frame = Frame(camera, 0, Mode.EVALUATE, WANTED)
    more = gaussians(Ellipsoids, torch.zeros(1, 3), turned(0.0), size=1.0)
    more.opacity_logits = torch.full((1,), 9.0)
    shape = activate_gaussians(more, camera.center.float(), 0)
    in_front = replace(shape, means=0.8 * camera.center.float()[None])
    rows = Rows(in_front, shape.colors)
    with torch.no_grad():
        covered = method.base.rasterize(frame, WANTED, [rows]).buffers
        bare = method.base.rasterize(frame, WANTED).buffers
    assert covered.normal is not None
    assert bare.normal is not None
    middle = (slice(None), camera.height // 2, camera.width // 2)
    axis = torch.tensor([0.0, 0.0, math.copysign(1.0, float(camera.center[2]))])
    torch.testing.assert_close(covered.normal[middle], axis, atol=0.05, rtol=0)
    assert float((bare.normal[middle] - axis).abs().max()) > 0.1
