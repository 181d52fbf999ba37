"""The first stage that every surfel method shares: one base set, rasterised, with photometric and geometric losses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.gaussians.initialize import gaussians_from_points
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.surfels import ActivatedSurfels, Surfels
from rtgs.methods.base import Decision, LossTerm, LossTerms, RenderedView, RenderOptions, Stage, StepEvent
from rtgs.methods.pixel_bound import bound_by_pixels
from rtgs.methods.settings import MethodSettings
from rtgs.methods.stages import method_stages
from rtgs.methods.surfel_set import SurfelSet
from rtgs.render.buffers import RasterBuffers, RasterOptions
from rtgs.render.surfels import rasterize_surfels
from rtgs.train.losses import (
    distortion_loss,
    inverse_depth_weights,
    mono_normal_loss,
    normal_consistency_loss,
    photometric_loss,
    surface_depth,
)
from rtgs.train.schedule import (
    check_schedule,
    densify_ahead,
    densify_due,
    loss_start,
    opacity_reset_due,
    opacity_was_reset,
    sh_degree_at,
)
from rtgs.train.settings import ScheduleSettings

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene, View


@dataclass(frozen=True)
class LossStarts:
    """First step of each geometric loss; None: never in this run."""

    normal: int | None
    mono_normal: int | None
    distortion: int | None


def _on(start: int | None, step: int) -> bool:
    return start is not None and step >= start


class SurfelMethod:
    """A base set of surfels from the scene's points, rendered by rasterisation (method.md 3.1).

    Subclasses add sets, shading and stages, or change the kind of Gaussian; this class alone is 2DGS.
    """

    kind: type[Gaussians] = Surfels
    maps: tuple[str, ...] = ("depth", "median_depth", "normal", "distortion")  # that :meth:`render` can give

    def __init__(
        self, settings: MethodSettings, scene: Scene, schedule: ScheduleSettings, generator: torch.Generator
    ) -> None:
        check_schedule(schedule)
        pixels = max((view.camera.width * view.camera.height for view in scene.train), default=0)
        settings, lowered = bound_by_pixels(settings, pixels)
        self.settings = settings
        self.schedule = schedule
        self.base_schedule = schedule  # of the base set's density control: a later stage may end it early
        self.generator = generator
        self.extent = scene.extent
        self.mcmc = settings.density.mcmc if settings.density.strategy == "mcmc" else None
        init = settings.init
        if self.mcmc is not None:
            init = replace(init, opacity=self.mcmc.init_opacity, scale=self.mcmc.init_scale)
        self.base = SurfelSet(
            "base",
            gaussians_from_points(self.kind, scene.points, scene.point_colors, init, generator),
            optimizer=settings.optimizer,
            density=settings.density,
            means_lr_steps=schedule.means_lr_steps,
            extent=scene.extent,
        )
        self.stages = method_stages(settings, schedule)
        self.starts, decisions = _decide_losses(settings, scene, schedule)
        self.decisions: tuple[Decision, ...] = (*decisions, *_decide_density(settings, schedule), *lowered)
        self._background = torch.tensor(settings.render.background)

    @property
    def sets(self) -> tuple[SurfelSet, ...]:
        return (self.base,)

    def sh_degree(self, step: int) -> int:
        """SH degree in use at ``step``."""
        return sh_degree_at(self.schedule, step, self.base.surfels.sh_degree)

    def begin(self, stage: Stage) -> tuple[StepEvent, ...]:
        """Nothing to prepare: the base set is there from the start."""
        return ()

    def training_options(self, step: int) -> RenderOptions:
        """The maps that the losses of this step need, and no others."""
        normal, mono = _on(self.starts.normal, step), _on(self.starts.mono_normal, step)
        ratio = self.settings.render.depth_ratio
        return RenderOptions(
            depth=(normal and ratio < 1) or (mono and self.settings.loss.normal_inverse_depth),
            median_depth=normal and ratio > 0,
            normal=normal or mono,
            distortion=_on(self.starts.distortion, step),
        )

    def render(
        self, camera: Camera, step: int, options: RenderOptions | None = None, mask: Tensor | None = None
    ) -> RenderedView:
        """Render one view; with ``options=None`` (training) density control watches it while it will run again."""
        buffers = self.rasterize_base(camera, step, options)
        return RenderedView(camera, buffers.features, buffers)

    def rasterize_base(self, camera: Camera, step: int, options: RenderOptions | None) -> RasterBuffers:
        """Rasterise the base set: its SH colours as features."""
        watched = self.watched(step, options)
        wanted = self.training_options(step) if options is None else options
        surfels = self.base.activated(camera.center.float(), self.sh_degree(step))
        probe = self.base.new_probe() if watched else None
        surfels, features = self.rasterized(surfels, self.base_features(surfels.colors), camera, step)
        extra = len(surfels.means) - len(self.base)  # rows that density control does not watch
        buffers = rasterize_surfels(
            surfels.means,
            surfels.tangent_u,
            surfels.tangent_v,
            surfels.scales,
            surfels.opacities,
            features,
            camera,
            background=torch.nn.functional.pad(self._background, (0, features.shape[1] - 3)),
            options=self.raster_options(wanted, weight_sum=watched),
            screen_probe=probe if probe is None or extra == 0 else torch.nn.functional.pad(probe, (0, 0, 0, extra)),
        )
        if probe is not None and buffers.weight_sum is not None:
            self.base.watch(probe, buffers.weight_sum[: len(self.base)])
        return buffers

    def rasterized(
        self, surfels: ActivatedSurfels, features: Tensor, camera: Camera, step: int
    ) -> tuple[ActivatedSurfels, Tensor]:
        """What is rasterised: the base set with its features (N, C), and what a subclass appends to them."""
        return surfels, features

    def watched(self, step: int, options: RenderOptions | None) -> bool:
        """Whether density control learns from a view rendered with these options at this step."""
        return options is None and self.base.density.needs_signal and densify_ahead(self.base_schedule, step)

    def base_features(self, colors: Tensor) -> Tensor:
        """(N, C) what is composited of the base set: the SH colours (N, 3) first."""
        return colors

    def raster_options(self, wanted: RenderOptions, *, weight_sum: bool) -> RasterOptions:
        """The rasteriser's options: near and far in world units of this scene."""
        render = self.settings.render
        return RasterOptions(
            near=render.near * self.extent,
            far=render.far * self.extent,
            depth=wanted.depth,
            median_depth=wanted.median_depth,
            normal=wanted.normal,
            distortion=wanted.distortion,
            weight_sum=weight_sum,
        )

    def losses(self, rendered: RenderedView, view: View, step: int) -> LossTerms:
        """L1 and D-SSIM always; normal consistency, monocular normals, distortion as decided (method.md 5)."""
        weights = self.settings.loss
        buffers = rendered.buffers
        photometric = photometric_loss(rendered.image, view.image, weights.l1, weights.dssim)
        total = photometric.total
        terms = [LossTerm("l1", photometric.l1, weights.l1), LossTerm("dssim", photometric.dssim, weights.dssim)]

        def add(name: str, value: Tensor, weight: float) -> None:
            nonlocal total
            total = total + weight * value
            terms.append(LossTerm(name, float(value.detach()), weight))

        if _on(self.starts.normal, step):
            add("normal", self._normal_consistency(buffers, rendered.camera), weights.normal)
        if _on(self.starts.mono_normal, step) and view.normal is not None:
            weight = weights.mono_normal * weights.mono_normal_gain
            add("mono_normal", self._mono_normal(buffers, view, rendered.camera), weight)
        if _on(self.starts.distortion, step):
            assert buffers.distortion is not None
            add("distortion", distortion_loss(buffers.distortion), weights.distortion)
        if self.mcmc is not None and self.mcmc.opacity_loss > 0:
            add("opacity", self.base.surfels.opacity_logits.sigmoid().mean(), self.mcmc.opacity_loss)
        if self.mcmc is not None and self.mcmc.scale_loss > 0:
            add("scale", self.base.surfels.log_scales.exp().mean() / self.extent, self.mcmc.scale_loss)
        return LossTerms(total, tuple(terms))

    def _normal_consistency(self, buffers: RasterBuffers, camera: Camera) -> Tensor:
        """L_norm with the surface depth that ``render.depth_ratio`` asks for."""
        ratio = self.settings.render.depth_ratio
        assert buffers.normal is not None
        depth = buffers.alpha if buffers.depth is None else buffers.depth  # unused at ratio 1
        return normal_consistency_loss(
            buffers.normal,
            depth,
            buffers.alpha,
            camera,
            inverse_depth_weight=self.settings.loss.normal_inverse_depth,
            depth_override=surface_depth(depth, buffers.alpha, buffers.median_depth, ratio) if ratio > 0 else None,
        )

    def _mono_normal(self, buffers: RasterBuffers, view: View, camera: Camera) -> Tensor:
        """L_mono, depth-weighted like L_norm (method.md 5); transparent objects may count more."""
        loss = self.settings.loss
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

    def after_step(self, step: int) -> tuple[StepEvent, ...]:
        """Adam, then what the schedule asks of the base set before the next step.

        Raises:
            RtgsError: density control left no surfel.
        """
        self.base.step(step, self.sh_degree(step))
        self.base.perturb(step, self.generator)
        following = step + 1
        events = []
        if densify_due(self.base_schedule, following):
            events.append(self.densify(self.base, self.settings.density.min_opacity, following))
        if self.base.density.resets_opacity and opacity_reset_due(self.base_schedule, following):
            events.append(self.reset_opacity(self.base, self.settings.density.reset_opacity))
        return tuple(events)

    def densify(self, part: SurfelSet, min_opacity: float, following: int) -> StepEvent:
        """Density control of one set before step ``following``.

        Raises:
            RtgsError: it left no surfel.
        """
        report = part.densify(self.generator, after_reset=opacity_was_reset(self.schedule, following))
        if report.total == 0:
            raise RtgsError(
                f"density control removed all {report.pruned} surfels of set {part.name!r} before step {following}: "
                f"every opacity was below method.density.min_opacity {min_opacity}. Lower it, or the learning rate "
                "method.optimizer.opacity_logits; the last checkpoint is intact"
            )
        detail = f"{report.cloned} cloned, {report.split} split, {report.pruned} pruned, {report.total} surfels"
        return StepEvent("density", part.name, detail)

    def reset_opacity(self, part: SurfelSet, opacity: float) -> StepEvent:
        """Opacity reset of one set."""
        part.reset_opacity()
        return StepEvent("opacity_reset", part.name, f"opacities lowered to {opacity}")

    def state(self) -> dict[str, Tensor]:
        """Flat mapping of every tensor that training needs to go on, generator included."""
        tensors = {"generator": self.generator.get_state()}
        for surfel_set in self.sets:
            tensors.update(surfel_set.state())
        return tensors

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from :meth:`state`."""
        self.generator.set_state(state["generator"])
        for surfel_set in self.sets:
            surfel_set.load(state)


def _decide_losses(
    settings: MethodSettings, scene: Scene, schedule: ScheduleSettings
) -> tuple[LossStarts, tuple[Decision, ...]]:
    """Which geometric losses this run computes and from when; what is left out, with the reason."""
    loss = settings.loss
    decisions: list[Decision] = []

    def start(name: str, weight: float, share: float) -> int | None:
        if weight == 0:
            decisions.append(Decision(f"no {name} loss", f"its weight is 0 in method {settings.name}"))
            return None
        first = loss_start(share, schedule.total)
        if first >= schedule.total:
            decisions.append(
                Decision(f"no {name} loss", f"it starts after {share:g} of the run, beyond {schedule.total} steps")
            )
            return None
        return first

    normal = start("normal consistency", loss.normal, loss.normal_start)
    distortion = start("distortion", loss.distortion, loss.distortion_start)
    mono = start("monocular normal", loss.mono_normal, loss.mono_normal_start)
    without = sum(view.normal is None for view in scene.train)
    if mono is not None and without:
        if without == len(scene.train):
            mono = None
        which = "no training view has" if mono is None else f"{without} of {len(scene.train)} training views lack"
        decisions.append(
            Decision(
                "no monocular normal loss" + ("" if mono is None else " on some views"),
                f"{which} a normal map in scene {scene.name}",
            )
        )
    return LossStarts(normal, mono, distortion), tuple(decisions)


def _decide_density(settings: MethodSettings, schedule: ScheduleSettings) -> tuple[Decision, ...]:
    """What density control does differently in this run."""
    if settings.density.strategy != "mcmc":
        return ()
    mcmc = settings.density.mcmc
    start = f"opacity {mcmc.init_opacity:g} and {mcmc.init_scale:g} times the size"
    decisions = [Decision(f"initial Gaussians of {start}", "density.strategy is mcmc (density.mcmc.init_*)")]
    if schedule.opacity_reset_every:
        decisions.append(Decision("no opacity resets", "density.strategy mcmc moves what is transparent instead"))
    return tuple(decisions)
