"""The composed render of the third stage in float64, by the readable twins alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from reflective_cases import training_maps
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.materials import activate_materials
from rtgs.gaussians.surfels import ActivatedGaussians, Surfels, activate
from rtgs.mesh.inner_paths import InnerPaths, Leg
from rtgs.methods.model import Model
from rtgs.methods.parts.kinds import surfel_options
from rtgs.methods.shading.mirror import SHORTEST_NORMAL, SurfacePixels, mirror_rays, pixel_weights, surface_pixels
from rtgs.render.buffers import TraceBuffers, TraceOptions
from rtgs.render.discontinuities.surfels import discontinuity_mask
from rtgs.render.discontinuities.trace import fragile_rays
from rtgs.render.reference import surfels as reference
from rtgs.render.reference import trace as reference_trace

Sets = dict[str, Surfels]


@dataclass(frozen=True)
class TwinGlass:
    image: Tensor  # (3, H, W) float64
    first_depth: Tensor  # (R,) Z_1 of the pixels with a second surface
    fragile: Tensor  # (H, W) bool: a decision lies within float32 rounding of its threshold


def doubled(surfels: Surfels) -> Surfels:
    """A float64 copy that requires gradients."""
    values = {name: tensor.detach().double().requires_grad_() for name, tensor in surfels.items()}
    return surfels.like(values)


def to_linear(color: Tensor) -> Tensor:
    """The sRGB curve as its standard writes it, for colours above 0.04045 and black ones."""
    return torch.where(color > 0.04045, ((color.clamp_min(0.04) + 0.055) / 1.055) ** 2.4, color / 12.92)


def to_srgb(light: Tensor) -> Tensor:
    return torch.where(light > 0.0031308, 1.055 * light.clamp_min(0.003) ** (1 / 2.4) - 0.055, 12.92 * light)


def thin_wall(cosine: Tensor, index: float) -> Tensor:
    """2 F / (1 + F), F of the angles of incidence and refraction (Fresnel's sine and tangent laws)."""
    outside = cosine.double().clamp(1e-4, 1 - 1e-9).acos()  # the laws have no limit at 0
    inside = (outside.sin() / index).asin()
    across = ((outside - inside).sin() / (outside + inside).sin()) ** 2
    along = ((outside - inside).tan() / (outside + inside).tan()) ** 2
    surface = (across + along) / 2
    return 2 * surface / (1 + surface)


class GlassTwin:
    """Reads a method's settings and plan, and none of its renderers."""

    def __init__(self, method: Model, sets: Sets, camera: Camera, step: int) -> None:
        self.method, self.sets, self.camera, self.step = method, sets, camera, step
        self.settings = method.settings.transmittance
        self.fragile = torch.zeros(camera.height * camera.width, dtype=torch.bool)

    def render(self, inside: Tensor) -> TwinGlass:
        """The view whose pixels ``inside`` (H, W) look through the object."""
        assert self.method.parts["glass"].guide is not None
        surfaces = self.method.parts["glass"].guide.surfaces(self.camera)
        flat, covered = self._surface()
        inside, met = inside.flatten(), inside.flatten() & surfaces.hit.flatten()
        known = met & self.method.parts["glass"]._glass[surfaces.triangle.flatten().clamp_min(0).long()]
        if self.settings.first_surface == "mesh":
            flat = replace(flat, depth=torch.where(known, surfaces.near.flatten().double(), flat.depth))
        if self.settings.normal == "mesh":
            flat = replace(flat, normal=torch.where(known, surfaces.normal.flatten(1).double(), flat.normal))
        if self.thin:
            grown = (flat.specular / self.settings.wall.cover).clamp(max=1)
            flat = replace(flat, specular=torch.where(known, grown, flat.specular))
        covered &= flat.depth > 0
        rays = self.camera.rays(torch.float64)
        view = rays.directions.reshape(-1, 3).T
        kind = self.method.settings.reflection.sh_direction
        mirrored = mirror_rays(flat, rays.origin, view, kind)
        options = replace(self.method.parts["mirror"].trace_options(self.step, False), weight_sum=False)
        everyone = torch.arange(view.shape[1])
        reflected = self._trace("reflection", mirrored.origins, mirrored.directions, options, everyone)
        weights = pixel_weights(mirrored.cosine, flat, self.method.settings.optics)
        assert reflected.colors is not None
        optics, gain = self.method.settings.optics, self.settings.max_gain
        own = pixel_weights(
            mirrored.cosine, flat, optics if gain is None else replace(optics, max_gain=gain)
        ).reflection
        if self.settings.max_weight > 0 and self.settings.interface.count > 0:
            near_bound = (own - self.settings.max_weight).abs() < 1e-4
            self.fragile |= inside & (near_bound if near_bound.ndim == 1 else near_bound.any(0))
            most = self.settings.max_weight
            smooth = own / (1 + (own / most) ** 4) ** 0.25
            own = smooth if self.settings.weight_bound == "smooth" else own.clamp_max(most)
        passing = weights.transmission
        if self.thin:
            own = thin_wall(mirrored.cosine, self.settings.wall.index)
            passing = (1 - own) * self.tint[:, None]
        reflection = torch.where(inside, own, weights.reflection)
        linear = self.method.settings.optics.blend == "linear"
        light = reflection * (to_linear(reflected.colors.T) if linear else reflected.colors.T)
        rows = (inside & covered).nonzero()[:, 0]
        near = flat.depth.detach()[rows]
        second = (surfaces.second.flatten() & met)[rows]
        far = torch.where(second, torch.maximum(surfaces.far.flatten().double()[rows], near), near)
        color, first = self._through(rays.origin, view[:, rows].T, near, far, second, rows)
        color = to_linear(color) if linear else color
        light = light + passing * torch.zeros_like(light).index_copy(1, rows, color.T)
        shape = (self.camera.height, self.camera.width)
        base = to_linear(flat.diffuse) if linear else flat.diffuse
        mixed = (1 - flat.specular) * base + flat.specular * light
        image = torch.where(covered, to_srgb(mixed) if linear else mixed, flat.diffuse).reshape(3, *shape)
        depth = first.depth if first.depth is not None else near
        return TwinGlass(image, depth[second], self.fragile.reshape(shape))

    @property
    def thin(self) -> bool:
        return self.settings.wall.light == "fresnel"

    @property
    def tint(self) -> Tensor:
        return torch.tensor(self.settings.wall.tint, dtype=torch.float64)

    def _mirrored_inside(self, behind: Tensor, rows: Tensor) -> Tensor:
        """(R, 3) light that the far wall sends on: one path at a time, from its last wall back."""
        method, settings = self.method, self.settings
        guide = method.parts["glass"].guide
        every = method.parts["glass"].wall._inner.paths(self.camera, guide)
        options = replace(method.parts["mirror"].trace_options(self.step, False), weight_sum=False)
        start = settings.offset * method.extent
        within = replace(options, t_min=start, sh_degree=method.parts["glass"]._own_degree(self.step))
        found: list[Tensor] = []
        for leg in every.legs:
            count, where = len(leg.length), self._pixels_of(every, leg)
            origin, direction = leg.origin.double(), leg.direction.double()
            limited = replace(within, t_max=leg.length.double().clamp_min(2 * start))
            contents = self._trace("transmittance", origin, direction, limited, where)
            leaving = origin + leg.length.double()[:, None] * direction
            seen = self._trace("reflection", leaving, direction, options, where)
            assert count == len(seen.alpha)
            found.append(torch.cat((contents.colors, contents.alpha[:, None], seen.colors), 1))
        result = []
        for row, pixel in enumerate(rows.tolist()):
            path = (every.pixels == pixel).nonzero()[:, 0]
            if len(path) == 0:
                result.append(behind[row])
                continue
            wall = thin_wall(every.cosine[path[0]], settings.wall.index)
            result.append((1 - wall) * self.tint * behind[row] + wall * self._along(every, found, 0, int(path[0])))
        return torch.stack(result)

    def _pixels_of(self, every: InnerPaths, leg: Leg) -> Tensor:
        """The pixel of each row of a leg."""
        pixels = every.pixels
        for each in every.legs:
            pixels = pixels[each.parent]
            if each is leg:
                return pixels
        raise ValueError("the leg is of other paths")

    def _along(self, every: InnerPaths, found: list[Tensor], level: int, row: int) -> Tensor:
        """(3,) light that arrives along one leg: contents over what comes through the wall and what it mirrors."""
        leg, met = every.legs[level], found[level][row]
        wall = leg.wall[row] * thin_wall(leg.cosine[row], self.settings.wall.index)
        light = ((1 - leg.wall[row]) + (leg.wall[row] - wall) * self.tint) * to_linear(met[4:])
        if level + 1 < len(found):
            on = (every.legs[level + 1].parent == row).nonzero()[:, 0]
            if len(on):
                light = light + wall * self._along(every, found, level + 1, int(on[0]))
        return to_linear(met[:3] + (1 - met[3]) * to_srgb(light))

    def _surface(self) -> tuple[SurfacePixels, Tensor]:
        settings = self.method.settings
        parts = [self._activated(name) for name in ("base", "interface") if name in self.sets]
        surfels = [part[0] for part in parts]
        names = ("means", "tangent_u", "tangent_v", "scales", "opacities")
        means, tangent_u, tangent_v, scales, opacities = (
            torch.cat([getattr(part, name) for part in surfels]) for name in names
        )
        shape = (means, tangent_u, tangent_v, scales, opacities)
        features = torch.cat([part[1] for part in parts])
        wanted = training_maps(self.method, self.camera, self.step)
        options = surfel_options(wanted, settings.render, self.method.extent, weight_sum=False)
        buffers = reference.rasterize_surfels(*shape, features, self.camera, options=options)
        assert buffers.depth is not None
        assert buffers.normal is not None
        alpha = buffers.alpha.flatten()
        depth = buffers.depth.flatten() / alpha.clamp_min(1e-6)
        flat = surface_pixels(buffers.features.flatten(1), alpha, depth, buffers.normal.flatten(1), settings.materials)
        length = flat.normal.norm(dim=0)
        self.fragile |= discontinuity_mask(*shape, features, self.camera, options=options).flatten()
        self.fragile |= (length < 0.05) | ((alpha - settings.reflection.smallest_alpha).abs() < 1e-4)
        return flat, (alpha > settings.reflection.smallest_alpha) & (length > SHORTEST_NORMAL)

    def _activated(self, name: str) -> tuple[ActivatedGaussians, Tensor]:
        raw = self.sets[name]
        surfels = activate(raw, self.camera.center, self.method.base.sh_degree(self.step))
        made = activate_materials(raw)
        return surfels, torch.cat((surfels.colors, made.specular[:, None], made.roughness[:, None], made.f0), 1)

    def _trace(
        self, name: str, origins: Tensor, directions: Tensor, options: TraceOptions, pixels: Tensor
    ) -> TraceBuffers:
        raw = self.sets[name]
        active = activate(raw, self.camera.center, 0)
        shape = (active.means, active.tangent_u, active.tangent_v, active.scales, active.opacities)
        dc, rest = raw.sh_dc, raw.sh_rest
        self.fragile[pixels] |= fragile_rays(*shape, origins, directions, sh_dc=dc, sh_rest=rest, options=options)
        return reference_trace.trace_surfels(*shape, origins, directions, sh_dc=dc, sh_rest=rest, options=options)

    def _through(
        self, center: Tensor, rays: Tensor, near: Tensor, far: Tensor, second: Tensor, rows: Tensor
    ) -> tuple[Tensor, TraceBuffers]:
        settings, method = self.settings, self.method
        assert method.parts["glass"].guide is not None
        thickness = far - near
        options = TraceOptions(
            t_min=settings.offset * method.extent,
            transmittance_cutoff=settings.transmittance_cutoff,
            alpha_cutoff=settings.alpha_cutoff,
            sh_degree=method.base.sh_degree(self.step),
            depth=True,
            sh_direction=method.settings.reflection.sh_direction,  # type: ignore[arg-type]
        )
        origins = center + near[:, None] * rays
        if "transmittance" not in self.sets:
            first = self._trace("base", origins, rays, replace(options, t_max=thickness), rows)
        else:
            bound = torch.where(second, thickness, torch.inf) if settings.first_bounce_end == "clip" else torch.inf
            own = replace(options, t_max=bound, sh_degree=method.parts["glass"]._own_degree(self.step))
            first = self._trace("transmittance", origins, rays, own, rows)
        assert first.colors is not None
        assert first.depth is not None
        left = 1 - first.alpha
        back = near + first.depth.detach() if settings.second_bounce == "first_bounce" else far
        start = settings.second_offset * method.parts["glass"].guide.mesh.voxel / rays.norm(dim=1)
        then = replace(options, t_min=start, depth=False)
        behind = self._trace("base", center + back[:, None] * rays, rays, then, rows).colors
        assert behind is not None
        if not settings.second_bounce_gradient:
            behind = behind.detach()
        if settings.compositing == "sum":
            return first.colors + behind, first
        self.fragile[rows] |= (left.detach() - settings.opaque).abs() < 1e-4
        shown = left.detach() > settings.opaque
        if self.thin:
            light = self._mirrored_inside(to_linear(torch.where(shown[:, None], behind, 0.0)), rows)
            return first.colors + left[:, None] * to_srgb(light), first
        return first.colors + torch.where(shown[:, None], left[:, None] * behind, 0.0), first
