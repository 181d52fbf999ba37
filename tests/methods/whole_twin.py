"""A whole method in float64 by the readable twins, and its comparison with the fast one: image, losses, gradients."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import pytest
import torch
from glass_twin import doubled
from reflective_cases import new_method, schedule, tiny, training_maps
from torch import Tensor
from torch.nn.functional import normalize, pad

from benchmarks.common.mirror_scene import MirrorScene
from rtgs.core.cameras import Camera
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.settings import DensitySettings, McmcSettings
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.light.lookup import cube_lookup_twin
from rtgs.light.prefilter import filtered_twin, level_roughness, shrunk
from rtgs.methods import Mode
from rtgs.methods.model import Model
from rtgs.methods.parts.kinds import surfel_options
from rtgs.methods.settings import MethodSettings
from rtgs.render.buffers import EllipsoidOptions, RasterBuffers
from rtgs.render.discontinuities.ellipsoids import ellipsoid_discontinuity_mask
from rtgs.render.discontinuities.surfels import DiscontinuityBands, discontinuity_mask
from rtgs.render.reference.ellipsoids import rasterize_ellipsoids
from rtgs.render.reference.surfels import rasterize_surfels
from rtgs.scenes.scene import View
from rtgs.train import reference_losses
from rtgs.train.method import RenderedView

STEP = 40  # SH of degree 2; every loss acts
# How far float32 may be from float64: about ten times what was found on all cases. A loss or a term of a gradient that
# is wrong by one hundredth shows where its share of a parameter's gradient is a hundredth.
IMAGE = 2e-5  # of a colour; found 2e-6
VALUE = 2e-5  # of a loss term, relative; found 2e-6
GRADIENT = 2e-4  # norm of the difference over norm, of each parameter; found 2e-5
# So near a threshold float32 and float64 may decide differently: a tenth of the usual bands of the two rasterisers.
BANDS = DiscontinuityBands(alpha=1e-5, rho=1e-4)
SHORT = 0.05  # a sum of normals that is shorter, as a share of its weights: its direction is a matter of rounding
VIEW = 1  # of the training views, the one that is compared
MCMC = DensitySettings(strategy="mcmc", mcmc=McmcSettings(init_scale=1.0))
SPHERE = {"scope_radius": 1.0, "scope_center": [0.1, 0.0, -0.2]}  # some Gaussians are inside, some outside

Terms = dict[str, tuple[float, Tensor]]  # weight and unweighted value by name, in the order of the log


def scene() -> MirrorScene:
    """The mirror ball: white below on the left, normals known but for a corner, cameras named as their views."""
    made, generator = tiny(), torch.Generator().manual_seed(8)
    towards = torch.tensor([0.0, 0.0, -2.0])[:, None, None]

    def known(view: View) -> View:
        image, normal = view.image.clone(), torch.randn(view.image.shape, generator=generator) + towards
        image[:, 9:, :8] = 1
        normal = normalize(normal, dim=0)
        normal[:, :4, :5] = 0
        return replace(view, image=image, normal=normal, camera=replace(view.camera, name=view.name))

    views = {name: tuple(known(view) for view in getattr(made.scene, name)) for name in ("train", "test")}
    return replace(made, scene=replace(made.scene, **views))


def begun(settings: MethodSettings, made: MirrorScene) -> Model:
    """In its last stage; every row has its own scales, colours and channels, and most pixels are covered."""
    method, generator = new_method(settings, made, schedule()), torch.Generator().manual_seed(4)
    for stage in method.stages:
        method.begin(stage)
    gaussians = method["base"].gaussians
    with torch.no_grad():
        for name, by in {"sh_rest": 0.1, "log_scales": 0.3, **dict.fromkeys(gaussians.raw, 0.5)}.items():
            gaussians[name] += by * torch.randn(gaussians[name].shape, generator=generator)
        gaussians.log_scales += 0.3
        gaussians.opacity_logits += 1.0
    return method


class Twin:
    """Float64 copies of everything that a method trains, and what it makes of them, written out for each method."""

    def __init__(self, method: Model) -> None:
        self.method = method
        self.own: dict[str, Any] = dict(method.settings.own)
        self.sets = {each.name: doubled(each.gaussians) for each in method.sets}
        self.gaussians = self.sets["base"]
        self.groups = {
            group.name: {name: tensor.detach().double().requires_grad_() for name, tensor in group.tensors()}
            for group in method.groups
        }

    def render(self, camera: Camera) -> tuple[RenderedView, Tensor]:
        """The view, and (H, W) bool: a decision lies within float32 rounding of its threshold."""
        raise NotImplementedError

    def own_losses(self, shown: RenderedView, view: View) -> Terms:
        """Those that other methods do not have."""
        raise NotImplementedError

    @property
    def background(self) -> Tensor:
        """(3,) behind everything."""
        return torch.tensor(self.method.settings.render.background, dtype=torch.float64)

    def raster(
        self, rows: ActivatedGaussians, features: Tensor, normals: Tensor | None, camera: Camera
    ) -> tuple[RasterBuffers, Tensor]:
        """The base set's maps, and where they are fragile; ellipsoids show these ``normals`` (N, 3)."""
        settings, extent = self.method.settings.render, self.method.extent
        shape = (rows.means, rows.tangent_u, rows.tangent_v, rows.scales, rows.opacities)
        background = pad(self.background, (0, features.shape[1] - 3))
        if normals is None:
            options = surfel_options(training_maps(self.method, camera, STEP), settings, extent, weight_sum=False)
            found = rasterize_surfels(*shape, features, camera, background=background, options=options)
            fragile = discontinuity_mask(*shape, features, camera, options=options, bands=BANDS)
        else:
            options = EllipsoidOptions(settings.near * extent, settings.dilation, settings.antialiased, depth=True)
            columns, behind = torch.cat((features, normals), 1), pad(background, (0, 3))
            drawn = rasterize_ellipsoids(*shape, columns, camera, background=behind, options=options)
            found = RasterBuffers(drawn.features[:-3], drawn.alpha, drawn.depth, normal=drawn.features[-3:])
            fragile = ellipsoid_discontinuity_mask(*shape, columns, camera, options=options, bands=BANDS)
        if found.normal is not None:  # what is shaded row by row has none, unless a loss asks for it
            fragile |= found.normal.detach().norm(dim=0) < SHORT * found.alpha.detach()
        return found, fragile

    def losses(self, shown: RenderedView, view: View) -> Terms:
        """Every term, as far as the weights ask for it."""
        loss, density, photo = self.method.settings.loss, self.method.settings.density, view.image.double()
        image = shown.image
        if loss.clipped:
            assert bool(((photo == 1) & (image > 1)).any())
            image = torch.where(photo == 1, image.clamp_max(1), image)
        l1, dssim = photometric(image, photo)
        terms = {"l1": (loss.l1, l1), "dssim": (loss.dssim, dssim)} | self._surface_losses(shown, view)
        if density.strategy == "mcmc":
            size = self.gaussians.log_scales.exp().mean() / self.method.extent
            terms["opacity"] = (density.mcmc.opacity_loss, self.gaussians.opacity_logits.sigmoid().mean())
            terms["scale"] = (density.mcmc.scale_loss, size)
        own = self.own_losses(shown, view)
        return terms | {name: term for name, term in own.items() if term[0] > 0}

    def _surface_losses(self, shown: RenderedView, view: View) -> Terms:
        loss, buffers, terms = self.method.settings.loss, shown.buffers, Terms()
        if loss.normal > 0:
            maps, weighted = (buffers.normal, buffers.depth, buffers.alpha), loss.normal_inverse_depth
            value = reference_losses.normal_consistency_loss(*maps, shown.camera, inverse_depth_weight=weighted)
            terms["normal"] = (loss.normal, value)
        if loss.mono_normal > 0:
            assert view.normal is not None
            by = None
            if loss.normal_inverse_depth:
                by = reference_losses.inverse_depth_weights(buffers.depth, buffers.alpha)
            value = reference_losses.mono_normal_loss(buffers.normal, view.normal.double(), shown.camera, weight=by)
            terms["mono_normal"] = (loss.mono_normal, value)
        if loss.distortion > 0:
            terms["distortion"] = (loss.distortion, buffers.distortion.mean())
        return terms


# ---- what twins are written with


def photometric(image: Tensor, photo: Tensor) -> tuple[Tensor, Tensor]:
    """The mean difference, and 1 - SSIM."""
    return (image - photo).abs().mean(), 1 - reference_losses.ssim(image, photo)


def reflected(view: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """(P, 3) unit mirror directions of ``view`` about ``normal`` (P, 3), of any length, and (P,) the cosine."""
    view, normal = (each / each.square().sum(1, keepdim=True).clamp_min(1e-6).sqrt() for each in (view, normal))
    cosine = -(view * normal).sum(1)
    return view + 2 * cosine[:, None] * normal, cosine


def shortest_axes(ellipsoids: Ellipsoids, center: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 3) shortest axes, turned to a camera, and (N,) bool whether they pointed there."""
    axes = ellipsoids.axes()[torch.arange(len(ellipsoids)), ellipsoids.log_scales.argmin(1)]
    front = ((center - ellipsoids.means) * axes).sum(1) > 0
    return torch.where(front[:, None], axes, -axes), front


def rough_light(texels: Tensor, sides: tuple[int, ...], directions: Tensor, roughness: Tensor) -> Tensor:
    """(P, 3) colours of a prefiltered cubemap (6, side, side, 3) along directions, for these roughnesses (P,)."""
    knots = level_roughness(len(sides))
    shares = [((roughness - low) / (high - low)).clamp(0, 1) for low, high in pairwise(knots)]
    levels = [filtered_twin(shrunk(texels, side).reshape(-1, 3), side, rough) for side, rough in zip(sides, knots)]
    return cube_lookup_twin(torch.cat(levels), sides, directions, torch.stack(shares).sum(0))


# ---- comparison


def held(view: RenderedView, fragile: Tensor, known: RenderedView) -> RenderedView:
    """The view with fragile pixels as ``known`` has them, and without a gradient: there the two may differ."""

    def of(own: Tensor | None, other: Tensor | None) -> Tensor | None:
        return None if own is None or other is None else torch.where(fragile, other.detach().to(own), own)

    names = ("alpha", "depth", "normal", "distortion")
    maps = {name: of(getattr(view.buffers, name), getattr(known.buffers, name)) for name in names}
    image, more = of(view.image, known.image), {name: of(view.maps[name], known.maps[name]) for name in known.maps}
    return replace(view, image=image, buffers=replace(view.buffers, **maps), maps=more)


@dataclass(frozen=True)
class Compared:
    """What was compared, for tests that want to know that it was there."""

    terms: dict[str, float]
    learned: set[str]  # parameters with a gradient


def compare(twin: Twin, made: MirrorScene) -> Compared:
    """Fail unless image, loss terms and gradients of the fast method are those of the twin."""
    method, view = twin.method, made.scene.train[VIEW]
    rendered = method.render(view.camera, STEP, Mode.TRAIN)
    exact, fragile = twin.render(view.camera)
    assert float(fragile.double().mean()) < 0.3
    assert rendered.maps.keys() == exact.maps.keys()
    for name, map_ in {"image": exact.image, **exact.maps}.items():
        fast = rendered.image if name == "image" else rendered.maps[name]
        error = (fast.detach().double() - map_.detach()).abs()[..., ~fragile]
        assert float(error.max()) < IMAGE, name
    losses = method.losses(held(rendered, fragile, rendered), view, STEP)
    terms = twin.losses(held(exact, fragile, rendered), view)
    assert [term.name for term in losses.terms] == list(terms)
    values = {name: float(value.detach()) for name, (_, value) in terms.items()}
    for term in losses.terms:
        assert term.weight == terms[term.name][0], term.name
        assert term.value == pytest.approx(values[term.name], rel=VALUE), term.name
    losses.total.backward()
    torch.stack([weight * value for weight, value in terms.values()]).sum().backward()
    return Compared(values, same_gradients(twin))


def same_gradients(twin: Twin) -> set[str]:
    """Fail unless every parameter has the twin's gradient; the names of those that have one."""
    pairs = {}
    for each in twin.method.sets:
        place = "" if each.name == "base" else f"{each.name}."
        pairs |= {f"{place}{name}": (raw, twin.sets[each.name][name]) for name, raw in each.gaussians.items()}
    for group in twin.method.groups:
        pairs |= {f"{group.name}.{name}": (tensor, twin.groups[group.name][name]) for name, tensor in group.tensors()}
    learned = set()
    for name, (fast, exact) in pairs.items():
        if exact.grad is None or not bool(exact.grad.any()):
            assert fast.grad is None or not bool(fast.grad.any()), name
            continue
        assert fast.grad is not None, name
        difference = float((fast.grad.double() - exact.grad).norm() / exact.grad.norm())
        assert difference < GRADIENT, f"{name}: {difference:.2g}"
        learned.add(name)
    return learned
