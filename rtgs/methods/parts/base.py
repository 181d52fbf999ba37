"""The base set: Gaussians from the scene's points, rasterised. Every method's first part."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.gaussians.initialize import gaussians_from_points
from rtgs.gaussians.normals import NORMAL_RESIDUAL
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.settings import DensitySettings, McmcSettings
from rtgs.gaussians.smoothing import REFRESH_EVERY, Smoothing
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.methods.parts.far_shell import Shell
from rtgs.methods.parts.gaussian_set import GaussianSet, densified, opacity_reset
from rtgs.methods.parts.kinds import GaussianKind, RasterRequest
from rtgs.methods.parts.part import Frame, Part, Raster, Rows
from rtgs.methods.shading.diffuse import diffuse
from rtgs.render.features import named_features
from rtgs.render.pose import seen_from
from rtgs.train.method import Mode, Observation, RenderedView, RenderOptions, StepEvent
from rtgs.train.schedule import (
    check_schedule,
    densify_ahead,
    densify_due,
    opacity_reset_due,
    opacity_was_reset,
    sh_degree_at,
)
from rtgs.train.settings import ScheduleSettings

if TYPE_CHECKING:
    from rtgs.methods.spec import Setup


class BaseRules(Protocol):
    """When the base set is held, densified and reset, where another part decides it."""

    def held(self, step: int) -> tuple[str, ...]:
        """Parameters that stand still in ``step``."""
        ...

    def densify_due(self, following: int) -> bool: ...

    def reset_due(self, following: int) -> bool: ...

    def after_reset(self) -> None:
        """Opacities of the base set have just been lowered."""
        ...


class Painter(Protocol):
    """What is composited of the base set, where another part decides it: shading of each Gaussian, for example."""

    def paint(self, frame: Frame, rows: ActivatedGaussians) -> Tensor:
        """(N, C) features of all Gaussians as they are activated for this view, the first three a colour."""
        ...


class BaseSet(Part):
    """A set of Gaussians of one kind from the scene's points (method.md 3.1), and its density control.

    Attributes:
        set: the Gaussians in training.
        schedule: of density control; a later stage may end it early.
        rules: of another part that decides about this set while it is in use; None: the schedule alone.
        painter: of another part that says what is composited; None: SH colours and channels as they are.
        bend: of another part that says which normals ellipsoids have, (N, 3) world of a view; None: shortest axes.
    """

    name = "base"

    def __init__(self, setup: Setup, kind: GaussianKind) -> None:
        check_schedule(setup.schedule)
        settings, scene = setup.settings, setup.scene
        self.kind = kind
        self.settings = settings
        self.generator = setup.generator
        self.extent = scene.extent
        self.run_schedule = setup.schedule
        self.schedule = setup.schedule
        self.rules: BaseRules | None = None
        self.painter: Painter | None = None
        self.bend: Callable[[Frame, ActivatedGaussians], Tensor] | None = None
        self.mcmc = mcmc_of(settings.density)
        init = settings.init
        shell = None if init.shell_points == 0 else Shell.of(init, scene)
        if self.mcmc is not None:
            init = replace(init, opacity=self.mcmc.init_opacity, scale=self.mcmc.init_scale)
        self.set = GaussianSet(
            self.name,
            gaussians_from_points(
                kind.type,
                scene.points,
                scene.point_colors,
                init,
                setup.generator,
                more=None if shell is None else (shell.points, shell.colors),
            ),
            optimizer=settings.optimizer,
            density=settings.density,
            means_lr_steps=setup.schedule.means_lr_steps,
            extent=scene.extent,
        )
        if shell is not None:
            self.set.density.beyond = shell.beyond
        if settings.render.smoothing > 0:
            cameras = [view.camera for view in scene.train]
            near = settings.render.near * scene.extent
            self.set.smoothing = Smoothing(settings.render.smoothing, cameras, near)
            self.set.smoothing.refresh(self.set.gaussians.means)
        self._background = torch.tensor(settings.render.background)
        self._decisions = _decide_density(self.mcmc, setup.schedule)

    @property
    def sets(self) -> tuple[GaussianSet, ...]:
        return (self.set,)

    @property
    def decisions(self) -> tuple[Decision, ...]:
        return self._decisions

    def sh_degree(self, step: int) -> int:
        """SH degree in use at ``step``."""
        return sh_degree_at(self.run_schedule, step, self.set.gaussians.sh_degree)

    # ---- rendering

    def watched(self, frame: Frame) -> bool:
        """Whether density control learns from this view: only while it will run again."""
        return frame.training and self.set.density.needs_signal and densify_ahead(self.schedule, frame.step)

    def rasterize(self, frame: Frame, wanted: RenderOptions, appended: Sequence[Rows] = ()) -> Raster:
        """Rasterise the set: SH colours, then its channels, and the rows that other parts append.

        Raises:
            ValueError: a map is asked for that this kind of Gaussian does not have.
        """
        self.kind.refuse_lacking(wanted)
        watched = self.watched(frame)
        center = frame.camera.center if frame.pose is None else frame.pose.center
        rows = self.set.activated(center.float(), self.sh_degree(frame.step))
        probe = self.set.new_probe() if watched else None
        features = (
            composited(self.set.gaussians, rows.colors) if self.painter is None else self.painter.paint(frame, rows)
        )
        shape, features = _joined(Rows(rows, features), appended)
        if frame.pose is not None:
            shape = seen_from(frame.pose, shape)
        more = len(shape.means) - len(self.set)  # rows that density control does not watch
        request = RasterRequest(
            frame.camera,
            wanted,
            watched,
            probe if probe is None or more == 0 else torch.nn.functional.pad(probe, (0, 0, 0, more)),
            torch.nn.functional.pad(self._background, (0, features.shape[1] - 3)),
            self.settings.render,
            self.extent,
            self.set.density.settings.signal == "absolute",
            self._normal_residual(more) if wanted.normal else None,
            self._bent(frame, rows, more) if wanted.normal else None,
        )
        buffers = self.kind.rasterize(shape, features, request)
        own = rows if self.set.smoothing is None else None
        if probe is None or buffers.weight_sum is None:
            return Raster(buffers, shape=own)
        return Raster(buffers, (Observation(self.name, probe, buffers.weight_sum[: len(self.set)]),), own)

    @torch.no_grad()
    def weight_of(self, chosen: Tensor, camera: Camera, step: int) -> tuple[Tensor, Tensor]:
        """(H, W) weight with which the Gaussians ``chosen`` (N,) bool are composited, and that of all of them."""
        sums, every = self.sums_of(chosen.float()[:, None].expand(-1, 3).contiguous(), camera, step)
        return sums[0], every

    @torch.no_grad()
    def sums_of(self, values: Tensor, camera: Camera, step: int) -> tuple[Tensor, Tensor]:
        """(3, H, W) sums of ``values`` (N, 3) by the weights with which the Gaussians are composited, and (H, W) the
        sum of these weights."""
        rows = self.set.activated(camera.center.float(), self.sh_degree(step))
        plain = RasterRequest(camera, RenderOptions(), False, None, torch.zeros(3), self.settings.render, self.extent)
        buffers = self.kind.rasterize(rows, values, plain)
        return buffers.features, buffers.alpha

    @torch.no_grad()
    def median_depth(self, camera: Camera, step: int) -> Tensor:
        """(H, W) z-depth of what is opaque in each pixel, 0 where nothing is."""
        wanted = RenderOptions(median_depth=True)
        found = self.rasterize(Frame(camera, step, Mode.EVALUATE, wanted), wanted).buffers.median_depth
        assert found is not None
        return found

    def _normal_residual(self, more: int) -> Tensor | None:
        """That of the set's channel, and 0 for ``more`` rows behind it."""
        gaussians = self.set.gaussians
        if NORMAL_RESIDUAL not in gaussians:
            return None
        return torch.nn.functional.pad(gaussians.activated(NORMAL_RESIDUAL), (0, 0, 0, more))

    def _bent(self, frame: Frame, rows: ActivatedGaussians, more: int) -> Tensor | None:
        """The normals that another part gives, 0 for ``more`` rows behind them."""
        return None if self.bend is None else torch.nn.functional.pad(self.bend(frame, rows), (0, 0, 0, more))

    def shade(self, frame: Frame, raster: Raster) -> RenderedView:
        """The view as it is rasterised."""
        return RenderedView(frame.camera, diffuse(raster.buffers), raster.buffers, observations=raster.observations)

    # ---- between steps

    def step(self, step: int, observations: Mapping[str, Observation]) -> None:
        held = () if self.rules is None else self.rules.held(step)
        self.set.step(step, self.sh_degree(step), observations.get(self.name), held=held)
        self.set.perturb(step, self.generator)

    def control(self, following: int) -> Iterator[StepEvent]:
        """Density control and opacity resets as the schedule or the rules ask.

        Raises:
            RtgsError: density control left no Gaussian.
        """
        rules = self.rules
        if densify_due(self.schedule, following) if rules is None else rules.densify_due(following):
            reset = opacity_was_reset(self.run_schedule, following)
            yield densified(self.set, self.settings.density, self.generator, following, after_reset=reset)
            self._refresh_smoothing()
        elif following % REFRESH_EVERY == 0:
            self._refresh_smoothing()
        if not self.set.density.resets_opacity:
            return
        if opacity_reset_due(self.schedule, following) if rules is None else rules.reset_due(following):
            yield opacity_reset(self.set, self.settings.density)
            if rules is not None:
                rules.after_reset()

    def _refresh_smoothing(self) -> None:
        """Means have moved, or are others."""
        if self.set.smoothing is not None:
            self.set.smoothing.refresh(self.set.gaussians.means)


def mcmc_of(density: DensitySettings) -> McmcSettings | None:
    """The settings of MCMC where it is the strategy."""
    return density.mcmc if density.strategy == "mcmc" else None


def composited(gaussians: Gaussians, colors: Tensor) -> Tensor:
    """(N, C) what is composited of a set: SH colours (N, 3), then every channel as it is activated, in its order."""
    return named_features(gaussians, colors)[1] if gaussians.channels else colors


def _joined(base: Rows, appended: Sequence[Rows]) -> tuple[ActivatedGaussians, Tensor]:
    if not appended:
        return base.shape, base.features
    every = (base, *appended)
    features = torch.cat([rows.features for rows in every])
    names = [field.name for field in fields(ActivatedGaussians) if field.name != "colors"]
    joined = {name: torch.cat([getattr(rows.shape, name) for rows in every]) for name in names}
    return ActivatedGaussians(**joined, colors=features[:, :3]), features


def _decide_density(mcmc: McmcSettings | None, schedule: ScheduleSettings) -> tuple[Decision, ...]:
    """What density control does differently in this run."""
    if mcmc is None:
        return ()
    start = f"opacity {mcmc.init_opacity:g} and {mcmc.init_scale:g} times the size"
    decisions = [Decision(f"initial Gaussians of {start}", "density.strategy is mcmc (density.mcmc.init_*)")]
    if schedule.opacity_reset_every:
        decisions.append(Decision("no opacity resets", "density.strategy mcmc moves what is transparent instead"))
    return tuple(decisions)
