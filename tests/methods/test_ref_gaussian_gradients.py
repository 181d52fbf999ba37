"""The whole of Ref-Gaussian, image, losses and every gradient, against a float64 composition of the twins."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from ref_gaussian_cases import CUBEMAP, INDIRECT, MATERIALS, mirror, settings
from torch import Tensor
from torch.nn.functional import conv2d, normalize, pad
from whole_twin import MCMC, STEP, Terms, Twin, begun, compare, reflected, rough_light, scene

from rtgs.core.cameras import Camera
from rtgs.gaussians.harmonics import SH_C0, sh_basis
from rtgs.gaussians.surfels import ActivatedGaussians, activate
from rtgs.light.lookup import cube_lookup_twin
from rtgs.light.prefilter import filtered_twin
from rtgs.mesh.triangles import TriangleMesh
from rtgs.methods.model import Model
from rtgs.methods.parts.split_sum_mirror import FORWARD, INDIRECT_DC, INDIRECT_REST
from rtgs.optics.split_sum import split_sum_factors
from rtgs.render.buffers import RasterBuffers
from rtgs.render.settings import RenderSettings
from rtgs.scenes.scene import View
from rtgs.train.method import RenderedView
from rtgs.train.settings import LossSettings
from tests.mesh.shapes import sphere

ALONE = LossSettings(normal=0.0)
SURFACE = LossSettings(
    normal=0.02, normal_start=0.0, normal_inverse_depth=True, mono_normal=0.02, distortion=0.5, distortion_start=0.0
)
BRIGHT = RenderSettings(background=(1.0, 0.7, 0.4))
ONE_LEVEL = replace(CUBEMAP, mips="none")
FINAL, SMOOTH = {"indirect_from": 1.0}, {"smooth": 0.45}  # without a mesh; gardenspheres' weight
SEEN = {"indirect_from": 0.5, "ray_offset": 1.0, "reach": 4.0}
VOXEL, NEAR = 0.1, 1e-4  # NEAR an edge of a triangle, as a share of it, or the end of the reach: rounding decides

CASES: dict[str, dict[str, Any]] = {
    "published, with every loss": {"own": FINAL | SMOOTH, "loss": SURFACE},
    "unit normals": {"own": FINAL | SMOOTH | {"normal": "unit"}},
    "one level": {"own": FINAL, "environment": ONE_LEVEL, "loss": ALONE},
    "visibility, with every loss": {"own": SEEN | SMOOTH, "loss": SURFACE},
    "visibility, unit normals": {"own": SEEN | {"normal": "unit", "reach": 0.0}, "loss": ALONE},
    "one by one, with every loss": {"own": {"forward_until": 0.8} | SMOOTH, "loss": SURFACE},
    "one by one, one level": {"own": {"forward_until": 0.8}, "environment": ONE_LEVEL, "loss": ALONE},
    "before a background, mcmc": {"own": FINAL, "render": BRIGHT, "density": MCMC},
}


class SplitSumTwin(Twin):
    """(1 - M) C_d + A (F_0 s + b) L of pixels; or rho (1 - m) E_d(n) + (F_0 s + b) E(w, r) of rows, composited."""

    def __init__(self, method: Model) -> None:
        super().__init__(method)
        self.one_by_one = FORWARD in self.groups
        self.texels = self.groups[FORWARD if self.one_by_one else "environment"]["texels"]

    def render(self, camera: Camera) -> tuple[RenderedView, Tensor]:
        raw = self.gaussians
        rows = activate(raw, camera.center, self.method.base.sh_degree(STEP))
        normals = torch.linalg.cross(rows.tangent_u, rows.tangent_v, dim=1)
        metal, rough, albedo = (raw[name].sigmoid().reshape(len(raw), -1) for name in MATERIALS)
        colors, own = rows.colors, []
        if self.one_by_one:
            view = rows.means - camera.center
            facing = torch.where((normals * view).sum(1, keepdim=True) > 0, -normals, normals)
            directions, cosine = reflected(view, facing)
            specular = self.lobe(metal[:, 0], rough[:, 0], albedo, cosine) * self.light(directions, rough[:, 0])
            colors = albedo * (1 - metal) * self.diffuse_light(facing) + specular
        elif INDIRECT_DC in raw:
            own = [self.indirect(rows, reflected(rows.means - camera.center, normals)[0])]
        buffers, fragile = self.raster(rows, torch.cat((colors, metal, rough, albedo, *own), 1), None, camera)
        image = buffers.features[:3]
        if not self.one_by_one:
            image, near = self.shaded(camera, buffers)
            fragile |= near
        return RenderedView(camera, image, buffers, maps={"specular": buffers.features[3]}), fragile

    def shaded(self, camera: Camera, buffers: RasterBuffers) -> tuple[Tensor, Tensor]:
        """(3, H, W) what each pixel shows, and (H, W) bool: rounding decides what its mirror ray meets."""
        shape = buffers.normal.shape
        color, material, albedo, indirect = buffers.features.flatten(1).T.tensor_split((3, 5, 8), 1)
        metal, rough = material.unbind(1)
        alpha, normal = buffers.alpha.reshape(-1, 1), buffers.normal.flatten(1).T
        normal = normalize(normal, dim=1) if self.own.get("normal") == "unit" else normal / alpha.clamp_min(1e-6)
        rays = camera.rays(torch.float64).directions.reshape(-1, 3)
        view = normalize(rays, dim=1)
        cosine = -(view * normal).sum(1)
        directions = normalize(view + 2 * cosine[:, None] * normal, dim=1)
        light, near = self.light(directions, rough), torch.zeros(shape[1:], dtype=torch.bool)
        if indirect.shape[1]:
            depth = buffers.depth.reshape(-1, 1) / alpha.clamp_min(1e-6)
            offset = self.own["ray_offset"] * VOXEL * normal
            free, decided = self.free(camera.center + depth * rays + offset, directions)
            assert 0.01 < float((~free).double().mean()) < 0.9
            light, near = torch.where(free[:, None], light, indirect), ~decided.reshape(shape[1:])
        image = (1 - metal[:, None]) * color + alpha * self.lobe(metal, rough, albedo, cosine) * light
        return image.T.reshape(shape), near

    def lobe(self, metal: Tensor, rough: Tensor, albedo: Tensor, cosine: Tensor) -> Tensor:
        """(P, 3) F_0 s + b."""
        scale, offset = (each[:, None] for each in split_sum_factors(cosine, rough.clamp_min(1e-3).square()))
        return (0.04 * (1 - metal[:, None]) + albedo * metal[:, None]) * scale + offset

    def light(self, directions: Tensor, rough: Tensor) -> Tensor:
        """(P, 3) of the raw texels, activated last."""
        cubemap = self.method.settings.environment
        if cubemap.mips == "ggx":
            return rough_light(self.texels, cubemap.levels, directions, rough).sigmoid()
        return cube_lookup_twin(self.texels.reshape(-1, 3), (cubemap.side,), directions).sigmoid()

    def diffuse_light(self, normals: Tensor) -> Tensor:
        """(N, 3) irradiance over pi."""
        side = self.method.settings.environment.side
        return cube_lookup_twin(filtered_twin(self.texels.reshape(-1, 3), side, None), (side,), normals).sigmoid()

    def indirect(self, rows: ActivatedGaussians, directions: Tensor) -> Tensor:
        """(N, 3) max(0, SH)."""
        dc, rest = self.gaussians[INDIRECT_DC], self.gaussians[INDIRECT_REST].reshape(len(rows.means), 15, 3)
        return (SH_C0 * dc + torch.einsum("nk,nkc->nc", sh_basis(directions, 3), rest)).relu()

    @torch.no_grad()
    def free(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """(P,) bool that no triangle is in the way, and (P,) bool that rounding has no say in it."""
        found = [~hit.any(1) for hit in self.hits(origins, directions)]
        return found[0], (found[1] == found[2])

    def hits(self, origins: Tensor, directions: Tensor) -> Iterator[Tensor]:
        """(P, F) bool for triangles as they are, a little smaller and a little larger; planes, then signed areas."""
        guide = mirror(self.method).visibility._guide
        assert guide is not None
        corners = torch.from_numpy(guide.mesh.vertices[guide.mesh.faces]).double()
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        away = ((corners[:, 0] * normals).sum(1) - origins @ normals.T) / (directions @ normals.T)
        points = (origins[:, None] + away[..., None] * directions[:, None])[:, :, None] - corners
        turned = torch.linalg.cross(points, points.roll(-1, 2))
        shares = ((turned * normals[:, None]).sum(3) / normals.square().sum(1)[:, None]).amin(2)
        reach = self.own["reach"] or float("inf")
        for margin in (0.0, NEAR, -NEAR):
            yield (shares > margin) & (away > margin) & (away < reach * (1 - margin))

    def own_losses(self, shown: RenderedView, view: View) -> Terms:
        """|Sobel n| exp(-|Sobel photo|)."""
        if "smooth" not in self.own:
            return {}
        across = torch.tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]], dtype=torch.float64) / 8
        kernels = torch.stack((across, across.T))[:, None]

        def changes(values: Tensor) -> Tensor:
            return conv2d(pad(values[:, None], (1, 1, 1, 1), mode="replicate"), kernels).abs()

        value = (changes(shown.buffers.normal) * (-changes(view.image.double())).exp()).sum(1).mean()
        return {"smooth": (self.own["smooth"], value)}


def prepared(method: Model) -> Model:
    """Where the settings ask for it, indirect light of every surfel, and a ball in the way of some mirror rays."""
    part, generator = mirror(method), torch.Generator().manual_seed(6)
    if part.indirect_from > STEP or part.forward.group is not None:
        return method
    part._begin_indirect()
    ball = sphere(0.7, 12)
    part.visibility._have(TriangleMesh(ball.vertices + np.float32([1.2, -0.8, 0.3]), ball.faces), VOXEL)
    with torch.no_grad():
        for values in (method["base"].gaussians[name] for name in INDIRECT):
            values += 0.3 + 0.3 * torch.randn(values.shape, generator=generator)
    return method


@pytest.mark.parametrize("case", CASES)
def test_image_losses_and_every_gradient_are_those_of_the_twins(case: str):
    made, changes = scene(), dict(CASES[case])
    method = prepared(begun(replace(settings(**changes.pop("own")), **changes), made))
    twin = SplitSumTwin(method)
    found = compare(twin, made)
    assert {"normal", "mono_normal", "distortion", "smooth"} <= found.terms.keys() or "every loss" not in case
    assert (INDIRECT_DC in method["base"].gaussians) == ("visibility" in case)
    assert twin.one_by_one == ("one by one" in case)
    harmonics = {"sh_dc", "sh_rest"} if twin.one_by_one else set()
    light = {f"{FORWARD if twin.one_by_one else 'environment'}.texels"}
    assert found.learned == {name for name, _ in method["base"].tensors()} - harmonics | light
