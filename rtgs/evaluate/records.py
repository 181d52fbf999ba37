"""What an evaluation found, and its files. Without torch: cached results are shown without what computes them."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from rtgs.core import records
from rtgs.core.errors import RtgsError
from rtgs.core.listing import spreadsheet_cell

FORMAT = "rtgs-evaluation"
# 2: layers; 3: transmission, given masks; 4: surface in the mask, object's mesh; 5: what is framed; 6: FLIP; 7: photos
VERSION = 8
_READ = (5, 6, 7, VERSION)  # a figure that a version did not know is absent
LAYER_METRICS = (
    "psnr_specular",
    "psnr_diffuse_part",
    *(f"psnr_{layer}{scaled}" for layer in ("reflection", "transmission") for scaled in ("", "_scaled")),
)
# Of the parts of the transmitted light: in a table only where a method renders such layers.
GLASS_METRICS = tuple(
    f"psnr_{layer}{scaled}" for layer in ("inner", "contents", "behind") for scaled in ("", "_scaled")
)
SURFACE_METRICS = ("depth_error_masked", "depth_share_masked", "normal_degrees_masked", "normal_share_masked")
WHOLE_SURFACE_METRIC = "depth_off"  # share of the whole picture whose depth is off by more than 5 %
# Over the pixels that at least three training views frame, and their share.
FRAMED_METRICS = ("psnr_framed", "framed_share")
# Seen through the test views' own masks instead of the mesh's silhouette (method.md 7; decision 21).
GIVEN_MASK_METRICS = ("psnr_given_masks", "psnr_masked_given_masks", "ssim_masked_given_masks")
# After a colour fit to each photo; from poses fitted to the photos. Neither is psnr: both have seen the test photos.
COLOR_METRIC, POSE_METRIC = "cc_psnr", "psnr_refined_poses"
# In the order of the columns. Higher is better for psnr*, cc_psnr, ssim*, *_share*; lower for lpips*, flip*, *_error*,
# *_degrees*, *_off.
METRICS = (
    "psnr",
    "ssim",
    "lpips_01",
    "lpips_11",
    "flip",
    "psnr_masked",
    "ssim_masked",
    "lpips_01_masked",
    "lpips_11_masked",
    "flip_masked",
    *LAYER_METRICS,
    *GIVEN_MASK_METRICS,
    *SURFACE_METRICS,
    *FRAMED_METRICS,
    WHOLE_SURFACE_METRIC,
    COLOR_METRIC,
    POSE_METRIC,
    "psnr_8bit",
    "ssim_8bit",
    "lpips_01_8bit",
    "render_seconds",  # of the image with the maps that the run keeps of it; artifacts of older versions: of the image
)


@dataclass(frozen=True)
class ObjectFacts:
    """The mesh of the transparent object; None: not known. Shares are of the pixels in the masks that bound something.

    The fallbacks of method.md 6.3: where the mesh has one surface, the object is a thin sheet, seen through without a
    depth between its walls; where the ray misses it, a training pixel likewise, and a test pixel shows no transmission.
    """

    source: str  # "hull", "tsdf", "given"
    flat: bool  # a pane: one surface everywhere
    silhouette_iou: float | None  # with the masks of the training views, where nothing opaque hides the object
    distance: float | None  # of mesh and true container to each other, mean, in diagonals of the container
    front: float | None  # share of first surfaces within 3 % of the true one, over the test views
    back: float | None  # of second ones
    one_hit: float | None  # share whose ray meets one surface only, over the training views
    no_hit: float | None  # share whose ray misses the mesh, likewise
    no_hit_test: float | None  # over the test views

    def numbers(self) -> dict[str, float]:
        """What is known, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, float)}

    @property
    def fallbacks(self) -> str:
        """One line on rays without a pair of surfaces."""
        if self.one_hit is None or self.no_hit is None:
            return "no masks"
        text = f"of the masked training pixels {self.one_hit:.2%} meet one surface only, {self.no_hit:.2%} miss the "
        text += "mesh: a thin sheet there"
        if self.no_hit_test is not None:
            text += f"; of the test views' masks {self.no_hit_test:.2%} miss it: nothing is transmitted there"
        return f"{text}; a pane has one surface by nature" if self.flat else text


@dataclass(frozen=True)
class RunFacts:
    """What was measured, printed in every row of the CSV and at the head of the JSON."""

    scene: str
    method: str
    preset: str = ""
    steps: int | None = None
    surfels: int | None = None
    # By the wall, and of all threads; with the mesh that the training waited for (before version 8: without it).
    train_seconds: float | None = None
    train_cpu_seconds: float | None = None
    peak_memory_mb: float | None = None
    supersample: int = 1  # pictures were rendered so many times finer, and averaged
    noise_psnr: float | None = None  # dB of the test photos against noise-free ones: no method can be told to be better
    models: int = 1  # whose mean the pictures are; ``steps`` are of one of them, the costs of all

    @property
    def shown_method(self) -> str:
        """As tables of runs call it."""
        return self.method if self.models == 1 else f"{self.method}, mean of {self.models}"


@dataclass(frozen=True)
class ViewScore:
    """One row. A metric that is None has its reason in :attr:`EvaluationTable.missing`."""

    view: str
    width: int
    height: int
    mask_share: float | None  # share of the pixels inside the mask; None without a mask
    values: dict[str, float | None]  # keys: METRICS, of methods that render such layers also GLASS_METRICS


@dataclass(frozen=True)
class EvaluationTable:
    """The measured result of one method on one scene."""

    facts: RunFacts
    rows: tuple[ViewScore, ...]
    missing: dict[str, str] = field(default_factory=dict)  # metric -> why it is absent (in all views, or in some)
    reflection_scale: float | None = None  # of psnr_reflection_scaled
    transmission_scale: float | None = None  # of psnr_transmission_scaled
    object: ObjectFacts | None = None  # of methods with a third stage, on scenes that have one
    glass_scales: dict[str, float] = field(default_factory=dict)  # by layer: of GLASS_METRICS that are scaled

    @property
    def metrics(self) -> tuple[str, ...]:
        """The columns: METRICS, and GLASS_METRICS where the rows have them."""
        return METRICS + tuple(name for name in GLASS_METRICS if any(name in row.values for row in self.rows))

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
        """``WxH``, or the range when the views differ, and supersampling; empty without views."""
        sizes = sorted({(row.width, row.height) for row in self.rows})
        text = " to ".join(f"{width}x{height}" for width, height in dict.fromkeys(sizes[:1] + sizes[-1:]))
        times = self.facts.supersample
        return text if times == 1 or not sizes else f"{text}, {times}x{times} samples a pixel"

    def _present(self, metric: str) -> list[float]:
        if metric not in (*METRICS, *GLASS_METRICS):
            raise KeyError(f"no metric {metric!r}; there are {', '.join((*METRICS, *GLASS_METRICS))}")
        values = (row.values.get(metric) for row in self.rows)
        return [value for value in values if value is not None]


def write_json(path: Path, table: EvaluationTable) -> None:
    """The whole table; absent figures are null and explained under ``missing``."""
    facts = asdict(table.facts)
    for name in ("supersample", "models"):
        if facts[name] == 1:  # the file stays what it was before there was such a setting
            del facts[name]
    document = {
        "format": FORMAT,
        "version": VERSION,
        "facts": facts,
        "resolution": table.resolution,
        "mean": {name: table.mean(name) for name in table.metrics},
        "std": {name: table.std(name) for name in table.metrics},
        "count": {name: table.count(name) for name in table.metrics},
        "missing": table.missing,
        "reflection_scale": table.reflection_scale,
        "transmission_scale": table.transmission_scale,
        **({"glass_scales": table.glass_scales} if table.glass_scales else {}),
        "object": None if table.object is None else asdict(table.object),
        "views": [asdict(row) for row in table.rows],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> EvaluationTable:
    """Read what :func:`write_json` wrote.

    Raises:
        RtgsError: another file, one of another version, or a damaged one; names it and what to do.
    """
    document = records.read_json(path)
    found = (document.get("format"), document.get("version"))
    if found not in [(FORMAT, version) for version in _READ]:
        raise RtgsError(f"{path} is not an evaluation: format {found}, expected {(FORMAT, VERSION)}")
    names = {item.name for item in fields(EvaluationTable)} - {"rows"}
    values = {name: document[name] for name in names & document.keys()} | {"rows": document.get("views")}
    return records.record_of(EvaluationTable, values, path)


def write_csv(path: Path, table: EvaluationTable) -> None:
    """One line per view, then mean and std; an absent figure is an empty field."""
    facts = asdict(table.facts)
    del facts["supersample"], facts["models"]  # in the resolution of the mean, and in the method
    facts["method"] = table.facts.shown_method
    header = ["scene", "method", "preset", "view", "resolution", "mask_share", *table.metrics]
    header += ["steps", "surfels", "train_seconds", "train_cpu_seconds", "peak_memory_mb", "noise_psnr"]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, header, restval="")
        writer.writeheader()
        for row in table.rows:
            cells = {"view": row.view, "resolution": f"{row.width}x{row.height}", "mask_share": row.mask_share}
            writer.writerow(_cells({**facts, **row.values, **cells}))
        for label, statistic in (("mean", table.mean), ("std", table.std)):
            cells = {name: statistic(name) for name in table.metrics}
            writer.writerow(_cells({**facts, **cells, "view": label, "resolution": table.resolution}))


def _cells(row: dict[str, Any]) -> dict[str, object]:
    return {key: spreadsheet_cell(value) for key, value in row.items()}
