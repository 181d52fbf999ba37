"""A method as a value: its stages, what it has, and how its model is composed.

Without torch: a plan is made of these alone. A method is one module that defines a :class:`MethodSpec` and one YAML
file in ``conf/method`` (docs/new_method.md shows one from the first line to the last).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from rtgs.core.build import build_checked
from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.train.method import Method, Stage
from rtgs.train.settings import LOSS_WEIGHTS

if TYPE_CHECKING:
    import torch

    from rtgs.mesh.container import ObjectMesh
    from rtgs.methods.settings import MethodSettings
    from rtgs.scenes.scene import Scene
    from rtgs.train.settings import ScheduleSettings

HARMONICS = "harmonics"  # colours of its Gaussians that turn with the view: SH above degree 0
SURFACE = "surface"  # Gaussians with a normal and a depth: losses on surfaces, meshes
MIRROR = "mirror"  # reflected light of its own
MICROFACET = "microfacet"  # a weight of reflected light that follows from roughness and reflectance
GLASS = "glass"  # a stage for what is seen through transparent objects
BEYOND_PAPER = "beyond_paper"  # what rtgs adds to the paper: glass on a mesh of its own, lit by physics; first values
RASTERIZED = "rasterized"  # rasterised Gaussians and nothing else: no ray starts from a pixel
PROPAGATION = "propagation"  # normals are propagated: from time to time Gaussians become opaque, mirrors grow
SABOTAGE = "sabotage"  # and then colours that have baked in a reflection get noise
FAR_LIGHT = "far_light"  # one map of the light of a far surrounding, which learns
FORWARD = "forward"  # every Gaussian is shaded by itself, with a normal that bends from its shortest axis
METAL = "metal"  # split-sum shading by metalness, roughness and albedo, light from the scene where a mesh is in the way
FEATURE_LIGHT = "feature_light"  # that map holds features, and a network makes light of them
FEATURES = (
    *(HARMONICS, SURFACE, MIRROR, MICROFACET, GLASS, BEYOND_PAPER, RASTERIZED),
    *(PROPAGATION, SABOTAGE, FAR_LIGHT, FORWARD, METAL, FEATURE_LIGHT),
)

StartOf = Callable[["MethodSettings", "ScheduleSettings"], int]
Reads = Callable[["MethodSettings"], "MethodSettings"]


def at_once(settings: MethodSettings, schedule: ScheduleSettings) -> int:
    """The first stage: from step 0 on."""
    return 0


def everything(settings: MethodSettings) -> MethodSettings:
    """The stage reads all settings."""
    return settings


def always(settings: MethodSettings) -> bool:
    """The stage is never switched off."""
    return True


@dataclass(frozen=True)
class StageSpec:
    """One stage of a method: a pipeline step ``train_<name>`` of its own, whose artifact is cached.

    Attributes:
        name: lower case; the step's name follows from it.
        start: first step of the stage in a run with these settings; from the end of the run on, there is no stage.
        start_key: the config key that ``start`` reads, for messages.
        reads: the settings with fixed values where the stage reads nothing: runs that differ there share its artifact.
        on: whether the settings ask for the stage.
        on_key: the config key that ``on`` reads, for messages.
        needs_object: only for scenes with a transparent object, whose mesh is made before the stage.
        version: of the step, raised when the stage trains otherwise than before.
    """

    name: str
    start: StartOf = at_once
    start_key: str = ""
    reads: Reads = everything
    on: Callable[[MethodSettings], bool] = always
    on_key: str = ""
    needs_object: bool = False
    version: int = 1


@dataclass(frozen=True)
class Setup:
    """What a method is composed from.

    Attributes:
        settings: with caps as this scene's pictures bound them.
        own: an instance of :attr:`MethodSpec.own`; None: the method has no settings of its own.
        generator: drawn from at initialisation, in training views and by density control; it travels in checkpoints.
        object_mesh: of the scene's transparent object, for methods with a stage that needs it; None: without it.
        stages: of this run.
        decisions: what was lowered in the settings, or has no effect.
    """

    spec: MethodSpec
    settings: MethodSettings
    scene: Scene
    schedule: ScheduleSettings
    generator: torch.Generator
    object_mesh: ObjectMesh | None = None
    stages: tuple[Stage, ...] = ()
    decisions: tuple[Decision, ...] = ()
    own: Any = None


@dataclass(frozen=True)
class MethodSpec:
    """A method.

    Attributes:
        name: as in ``method.name`` and in tables.
        stages: in order; the first starts at step 0.
        build: composes what trains from a :class:`Setup`. It imports torch, and is called when
            something trains or renders.
        has: which of :data:`FEATURES` it has. Ablations say what they take away, and are refused by methods without it.
        own: a frozen dataclass of plain values, the settings that only this method has: keys ``method.own.<field>``.
            None: there are none.
        elsewhere: its pictures are another program's: it has no stages, and nothing is trained.
        layers: what layers of its pictures are in its own symbols, by name, for captions of reports.
    """

    name: str
    stages: tuple[StageSpec, ...]
    build: Callable[[Setup], Method]
    has: frozenset[str] = frozenset()
    own: type | None = None
    elsewhere: bool = False
    layers: Mapping[str, str] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if self.elsewhere:
            if self.stages:
                raise ValueError(f"method {self.name!r}: its pictures come from elsewhere, so it has no stages")
            return
        first = self.stages[0] if self.stages else None
        if first is None or first.start is not at_once or first.on is not always or first.needs_object:
            raise ValueError(f"method {self.name!r}: its first stage must start at once, in every scene (step 0)")
        if keyless := [stage.name for stage in self.stages[1:] if not stage.start_key]:
            raise ValueError(f"method {self.name!r}: stage {keyless[0]} names no start_key, the key its start reads")
        names = [stage.name for stage in self.stages]
        if len(set(names)) < len(names):
            raise ValueError(f"method {self.name!r} has two stages of one name: {', '.join(names)}")
        if unknown := self.has - set(FEATURES):
            raise ValueError(f"method {self.name!r} has {', '.join(sorted(unknown))}: known are {', '.join(FEATURES)}")

    def own_settings(self, settings: MethodSettings) -> Any:
        """An instance of :attr:`own` with the values of ``settings.own``; None where the method has none.

        Raises:
            RtgsError: a key that the method does not have, or a value it cannot take.
        """
        if self.own is None:
            if settings.own:
                keys = ", ".join(f"method.own.{name}" for name in settings.own)
                raise RtgsError(f"{keys}: method {self.name} has no settings of its own; remove it")
            return None
        return build_checked(self.own, settings.own, "method.own")

    @property
    def learns_poses(self) -> bool:
        """Its pictures give a gradient of the camera: it is :data:`RASTERIZED`."""
        return RASTERIZED in self.has

    def refuse_poses(self, settings: MethodSettings, asked: str = "") -> None:
        """Poses of cameras are learned from what is rasterised; rays give no gradient of them.

        ``asked``: a key with its value that asks for it as ``method.poses.enabled`` does.

        Raises:
            RtgsError: they are to be learned, and the method is more than :data:`RASTERIZED`.
        """
        if (asked or settings.poses.enabled) and not self.learns_poses:
            raise RtgsError(
                f"{asked or 'method.poses.enabled=true'}, but method {self.name} is not {RASTERIZED!r} alone: the rays "
                "that it traces from its pixels give no gradient of the camera. Leave it out, or train method=2dgs or "
                "3dgs"
            )

    def stage(self, name: str) -> StageSpec:
        """The stage of this name.

        Raises:
            ValueError: the method has none.
        """
        for stage in self.stages:
            if stage.name == name:
                return stage
        names = ", ".join(stage.name for stage in self.stages)
        raise ValueError(f"method {self.name} has no stage {name!r}: it has {names}")

    def object_stage(self, settings: MethodSettings) -> StageSpec | None:
        """The stage that needs a transparent object's mesh, where the settings ask for it."""
        return next((stage for stage in self.stages if stage.needs_object and stage.on(settings)), None)

    def unread_losses(self, settings: MethodSettings) -> tuple[Decision, ...]:
        """The weights of losses that are above 0 and that no stage of the method reads, whether it is on or not.

        In the place of what it does not read a stage has the dataclass's default, so a weight of that value is not
        among them.
        """
        weights = {name: getattr(settings.loss, name) for name in LOSS_WEIGHTS}
        if self.elsewhere:
            return ()
        return tuple(
            Decision(f"method.loss.{name}={weight:g} has no effect", self._why_unread(name, settings))
            for name, weight in weights.items()
            if weight > 0 and not self._reads_loss(name, settings)
        )

    def _why_unread(self, loss: str, settings: MethodSettings) -> str:
        key = f"{loss}_start"
        if hasattr(settings.loss, key):
            at_once = replace(settings, loss=replace(settings.loss, **{key: 0.0}))
            if self._reads_loss(loss, at_once):
                start = getattr(settings.loss, key)
                return f"no stage of {self.name} reads it where method.loss.{key} is {start:g}, let it start earlier"
        return f"{self.name} has no such loss"

    def _reads_loss(self, loss: str, settings: MethodSettings) -> bool:
        weight = getattr(settings.loss, loss)
        return any(getattr(stage.reads(settings).loss, loss) == weight for stage in self.stages)

    def before(self, name: str, settings: MethodSettings, schedule: ScheduleSettings) -> Stage:
        """The stage that goes on to the end of a run where the stage ``name`` turns out to have no object."""
        order = [stage.name for stage in self.stages]
        earlier = order[: order.index(name)]
        return [stage for stage in self.timeline(settings, schedule) if stage.name in earlier][-1]

    def timeline(
        self, settings: MethodSettings, schedule: ScheduleSettings, *, transparent: bool = False
    ) -> tuple[Stage, ...]:
        """The stages that a run under ``schedule`` goes through, in order.

        ``transparent``: the scene has a transparent object (masks that are not empty).

        Raises:
            ValueError: a stage would start before the one before it.
        """
        settings = settings.in_scene(glass=transparent and self.object_stage(settings) is not None)
        total = schedule.total
        begun: list[tuple[StageSpec, int]] = []
        for stage in self.stages:
            first = min(stage.start(settings, schedule), total)
            if not stage.on(settings) or (stage.needs_object and not transparent):
                continue
            if len(begun) > 1 and first <= begun[-1][1]:
                self._refuse_order(begun[-1], (stage, first), settings, total)
            begun.append((stage, first))
            if first >= total:
                break
        ends = [first for _, first in begun[1:]] + [total]
        return tuple(Stage(stage.name, first, end) for (stage, first), end in zip(begun, ends) if first < end)

    def _refuse_order(
        self, before: tuple[StageSpec, int], late: tuple[StageSpec, int], settings: MethodSettings, total: int
    ) -> None:
        (one, first), (two, second) = before, late
        raise ValueError(
            f"{two.start_key}={_value(settings, two.start_key):g} is step {second} of {total}, but the {one.name} "
            f"stage before it starts at step {first} ({one.start_key}={_value(settings, one.start_key):g}): "
            "let it start later"
        )


def _value(settings: MethodSettings, key: str) -> float:
    """The value of a dotted key ``method.a.b``."""
    value: object = settings
    for part in key.split(".")[1:]:
        value = getattr(value, part)
    assert isinstance(value, (int, float))
    return float(value)
