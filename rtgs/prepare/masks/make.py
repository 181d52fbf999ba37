"""Masks of transparent objects for every photo of a capture: made by one of the ways, compared with each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from rtgs.core.names import path_inside
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.hull import Consensus, Hull, SmallMask, find_consensus, limits, small_mask
from rtgs.prepare.masks.maker import Made, Maker
from rtgs.prepare.masks.makers import make_maker
from rtgs.prepare.masks.report import METHODS, PICTURE_FILE, MaskReport, MaskRow, Tile, draw_masks
from rtgs.prepare.masks.settings import CleanSettings, MaskSettings
from rtgs.prepare.progress import Say, Ticker
from rtgs.scenes.capture import CaptureView
from rtgs.scenes.images import nearest_resize, read_mask, read_photo
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.splits import select_views

MASKS_DIR = "masks"
_SMALL = 0.1  # share that a mask may miss of the hull's silhouette and is not filled up: its holes may be true


@dataclass(frozen=True)
class MaskRequest:
    """What is asked for."""

    method: str  # key of METHODS
    scene: SceneSettings  # a capture with poses
    settings: MaskSettings
    source: Path  # folder that holds given masks and the file of marks
    cache: Path  # folder of single masks by networks, keyed by network, settings and photo; shared by all captures
    threads: int = 0  # of onnxruntime; 0: its own choice


def make_masks(request: MaskRequest, out: Path, say: Say) -> MaskReport:
    """Write ``masks/<image name>.png`` (255 on the object), ``masks.json``, ``masks.csv`` and ``masks.png``.

    One photo is in memory at a time. Where nothing is found in any photo there are no masks, and the report says so.

    Raises:
        MissingWeights: the networks' files are not there.
        PrepareError: a network, a file of marks or a given mask that does not fit.
        CaptureError: an unreadable photo or mask.
    """
    if request.method not in METHODS:
        raise PrepareError(f"masks cannot be made by {request.method!r}: choose one of {', '.join(METHODS)}")
    capture = read_capture(request.scene)
    views = select_views(capture, request.scene)
    maker = make_maker(request.method, request.settings, capture, views, request.source, request.cache, request.threads)
    made: dict[str, MaskRow] = {}
    small: dict[str, SmallMask] = {}
    ticker, cached = Ticker(say, "masks", len(views)), 0
    for number, view in enumerate(maker.order(views), start=1):
        result = maker(view)
        cached += result.from_cache
        made[view.name] = _row(view, result)
        if result.inside is not None:
            write_mask(result.inside, mask_path(out, view.name))
            small[view.name] = small_mask(view, result.inside, request.settings.clean.mask_size)
            maker.learn(small[view.name])
        ticker(number)
    rows = [made[view.name] for view in views]
    if not any(mask.votes for mask in small.values()):
        rows = [_forgotten(row, out) for row in rows]
        common, checked = None, "nothing found in any photo: the scene goes on without masks"
    else:
        common, checked = _common(maker, list(small.values()), request.settings.clean)
    if common is not None:
        rows = [_cleaned(row, common, small.get(row.name), request, out) for row in rows]
    report = MaskReport(request.method, maker.networks, tuple(rows), checked, cached, maker.notes, maker.panes)
    _finish(report, out, {view.name: view for view in views}, request.scene, common.hull if common else None, small)
    say(str(report))
    return report


def mask_path(folder: Path, name: str) -> Path:
    """Where the mask of a photo lies in the step's output.

    Raises:
        RtgsError: a name that leads out of it (:mod:`rtgs.core.names`).
    """
    return path_inside(folder / MASKS_DIR, f"{name}.png")


def write_mask(inside: np.ndarray, path: Path) -> None:
    """Write a mask (H, W) bool as grey PNG, 255 on the object."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(inside.astype(np.uint8) * 255).save(path)


def _row(view: CaptureView, made: Made) -> MaskRow:
    if made.inside is None:
        return MaskRow(view.name, "", 0.0, None, note=made.note)
    return MaskRow(view.name, made.origin, float(made.inside.mean()), None, boxes=made.boxes, note=made.note)


def _forgotten(row: MaskRow, out: Path) -> MaskRow:
    mask_path(out, row.name).unlink(missing_ok=True)
    return replace(row, origin="", note=row.note or row.origin)


def _common(maker: Maker, masks: Sequence[SmallMask], clean: CleanSettings) -> tuple[Consensus | None, str]:
    """The hull of all masks, and in words how they were compared or why not."""
    voting = sum(mask.votes for mask in masks)
    if not maker.solid:
        return None, "not compared by a hull: flat panes have none"
    if voting < clean.min_views:
        return None, f"not compared with each other: {voting} photos show something, {clean.min_views} are needed"
    common = find_consensus(masks, clean)
    if common is None:
        return None, (
            "not compared with each other: most masks have no hull in common; either they mark different things, or "
            "what they mark moved, or the poses are wrong"
        )
    how = "holes filled" if common.form == "filled" else "as convex hulls, since something stands before the glass"
    return common, f"compared with the hull of {voting} masks ({how})"


def _cleaned(row: MaskRow, common: Consensus, mask: SmallMask | None, request: MaskRequest, out: Path) -> MaskRow:
    """A row with its agreement; the mask on disk is repaired or dropped where it is too low and that is wanted."""
    clean = request.settings.clean
    if mask is None:
        return row
    found = common.agreement[row.name]
    flagged = found.value < clean.min_agreement
    row = replace(row, agreement=found.value, missing=found.missing, extra=found.extra, flagged=flagged)
    action = clean.action if clean.action != "auto" else "flag" if request.method == "given" else "repair"
    path = mask_path(out, row.name)
    if not flagged or action == "flag":
        return row
    if action == "drop":
        path.unlink()
        return replace(row, origin="", action="dropped")
    inside = read_mask(path)
    height, width = inside.shape
    if not inside.any():
        repaired = nearest_resize(common.hull.silhouette(mask), width, height)
    else:
        least, most = (nearest_resize(limit, width, height) for limit in limits(common.hull, mask))
        repaired = inside & most if found.missing < _SMALL else (inside | least) & most
    write_mask(repaired, path)
    return replace(row, area=float(repaired.mean()), action="repaired" if inside.any() else "from the hull")


def _finish(
    report: MaskReport,
    out: Path,
    views: dict[str, CaptureView],
    scene: SceneSettings,
    hull: Hull | None,
    small: dict[str, SmallMask],
) -> None:
    """Write table and picture."""
    (out / MASKS_DIR).mkdir(exist_ok=True)

    def tile(row: MaskRow) -> Tile:
        view, path = views[row.name], mask_path(out, row.name)
        assert view.lens is not None
        photo = read_photo(view.image, scene.background, (view.lens.width, view.lens.height))
        seen = hull.silhouette(small[row.name]) if hull is not None and row.name in small else None
        return Tile(row, photo, read_mask(path) if path.is_file() else None, seen)

    report.write(out)
    draw_masks(out / PICTURE_FILE, report, tile)
