"""``rtgs outline FOLDER``: poses for photos that have none, and a page on which the glass is outlined."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.errors import RtgsError

if TYPE_CHECKING:
    from rtgs.config.schema import RunConfig
    from rtgs.prepare.masks.drawn import Drawing
    from rtgs.prepare.source import Source

PAGE = "outline.html"
PHOTOS = 8

HELP = f"""rtgs outline FOLDER | VIDEO | scene=NAME [key=value of `rtgs run`]

Finds poses where there are none (`rtgs run` takes them from the cache), chooses {PHOTOS} photos from different sides,
and writes a page beside the capture, {PAGE}: open it, click round the glass in three photos or more, save
masks.yaml beside it. `rtgs run` makes the masks of all photos from that."""


def outline(words: Sequence[str]) -> int:
    """The command; returns the exit code.

    Raises:
        RtgsError: a word that is not understood.
        CaptureError, PrepareError: the capture cannot be read, or its poses not be found.
    """
    if not words or words[0] in ("-h", "--help"):
        print(HELP)
        return 0 if words else 2
    from pipelines.cli.app import short
    from pipelines.planning.inspection import Inspections
    from rtgs.config import compose
    from rtgs.config.words import friendly_overrides, is_override, quoted
    from rtgs.prepare.masks.outline_page import far_apart, write_outline_page
    from rtgs.prepare.poses.export import read_lenses
    from rtgs.prepare.source import mark_file
    from rtgs.scenes.importers.registry import read_capture
    from rtgs.scenes.splits import select_views

    if words[0].startswith("-"):
        raise RtgsError(f"rtgs outline: {words[0]} is no word of it\n\n{HELP}")
    first = words[0] if is_override(words[0]) else f"scene.path={quoted(words[0])}"
    config, _ = compose(friendly_overrides([first, *words[1:]]))
    inspection = Inspections().of(config.scene, config.sfm)
    if inspection.given_masks:
        print(f"{config.scene.name}: {inspection.given_masks}: they are taken, an outline would not be read")
        return 0
    settings = config.scene
    if not inspection.source.has_poses:
        folder = str(_posed(config, inspection.source))  # laid out as the search does, not as the photos lie
        settings = replace(settings, path=folder, format="auto", images_dir=None, model_dir=None)
    capture = read_capture(settings)
    views = select_views(capture, settings)
    target = mark_file(inspection.source, config.masks)
    drawing = _earlier(target, [view.name for view in views])
    chosen = {views[row].name for row in far_apart([view.center for view in views], PHOTOS)}
    chosen |= set(drawing.marked) if drawing is not None else set()
    page = target.with_name(PAGE)
    page.parent.mkdir(parents=True, exist_ok=True)
    shown = [view for view in views if view.name in chosen]
    write_outline_page(page, config.scene.name, shown, target, drawing, read_lenses(capture.root))
    print(f"{short(page)}: open it in a browser, outline the glass in three photos or more, save the file as")
    print(f"{short(target)}; then: rtgs run {shlex.join(_of_run(words))}")
    return 0


def _earlier(file: Path, views: Sequence[str]) -> Drawing | None:
    """The marks that the page begins with: those of the file, if it is there."""
    from rtgs.prepare.errors import PrepareError
    from rtgs.prepare.masks.drawn import read_drawing

    if not file.is_file():
        return None
    try:
        return read_drawing(file, views)
    except PrepareError as error:
        raise PrepareError(f"{error}\nmend that file, or remove it to begin anew") from error


def _of_run(words: Sequence[str]) -> list[str]:
    """The same capture with the same settings, whose poses are in the cache."""
    keys = {word.partition("=")[0] for word in words[1:]}
    usual = {"method": "rtgs", "preset": "quick"}
    return [*words, *(f"{key}={value}" for key, value in usual.items() if key not in keys)]


def _posed(config: RunConfig, source: Source) -> Path:
    """The capture that the search of poses makes; the same step as that of a run, so it is not done twice."""
    from pipelines.planning.plan import remote_store
    from pipelines.steps import sfm
    from rtgs.workflow import InlineExecutor, Store, make_plan

    _tell()
    store, remote = Store(config.paths.store), remote_store(config)
    step = sfm.sfm_step(source, config.scene, config.sfm)
    plan = make_plan((step,), store, remote)
    return InlineExecutor(store, None, remote).execute(plan)[-1].folder


def _tell() -> None:
    """What the step says, as a run prints it."""
    log = logging.getLogger("rtgs")
    if not log.handlers and not logging.getLogger().handlers:
        told = logging.StreamHandler(sys.stderr)
        told.setFormatter(logging.Formatter("%(message)s"))
        log.addHandler(told)
    log.setLevel(logging.INFO)
