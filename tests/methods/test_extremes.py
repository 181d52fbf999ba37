"""Nothing of a reflection is NaN at the ends of any range, and gradients stay bounded (method.md 14)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reflective_cases import new_method, recipe, schedule, tiny
from torch import Tensor

from rtgs.methods import Mode, RenderOptions, Stage
from rtgs.methods.shading.blend import Blend, blended
from rtgs.methods.shading.mirror import SHORTEST_NORMAL, SurfacePixels, mirror_rays, reflected_weight
from rtgs.methods.shading.traced_pixels import TracedPixels
from rtgs.optics.settings import OpticsSettings

TOWARDS = torch.tensor([0.0, 0.0, -1.0])  # the camera, from what it sees straight ahead
SIDEWAYS = torch.tensor([1.0, 0.0, 0.0])
BOUNDED = {  # the largest gradient by one input, for light and upstream within [0, 1]
    "default": OpticsSettings(),
    "S_max 16": OpticsSettings(max_gain=16.0),
    "split sum": OpticsSettings(weight="split_sum"),
    "envgs": OpticsSettings(weight="envgs"),
    "conductor": OpticsSettings(fresnel="conductor"),
    "conductor, low edge": OpticsSettings(fresnel="conductor", edge_tint=0.1),
    "dielectric": OpticsSettings(fresnel="dielectric"),
    "coated": OpticsSettings(fresnel="coated"),
}
OPEN = {"no bound": OpticsSettings(max_gain=0.0), "literal": OpticsSettings(weight="literal")}
LARGEST_GRADIENT = 1e5  # of a whole model
LARGEST_OF_A_PIXEL = 1e6  # all drawn values together reach 5.4e5: 1 / SHORTEST_NORMAL times the slope at grazing

share = st.sampled_from([0.0, 1e-30, 1e-6, 1e-3, 0.5, 1 - 1e-6, 1.0])  # k_s, roughness, f0: both ends and near them
# Of the cosine between normal and view: straight on, grazing and just off it on either side, from behind.
cosine = st.sampled_from([1.0, 1 - 1e-7, 0.5, 1e-3, 1e-7, 0.0, -1e-7, -1e-3, -1.0])
length = st.sampled_from([0.0, 1e-38, 1e-20, 0.5 * SHORTEST_NORMAL, SHORTEST_NORMAL, 1.0, 1e4])  # of the summed normals


@dataclass(frozen=True)
class Pixel:
    """What the maps hold at one pixel."""

    specular: float
    roughness: float
    f0: float
    cosine: float
    length: float
    depth: float


pixels = st.builds(
    Pixel,
    specular=share,
    roughness=share,
    f0=share,
    cosine=cosine,
    length=length,
    depth=st.sampled_from([1e-6, 1, 1e5]),
)


def maps(drawn: list[Pixel]) -> SurfacePixels:
    """Float32 leaves of the pixels, seen along the camera's axis."""

    def leaf(values: list[float]) -> Tensor:
        return torch.tensor(values, dtype=torch.float32).requires_grad_()

    tilt = torch.tensor([p.cosine for p in drawn], dtype=torch.float32)
    normal = TOWARDS[:, None] * tilt + SIDEWAYS[:, None] * (1 - tilt.square()).clamp_min(0).sqrt()
    normal = (normal * torch.tensor([p.length for p in drawn])).requires_grad_()
    diffuse = torch.linspace(0, 1, len(drawn)).expand(3, -1).clone().requires_grad_()
    specular, roughness, f0, depth = (
        leaf([getattr(p, name) for p in drawn]) for name in ("specular", "roughness", "f0", "depth")
    )
    return SurfacePixels(diffuse, specular, roughness, f0, normal, depth)


@pytest.mark.parametrize("name", [*BOUNDED, *OPEN])
def test_a_pixel_at_the_ends_of_every_range(name: str):
    optics = (BOUNDED | OPEN)[name]

    @settings(max_examples=150, deadline=None, derandomize=True, database=None)
    @given(st.lists(pixels, min_size=1, max_size=20))
    def draw(drawn: list[Pixel]) -> None:
        given_maps = maps(drawn)
        view = -TOWARDS[:, None].expand(3, len(drawn)).contiguous()
        rays = mirror_rays(given_maps, torch.zeros(3), view)
        color = torch.linspace(1, 0, len(drawn)).expand(3, -1)
        light = (reflected_weight(rays.cosine, given_maps, optics), color)
        chosen, how = TracedPixels(torch.arange(len(drawn)), None), Blend("srgb", additive=False)
        image = blended(given_maps.diffuse, given_maps.specular, [light], chosen, how)
        for values in (rays.origins, rays.directions, rays.cosine, image):
            assert bool(values.isfinite().all())
        lengths = torch.tensor([p.length for p in drawn])
        reaching = rays.directions.detach().norm(dim=1)
        assert bool(((reaching - 1).abs() < 1e-5)[lengths > SHORTEST_NORMAL].all())
        along = rays.origins.sum() * 1e-3 + rays.directions.sum()  # what the tracer would send back
        (image.sum() + along).backward()
        for field in ("diffuse", "specular", "roughness", "f0", "normal", "depth"):
            gradient = getattr(given_maps, field).grad
            if gradient is None:
                assert name == "envgs", field
                continue
            assert bool(gradient.isfinite().all()), field
            if name in BOUNDED:
                assert float(gradient.abs().max()) < LARGEST_OF_A_PIXEL, field

    draw()


FAR = 30.0  # sigmoid(30) is 1 in float32
CORNERS = list(itertools.product((-110.0, -FAR, FAR), (-FAR, FAR), (-FAR, FAR)))  # sigmoid(-110) is 0


@pytest.fixture(scope="module")
def made():
    return tiny()


@pytest.mark.parametrize(("specular", "roughness", "f0"), CORNERS)
def test_a_training_step_at_the_corners_of_the_materials(made, specular: float, roughness: float, f0: float):
    chosen = recipe()
    method = new_method(replace(chosen, optics=replace(chosen.optics, max_gain=16.0)), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    surfels = method["base"].gaussians
    with torch.no_grad():
        for logits, value in (("specular_logits", specular), ("roughness_logits", roughness), ("f0_logits", f0)):
            surfels[logits].fill_(value)
        surfels.quaternions[::4] = 0  # no direction at all
        surfels.log_scales[::5] = torch.tensor([-20.0, 1.0])  # needles
    view = made.scene.train[0]
    rendered = method.render(view.camera, 15, Mode.TRAIN)
    assert bool(rendered.image.isfinite().all())
    method.losses(rendered, view, 15).total.backward()
    for part in method.sets:
        for key, tensor in part.gaussians.items():
            assert tensor.grad is None or bool(tensor.grad.isfinite().all()), f"{part.name}.{key}"
            assert tensor.grad is None or float(tensor.grad.abs().max()) < LARGEST_GRADIENT, f"{part.name}.{key}"
    method.after_step(15, rendered.observations)
    with torch.no_grad():
        assert bool(method.render(made.scene.test[0].camera, 16, Mode.EVALUATE, RenderOptions()).image.isfinite().all())
