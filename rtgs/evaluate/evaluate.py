"""Score rendered test views: one row per view, means, spreads, and the reason wherever a number is absent."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

from torch import Tensor

from rtgs.evaluate.images import ERROR_FULL_SCALE, error_map, error_scale_note, file_stem, write_png
from rtgs.evaluate.layers import LAYER_METRICS, LayerTruth, layer_scales, layer_scores, why_absent
from rtgs.evaluate.lpips import InputRange, Lpips, lpips
from rtgs.evaluate.metrics import psnr, quantized, ssim
from rtgs.evaluate.surface import SURFACE_METRICS, ObjectFacts, surface_scores
from rtgs.evaluate.weights import MissingWeights, WrongWeights

FORMAT = "rtgs-evaluation"
VERSION = 4  # 2: the layer metrics; 3: transmission, given masks; 4: the surface in the mask, the object's mesh
# Seen through the test views' own masks instead of the mesh's silhouette (methods.md 7; register row 21).
GIVEN_MASK_METRICS = ("psnr_given_masks", "psnr_masked_given_masks", "ssim_masked_given_masks")
# In the order of the columns. Higher is better for psnr*, ssim*, *_share*; lower for lpips*, *_error*, *_degrees*.
METRICS = (
    "psnr",
    "ssim",
    "lpips_01",
    "lpips_11",
    "psnr_masked",
    "ssim_masked",
    "lpips_01_masked",
    "lpips_11_masked",
    *LAYER_METRICS,
    *GIVEN_MASK_METRICS,
    *SURFACE_METRICS,
    "psnr_8bit",
    "ssim_8bit",
    "lpips_01_8bit",
    "render_seconds",
)
NO_TEST_VIEWS = "the scene has no test views; scene.split_every=8 holds out every 8th"


class PhotoView(Protocol):
    """What evaluation needs of a test view; :class:`rtgs.scenes.scene.View` has it."""

    @property
    def name(self) -> str: ...
    @property
    def image(self) -> Tensor: ...  # (3, H, W) in [0, 1]
    @property
    def mask(self) -> Tensor | None: ...  # (H, W) bool
    @property
    def truth(self) -> LayerTruth | None: ...  # of path-traced captures


@dataclass(frozen=True)
class TimedRender:
    """A render of one test view."""

    image: Tensor  # (3, H, W)
    seconds: float | None = None  # wall time of the render call
    reflection: Tensor | None = None  # (3, H, W) k_s w_r C_r, of methods that render it
    transmission: Tensor | None = None  # (3, H, W) k_s w_t C_t, likewise
    given_masks: Tensor | None = None  # (3, H, W) the image through the view's own mask, likewise
    depth: Tensor | None = None  # (H, W) z-depth of the first surface
    normal: Tensor | None = None  # (3, H, W) of the first surface, camera frame, any length


@dataclass(frozen=True)
class EvaluationSettings:
    """Which groups of columns are computed."""

    lpips: bool = True  # both input conventions, when the weights are on this machine
    masked: bool = True  # inside the mask, for views that have one
    eight_bit: bool = True  # after rounding to 1/255, the protocol of codes that measure saved PNGs


@dataclass(frozen=True)
class RunFacts:
    """What was measured, printed in every row of the CSV and at the head of the JSON."""

    scene: str
    method: str
    preset: str = ""
    steps: int | None = None
    surfels: int | None = None
    train_seconds: float | None = None  # by the wall
    train_cpu_seconds: float | None = None  # all threads
    peak_memory_mb: float | None = None


@dataclass(frozen=True)
class ViewScore:
    """One row. A metric that is None has its reason in :attr:`EvaluationTable.missing`."""

    view: str
    width: int
    height: int
    mask_share: float | None  # share of the pixels inside the mask; None without a mask
    values: dict[str, float | None]  # keys: METRICS


@dataclass(frozen=True)
class EvaluationTable:
    """The measured result of one method on one scene."""

    facts: RunFacts
    rows: tuple[ViewScore, ...]
    missing: dict[str, str] = field(default_factory=dict)  # metric -> why it is absent (in all views, or in some)
    reflection_scale: float | None = None  # of psnr_reflection_scaled
    transmission_scale: float | None = None  # of psnr_transmission_scaled
    object: ObjectFacts | None = None  # of methods with a third stage, on scenes that have one

    def mean(self, metric: str) -> float | None:
        """Mean over the views that have the metric; None when none has."""
        values = self._present(metric)
        return sum(values) / len(values) if values else None

    def std(self, metric: str) -> float | None:
        """Population standard deviation over the views that have the metric."""
        values = self._present(metric)
        if not values:
            return None
        mean = sum(values) / len(values)
        return math.sqrt(sum((value - mean) ** 2 for value in values) / len(values))

    def count(self, metric: str) -> int:
        """Views that have the metric."""
        return len(self._present(metric))

    @property
    def resolution(self) -> str:
        """``WxH``, or the range when the views differ; empty without views."""
        sizes = sorted({(row.width, row.height) for row in self.rows})
        return " to ".join(f"{width}x{height}" for width, height in dict.fromkeys(sizes[:1] + sizes[-1:]))

    def _present(self, metric: str) -> list[float]:
        if metric not in METRICS:
            raise KeyError(f"no metric {metric!r}; there are {', '.join(METRICS)}")
        return [value for row in self.rows if (value := row.values[metric]) is not None]


def load_lpips(settings: EvaluationSettings) -> tuple[Lpips | None, str]:
    """The LPIPS model, or None and the reason, to be printed in place of the figure."""
    if not settings.lpips:
        return None, "switched off (evaluation.lpips=false)"
    try:
        return Lpips.load(), ""
    except (MissingWeights, WrongWeights) as error:
        return None, str(error)


def evaluate_views(
    renders: Sequence[TimedRender],
    views: Sequence[PhotoView],
    facts: RunFacts,
    settings: EvaluationSettings = EvaluationSettings(),
    *,
    lpips_model: Lpips | None = None,
    object_facts: ObjectFacts | None = None,
) -> EvaluationTable:
    """Score ``renders[i]`` against ``views[i]``, at the resolution of the photo.

    ``lpips_model``: None loads the registered weights; without them the LPIPS columns stay None and
    :attr:`EvaluationTable.missing` says why.

    A scene without test views gives a table without rows, and :attr:`EvaluationTable.missing` says so for every metric.

    Raises:
        ValueError: another number of renders than views; and what :mod:`rtgs.evaluate.metrics` refuses, with the
            view's name.
    """
    if len(renders) != len(views):
        raise ValueError(f"{len(renders)} renders for {len(views)} test views of scene {facts.scene!r}")
    if not views:
        return EvaluationTable(facts, (), dict.fromkeys(METRICS, NO_TEST_VIEWS), object=object_facts)
    model, reason = (lpips_model, "") if lpips_model is not None and settings.lpips else load_lpips(settings)
    missing: dict[str, str] = {}
    if model is None:
        missing.update({name: reason for name in METRICS if name.startswith("lpips")})
    rows, scales = [], layer_scales(renders, views)
    for render, view in zip(renders, views, strict=True):
        try:
            score = _score(render, view, settings, model)
            score.values.update(layer_scores(render, view, scales))
        except (TypeError, ValueError) as error:
            raise type(error)(f"view {view.name!r}: {error}") from error
        rows.append(score)
    absent = [name for name in LAYER_METRICS if any(row.values[name] is None for row in rows)]
    missing |= {name: why_absent(name, renders, views) for name in absent}
    _explain_absent(rows, settings, missing)
    return EvaluationTable(facts, tuple(rows), missing, scales["reflection"], scales["transmission"], object_facts)


def _score(render: TimedRender, view: PhotoView, settings: EvaluationSettings, model: Lpips | None) -> ViewScore:
    """All metrics of one view."""
    image, target, mask = render.image, view.image, view.mask
    values: dict[str, float | None] = dict.fromkeys(METRICS)
    values["psnr"], values["ssim"] = psnr(image, target), ssim(image, target)
    values["render_seconds"] = render.seconds
    if model is not None:
        for convention in InputRange:
            values[convention.value] = lpips(model, image, target, convention)
    if settings.masked and mask is not None and bool(mask.any()):
        values["psnr_masked"] = psnr(image, target, mask=mask)
        values["ssim_masked"] = ssim(image, target, mask=mask)
        if model is not None:
            for convention in InputRange:
                values[f"{convention.value}_masked"] = lpips(model, image, target, convention, mask=mask)
        if view.truth is not None:
            values |= surface_scores(render.depth, render.normal, view.truth, mask)
    if settings.masked and render.given_masks is not None:
        values["psnr_given_masks"] = psnr(render.given_masks, target)
        if mask is not None and bool(mask.any()):
            values["psnr_masked_given_masks"] = psnr(render.given_masks, target, mask=mask)
            values["ssim_masked_given_masks"] = ssim(render.given_masks, target, mask=mask)
    if settings.eight_bit:
        image_8bit, target_8bit = quantized(image.double()), quantized(target.double())
        values["psnr_8bit"], values["ssim_8bit"] = psnr(image_8bit, target_8bit), ssim(image_8bit, target_8bit)
        if model is not None:
            values["lpips_01_8bit"] = lpips(model, image_8bit, target_8bit, InputRange.ZERO_ONE)
    share = None if mask is None else float(mask.double().mean())
    return ViewScore(view.name, int(target.shape[2]), int(target.shape[1]), share, values)


def _explain_absent(rows: Sequence[ViewScore], settings: EvaluationSettings, missing: dict[str, str]) -> None:
    """A reason for every metric that at least one view lacks."""
    for name in METRICS:
        absent = sum(row.values[name] is None for row in rows)
        if not absent or name in missing:
            continue
        if name.endswith("_8bit"):
            missing[name] = "switched off (evaluation.eight_bit=false)"
        elif (name.endswith("_masked") or name in GIVEN_MASK_METRICS) and not settings.masked:
            missing[name] = "switched off (evaluation.masked=false)"
        elif name in GIVEN_MASK_METRICS:
            missing[name] = "the method has no stage for transparent objects, or the view no mask"
        elif name in SURFACE_METRICS:
            missing[name] = "only path-traced captures know the surface in the mask, and the method must render it"
        elif name.endswith("_masked"):
            missing[name] = f"{absent} of {len(rows)} views have no mask, or an empty one"
        else:
            missing[name] = f"not recorded for {absent} of {len(rows)} views"


def write_error_maps(
    renders: Sequence[TimedRender],
    views: Sequence[PhotoView],
    folder: Path,
    full_scale: float = ERROR_FULL_SCALE,
) -> list[Path]:
    """One PNG per view in ``folder``; the colour scale is in each file's description and in ``scale.txt``."""
    paths = []
    for render, view in zip(renders, views, strict=True):
        path = folder / f"{file_stem(view.name)}.png"
        write_png(path, error_map(render.image, view.image, full_scale), error_scale_note(full_scale))
        paths.append(path)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scale.txt").write_text(error_scale_note(full_scale) + "\n", encoding="utf-8")
    return paths


def write_json(path: Path, table: EvaluationTable) -> None:
    """The whole table; absent figures are null and explained under ``missing``."""
    document = {
        "format": FORMAT,
        "version": VERSION,
        "facts": asdict(table.facts),
        "resolution": table.resolution,
        "mean": {name: table.mean(name) for name in METRICS},
        "std": {name: table.std(name) for name in METRICS},
        "count": {name: table.count(name) for name in METRICS},
        "missing": table.missing,
        "reflection_scale": table.reflection_scale,
        "transmission_scale": table.transmission_scale,
        "object": None if table.object is None else asdict(table.object),
        "views": [asdict(row) for row in table.rows],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> EvaluationTable:
    """Read what :func:`write_json` wrote.

    Raises:
        ValueError: another file, or one of another version.
    """
    document = json.loads(path.read_text(encoding="utf-8"))
    found = (document.get("format"), document.get("version")) if isinstance(document, dict) else (None, None)
    if found != (FORMAT, VERSION):
        raise ValueError(f"{path} is not an evaluation: format {found}, expected {(FORMAT, VERSION)}")
    return EvaluationTable(
        RunFacts(**document["facts"]),
        tuple(ViewScore(**row) for row in document["views"]),
        document["missing"],
        document["reflection_scale"],
        document["transmission_scale"],
        None if document["object"] is None else ObjectFacts(**document["object"]),
    )


def write_csv(path: Path, table: EvaluationTable) -> None:
    """One line per view, then mean and std; an absent figure is an empty field."""
    facts = asdict(table.facts)
    header = ["scene", "method", "preset", "view", "resolution", "mask_share", *METRICS]
    header += ["steps", "surfels", "train_seconds", "train_cpu_seconds", "peak_memory_mb"]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, header, restval="")
        writer.writeheader()
        for row in table.rows:
            cells = {"view": row.view, "resolution": f"{row.width}x{row.height}", "mask_share": row.mask_share}
            writer.writerow({**facts, **row.values, **cells})
        for label, statistic in (("mean", table.mean), ("std", table.std)):
            cells = {name: statistic(name) for name in METRICS}
            writer.writerow({**facts, **cells, "view": label, "resolution": table.resolution})
