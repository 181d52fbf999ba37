"""Runs side by side, and the figures of the paper's tables (:mod:`rtgs.evaluate.publish` sets both side by side)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rtgs.evaluate.records import EvaluationTable

NOT_AVAILABLE = "n/a"


@dataclass(frozen=True)
class PaperScore:
    """One cell group of the paper's tables 1 to 3 (RT-GS); LPIPS is VGG fed with [0, 1]: our ``lpips_01``."""

    psnr: float
    ssim: float
    lpips: float


def _scores(method: str, scenes: Sequence[str], cells: str) -> dict[tuple[str, str], PaperScore]:
    """``cells``: PSNR SSIM LPIPS for each scene in order, separated by blanks."""
    numbers = [float(cell) for cell in cells.split()]
    return {(method, scene): PaperScore(*numbers[3 * k : 3 * k + 3]) for k, scene in enumerate(scenes)}


_REF_REAL = ("sedan", "gardenspheres", "toycar")
_NU_NERF = ("ballstatue", "popcorncup", "real_bottle", "tall_bottle")

# method.md 11, keys (method, scene) in this project's names.
PAPER_SCORES: dict[tuple[str, str], PaperScore] = {
    **_scores("3dgs", _REF_REAL, "25.556 0.729 0.294 22.386 0.590 0.239 24.394 0.661 0.229"),
    **_scores("gaussian_shader", _REF_REAL, "22.759 0.648 0.395 22.080 0.599 0.268 23.641 0.661 0.283"),
    **_scores("ref_gs", _REF_REAL, "25.522 0.724 0.338 22.236 0.593 0.274 24.237 0.646 0.270"),
    **_scores("ref_gaussian", _REF_REAL, "24.324 0.675 0.380 22.788 0.614 0.278 23.991 0.644 0.279"),
    **_scores("envgs", _REF_REAL, "26.142 0.727 0.300 23.031 0.620 0.196 24.759 0.669 0.206"),
    **_scores("rtgs", _REF_REAL, "26.203 0.728 0.298 23.050 0.620 0.198 24.693 0.668 0.231"),
    **_scores("nu_nerf", _NU_NERF, "23.453 0.706 0.345 17.031 0.727 0.333 25.818 0.722 0.336 18.923 0.707 0.344"),
    **_scores("3dgs", _NU_NERF, "27.303 0.899 0.142 25.679 0.869 0.202 30.740 0.936 0.162 25.455 0.883 0.173"),
    **_scores(
        "gaussian_shader", _NU_NERF, "25.589 0.872 0.206 16.618 0.701 0.417 22.610 0.824 0.326 18.137 0.734 0.389"
    ),
    **_scores("ref_gs", _NU_NERF, "23.891 0.856 0.263 22.919 0.817 0.342 29.527 0.926 0.249 24.818 0.860 0.267"),
    **_scores("ref_gaussian", _NU_NERF, "15.138 0.660 0.479 22.837 0.829 0.279 28.019 0.896 0.236 23.766 0.845 0.261"),
    **_scores("envgs", _NU_NERF, "25.508 0.878 0.182 23.898 0.847 0.232 30.244 0.915 0.178 25.393 0.886 0.183"),
    **_scores("rtgs", _NU_NERF, "26.053 0.885 0.174 25.720 0.874 0.199 30.298 0.918 0.174 26.225 0.888 0.172"),
    # Table 3, by the names of our ablations.
    **_scores("rtgs, no_transmittance_gaussians", _NU_NERF[:1], "24.844 0.866 0.196"),
    **_scores("rtgs, no_specular_loss", _NU_NERF[:1], "25.673 0.882 0.174"),
    **_scores("rtgs, no_depth_loss", _NU_NERF[:1], "25.941 0.881 0.172"),
    **_scores("rtgs, no_mesh_guide", _NU_NERF[:1], "25.889 0.880 0.174"),
}


def paper_score(row: str, scene: str) -> PaperScore | None:
    """What the paper prints for a row of a table, ``method`` or ``method, ablation``; None: nothing.

    The paper's RT-GS is that of ``rtgs_printed`` and of ``rtgs``; other programs are found however they are spelt.
    """
    return PAPER_SCORES.get((paper_row(row), scene))


def paper_row(row: str) -> str:
    """What the paper's row for a row of a table is called here: ``NU-NeRF`` is ``nu_nerf``."""
    method, comma, ablation = row.partition(",")
    method = method.lower().replace("-", "_").replace(" ", "_")
    return f"{'rtgs' if method == 'rtgs_printed' else method}{comma}{ablation}"


def paper_rows(scene: str, *, ablations: bool) -> tuple[str, ...]:
    """The rows that the paper prints for one of its scenes: its methods or, with ``ablations``, RT-GS and what is taken
    away from it."""
    rows = (row for row, printed in PAPER_SCORES if printed == scene)
    return tuple(row for row in rows if ("," in row) == ablations or (ablations and row == "rtgs"))


@dataclass(frozen=True)
class SummaryRow:
    """One run in a table of runs. None: not measured."""

    scene: str
    method: str
    preset: str
    resolution: str
    views: int
    psnr: float | None
    ssim: float | None
    lpips_01: float | None
    flip: float | None
    train_seconds: float | None
    peak_memory_mb: float | None
    surfels: int | None
    psnr_framed: float | None = None  # over the pixels that enough training views show
    noise_psnr: float | None = None  # of the test photos


def summarize(tables: Sequence[EvaluationTable]) -> list[SummaryRow]:
    """One row per evaluation, in the order given."""
    rows = []
    for table in tables:
        facts = table.facts
        rows.append(
            SummaryRow(
                scene=facts.scene,
                method=facts.shown_method,
                preset=facts.preset,
                resolution=table.resolution,
                views=len(table.rows),
                psnr=table.mean("psnr"),
                ssim=table.mean("ssim"),
                lpips_01=table.mean("lpips_01"),
                flip=table.mean("flip"),
                train_seconds=facts.train_seconds,
                peak_memory_mb=facts.peak_memory_mb,
                surfels=facts.surfels,
                psnr_framed=table.mean("psnr_framed"),
                noise_psnr=facts.noise_psnr,
            )
        )
    return rows
