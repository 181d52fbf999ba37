"""The report of a run: one self-contained HTML page. No file beside it, no network, opens anywhere.

:func:`write_report` takes a :class:`ReportData`; every text in it is escaped.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.evaluate.coverage import FRAMED_BY
from rtgs.evaluate.flip import FLIP_COLORMAP, flip_map
from rtgs.evaluate.images import ERROR_COLORMAP, ERROR_FULL_SCALE, colorize, error_map, to_bytes
from rtgs.evaluate.records import EvaluationTable, ViewScore
from rtgs.report.figures import (
    DEPTH_COLORMAP,
    Curve,
    alpha_picture,
    colorbar_uri,
    curve_svg,
    data_uri,
    depth_picture,
    image_bytes,
    normal_picture,
    outlined,
)
from rtgs.report.files import BEGIN, END
from rtgs.report.layers import layer_pixels
from rtgs.report.table import columns_of, reasons_of
from rtgs.scenes.truth import ViewTruth

REACHES = ("templates/*",)

_MANY_VIEWS = 12  # training views of a pixel from which on it is drawn white
TARGET_BYTES = 5_000_000  # of all pictures together, as base64
# Tried in order until the pictures fit: long side in pixels, JPEG quality.
PICTURE_STEPS = ((800, 90), (720, 87), (600, 85), (480, 82), (360, 80), (240, 75))


@dataclass(frozen=True)
class StepLine:
    """One step of the pipeline as it went."""

    name: str
    fingerprint: str
    hit: bool  # read from the cache instead of run
    seconds: float | None = None  # of the execution that made the artifact
    reason: str = ""  # why it had to run


@dataclass(frozen=True)
class ConfigLine:
    """One resolved config value beside its default."""

    key: str
    value: str
    default: str | None  # None: the default config has no such key

    @property
    def changed(self) -> bool:
        return self.value != self.default


@dataclass(frozen=True)
class ReportView:
    """One test view with its maps. Absent maps are left out of the page."""

    name: str  # of a row of the evaluation
    camera: Camera
    photo: Tensor  # (3, H, W) in [0, 1]
    render: Tensor  # (3, H, W)
    role: str = ""  # why it was chosen: "best", "median", ...
    depth: Tensor | None = None  # (H, W) z-depth of the surface, world units (divided by alpha)
    normal: Tensor | None = None  # (3, H, W) world frame
    alpha: Tensor | None = None  # (H, W)
    mask: Tensor | None = None  # (H, W) bool, where the masked figures are measured; outlined in the error map
    layers: Mapping[str, Tensor] = field(default_factory=dict)  # as rtgs.report.layers.layer_pixels takes them
    symbols: Mapping[str, str] = field(default_factory=dict)  # likewise
    truth: ViewTruth | None = None  # of path-traced captures
    framed: Tensor | None = None  # (H, W) training views that show what the pixel shows


@dataclass(frozen=True)
class MeshFigure:
    """A picture of the extracted mesh."""

    pixels: np.ndarray  # (H, W, 3) uint8
    vertices: int
    faces: int
    note: str = ""  # how it was made


@dataclass(frozen=True)
class ReportData:
    """Everything the page shows."""

    title: str
    evaluation: EvaluationTable
    command: str = ""  # that repeats this run
    created: str = ""
    views: tuple[ReportView, ...] = ()
    curves: tuple[Curve, ...] = ()
    steps: tuple[StepLine, ...] = ()
    decisions: tuple[Decision, ...] = ()
    config: tuple[ConfigLine, ...] = ()
    machine: Mapping[str, str] = field(default_factory=dict)  # processor, cores, threads, instruction set, versions
    mesh: MeshFigure | None = None
    preview: str = ""  # address of a moving picture; empty: none
    environment: np.ndarray | None = None  # (H, 2 H, 3) uint8, all directions: the far light that surfaces mirror
    timed: str = "per view"  # what the time of rendering is of


@dataclass(frozen=True)
class Picture:
    """An encoded picture with what is written under it."""

    uri: str
    title: str
    caption: str = ""
    scale_uri: str = ""  # a colour bar
    scale_low: str = ""
    scale_high: str = ""


@dataclass(frozen=True)
class LayerFigure:
    """A layer beside its truth; what does not exist is None."""

    title: str
    caption: str
    rendered: Picture | None
    truth: Picture | None


@dataclass(frozen=True)
class ViewPanel:
    """One view as the template takes it."""

    name: str
    role: str
    score: ViewScore
    width: int
    height: int
    photo: Picture
    render: Picture
    maps: tuple[Picture, ...]
    layers: tuple[LayerFigure, ...] = ()


def pick_views(table: EvaluationTable, count: int = 4) -> list[tuple[int, str]]:
    """Row numbers and roles of up to ``count`` views that stand for all: best, worst, and evenly between, by PSNR."""
    order = sorted(range(len(table.rows)), key=lambda row: -(table.rows[row].values["psnr"] or 0.0))
    if len(order) <= 1 or count <= 1:
        return [(row, "") for row in order[:1]]
    count = min(count, len(order))
    places = [round(k * (len(order) - 1) / (count - 1)) for k in range(count)]
    return [(order[place], _role(place, len(order))) for place in places]


def _role(place: int, total: int) -> str:
    if place == 0:
        return "best"
    return "worst" if place == total - 1 else f"rank {place + 1} of {total}"


def config_lines(values: Mapping[str, object], defaults: Mapping[str, object]) -> tuple[ConfigLine, ...]:
    """Dotted keys and values of the resolved config beside the defaults, sorted by key."""
    return tuple(
        ConfigLine(key, str(values[key]), str(defaults[key]) if key in defaults else None) for key in sorted(values)
    )


def write_report(path: Path, data: ReportData) -> int:
    """Write the page and return its size in bytes.

    Raises:
        ValueError: a view that the evaluation does not have.
    """
    page = render_report(data).encode("utf-8")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(page)
    return len(page)


def render_report(data: ReportData) -> str:
    """The page as a string."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    panels, mesh, picture_note = _pictures(data)
    environment = Environment(
        loader=PackageLoader("rtgs.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = _number
    environment.filters["duration"] = _duration
    return environment.get_template("report.html").render(
        data=data,
        table=data.evaluation,
        columns=columns_of(data.evaluation),
        reasons=reasons_of(data.evaluation),
        panels=panels,
        mesh=mesh,
        environment=_environment_picture(data.environment),
        files=Markup(BEGIN + END),
        picture_note=picture_note,
        charts=[Markup(svg) for svg in _charts(data.curves) if svg],
    )


def _charts(curves: Sequence[Curve]) -> list[str]:
    """Loss terms (logarithmic), PSNR, surfel counts: by the names the trainer records."""
    psnr = [curve for curve in curves if curve.name.endswith("/psnr")]
    counts = [curve for curve in curves if curve.name.startswith("surfels/")]
    losses = [curve for curve in curves if curve not in psnr and curve not in counts]
    losses.sort(key=lambda curve: curve.name != "train/loss")  # the total first
    return [
        curve_svg([_renamed(curve, "train/") for curve in losses], label="Loss terms", log=True),
        curve_svg([_renamed(curve, "", "/psnr") for curve in psnr], label="PSNR, dB"),
        curve_svg([_renamed(curve, "surfels/") for curve in counts], label="Gaussians"),
    ]


def _renamed(curve: Curve, prefix: str, suffix: str = "") -> Curve:
    return Curve(curve.name.removeprefix(prefix).removesuffix(suffix), curve.steps, curve.values)


def _pictures(data: ReportData) -> tuple[list[ViewPanel], Picture | None, str]:
    """All pictures at the first of PICTURE_STEPS that fits TARGET_BYTES."""
    drawn = [_draw(view) for view in data.views]
    scores = {row.view: row for row in data.evaluation.rows}
    for view in data.views:
        if view.name not in scores:
            raise ValueError(f"report view {view.name!r} is not among the evaluated views {sorted(scores)}")
    note, panels, mesh = "", [], None
    for long_side, quality in PICTURE_STEPS:
        panels = [
            _panel(view, scores[view.name], pictures, long_side, quality)
            for view, pictures in zip(data.views, drawn, strict=True)
        ]
        mesh = _mesh_picture(data.mesh, long_side, quality)
        note = (
            f"Pictures are JPEG (quality {quality}, at most {long_side} pixels); figures are measured on the renders."
        )
        if sum(_size(panel) for panel in panels) + len(mesh.uri if mesh else "") <= TARGET_BYTES:
            break
    return panels, mesh, note if panels or mesh else ""


@dataclass(frozen=True)
class _Drawn:
    """A picture before it is encoded."""

    pixels: np.ndarray
    label: Picture  # everything but the address


def _draw(view: ReportView) -> list[_Drawn]:
    """Photo, render, then the maps, as pixels."""
    drawn = [_Drawn(to_bytes(view.photo), Picture("", "Photo")), _Drawn(to_bytes(view.render), Picture("", "Render"))]
    flipped = colorize(flip_map(view.render, view.photo), 0.0, 1.0, FLIP_COLORMAP)
    for pixels, title, caption, colormap, most in (
        (
            error_map(view.render, view.photo),
            *("Error", "mean over RGB of |render − photo|", ERROR_COLORMAP, f"≥ {ERROR_FULL_SCALE:g}"),
        ),
        (flipped, "FLIP", "difference as it is seen when render and photo alternate", FLIP_COLORMAP, "1"),
    ):
        if view.mask is not None and view.mask.any():
            pixels, caption = outlined(pixels, view.mask), f"{caption}; outlined: the mask"
        drawn.append(_Drawn(pixels, Picture("", title, caption, colorbar_uri(colormap), "0", most)))
    depth = None if view.depth is None else depth_picture(view.depth, view.alpha)
    if depth is not None:
        caption = "z-depth in world units, even steps in 1/z; grey: alpha below one half"
        near, far = f"far {depth.far:.3g}", f"near {depth.near:.3g}"
        label = Picture("", "Depth", caption, colorbar_uri(DEPTH_COLORMAP), near, far)
        drawn.append(_Drawn(depth.pixels, label))
    if view.normal is not None:
        caption = "camera frame: red right, green up, blue towards the viewer"
        drawn.append(_Drawn(normal_picture(view.normal, view.camera), Picture("", "Normal", caption)))
    if view.alpha is not None:
        label = Picture("", "Alpha", "accumulated opacity", colorbar_uri("gray"), "0", "1")
        drawn.append(_Drawn(alpha_picture(view.alpha), label))
    if view.framed is not None:
        caption = f"training views that show what the pixel shows; outlined: fewer than {FRAMED_BY}"
        grey = alpha_picture(view.framed.float() / _MANY_VIEWS)
        few = view.framed < FRAMED_BY
        label = Picture("", "Coverage", caption, colorbar_uri("gray"), "0", f"≥ {_MANY_VIEWS}")
        drawn.append(_Drawn(outlined(grey, few) if few.any() else grey, label))
    return drawn


def _panel(view: ReportView, score: ViewScore, drawn: list[_Drawn], long_side: int, quality: int) -> ViewPanel:
    pictures = [_encoded(item.pixels, item.label, long_side, quality) for item in drawn]
    height, width = view.photo.shape[1:]
    maps, layers = tuple(pictures[2:]), _layer_figures(view, long_side, quality)
    return ViewPanel(view.name, view.role, score, width, height, pictures[0], pictures[1], maps, layers)


def _layer_figures(view: ReportView, long_side: int, quality: int) -> tuple[LayerFigure, ...]:
    figures = []
    seen = (view.layers, view.render, view.photo, view.camera, view.truth)
    for layer in layer_pixels(*seen, view.symbols):
        both = ((layer.rendered, "rendered"), (layer.truth, "truth"))
        rendered, truth = (
            None if pixels is None else _encoded(pixels, Picture("", f"{layer.title}, {kind}"), long_side // 2, quality)
            for pixels, kind in both
        )
        figures.append(LayerFigure(layer.title, layer.caption, rendered, truth))
    return tuple(figures)


def _encoded(pixels: np.ndarray, label: Picture, long_side: int, quality: int) -> Picture:
    uri = data_uri(image_bytes(pixels, long_side, quality))
    return Picture(uri, label.title, label.caption, label.scale_uri, label.scale_low, label.scale_high)


def _mesh_picture(mesh: MeshFigure | None, long_side: int, quality: int) -> Picture | None:
    if mesh is None:
        return None
    label = Picture("", "Mesh", f"{mesh.vertices:,} vertices, {mesh.faces:,} triangles. {mesh.note}".strip())
    return _encoded(mesh.pixels, label, long_side, quality)


def _environment_picture(panorama: np.ndarray | None) -> Picture | None:
    if panorama is None:
        return None
    caption = "All directions, as the model mirrors them. Up is that of the cameras; the middle is ahead of the first."
    return _encoded(panorama, Picture("", "Environment", caption), *PICTURE_STEPS[0])


def _size(panel: ViewPanel) -> int:
    layers = [picture for layer in panel.layers for picture in (layer.rendered, layer.truth) if picture]
    return sum(len(picture.uri) for picture in (panel.photo, panel.render, *panel.maps, *layers))


def _number(value: float | None, digits: int = 2, factor: float = 1.0) -> str:
    return "n/a" if value is None else f"{value * factor:,.{digits}f}"


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "n/a"
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours or minutes >= 10:  # seconds would break the line of a tile, and tell nothing
        return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"
    return f"{minutes} min {rest:02d} s"
