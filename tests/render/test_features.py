"""Named features through the rasterisers: layout, and that each named map is what its part alone would give."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rtgs.gaussians.activate import activate_gaussians
from rtgs.gaussians.channels import MAX_CHANNELS, Channel
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.harmonics import rgb_to_sh_dc
from rtgs.gaussians.materials import activate_materials, with_materials
from rtgs.gaussians.normals import NORMAL_RESIDUAL, ellipsoid_normals, normal_residual_channel
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.settings import MaterialSettings
from rtgs.gaussians.surfels import Surfels, activate
from rtgs.render.buffers import EllipsoidOptions
from rtgs.render.ellipsoids import rasterize_ellipsoids
from rtgs.render.features import FeatureLayout, feature_layout, named_features
from rtgs.render.reference.ellipsoids import rasterize_ellipsoids as twin
from rtgs.render.surfels import rasterize_surfels

from .comparison import pixel_error, relative_error
from .scenes import identity_camera

GLOSS = Channel("gloss_logits", 0.25, "sigmoid", rate=0.5)
CAMERA = replace(identity_camera(24, 19, fx=20.0, fy=21.0, cx=12.3, cy=9.4), translation=torch.tensor([0.1, -0.2, 0.3]))


def cloud(kind, count: int = 60, seed: int = 0) -> Gaussians:
    """Gaussians of a few pixels in front of the camera."""
    generator = torch.Generator().manual_seed(seed)

    def rows(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator)

    depth = 3 + 2 * torch.rand(count, 1, generator=generator)
    means = torch.cat((0.4 * depth * rows(2).clamp(-1.5, 1.5), depth), dim=1)
    scales = -1.6 + 0.5 * rows(kind.axis_count)
    colors = rgb_to_sh_dc(torch.rand(count, 3, generator=generator))
    return kind(means, scales, rows(4), rows(), colors, torch.zeros(count, 0, 3))


def drawn(gaussians: Gaussians, features: Tensor):
    shown = activate_gaussians(gaussians, CAMERA.center.float(), 0)
    parts = (shown.means, shown.tangent_u, shown.tangent_v, shown.scales, shown.opacities, features, CAMERA)
    return rasterize_ellipsoids(*parts) if isinstance(gaussians, Ellipsoids) else rasterize_surfels(*parts)


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
def test_maps_of_a_set_with_materials(kind):
    """They are those of the hand-made order of columns, bit for bit."""
    made = with_materials(cloud(kind), MaterialSettings(f0_channels=3))
    generator = torch.Generator().manual_seed(1)
    for name in made.names[6:]:
        made[name] = torch.randn(made[name].shape, generator=generator)
    colors = torch.rand(60, 3, generator=generator)
    layout, features = named_features(made, colors)
    assert layout.names == ("color", "specular_logits", "roughness_logits", "f0_logits")
    assert layout.columns == (3, 1, 1, 3)
    found = activate_materials(made)
    by_hand = torch.cat((colors, found.specular[:, None], found.roughness[:, None], found.f0), dim=1)
    assert torch.equal(features, by_hand)
    composited = drawn(made, features).features
    maps = layout.split(composited)
    assert torch.equal(maps["f0_logits"], composited[5:])
    assert maps["roughness_logits"].shape == (1, CAMERA.height, CAMERA.width)
    alone = drawn(made, found.roughness[:, None]).features
    torch.testing.assert_close(maps["roughness_logits"], alone)


def test_splitting_is_the_inverse_of_joining():
    layout = FeatureLayout(("a", "b", "c"), (2, 1, 4))
    generator = torch.Generator().manual_seed(0)
    values = {name: torch.rand(5, count, generator=generator) for name, count in zip("abc", (2, 1, 4))}
    joined = layout.join({**values, "b": values["b"][:, 0]})
    assert joined.shape == (5, layout.total)
    for name, part in layout.split(joined, dim=-1).items():
        assert torch.equal(part, values[name])
    picture = torch.rand(3, 2, 7, generator=generator)  # (H, W, C)
    last, first = layout.split(picture, dim=-1), layout.split(picture.permute(2, 0, 1))
    assert last["c"].shape == (3, 2, 4)
    assert all(torch.equal(last[name], first[name].permute(1, 2, 0)) for name in layout.names)
    assert layout.join({name: torch.zeros(0, count) for name, count in zip("abc", (2, 1, 4))}).shape == (0, 7)


@pytest.mark.parametrize(
    ("names", "columns", "message"),
    [
        (("a", "a"), (1, 1), "different names"),
        (("a",), (1, 2), "one number of columns for each"),
        (("a", "b"), (1, 0), "1 to 32 columns in all"),
        (("a", "b"), (3, 30), "1 to 32 columns in all"),
        ((), (), "1 to 32 columns in all"),
    ],
)
def test_a_layout_that_cannot_be_composited_is_refused(names, columns, message: str):
    with pytest.raises(ValueError, match=message):
        FeatureLayout(names, columns)


def test_values_that_do_not_fit_the_layout_are_named():
    layout = FeatureLayout(("a", "b"), (2, 1))
    with pytest.raises(ValueError, match="features a given for the layout of a, b"):
        layout.join({"a": torch.zeros(4, 2)})
    with pytest.raises(ValueError, match=r"feature b must have 1 columns, got \(4, 2\)"):
        layout.join({"a": torch.zeros(4, 2), "b": torch.zeros(4, 2)})
    with pytest.raises(ValueError, match=r"3 columns expected along dimension 0, got \(2, 5, 5\)"):
        layout.split(torch.zeros(2, 5, 5))


def test_the_residual_of_a_normal_is_no_column_of_its_own():
    made = cloud(Ellipsoids).with_channels(normal_residual_channel(1e-3), GLOSS)
    assert feature_layout(made).names == ("color", "gloss_logits")
    assert feature_layout(made, normals=True).names == ("color", "gloss_logits", "normal")
    wide = made.without_channels(NORMAL_RESIDUAL).with_channels(replace(GLOSS, name="wide", shape=(28,)))
    assert feature_layout(wide).total == MAX_CHANNELS
    with pytest.raises(ValueError, match="1 to 32 columns in all"):
        feature_layout(wide, normals=True)
    with pytest.raises(TypeError, match="normals of Surfels: ask the surfel rasteriser"):
        named_features(cloud(Surfels), torch.zeros(60, 3), normals_seen_from=torch.zeros(3))


def test_the_residual_alone_bends_the_composited_normals():
    """Only the residual's gradient turns the picture of normals towards another direction."""
    made = cloud(Ellipsoids).with_channels(normal_residual_channel(1e-3))
    made[NORMAL_RESIDUAL].requires_grad_()
    aim = torch.tensor([0.0, 0.6, -0.8])[:, None, None]

    def distance() -> Tensor:
        layout, features = named_features(made, torch.zeros(60, 3), normals_seen_from=CAMERA.center)
        buffers = drawn(made, features)
        return (layout.split(buffers.features)["normal"] - buffers.alpha * aim).square().mean()

    optimizer = torch.optim.Adam([made[NORMAL_RESIDUAL]], lr=0.05)
    first = float(distance().detach())
    for _ in range(60):
        optimizer.zero_grad()
        distance().backward()
        optimizer.step()
    assert float(distance().detach()) < 0.1 * first


@pytest.mark.parametrize("with_residual", [False, True])
def test_composited_normals_and_their_gradients_are_those_of_the_twin(isa: str, with_residual: bool):
    """From raw parameters to the picture of normals and back: native in float32 against the twin in float64."""
    made = cloud(Ellipsoids, seed=4).with_channels(GLOSS)
    made["gloss_logits"] = torch.linspace(-2, 2, 60)
    if with_residual:
        made = made.with_channels(normal_residual_channel(1e-3))
        made[NORMAL_RESIDUAL] = 0.4 * torch.randn(60, 3, generator=torch.Generator().manual_seed(2))
    exact = made.like({name: tensor.double() for name, tensor in made.items()}).requires_grad_()
    made.requires_grad_()
    upstream = torch.randn(3 + 1 + 3, CAMERA.height, CAMERA.width, generator=torch.Generator().manual_seed(5))
    upstream /= upstream.numel()
    pictures = []
    for gaussians, rasterize, active in ((made, rasterize_ellipsoids, activate_gaussians), (exact, twin, activate)):
        shown = active(gaussians, CAMERA.center.to(gaussians.means), 0)
        layout, features = named_features(gaussians, shown.colors, normals_seen_from=CAMERA.center)
        parts = (shown.means, shown.tangent_u, shown.tangent_v, shown.scales, shown.opacities)
        buffers = rasterize(*parts, features, CAMERA, options=EllipsoidOptions())
        (buffers.features * upstream.to(buffers.features)).sum().backward()
        pictures.append(layout.split(buffers.features.detach()))
    for name, picture in pictures[1].items():
        error = pixel_error(pictures[0][name], picture)
        assert float((error > 1e-5).double().mean()) <= 4e-3, name
    for name, tensor in exact.items():
        if name == "sh_rest":
            continue
        assert tensor.grad is not None
        assert made[name].grad is not None
        assert float(tensor.grad.abs().max()) > 0, name
        assert float(relative_error(made[name].grad, tensor.grad).max()) <= 1e-4, name
    if with_residual:
        assert isinstance(exact, Ellipsoids)
        plain = ellipsoid_normals(exact, CAMERA.center)
        bent = ellipsoid_normals(exact, CAMERA.center, exact[NORMAL_RESIDUAL])
        assert float((plain - bent).detach().abs().max()) > 0.1
