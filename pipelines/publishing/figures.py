"""The paper's pictures as panels, from runs that are in the store: nothing is trained or rendered here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.planning.graph import RunGraph, build_graph, command, row_label
from pipelines.planning.inspection import Inspections
from pipelines.steps.evaluate import TABLE_JSON
from rtgs.config.compose import compose
from rtgs.config.locate import conf_dir
from rtgs.config.schema import Choices, RunConfig
from rtgs.config.words import friendly_overrides
from rtgs.core.documents import load_yaml
from rtgs.core.errors import RtgsError
from rtgs.core.records import record_of
from rtgs.runs.views import read_render
from rtgs.scenes.capture import list_some
from rtgs.workflow import Store

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from rtgs.evaluate.records import EvaluationTable
    from rtgs.report.panels import PanelRow, Tile
    from rtgs.scenes.scene import Scene, View

REMEDY = "correct the file"
CAPTION = "caption.txt"


@dataclass(frozen=True)
class FigureRow:
    """One view of one scene."""

    scene: str
    """A file of ``conf/scene``, or a folder."""
    view: str = ""
    """A test view. Empty: the first."""
    crops: tuple[tuple[float, ...], ...] = ()
    """Magnified parts: x, y, width, height in shares of the picture."""
    words: tuple[str, ...] = ()
    """Of the runs of all its columns, before theirs; for rows that show several methods on one scene."""


@dataclass(frozen=True)
class FigureColumn:
    """One run of each row's scene, or one layer of it."""

    title: str
    layer: str = "image"
    """One of :data:`rtgs.report.panels.LAYERS`."""
    words: tuple[str, ...] = ()
    """The run, as for ``rtgs run`` without scene and preset. Empty: that of the row, else of the first column that has
    words; ``photo`` needs none."""


@dataclass(frozen=True)
class FigureSpec:
    """A file of ``conf/figure``."""

    title: str
    rows: tuple[FigureRow, ...]
    columns: tuple[FigureColumn, ...]


def read_figure(path: Path) -> FigureSpec:
    """A figure's description.

    Raises:
        RtgsError: the file is missing or damaged, or has no run.
    """
    try:
        values = load_yaml(path)
    except OSError as error:
        raise RtgsError(f"figure {path} cannot be read ({error.strerror}): give a file of conf/figure") from error
    except RtgsError as error:
        raise RtgsError(f"figure {path} is no YAML ({error}): {REMEDY}") from error
    spec = record_of(FigureSpec, values if isinstance(values, dict) else {}, path, REMEDY)
    named = spec.columns and all(row.words for row in spec.rows)
    if not spec.rows or not (named or any(column.words for column in spec.columns)):
        raise RtgsError(f"figure {path} has no rows, or no column with the words of a run: {REMEDY}")
    return spec


@dataclass(frozen=True)
class CachedRun:
    """A run of a figure."""

    config: RunConfig
    choices: Choices
    graph: RunGraph
    store: Store = field(compare=False)

    @property
    def missing(self) -> bool:
        """Whether pictures or figures of it are not in the store."""
        return any(self.store.find(step) is None for step in (self.graph.scene, self.graph.render, self.graph.evaluate))

    @property
    def command(self) -> str:
        """The words that make it."""
        return command(self.choices)

    @property
    def label(self) -> str:
        """Of its row in tables."""
        return row_label(self.config, self.choices)

    @cached_property
    def scene(self) -> Scene:
        """The imported scene."""
        from rtgs.scenes.canonical import read_scene

        return read_scene(self._folder("scene"))

    @cached_property
    def scores(self) -> EvaluationTable:
        """What was measured."""
        from rtgs.evaluate.records import read_json

        return read_json(self._folder("evaluate") / TABLE_JSON)

    def psnr(self, view: str) -> float:
        """Of one test view, dB."""
        (found,) = (row.values["psnr"] for row in self.scores.rows if row.view == view)
        assert found is not None
        return found

    def pixels(self, view: View, layer: str) -> np.ndarray | None:
        """One layer of a test view; None: the method has none."""
        from rtgs.report.panels import ENVIRONMENT, PHOTO, layer_pixels

        if layer == ENVIRONMENT:
            maps = self._panorama()
        else:
            maps = {} if layer == PHOTO else read_render(self._folder("render"), view.name)
        return layer_pixels(layer, maps, view.image, view.camera, self.config.method.optics.blend)

    def _panorama(self) -> dict[str, Tensor]:
        """``environment`` (3, h, w) of a method with a far light, else nothing."""
        import numpy as np
        import torch
        from PIL import Image

        from pipelines.steps.render import ENVIRONMENT as FOLDER
        from rtgs.light.pictures import PANORAMA
        from rtgs.report.panels import ENVIRONMENT

        path = self._folder("render") / FOLDER / PANORAMA
        if not path.is_file():
            return {}
        with Image.open(path) as picture:
            pixels = torch.from_numpy(np.array(picture.convert("RGB")))
        return {ENVIRONMENT: pixels.permute(2, 0, 1) / 255}

    def _folder(self, step: str) -> Path:
        artifact = self.store.find(getattr(self.graph, step))
        assert artifact is not None, f"{step} is looked for by missing"
        return artifact.folder


class Runs:
    """The runs of several figures under the same words, each composed once."""

    def __init__(self, words: Sequence[str]) -> None:
        self._words = tuple(words)
        self._inspections = Inspections()
        self._known: dict[tuple[str, ...], CachedRun] = {}

    def of(self, row: FigureRow, column: FigureColumn) -> CachedRun:
        """The run of a column on a row's scene."""
        words = tuple(friendly_overrides((f"scene={row.scene}", *row.words, *column.words, *self._words)))
        if words not in self._known:
            config, choices = compose(words)
            graph = build_graph(config, choices, self._inspections)
            self._known[words] = CachedRun(config, choices, graph, Store(config.paths.store))
        return self._known[words]


def draw_figure(name: str, spec: FigureSpec, runs: Runs) -> tuple[Path, ...]:
    """Write ``<root>/figures/<name>-<preset>/<name>.{png,pdf}`` and ``caption.txt``; the paths written.

    Raises:
        RtgsError: runs of it are not in the store; says how each is made. A row's view or crop is none.
    """
    from rtgs.report.panels import draw_panels

    first = next((column for column in spec.columns if column.words), spec.columns[0])
    needed = [runs.of(row, column) for row in spec.rows for column in spec.columns if row.words or column.words]
    if missing := dict.fromkeys(run.command for run in needed if run.missing):
        total = len({run.command for run in needed})
        raise RtgsError(
            f"figure {name}: {len(missing)} of its {total} runs are not in the store; make them with\n  "
            + "\n  ".join(missing)
        )
    made = [_row(row, spec, runs, first) for row in spec.rows]
    config, choices = needed[0].config, needed[0].choices
    settings = f"preset {choices.preset}, seed {config.seed}"
    caption = f"{spec.title}: {settings}. {' '.join(text for _, text in made)} PSNR is that of the view."
    folder = config.paths.figures / f"{name}-{choices.preset}"
    written = draw_panels([row for row, _ in made], caption, folder / name)
    (folder / CAPTION).write_text(f"{caption}\n", encoding="utf-8")
    return (*written, folder / CAPTION)


def _row(row: FigureRow, spec: FigureSpec, runs: Runs, first: FigureColumn) -> tuple[PanelRow, str]:
    """The tiles of a row, and a sentence on them."""
    from rtgs.report.panels import Box, PanelRow

    view = _view(row, runs.of(row, first).scene)
    tiles, told = [], []
    for column in spec.columns:
        run = runs.of(row, column if row.words or column.words else first)
        tiles.append(_tile(column, run, view))
        if column.layer == "image":
            told.append(f"{run.label} {run.psnr(view.name):.2f} dB")
    if wrong := [crop for crop in row.crops if len(crop) != 4]:
        raise RtgsError(f"crops of {row.scene}: {list(wrong[0])} must be x, y, width, height: {REMEDY}")
    scene = f"{runs.of(row, first).scores.facts.scene}\n{view.name}"
    text = f"{scene.replace(chr(10), ', ')}: {', '.join(dict.fromkeys(told))}."
    label = f"{runs.of(row, first).label}\n{scene}" if row.words else scene
    return PanelRow(label, tuple(tiles), tuple(Box(*crop) for crop in row.crops)), text


def _tile(column: FigureColumn, run: CachedRun, view: View) -> Tile:
    import numpy as np

    from rtgs.report.panels import Tile

    pixels = run.pixels(view, column.layer)
    if pixels is None:  # of this scene or method: said in the picture
        blank = np.full((view.camera.height, view.camera.width, 3), 255, np.uint8)
        return Tile(blank, f"{column.title}\nno such layer")
    return Tile(pixels, f"{column.title}\n{run.psnr(view.name):.2f} dB" if column.layer == "image" else column.title)


def _view(row: FigureRow, scene: Scene) -> View:
    """The row's test view.

    Raises:
        RtgsError: the scene has none of this name.
    """
    found = [view for view in scene.test if row.view in ("", view.name)]
    if not found:
        names = list_some([view.name for view in scene.test]) or "none"
        raise RtgsError(f"{row.scene} has no test view {row.view!r}: it has {names}")
    return found[0]


def figure_names() -> tuple[str, ...]:
    """The files of ``conf/figure``."""
    return tuple(sorted(path.stem for path in (conf_dir() / "figure").glob("*.yaml")))


def figure_file(name: str) -> Path:
    """A figure by the name of its file in ``conf/figure``, or any YAML file.

    Raises:
        RtgsError: there is none of this name.
    """
    if name.endswith(".yaml"):
        return Path(name)
    if name not in figure_names():
        raise RtgsError(f"no figure {name!r}: there are {', '.join(figure_names())}, or give a YAML file")
    return conf_dir() / "figure" / f"{name}.yaml"
