"""The columns of a report's table of views."""

from __future__ import annotations

from dataclasses import dataclass

from rtgs.evaluate.coverage import FRAMED_BY
from rtgs.evaluate.records import GLASS_METRICS, EvaluationTable


@dataclass(frozen=True)
class Column:
    """A column of the per-view table."""

    metric: str
    title: str
    digits: int
    factor: float = 1.0


_ALWAYS = (
    Column("psnr", "PSNR", 2),
    Column("ssim", "SSIM", 4),
    Column("lpips_01", "LPIPS [0,1]", 4),
    Column("lpips_11", "LPIPS [−1,1]", 4),
    Column("flip", "FLIP", 4),
)
_WHEN_PRESENT = (
    Column("cc_psnr", "PSNR after a colour fit", 2),
    Column("psnr_refined_poses", "PSNR from refined poses", 2),
    Column("psnr_masked", "PSNR in mask", 2),
    Column("ssim_masked", "SSIM in mask", 4),
    Column("lpips_01_masked", "LPIPS [0,1] in mask", 4),
    Column("lpips_11_masked", "LPIPS [−1,1] in mask", 4),
    Column("flip_masked", "FLIP in mask", 4),
    Column("psnr_specular", "PSNR on specular objects", 2),
    Column("psnr_diffuse_part", "PSNR off them", 2),
    Column("psnr_reflection", "PSNR of the reflection", 2),
    Column("psnr_reflection_scaled", "PSNR of the reflection, scaled", 2),
    Column("psnr_transmission", "PSNR of the transmission", 2),
    Column("psnr_transmission_scaled", "PSNR of the transmission, scaled", 2),
    *(Column(name, f"PSNR of {name.removeprefix('psnr_').replace('_', ', ')}", 2) for name in GLASS_METRICS),
    Column("psnr_given_masks", "PSNR, given masks", 2),
    Column("psnr_masked_given_masks", "PSNR in mask, given masks", 2),
    Column("ssim_masked_given_masks", "SSIM in mask, given masks", 4),
    Column("depth_error_masked", "depth error in mask, %", 2, 100.0),
    Column("depth_share_masked", "depth within 3 % in mask, %", 1, 100.0),
    Column("normal_degrees_masked", "normal error in mask, degrees", 1),
    Column("normal_share_masked", "normal within 15 degrees in mask, %", 1, 100.0),
    Column("psnr_framed", f"PSNR where {FRAMED_BY} training views look", 2),
    Column("framed_share", "share of it, %", 1, 100.0),
    Column("depth_off", "depth off by 5 %, %", 1, 100.0),
    Column("psnr_8bit", "PSNR 8 bit", 2),
    Column("ssim_8bit", "SSIM 8 bit", 4),
    Column("lpips_01_8bit", "LPIPS [0,1] 8 bit", 4),
    Column("render_seconds", "render, ms", 1, 1000.0),
)


def columns_of(table: EvaluationTable) -> tuple[Column, ...]:
    """Those that always stand there, and those of which the table has values."""
    return _ALWAYS + tuple(column for column in _WHEN_PRESENT if table.count(column.metric))


def reasons_of(table: EvaluationTable) -> list[tuple[str, str]]:
    """Why figures are missing: (columns, reason), columns with the same reason together."""
    titles = {column.metric: column.title for column in _ALWAYS + _WHEN_PRESENT if column.metric in table.metrics}
    every_lpips = {metric for metric in titles if metric.startswith("lpips")}
    grouped: dict[str, set[str]] = {}
    for metric, reason in table.missing.items():
        grouped.setdefault(reason, set()).add(metric)
    lines = []
    for reason, metrics in grouped.items():
        names = [titles[metric] for metric in titles if metric in metrics]
        joined = "every figure" if metrics >= set(titles) else ", ".join(names)
        lines.append(("LPIPS, all columns" if metrics == every_lpips else joined, reason))
    return lines
