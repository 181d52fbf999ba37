"""Every number of a method that is not of one room below, with its source: later stages, and the method as a whole.

Boundaries are shares of the run (``schedule.total``), intervals are steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from rtgs.core.errors import RtgsError
from rtgs.core.recipe import UNLESS, UNLESS_DEFAULT
from rtgs.core.refuse import refuse_bad_counts, refuse_bad_numbers, refuse_outside, refuse_unknown_words, refuse_unless
from rtgs.gaussians.settings import DensitySettings, InitSettings, MaterialSettings, OptimizerSettings
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods.photo_settings import AppearanceSettings, PoseSettings
from rtgs.optics.settings import OpticsSettings, WallSettings
from rtgs.render.settings import RenderSettings
from rtgs.train.settings import LossSettings, ScheduleSettings


@dataclass(frozen=True)
class PropagationSettings:
    """EnvGS's normal propagation and colour sabotage (method.md 6.1; invented in 3DGS-DR)."""

    every: int = 1000  # steps; 0 = never. Not at the steps of an opacity reset
    until: float = 0.3  # share of the run: 18,000 of 60,000
    opacity: float = 0.9  # opacities of the base set become at least this
    grow: float = 1.5  # scales of specular surfels are multiplied by it
    grow_border: float = 0.02  # specular: k_s at least this
    hold_every: int = 200  # opacities stand still until the next multiple of it
    sabotage: float = 0.4  # half width of the uniform noise added to SH dc; 0 = none
    sabotage_border: float = 0.05  # surfels with k_s at most this get it
    densify_every: int = 500  # interval of the base set's density control while propagation runs

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.reflection.propagation")
        refuse_unless(0 <= self.until <= 1, "method.reflection.propagation.until", self.until, "between 0 and 1")
        refuse_unless(self.every >= 0, "method.reflection.propagation.every", self.every, "at least 0 (0: never)")
        for name in ("hold_every", "densify_every"):
            value = getattr(self, name)
            refuse_unless(value >= 1, f"method.reflection.propagation.{name}", value, "at least 1 step")


@dataclass(frozen=True)
class TracedShareSettings:
    """Which pixels get a mirror ray: those that show one, in training a random part of the rest; which share one."""

    threshold: float = 0.0  # k_s * max(w_r, 1) below which a pixel counts as one of the rest; 0 = trace all, as EnvGS
    share: float = 0.25  # of the rest, in training: whole tiles, drawn afresh each step, gradients times 1 / share
    tile: int = 8  # side of these tiles, pixels
    # In training after matte.probation, the pixels of a 2x2 block below this k_s * max(w_r, 1) show the colour of one
    # mirror ray, each step of another of them: an error of at most so much of what their rays differ. 0 = never (EnvGS)
    shared_below: float = 0.0

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.reflection.traced")
        refuse_unless(0 < self.share <= 1, "method.reflection.traced.share", self.share, "above 0 and at most 1")
        refuse_unless(
            self.tile >= 4 and self.tile % 4 == 0, "method.reflection.traced.tile", self.tile, "a multiple of 4"
        )


@dataclass(frozen=True)
class MatteSettings:
    """How a scene with nothing specular is recognised, from its training views alone (docs/reflection.md)."""

    probation: float = 1 / 60  # share of the run: then the stage is judged, before any propagation or reset; 0 = never
    views: int = 12  # training views looked at, evenly spaced
    # A pixel counts as specular when its k_s is at least this; with fewer of them than the share the scene is matte.
    # Measured on a mirror ball of strength 0 / 0.3 / 0.8 (docs/lab/reflection.md): at most 0.04 % / at least 3 % / 2 %.
    specular: float = 0.15
    share: float = 0.002

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.reflection.matte")
        refuse_unless(0 <= self.probation <= 1, "method.reflection.matte.probation", self.probation, "between 0 and 1")
        refuse_unless(self.views >= 1, "method.reflection.matte.views", self.views, "at least 1")


def _reflection_density() -> DensitySettings:
    return DensitySettings(gradient_threshold=1e-4, max_surfels=700_000)  # EnvGS; the signal is the tracer's


@dataclass(frozen=True)
class ReflectionSettings:
    """The reflection set and its part of the schedule (method.md 3.2, 6.1, 6.2).

    Boundaries are shares of the run, so that they keep their sense when it shrinks; intervals are steps, because what
    they wait for (views seen, recovery from a reset) takes as many steps in a short run as in a long one. Learning
    rates are those of ``method.optimizer``, the same for both sets unless ``rate_gain`` says otherwise.
    """

    start: float = 0.05  # share of the run: 3,000 of 60,000
    # At the latest in scenes with a transparent object, whose stage needs the time; None: at ``start``.
    start_before_glass: float | None = field(default=None, metadata=UNLESS_DEFAULT)
    densify_until: float = 0.35  # 21,000 of 60,000
    densify_every: int = 500
    opacity_reset_every: int = 6_000  # 0 = never; only while densifying
    sh_every: int = 1_000  # one degree more each, from the start of the stage
    specular_reset: bool = True  # decision 25: at resets of the base set k_s becomes min(k_s, initial)
    cells: int = 32  # per axis of the box: stratified random points
    per_cell: int = 5
    # The points' box reaches at least so far from its middle on every axis, times the extent; 0 = as it is.
    # EnvGS's boxes reach 3.8 (spheres), 2.7 (toycar), 4.2 and 1.9 (sedan) extents.
    box_reach: float = 2.0
    box_half: float = 0.0  # half side of a cube around the origin; 0 = box of the points (EnvGS: 20 for two scenes)
    # "box": random points as above; "base": a copy of the base set as it is then (MaterialRefGS), the most opaque ones
    # where density.max_surfels allows fewer. Nothing is where the base set has nothing: a sky, a ceiling.
    init_from: Literal["box", "base"] = field(default="box", metadata=UNLESS_DEFAULT)
    # Colours the set starts with, and what rays see that leave it: "random", "black" (EnvGS), or of the training images
    # the "mean" or what a tenth of the pixels exceed ("bright"). Where they are darker than a sky, k_s falls there.
    # Rays may also see a "cubemap" that learns: ``method.environment``.
    init_color: Literal["random", "mean", "bright"] = "random"
    background: Literal["black", "mean", "bright", "cubemap"] = "black"
    offset: float = 1e-4  # of the mirror ray's start, times the extent (method.md 6.3; EnvGS 0)
    smallest_alpha: float = 1e-2  # pixels with less coverage have no surface to reflect at
    rebuild_every: int = 100  # steps between new trees; in between the tree is refitted (docs/tracer.md)
    # Times the rates of colours and scales: the set starts from noise when the base set is half done.
    rate_gain: float = 1.0
    transmittance_cutoff: float = 1e-4
    alpha_cutoff: float = 1 / 255
    # Decision 24; "last_sh": what EnvGS's public tracer returns.
    direction_gradient: Literal["full", "last_sh"] = "full"
    # Decision 23, of every traced colour: at unit directions, or "raw": rays keep the camera ray's length (EnvGS).
    sh_direction: Literal["unit", "raw"] = "unit"
    propagation: PropagationSettings = field(default_factory=PropagationSettings)
    traced: TracedShareSettings = field(default_factory=TracedShareSettings)
    matte: MatteSettings = field(default_factory=MatteSettings)
    init: InitSettings = field(default_factory=InitSettings)
    density: DensitySettings = field(default_factory=_reflection_density)

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.reflection")
        self.init.refuse_shell("method.reflection.init")
        self.density.refuse_absolute("method.reflection.density")
        refuse_outside(self, "method.reflection", 0, 1, "smallest_alpha", "transmittance_cutoff", "alpha_cutoff")
        refuse_unknown_words(self, "method.reflection")
        for name in ("start", "start_before_glass", "densify_until"):
            value = getattr(self, name)
            refuse_unless(value is None or 0 <= value <= 1, f"method.reflection.{name}", value, "between 0 and 1")
        for name in ("densify_every", "sh_every", "cells", "per_cell", "rebuild_every"):
            value = getattr(self, name)
            refuse_unless(value >= 1, f"method.reflection.{name}", value, "at least 1")
        every = self.opacity_reset_every
        refuse_unless(every >= 0, "method.reflection.opacity_reset_every", every, "at least 0 (0: never)")


@dataclass(frozen=True)
class InterfaceSettings:
    """Opaque surfels on the transparent object's mesh: the surface that photos alone do not form (decision 31).

    They are rasterised with the base set, have its materials, and learn with it; rays that have entered the object do
    not meet them.
    """

    count: int = 4_500  # surfels; 0 = none, as in the paper
    opacity: float = 0.95  # initial
    floor: float = 0.9  # opacities stay at or above it: photometric training erodes glass; no resets here
    scale: float = 1.0  # times the distance to the neighbours
    specular: float = 0.9  # initial k_s: L_spec's target
    # With both and transmittance.max_gain 16, w_r starts near 0.8, bounded by transmittance.max_weight; f0 0.05 starts
    # near 0.25 and ends as well (docs/lab/transmittance.md).
    f0: float = 0.15  # initial
    roughness: float = 0.005  # initial
    # Weight of 1 - n . N of the mesh in the masks. 0 = none: n is as rasterised, and the base set with its labels and
    # contents would bend too.
    normal_loss: float = 0.0
    # Weight of the mean over the interface's surfels of 1 - n . n as put on the mesh. 0 = none: normals that the mesh
    # has right to 1 or 2 degrees end 4 off (docs/transmittance.md).
    normal_hold: float = field(default=20.0, metadata={"recipe": "unless", "value": 0.0})
    normal_loss_until: float = 1.0  # share of the run for both; afterwards only reflections move the normals
    masked_share: float = 0.5  # of the views in which a point of the mesh is the first surface: masked there in fewer
    # than this share, it is no glass (a label, the lid that a hull puts on a cup) and gets no surfels

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.transmittance.interface")
        refuse_unless(self.count >= 0, "method.transmittance.interface.count", self.count, "at least 0 (0: none)")
        for name in ("opacity", "floor", "specular", "f0", "roughness"):
            value = getattr(self, name)
            refuse_unless(0 < value < 1, f"method.transmittance.interface.{name}", value, "between 0 and 1")
        refuse_unless(
            self.opacity >= self.floor, "method.transmittance.interface.opacity", self.opacity, f"at least {self.floor}"
        )
        refuse_unless(self.scale > 0, "method.transmittance.interface.scale", self.scale, "above 0")


_EVERY = ("densify_every", "sh_every", "cells", "per_cell", "rebuild_every")


@dataclass(frozen=True)
class VertexSettings:
    """Vertices of the transparent object's mesh, learned from the photos in the third stage (docs/glass_light.md)."""

    # Of Adam: voxels a step at the start, a tenth of it at the end. 0: the mesh stays as it was found.
    rate: float = 0.0
    start: float = 0.1  # share of the stage; before it they stand still
    spacing: float = 8.0  # voxels between the points at which heights are learned
    rebuilds: int = 4  # times that the mesh is made anew, the last at the end of the stage
    hold: float = 1e-4  # weight of the mean square of the heights, voxels
    outline: float = 1e-2  # weight of the mean square distance from the masks' outlines, pixels

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.transmittance.vertices")
        key = "method.transmittance.vertices"
        refuse_unless(0 <= self.start < 1, f"{key}.start", self.start, "at least 0 and below 1")
        refuse_unless(self.spacing >= 1, f"{key}.spacing", self.spacing, "at least 1")
        refuse_unless(self.rebuilds >= 1, f"{key}.rebuilds", self.rebuilds, "at least 1: the mesh of the end")


def _transmittance_init() -> InitSettings:
    return InitSettings(scale=0.5)  # a quarter of the hits of each ray at the start


@dataclass(frozen=True)
class TransmittanceSettings:
    """The third stage: straight rays through transparent objects (method.md 3.3, 4.4, 6.2, 6.3).

    Of scenes with masks only. Boundaries are shares of the run, intervals are steps of the set's own clock, which
    begins with the stage. Recipes: conf/method/rtgs.yaml, and as the paper has it conf/method/rtgs_printed.yaml.
    """

    enabled: bool = True  # False: the run ends after the second stage
    start: float = 1 / 3  # share of the run: 20,000 of 60,000
    # Until this share of the run the stage sees views of half the size (docs/lab/glass_light.md); 0: none.
    half_size_until: float = field(default=0.0, metadata=UNLESS_DEFAULT)
    # Surfaces beside the object mirror in this stage, too. Where none does, False saves a seventh of the time;
    # with first_bounce "none" it says nothing.
    mirrors_beside: bool = field(default=True, metadata=UNLESS_DEFAULT)
    # Share of the object's pixels that a training step traces, about: tiles that were wrong when the view was last seen
    # are drawn more often, and count by the inverse (docs/lab/glass_light.md). The log's losses are those of what was
    # drawn. No tile is drawn more seldom than in a quarter of the steps. 1: all, as without a first bounce.
    drawn_share: float = field(default=1.0, metadata=UNLESS_DEFAULT)
    # Decision 26: what it meets; "base": the base set inside; "none": nothing.
    first_bounce: Literal["transmittance", "base", "none"] = "transmittance"
    # Decision 17: the paper relies on L_d; "clip": no hit counts behind the back surface.
    first_bounce_end: Literal["open", "clip"] = "open"
    # Decision 27: begins at the mesh's back; "first_bounce": at z_s + Z_1; "none".
    second_bounce: Literal["mesh", "first_bounce", "none"] = "mesh"
    second_bounce_gradient: bool = True  # decision 13: it teaches the base set
    second_offset: float = 2.0  # decision 14: it begins so many voxels behind the back surface
    compositing: Literal["over", "sum"] = "over"  # decision 12: C_1 + (1 - A_1) C_2; "sum": C_1 + C_2
    # Where the object's pixels have their surface; the paper: "base", the rasterised depth.
    first_surface: Literal["mesh", "base"] = "mesh"
    # The rasterised normals there (of the interface, if there is one); "mesh": those of the mesh, which stay.
    normal: Literal["base", "mesh"] = "base"
    # S_max in the object's pixels, whose f0 stays low; None: optics.max_gain. w_r is bounded by max_weight.
    max_gain: float | None = 16.0
    # Both of the interface, without one (interface.count 0) neither acts: the largest w_r in the object's pixels, whose
    # rim else glows (0: none), and how many pixels around get straight rays too: surfels reach over the outline.
    max_weight: float = 1.0
    # "clamp": w_r above max_weight teaches roughness and f0 nothing; "smooth": it nears max_weight and always does.
    weight_bound: Literal["clamp", "smooth"] = field(default="smooth", metadata={"recipe": UNLESS, "value": "clamp"})
    rim: int = 2
    # With wall.light=fresnel: samples of each pixel at the object's outline, 4, 9, ... (docs/glass_walls.md); 0: none.
    rim_samples: int = field(default=0, metadata=UNLESS_DEFAULT)
    # Share of the masked pixels whose base depth is the object's first surface; with more the object is opaque and the
    # stage left out (docs/lab/transmittance.md: thin glass 0.27 to 0.73). 1: never.
    opaque_share: float = 0.9
    # Base surfels in the object begin as its contents with an opacity of at most this, so that light can take the place
    # of those that stood for it (docs/lab/glass_light.md). 1: as they are.
    start_opacity: float = field(default=1.0, metadata=UNLESS_DEFAULT)
    # How the eye sees the contents: by rays through pixel centres, or by the rasteriser, which misses no small surfel
    # (where :attr:`MethodSettings.single_rays` is empty).
    contents: Literal["traced", "rasterized"] = field(default="traced", metadata=UNLESS_DEFAULT)
    keep_seen: int = 3  # views that see a surfel bare, from which on it stays in the base set too; 0: all go
    sh_degree: int = 3  # of the transmittance set, at most
    split: bool = True  # base surfels inside the mesh become the transmittance set; the paper: a random set (False)
    split_margin: float = 1.0  # voxels outside the mesh that still count as inside
    box: Literal["object", "scene"] = "object"  # decision 16, of a random set; "scene": the paper
    cells: int = 32  # per axis of the box, as the reflection set
    per_cell: int = 5
    most_hits: float = 80.0  # of a ray through the random set: its surfels are shrunk until no more are expected
    freeze_base: bool = True  # decision 18: density control and resets of the base set end here; False: EnvGS's windows
    # density.too_large in scenes of this stage, where the base set has to grow sooner; None: as elsewhere.
    base_too_large: float | None = field(default=None, metadata=UNLESS_DEFAULT)
    # Decision 21: of the mesh; "given": the scene's where the mesh is met too; "as_trained": the scene's as they are.
    test_masks: Literal["silhouette", "given", "as_trained"] = "silhouette"
    offset: float = 1e-4  # of the first bounce's start, times the extent
    opaque: float = 1 / 255  # no second bounce where the first leaves less light than this
    densify_from: int = 500
    densify_until: float = 2 / 3  # share of the run: 40,000 of 60,000
    densify_every: int = 500
    opacity_reset_every: int = 6_000  # 0 = never; only while densifying
    sh_every: int = 1_000  # one degree more each; a set taken from the base keeps its degrees
    rebuild_every: int = 100  # steps between new trees
    rate_gain: float = 1.0  # as the reflection set's
    transmittance_cutoff: float = 1e-4
    alpha_cutoff: float = 1 / 255
    interface: InterfaceSettings = field(default_factory=InterfaceSettings)
    wall: WallSettings = field(default_factory=WallSettings, metadata={"recipe": "unless", "value": WallSettings()})
    vertices: VertexSettings = field(
        default_factory=VertexSettings, metadata={"recipe": "unless", "value": VertexSettings()}
    )
    init: InitSettings = field(default_factory=_transmittance_init)
    density: DensitySettings = field(default_factory=_reflection_density)

    @property
    def masks_alone(self) -> bool:
        """Only masks say which pixels show the object: nothing knows its mesh, as in ``ablation=no_mesh_guide``."""
        return self.second_bounce == "first_bounce" and self.test_masks == "as_trained"

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.transmittance")
        self.init.refuse_shell("method.transmittance.init")
        self.density.refuse_absolute("method.transmittance.density")
        refuse_unknown_words(self, "method.transmittance")
        refuse_bad_counts(self, "method.transmittance", **dict.fromkeys(_EVERY, 1))
        refuse_outside(self, "method.transmittance", 0, 3, "sh_degree")
        given = [name for name in ("max_gain", "base_too_large") if getattr(self, name) is not None]
        refuse_outside(self, "method.transmittance", 0, math.inf, *given)
        refuse_outside(self, "method.transmittance", 0, 1, "opaque_share", "opaque", "alpha_cutoff")
        key = "method.transmittance.start_opacity"
        refuse_unless(0 < self.start_opacity <= 1, key, self.start_opacity, "above 0 and at most 1")
        key = "method.transmittance.drawn_share"
        refuse_unless(0.25 <= self.drawn_share <= 1, key, self.drawn_share, "at least 0.25 and at most 1 (1: all)")
        for name in ("start", "half_size_until", "densify_until"):
            value = getattr(self, name)
            refuse_unless(0 <= value <= 1, f"method.transmittance.{name}", value, "between 0 and 1")
        for name in ("densify_every", "sh_every", "cells", "per_cell", "rebuild_every", "most_hits"):
            value = getattr(self, name)
            refuse_unless(value >= 1, f"method.transmittance.{name}", value, "at least 1")
        key, count = "method.transmittance.rim_samples", self.rim_samples
        refuse_unless(count >= 0 and math.isqrt(count) ** 2 == count, key, count, "a square number, or 0: none")
        every = self.opacity_reset_every
        refuse_unless(every >= 0, "method.transmittance.opacity_reset_every", every, "at least 0 (0: never)")


@dataclass(frozen=True)
class MethodSettings:
    """A method: which recipe, with which numbers. ``name`` is one that :func:`rtgs.methods.find_method` finds."""

    name: str = "2dgs"
    loss: LossSettings = field(default_factory=LossSettings)
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    density: DensitySettings = field(default_factory=DensitySettings)
    init: InitSettings = field(default_factory=InitSettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    materials: MaterialSettings = field(default_factory=MaterialSettings)  # these three: methods with a second stage
    optics: OpticsSettings = field(default_factory=OpticsSettings)
    reflection: ReflectionSettings = field(default_factory=ReflectionSettings)
    transmittance: TransmittanceSettings = field(default_factory=TransmittanceSettings)  # of rtgs
    appearance: AppearanceSettings = field(
        default_factory=AppearanceSettings, metadata={"recipe": "unless", "value": AppearanceSettings()}
    )
    poses: PoseSettings = field(default_factory=PoseSettings, metadata={"recipe": "unless", "value": PoseSettings()})
    # Of methods with a cubemap of what is far away.
    environment: EnvironmentSettings = field(
        default_factory=EnvironmentSettings, metadata={"recipe": "unless", "value": EnvironmentSettings()}
    )
    paper_schedule: ScheduleSettings = field(default_factory=ScheduleSettings)  # preset=paper takes this one
    # Numbers that only this method has: :attr:`rtgs.methods.spec.MethodSpec.own` says which, and checks them.
    own: dict[str, Any] = field(default_factory=dict, metadata={"recipe": "unless", "value": {}})

    def __post_init__(self) -> None:
        if self.transmittance.wall.light == "fresnel" and self.optics.blend != "linear":
            raise RtgsError(
                "method.transmittance.wall.light=fresnel gives shares of linear light, but "
                f"method.optics.blend={self.optics.blend}: set it to linear, or wall.light=learned"
            )
        self._refuse_unfit_vertices()

    def _refuse_unfit_vertices(self) -> None:
        """Raises :class:`RtgsError` where the mesh's vertices are learned, and something shows them not, or wrong."""
        glass = self.transmittance
        if glass.vertices.rate == 0:
            return
        moves = f"method.transmittance.vertices.rate={glass.vertices.rate:g} moves the object's mesh"
        if glass.normal != "mesh":
            raise RtgsError(
                f"{moves}, but method.transmittance.normal={glass.normal} shows none of it: set it to mesh, or the "
                "rate to 0"
            )
        if glass.rim_samples > 0 and glass.wall.light == "fresnel":  # learned weights read none
            raise RtgsError(
                f"{moves}, but method.transmittance.rim_samples={glass.rim_samples} takes samples of a mesh that "
                "stays: set one of them to 0"
            )
        if glass.wall.roughness > 0:  # a loss on one sample a pixel asks for a mesh that scatters them less
            raise RtgsError(
                f"{moves}, but method.transmittance.wall.roughness={glass.wall.roughness:g} shows one sample a step, "
                "which teaches it wrong: set one of them to 0"
            )

    @property
    def single_rays(self) -> str:
        """The key that reads the hits of single rays in the contents, and its value; empty: none does."""
        if self.transmittance.first_bounce_end == "clip":
            return "method.transmittance.first_bounce_end=clip"
        if self.loss.transmission_depth > 0 and self.loss.transmission_depth_form == "per_hit":
            return "method.loss.transmission_depth_form=per_hit"
        if self.transmittance.wall.light == "fresnel" and self.transmittance.wall.roughness > 0:
            return f"method.transmittance.wall.roughness={self.transmittance.wall.roughness:g}"
        return ""

    def in_scene(self, *, glass: bool) -> MethodSettings:
        """As they are in a scene in which the stage for transparent objects runs (``glass``), or does not.

        Raises
        ------
        RtgsError
            There light that passes through an object would be added to the object's own colour.
        """
        if glass and self.optics.additive:
            raise RtgsError(
                "method.optics.weight=additive takes nothing from a surface's own colour, so the light behind a "
                "transparent object would be added to it: choose another weight, or method.transmittance.enabled=false"
            )
        start, latest = self.reflection.start, self.reflection.start_before_glass
        start = start if latest is None or not glass else min(start, latest)
        large = self.transmittance.base_too_large
        density = self.density if large is None or not glass else replace(self.density, too_large=large)
        reflection = replace(self.reflection, start=start, start_before_glass=None)
        transmittance = replace(self.transmittance, base_too_large=None)
        return replace(self, density=density, reflection=reflection, transmittance=transmittance)
