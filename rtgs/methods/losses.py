"""The loss terms of the surfel family (method.md 5): each a :class:`~rtgs.train.terms.LossTerm`, or why there is none.

A method's module chooses from them, and may add terms of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.methods.parts.base import BaseSet
from rtgs.methods.parts.glass import Glass
from rtgs.methods.parts.glass_evidence import has_masks
from rtgs.methods.settings import MethodSettings
from rtgs.methods.shading.straight import FirstBounce, depth_loss, mesh_normal_loss
from rtgs.pretrained.weights import MissingWeights
from rtgs.render.buffers import RasterBuffers
from rtgs.train.losses import (
    distortion_loss,
    inverse_depth_weights,
    mono_normal_loss,
    normal_consistency_loss,
    surface_depth,
)
from rtgs.train.method import RenderedView, RenderOptions
from rtgs.train.perceptual import PerceptualLoss
from rtgs.train.schedule import loss_start
from rtgs.train.settings import LossSettings
from rtgs.train.terms import LossTerm, TermValue, term_start

if TYPE_CHECKING:
    from rtgs.methods.spec import Setup
    from rtgs.scenes.scene import View

Terms = Sequence[LossTerm | Decision]
SURFACE_LOSSES = ("normal", "mono_normal", "distortion")


def refuse_surface_losses(settings: MethodSettings, names: Sequence[str] = SURFACE_LOSSES) -> None:
    """For Gaussians that have no surface.

    Raises:
        ValueError: a loss is on that needs one.
    """
    for name in names:
        if weight := getattr(settings.loss, name):
            raise ValueError(
                f"method.loss.{name}={weight:g}, but the ellipsoids of method {settings.name} have no surface to "
                "compare with: set it to 0, or use method=2dgs"
            )


def surface_terms(setup: Setup) -> Terms:
    """Normal consistency, monocular normals, distortion (method.md 5)."""
    loss, ratio = setup.settings.loss, setup.settings.render.depth_ratio

    def consistency(rendered: RenderedView, view: View) -> Tensor:
        return _normal_consistency(rendered.buffers, rendered.camera, loss, ratio)

    def distortion(rendered: RenderedView, view: View) -> Tensor:
        assert rendered.buffers.distortion is not None
        return distortion_loss(rendered.buffers.distortion)

    def term(name: str, called: str, share: float, value: TermValue, needs: RenderOptions) -> LossTerm | Decision:
        weight = getattr(loss, name)
        first = term_start(called, weight, share, setup.schedule.total, setup.settings.name)
        return first if isinstance(first, Decision) else LossTerm(name, weight, value, first, needs=needs)

    both = RenderOptions(depth=ratio < 1, median_depth=ratio > 0, normal=True)
    return (
        term("normal", "normal consistency", loss.normal_start, consistency, both),
        *_mono_terms(setup),
        term("distortion", "distortion", loss.distortion_start, distortion, RenderOptions(distortion=True)),
    )


def _mono_terms(setup: Setup) -> Terms:
    """L_mono; of two weights, one after the other, where nothing is transparent and the settings say so."""
    loss, total = setup.settings.loss, setup.schedule.total
    weight, times = loss.mono_normal * loss.mono_normal_gain, loss.mono_normal_opaque
    found: list[LossTerm | Decision] = []
    start = term_start("monocular normal", weight, loss.mono_normal_start, total, setup.settings.name)
    first = _mono_start(setup, start, found)
    if isinstance(first, Decision):
        return (first,)

    def value(rendered: RenderedView, view: View) -> Tensor | None:
        return None if view.normal is None else _mono_normal(rendered.buffers, view, rendered.camera, loss)

    needs = RenderOptions(depth=loss.normal_inverse_depth, normal=True)
    until = round(loss.mono_normal_opaque_until * total)
    if times != 1 and first < until and not has_masks(setup.scene.train):
        why = f"no training view of scene {setup.scene.name} has a mask of a transparent object"
        found.append(Decision(f"monocular normals count {times:g} times until step {until}", why))
        found.append(LossTerm("mono_normal", weight * times, value, first, until=until, needs=needs))
        first = until
    if first < total:
        found.append(LossTerm("mono_normal", weight, value, first, needs=needs))
    return tuple(found)


def _mono_start(setup: Setup, start: int | Decision, found: list[LossTerm | Decision]) -> int | Decision:
    """``start`` where training views have normal maps; says where some have not."""
    scene = setup.scene
    without = sum(view.normal is None for view in scene.train)
    if isinstance(start, Decision) or not without:
        return start
    if without == len(scene.train):
        why = f"no training view has a normal map in scene {scene.name}"
        return Decision("no monocular normal loss", why)
    why = f"{without} of {len(scene.train)} training views lack a normal map in scene {scene.name}"
    found.append(Decision("no monocular normal loss on some views", why))
    return start


def _normal_consistency(buffers: RasterBuffers, camera: Camera, loss: LossSettings, ratio: float) -> Tensor:
    """L_norm with the surface depth that ``render.depth_ratio`` asks for."""
    assert buffers.normal is not None
    depth = buffers.alpha if buffers.depth is None else buffers.depth  # unused at ratio 1
    return normal_consistency_loss(
        buffers.normal,
        depth,
        buffers.alpha,
        camera,
        inverse_depth_weight=loss.normal_inverse_depth,
        depth_override=surface_depth(depth, buffers.alpha, buffers.median_depth, ratio) if ratio > 0 else None,
    )


def _mono_normal(buffers: RasterBuffers, view: View, camera: Camera, loss: LossSettings) -> Tensor:
    """L_mono, depth-weighted like L_norm (method.md 5); transparent objects may count more."""
    assert buffers.normal is not None
    assert view.normal is not None
    weight = None
    if loss.normal_inverse_depth:
        assert buffers.depth is not None
        weight = inverse_depth_weights(buffers.depth, buffers.alpha)
    if loss.mono_normal_masked != 1 and view.mask is not None:
        masked = torch.where(view.mask, loss.mono_normal_masked, 1.0)
        weight = masked if weight is None else weight * masked
    return mono_normal_loss(buffers.normal, view.normal, camera, form=loss.mono_normal_form, weight=weight)


def mcmc_terms(base: BaseSet, setup: Setup) -> Terms:
    """Opacity and scale of all base Gaussians, where MCMC is the density strategy (Kheradmand et al. 2024, eq. 10)."""
    mcmc, extent = base.mcmc, setup.scene.extent
    if mcmc is None:
        return ()

    def opacity(rendered: RenderedView, view: View) -> Tensor:
        return base.set.gaussians.opacity_logits.sigmoid().mean()

    def scale(rendered: RenderedView, view: View) -> Tensor:
        return base.set.gaussians.log_scales.exp().mean() / extent

    both = (("opacity", mcmc.opacity_loss, opacity), ("scale", mcmc.scale_loss, scale))
    return [LossTerm(name, weight, value) for name, weight, value in both if weight > 0]


def perceptual_terms(setup: Setup) -> Terms:
    """L_perc of views with reflection, where its weights are there (decision 20); else why it is left out."""
    loss = setup.settings.loss
    if loss.perceptual == 0:
        return ()
    try:
        perceptual = PerceptualLoss(loss)
    except MissingWeights as error:
        return (Decision("no perceptual loss", str(error).splitlines()[0]),)

    def value(rendered: RenderedView, view: View) -> Tensor | None:
        return None if "specular" not in rendered.maps else perceptual(rendered.image, view.image, setup.generator)

    start = loss_start(loss.perceptual_start, setup.schedule.total)
    return (LossTerm("perceptual", loss.perceptual, value, start),)


def masked_pixels(view: View) -> Tensor | None:
    """(H, W) bool: the view's own mask."""
    return view.mask


def specular_terms(setup: Setup, mask: Callable[[View], Tensor | None] = masked_pixels) -> Terms:
    """L_spec in ``mask`` of a view, where it is one of transparent objects (decisions 9, 10)."""
    loss = setup.settings.loss
    if loss.specular == 0 or not setup.settings.transmittance.enabled:
        return ()

    def value(rendered: RenderedView, view: View) -> Tensor | None:
        specular = rendered.maps.get("specular")
        where = None if specular is None else mask(view)
        if where is None or specular is None:
            return None
        return (where * (loss.specular_target - specular).clamp_min(0)).mean()

    return (LossTerm("specular", loss.specular, value, loss_start(loss.specular_start, setup.schedule.total)),)


def glass_terms(setup: Setup, glass: Glass) -> Terms:
    """L_d, what holds the interface's normals (method.md 5.1), and what holds vertices that are learned."""
    loss, interface = setup.settings.loss, setup.settings.transmittance.interface
    vertices = setup.settings.transmittance.vertices

    def depth(rendered: RenderedView, view: View) -> Tensor | None:
        if not isinstance(rendered.kept, FirstBounce):
            return None
        pixels = rendered.camera.height * rendered.camera.width
        return depth_loss(rendered.kept, loss.transmission_depth_form, pixels)

    def hold(rendered: RenderedView, view: View) -> Tensor | None:
        return None if glass.interface is None else glass.interface.turned()

    def normal(rendered: RenderedView, view: View) -> Tensor | None:
        """1 - n . N where the object is seen; n rasterised, N of the mesh."""
        transparent = rendered.maps.get("transparent")
        if glass.interface is None or glass.guide is None or transparent is None:
            return None
        surfaces = glass.guide.surfaces(rendered.camera)
        assert rendered.buffers.normal is not None
        return mesh_normal_loss(rendered.buffers.normal, surfaces.normal, transparent & glass.on_glass(surfaces))

    def held(rendered: RenderedView, view: View) -> Tensor | None:
        return None if glass.vertices is None else glass.vertices.held()

    def outlined(rendered: RenderedView, view: View) -> Tensor | None:
        return None if glass.vertices is None else glass.vertices.outlined()

    until = loss_start(interface.normal_loss_until, setup.schedule.total)
    learned = vertices.rate > 0
    terms = (
        ("transmission_depth", loss.transmission_depth, depth, math.inf, RenderOptions()),
        ("interface_hold", interface.normal_hold, hold, until, RenderOptions()),
        ("interface_normal", interface.normal_loss, normal, until, RenderOptions(normal=True)),
        ("vertex_hold", vertices.hold * learned, held, math.inf, RenderOptions()),
        ("vertex_outline", vertices.outline * learned, outlined, math.inf, RenderOptions()),
    )
    return [
        LossTerm(name, weight, value, until=end, needs=needs) for name, weight, value, end, needs in terms if weight > 0
    ]
