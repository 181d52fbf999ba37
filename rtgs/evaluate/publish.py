"""Tables as papers print them: methods by scenes, the best three marked, spread over seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.refuse import refuse_unknown_words
from rtgs.evaluate.records import EvaluationTable
from rtgs.evaluate.tables import PaperScore, paper_row, paper_rows, paper_score

DataKind = Literal["stand_in", "paper", "own"]
STAND_IN: DataKind = "stand_in"
PAPER_DATA: DataKind = "paper"
OWN_DATA: DataKind = "own"
PAPER_PRESET = "paper"  # the preset that is the published schedule


@dataclass(frozen=True)
class TableSpec:
    """Which table this is, and on whose data."""

    name: str  # also the folder it is written into
    title: str
    data: DataKind = OWN_DATA
    blocks: Mapping[str, str] = field(
        default_factory=dict
    )  # heading by method: its rows stand and compete by themselves

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "table")


@dataclass(frozen=True)
class Measured:
    """One evaluated run of a table.

    Attributes:
        paper_scene: the paper's name for the scene, where it has one.
        differs: in words, each way in which the run is not what the paper describes.
    """

    evaluation: EvaluationTable
    seed: int
    paper_scene: str = ""
    differs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Metric:
    """A column: key of the evaluation or of the run's facts."""

    key: str
    title: str
    digits: int
    higher_is_better: bool | None  # None: not ranked


QUALITY = (
    Metric("psnr", "PSNR", 2, True),
    Metric("ssim", "SSIM", 3, True),
    Metric("lpips_01", "LPIPS", 3, False),
    Metric("flip", "FLIP", 3, False),
)
COSTS = (
    Metric("psnr_masked", "PSNR in the mask", 2, True),
    Metric("ssim_masked", "SSIM in the mask", 3, True),
    Metric("flip_masked", "FLIP in the mask", 3, False),
    Metric("psnr_masked_given_masks", "PSNR in the mask, given masks", 2, True),
    Metric("train_seconds", "training s, mesh included", 0, None),
    Metric("peak_memory_mb", "memory MB", 0, None),
    Metric("surfels", "Gaussians", 0, None),
)
TRUTH = (  # of path-traced scenes
    Metric("psnr_reflection", "reflection PSNR", 2, True),
    Metric("psnr_reflection_scaled", "reflection PSNR, scaled", 2, True),
    Metric("psnr_transmission", "transmission PSNR", 2, True),
    Metric("psnr_transmission_scaled", "transmission PSNR, scaled", 2, True),
    Metric("depth_share_masked", "depth within 3 % in the mask", 3, True),
    Metric("normal_degrees_masked", "normal error in the mask, degrees", 1, False),
    Metric("object_distance", "mesh to container, diagonals", 4, False),
)
MESH = (Metric("object_silhouette_iou", "IoU of mesh and masks", 3, None),)  # real captures have it too
PHOTOS = (  # in CSV files alone: these have seen the test photos
    Metric("cc_psnr", "PSNR after a colour fit", 2, True),
    Metric("psnr_refined_poses", "PSNR from refined poses", 2, True),
)
ALL = (*QUALITY, *COSTS, *MESH, *TRUTH, *PHOTOS)


@dataclass(frozen=True)
class Value:
    """Mean over seeds and, with more than one, the sample standard deviation."""

    mean: float
    spread: float | None
    seeds: int


@dataclass(frozen=True)
class Cell:
    """One method on one scene."""

    method: str
    scene: str
    values: Mapping[str, Value | None]  # by metric key
    ranks: Mapping[str, int]  # 1, 2, 3 by metric key, where earned
    paper: PaperScore | None  # on the paper's own data; never beside stand-ins
    seeds: tuple[int, ...]
    preset: str
    resolution: str
    views: int
    differs: tuple[str, ...] = ()  # from the paper, in any of its runs


@dataclass(frozen=True)
class PaperTable:
    """All cells, methods and scenes in the order of the runs.

    Attributes:
        published: what the paper prints, by (row, scene): of the rows that were run, then of those that were not.
            On its own data. Empty where the scenes have nothing to do with the paper's.
        paper_scenes: the paper's name of each scene.
    """

    spec: TableSpec
    methods: tuple[str, ...]
    scenes: tuple[str, ...]
    cells: Mapping[tuple[str, str], Cell]
    published: Mapping[tuple[str, str], PaperScore] = field(default_factory=dict)
    paper_scenes: Mapping[str, str] = field(default_factory=dict)

    def cell(self, method: str, scene: str) -> Cell | None:
        """The cell, or None where this method was not run on this scene (or failed)."""
        return self.cells.get((method, scene))

    @property
    def blocks(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """(heading, methods) of each block of rows; one without a heading where the table has none."""
        return self._grouped(self.methods)

    @property
    def blocks_with_published(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """The same with the paper's rows that were not run, which come last."""
        return self._grouped((*self.methods, *(row for row, _ in self.published)))

    def _grouped(self, rows: Sequence[str]) -> tuple[tuple[str, tuple[str, ...]], ...]:
        groups: dict[str, list[str]] = {}
        for method in dict.fromkeys(rows):
            groups.setdefault(block_of(self.spec, method), []).append(method)
        return tuple((heading, tuple(methods)) for heading, methods in groups.items())


def block_of(spec: TableSpec, method: str) -> str:
    """The heading of the block in which a row stands; a row is called ``method`` or ``method, ablation``."""
    return spec.blocks.get(method.split(",")[0], "")


def build_table(spec: TableSpec, runs: Sequence[Measured]) -> PaperTable:
    """Group runs by method and scene.

    Raises:
        ValueError: no runs, or the same method, scene and seed twice.
    """
    if not runs:
        raise ValueError(f"table {spec.name} has no runs")
    groups: dict[tuple[str, str], list[Measured]] = {}
    for run in runs:
        facts = run.evaluation.facts
        group = groups.setdefault((facts.method, facts.scene), [])
        if any(other.seed == run.seed for other in group):
            raise ValueError(f"table {spec.name}: {facts.method} on {facts.scene} with seed {run.seed} comes twice")
        group.append(run)
    values = {key: {m.key: _value(m.key, group) for m in ALL} for key, group in groups.items()}
    ranks = _ranks(values, spec)
    cells = {key: _cell(key, group, values[key], ranks[key], spec) for key, group in groups.items()}
    methods = tuple(dict.fromkeys(method for method, _ in groups))
    scenes = {run.evaluation.facts.scene: run.paper_scene for run in runs}
    published = {} if spec.data == OWN_DATA else _published(methods, scenes)
    return PaperTable(spec, methods, tuple(scenes), cells, published, scenes)


def _published(methods: Sequence[str], scenes: Mapping[str, str]) -> dict[tuple[str, str], PaperScore]:
    """By row and scene; ``scenes``: the paper's name of each."""
    found: dict[tuple[str, str], PaperScore] = {}
    for scene, papers in scenes.items():
        found |= {(row, scene): score for row in methods if (score := paper_score(row, papers)) is not None}
    ran = {paper_row(row) for row in methods}
    ablations = any("," in row for row, _ in found)  # of the paper: a judged row is none
    for scene, papers in scenes.items():
        for row in paper_rows(papers, ablations=ablations):
            score = paper_score(row, papers)
            if row not in ran and score is not None:
                found[row, scene] = score
    return found


def _value(key: str, group: Sequence[Measured]) -> Value | None:
    found = [value for run in group if (value := _of_run(key, run)) is not None]
    if not found:
        return None
    mean = math.fsum(found) / len(found)
    spread = math.sqrt(math.fsum((v - mean) ** 2 for v in found) / (len(found) - 1)) if len(found) > 1 else None
    return Value(mean, spread, len(found))


def _of_run(key: str, run: Measured) -> float | None:
    evaluation = run.evaluation
    if key in ("train_seconds", "peak_memory_mb", "surfels"):
        return getattr(evaluation.facts, key)
    if key.startswith("object_"):
        return None if evaluation.object is None else getattr(evaluation.object, key.removeprefix("object_"))
    return evaluation.mean(key)


def _ranks(
    values: Mapping[tuple[str, str], Mapping[str, Value | None]], spec: TableSpec
) -> dict[tuple[str, str], dict[str, int]]:
    """Places 1 to 3 within each scene and block; equal printed figures share a place; a method alone earns none."""
    ranks: dict[tuple[str, str], dict[str, int]] = {key: {} for key in values}
    groups: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for key in values:
        groups.setdefault((key[1], block_of(spec, key[0])), []).append(key)
    for mine in groups.values():
        for metric in ALL:
            found = {key: round(v.mean, metric.digits) for key in mine if (v := values[key][metric.key]) is not None}
            if metric.higher_is_better is None or len(found) < 2:
                continue
            for key, value in found.items():
                better = sum(other > value if metric.higher_is_better else other < value for other in found.values())
                if better < 3:
                    ranks[key][metric.key] = better + 1
    return ranks


def _cell(
    key: tuple[str, str],
    group: Sequence[Measured],
    values: Mapping[str, Value | None],
    ranks: Mapping[str, int],
    spec: TableSpec,
) -> Cell:
    first = group[0].evaluation
    paper = paper_score(key[0], group[0].paper_scene) if spec.data == PAPER_DATA else None
    seeds = tuple(sorted(run.seed for run in group))
    differs = tuple(dict.fromkeys(way for run in group for way in run.differs))
    return Cell(*key, values, ranks, paper, seeds, first.facts.preset, first.resolution, len(first.rows), differs)
