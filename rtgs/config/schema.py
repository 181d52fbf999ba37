"""What a run is made of. These dataclasses are the schema of ``conf/``: a misspelt key or a wrong type stops there."""

from __future__ import annotations

import dataclasses
import importlib
import math
import typing
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

from rtgs.core.refuse import refuse_below, refuse_outside, refuse_unknown_words, refuse_unless, words_of
from rtgs.evaluate.publish import OWN_DATA, DataKind
from rtgs.evaluate.settings import EvaluationSettings, ExternalSettings
from rtgs.mesh.settings import MeshSource, ObjectSettings, TsdfSettings
from rtgs.methods.settings import MethodSettings
from rtgs.prepare.masks.settings import MaskSettings
from rtgs.prepare.settings import NormalSettings, SfmSettings
from rtgs.scenes.settings import SceneSettings
from rtgs.track import TrackingKind
from rtgs.train.settings import ScheduleSettings, WatchSettings
from rtgs.view.settings import ViewerSettings

SCHEMA_NAME = "run_schema"
_DOT = "__"  # in the names of twins
REACHES = ()  # by name: only settings that a launcher unpickles; a step gets them as parameters


@dataclass(frozen=True)
class PathsConfig:
    """Where results go: ``<root>/store`` (cached artifacts), ``<root>/runs`` (results), tracking and logs beside."""

    root: str = "."
    """The folder that holds store/, runs/, tables/ and what is tracked."""
    remote: str = ""
    """A store that machines share (``s3://bucket/path``, any URL of fsspec).

    Looked into before a step is run, and given what was run. Empty: none.
    """

    @property
    def store(self) -> Path:
        """The artifact store."""
        return Path(self.root) / "store"

    @property
    def tables(self) -> Path:
        """One folder per table of an experiment."""
        return Path(self.root) / "tables"

    @property
    def figures(self) -> Path:
        """One folder per figure of ``rtgs figures``."""
        return Path(self.root) / "figures"

    @property
    def runs(self) -> Path:
        """One folder per run with what people look at."""
        return Path(self.root) / "runs"


@dataclass(frozen=True)
class TrackingConfig:
    """Experiment tracking (``rtgs.track``)."""

    kind: TrackingKind = "mlflow"
    uri: str = ""
    """MLflow tracking URI; empty: ``sqlite:///<paths.root>/mlflow.db``."""
    experiment: str = "rtgs/runs"
    """Experiment of the runs; executed steps go to ``rtgs/steps``."""

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "tracking")


@dataclass(frozen=True)
class AblationConfig:
    """What an ablation file says about itself besides the one to three keys it flips."""

    why: str = ""
    """One line: what the flipped keys take away and what should be seen."""
    needs: tuple[str, ...] = ()
    """What a method must have for it (:data:`rtgs.methods.spec.FEATURES`); others are refused. Empty: nothing."""
    idle_with: tuple[str, ...] = ()
    """Presets, and ``key=value``, with which what it takes away is off already: it is refused with them."""


@dataclass(frozen=True)
class MeshConfig:
    """The mesh step (method.md 6.3)."""

    extract: bool = False
    """Run it: fuse the depths of the training views into a mesh."""
    only_masked: bool = False
    """Only what lies inside the scene's masks: the glass object instead of the scene."""
    depth_ratio: float = 0.0
    """0: expected depth (2DGS for meshes of real scenes), 1: median depth."""
    obj: bool = False
    """Also write an OBJ file."""
    source: MeshSource = "auto"
    """Of the transparent object's mesh, for the third stage: ``hull``, ``tsdf``, ``given`` or ``auto``."""
    of: Literal["object", "scene"] = "object"
    """What the third stage's TSDF mesh is of: the masked ``object``, or the ``scene`` (decision 15)."""
    object: ObjectSettings = field(default_factory=ObjectSettings)
    """How that mesh is found."""
    tsdf: TsdfSettings = field(default_factory=TsdfSettings)

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "mesh")
        refuse_outside(self, "mesh", 0, 1, "depth_ratio")


@dataclass(frozen=True)
class JudgeConfig:
    """The judge on photos: where a plain method is better on held-out views, it is shown instead (docs/judge.md)."""

    plain: str = ""
    """The plain method, a file of ``conf/method``: it is trained as well, on the same views. Empty: no judge."""
    every: int = 12
    """About every n-th training view is held out for it (``scene.hold_out``, which goes first where it is not 0)."""
    at: float = 0.7
    """Share of the method's last stage after which both are judged; from there on what is shown is trained on the
    held-out views as well, and what is not shown ends. 1: at the end, and no method learns from them."""

    def __post_init__(self) -> None:
        refuse_below("judge.every", self.every, 1)
        refuse_unless(0 < self.at <= 1, "judge.at", self.at, "above 0, at most 1")


@dataclass(frozen=True)
class DistillConfig:
    """Models with other seeds teach the one of the run what they agree on around the photos (docs/distill.md)."""

    teachers: int = 0
    """How many are trained before it, each with a seed of its own: seed + 1000, seed + 2000 and so on. 0: none."""
    preset: str = ""
    """The preset of their recipe, on the scene of the run. Empty: the run's."""
    views: int = 3
    """Visits of pseudo views, which show their mean picture, for each visit of a photo."""
    most: int = 240
    """Pseudo views at most; beyond, each is visited more often. They take memory as photos do."""

    def __post_init__(self) -> None:
        refuse_unless(self.teachers == 0 or 2 <= self.teachers <= 9, "distill.teachers", self.teachers, "0, or 2 to 9")
        refuse_below("distill.views", self.views, 1)
        refuse_below("distill.most", self.most, 1)


@dataclass(frozen=True)
class TableConfig:
    """The table that a sweep ends with (:mod:`rtgs.evaluate.publish`); set by files of ``conf/experiment``."""

    name: str = ""
    """Folder under ``<root>/tables``, the preset is added. Empty: no table is written."""
    title: str = ""
    kind: Literal["results", "time_quality"] = "results"
    """``results`` at the end of each run, or ``time_quality``: along the way (``watch``), a plot for each scene."""
    minutes: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0)
    """Of ``time_quality``: CPU minutes after which runs are compared."""
    data: DataKind = OWN_DATA
    """``stand_in`` (scenes named after the paper's), ``paper`` (its data: differences are formed) or ``own``."""
    paper_scenes: dict[str, str] = field(default_factory=dict)
    """The paper's name of a scene by ours, where they differ."""
    blocks: dict[str, str] = field(default_factory=dict)
    """Headings by method: the rows of each stand together and are ranked among themselves. Empty: one block."""

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "table")


@dataclass(frozen=True)
class Choices:
    """The files chosen from the config groups: names for tables, folders and the report."""

    scene: str = ""
    """Name of the scene."""
    scene_file: str = ""
    method: str = ""
    preset: str = ""
    ablation: str = "none"
    experiment: str = ""
    overrides: tuple[str, ...] = ()
    """Keys set on the command line besides the groups."""


@dataclass(frozen=True)
class EnsembleConfig:
    """Models with other seeds beside the run's: its pictures are the mean of theirs (docs/ensemble.md)."""

    members: int = 1
    """How many models, the run's own among them; the others' seeds are seed + 1000, seed + 2000 and so on."""
    preset: str = ""
    """The preset of the others' recipe, on the scene of the run. Empty: the run's."""

    def __post_init__(self) -> None:
        refuse_unless(1 <= self.members <= 10, "ensemble.members", self.members, "1 to 10")


@dataclass(frozen=True)
class RunConfig:
    """One run: a method trained on a scene with a budget, measured and reported."""

    scene: SceneSettings = field(default_factory=SceneSettings)
    sfm: SfmSettings = field(default_factory=SfmSettings)
    masks: MaskSettings = field(default_factory=MaskSettings)
    normals: NormalSettings = field(default_factory=NormalSettings)
    method: MethodSettings = field(default_factory=MethodSettings)
    schedule: ScheduleSettings = field(default_factory=ScheduleSettings)
    steps_scaler: float = 1.0
    """As gsplat's: every number of steps of the schedule and the method times this, in the end (docs/training.md)."""
    watch: WatchSettings = field(default_factory=WatchSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    external: ExternalSettings = field(default_factory=ExternalSettings)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    ablation: AblationConfig = field(default_factory=AblationConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    distill: DistillConfig = field(default_factory=DistillConfig)
    ensemble: EnsembleConfig = field(default_factory=EnsembleConfig)
    table: TableConfig = field(default_factory=TableConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    paths: PathsConfig = field(default_factory=PathsConfig)
    viewer: ViewerSettings = field(default_factory=ViewerSettings)
    view: bool = False
    """Show the model in the browser while it trains (docs/view.md); nothing of the result depends on it."""
    seed: int = 0
    """Seed of everything random."""
    name: str | None = None
    """Folder under ``<root>/runs``. None: scene, method, preset, ablation and seed."""
    threads: int | None = None
    """Threads of torch and the native core. None: torch's default."""
    processes: int | None = None
    """Trainings of one run that do not wait for each other (of further models, of teachers) pass at once in so many
    processes at most, which share the threads. None: as many as there are such trainings, threads and memory for; a
    job of a sweep has one."""

    def __post_init__(self) -> None:
        refuse_below("seed", self.seed, 0)
        refuse_below("threads", self.threads, 1)
        refuse_below("processes", self.processes, 1)
        scaler = self.steps_scaler
        refuse_unless(0 < scaler < math.inf, "steps_scaler", scaler, "above 0 and finite")
        refuse_unless(self.threads is None or self.threads <= _MOST_THREADS, "threads", self.threads, "at most 1024")

    def other_seed(self, number: int) -> int:
        """The seed of a further model, from 1 on, that teaches this run's or stands beside it."""
        return self.seed + _APART * number


OF_THE_MACHINE = ("name", "threads", "processes", "view")  # of RunConfig: no part of what a run is
_APART = 1000  # between the seeds of models of one run: those of a sweep over seeds stay apart
_MOST_THREADS = 1024  # no machine has more cores


def open_schema(cls: type) -> type:
    """A mutable twin of a frozen dataclass tree with the same fields: OmegaConf makes frozen ones read-only."""
    return _twin(cls)


@cache
def _twin(cls: type) -> type:
    hints = typing.get_type_hints(cls)
    fields: list[Any] = []
    for item in dataclasses.fields(cls):
        hint = _open_hint(hints[item.name])
        if dataclasses.is_dataclass(hint):
            twin = _twin(typing.cast(type, hint))
            default = dataclasses.field(default_factory=_defaults(item, twin))
            fields.append((item.name, twin, default))
        else:
            default = dataclasses.field(default_factory=_defaults(item, None))
            fields.append((item.name, hint, default))
    twin = dataclasses.make_dataclass(cls.__name__, fields)
    twin.__module__, twin.__qualname__ = __name__, f"{cls.__module__}.{cls.__qualname__}".replace(".", _DOT)
    return twin


def _open_hint(hint: Any) -> Any:
    """``str`` for a ``Literal`` of words, which OmegaConf does not know: :func:`rtgs.core.build.build` checks them."""
    words = words_of(hint)
    if not words:
        return hint
    plain = type(words[0])
    return plain | None if type(None) in typing.get_args(hint) else plain


def __getattr__(name: str) -> type:
    """Twins by their qualified name: launchers with processes of their own pickle a config with its classes."""
    module, _, cls = name.rpartition(_DOT)
    if not module or name.startswith("__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _twin(getattr(importlib.import_module(module.replace(_DOT, ".")), cls))


def _defaults(item: dataclasses.Field[Any], twin: type | None) -> typing.Callable[[], Any]:
    """A factory for the default of a field; nested dataclasses become their twins, value for value."""
    if item.default is not dataclasses.MISSING:
        value = item.default
    elif item.default_factory is not dataclasses.MISSING:
        value = item.default_factory()
    else:
        return lambda: "???"
    return (lambda: _open(value, twin)) if twin is not None else (lambda: value)


def _open(value: Any, twin: type) -> Any:
    hints = typing.get_type_hints(twin)
    return twin(
        **{
            item.name: _open(getattr(value, item.name), hints[item.name])
            if dataclasses.is_dataclass(hints[item.name])
            else getattr(value, item.name)
            for item in dataclasses.fields(twin)
        }
    )


def register_schema() -> None:
    """Put the schema into Hydra's config store, under the name that ``conf/config.yaml`` lists first."""
    from hydra.core.config_store import ConfigNode, ConfigStore
    from omegaconf import OmegaConf

    schema, store = open_schema(RunConfig), ConfigStore.instance()
    there = store.repo.get(f"{SCHEMA_NAME}.yaml")
    if isinstance(there, ConfigNode) and OmegaConf.get_type(there.node) is schema:
        return  # making the node takes a quarter of the time of composing a config
    store.store(name=SCHEMA_NAME, node=schema, provider="rtgs")
