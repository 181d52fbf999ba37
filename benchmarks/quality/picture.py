"""One picture of a finished run: ``python -m benchmarks.quality.picture RUN_FOLDER OUTPUT.jpg [--views NAME NAME]``.

Columns photo, render, error, depth, normal; one row per test view. Without ``--views``: the view of the median PSNR and
the best one, as the run's ``metrics.json`` has them. Colours are those of the report: error from 0 to the full scale
named in the caption, near warm and far cold, normals in the camera frame. The photos come from the run's imported
scene and the maps from its render step, both in the store of ``paths.root``. Last line: a JSON object.
"""

from __future__ import annotations

import argparse
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.publishing.results import RUN_FILE, RunRecord
from pipelines.steps.evaluate import TABLE_JSON
from rtgs.core.errors import RtgsError
from rtgs.evaluate.images import ERROR_FULL_SCALE, error_map, to_bytes
from rtgs.evaluate.records import EvaluationTable, read_json
from rtgs.report.figures import depth_picture, normal_picture
from rtgs.runs.views import read_render
from rtgs.scenes.canonical import read_scene

if TYPE_CHECKING:
    from PIL import Image

    from rtgs.scenes.scene import View

WIDTH = 1500  # of the whole picture, pixels
MAX_BYTES = 250_000
QUALITIES = (92, 88, 84, 80, 75, 70, 60, 50)  # tried in order until the file is small enough
GAP, HEAD, FOOT = 6, 34, 30  # pixels: between pictures, above and below a row
COLUMNS = ("photo (held out)", "render", f"error, 0 to {ERROR_FULL_SCALE:g}", "depth", "normal")
GROUND, INK, SOFT = (255, 255, 255), (30, 36, 42), (95, 105, 115)


@dataclass(frozen=True)
class Row:
    """The pictures of one test view, (H, W, 3) uint8 in the order of COLUMNS, and its caption."""

    pictures: tuple[np.ndarray, ...]
    caption: str


def artifact(run: Path, step: str) -> Path:
    """The folder in the store of a step of this run.

    Raises:
        RtgsError: the folder is no finished run, or its store no longer has the artifact.
    """
    record = RunRecord.read(run)
    if record is None:
        raise RtgsError(
            f"{run} is no finished run: it has no readable {RUN_FILE}; give a folder that `rtgs run` filled"
        )
    fingerprint = record.steps.get(step, "")
    for root in (run.resolve().parents[1], Path.cwd()):  # runs/<name> lies beside store/
        folder = root / "store" / step / fingerprint[:2] / fingerprint
        if fingerprint and folder.is_dir():
            return folder
    raise RtgsError(f"the store beside {run} has no {step} {fingerprint[:12]}: run `{record.command}` again")


def choose(table: EvaluationTable) -> list[str]:
    """The views of median and best PSNR, in the order of the table."""
    ranked = sorted(table.rows, key=lambda row: row.values.get("psnr") or 0.0)
    chosen = {ranked[(len(ranked) - 1) // 2].view, ranked[-1].view}
    return [row.view for row in table.rows if row.view in chosen]


def make_row(view: View, rendered: Path, table: EvaluationTable) -> Row:
    maps = read_render(rendered, view.name)
    depth = depth_picture(maps["depth"], maps["alpha"])
    if depth is None:
        raise RtgsError(f"{rendered}: nothing is rendered in view {view.name}")
    image = maps["image"].clamp(0, 1)
    pictures = (
        to_bytes(view.image),
        to_bytes(image),
        error_map(image, view.image),
        depth.pixels,
        normal_picture(maps["normal"], view.camera),
    )
    values = next(row.values for row in table.rows if row.view == view.name)
    return Row(pictures, f"{view.name}: {values['psnr']:.1f} dB, SSIM {values['ssim']:.3f}")


def compose(rows: list[Row], title: str) -> Image.Image:
    """All rows on one sheet of WIDTH pixels."""
    from PIL import Image, ImageDraw, ImageFont

    cell = (WIDTH - GAP * (len(COLUMNS) + 1)) // len(COLUMNS)
    heights = [round(cell * row.pictures[0].shape[0] / row.pictures[0].shape[1]) for row in rows]
    sheet = Image.new("RGB", (WIDTH, HEAD + sum(heights) + FOOT * len(rows)), GROUND)
    draw = ImageDraw.Draw(sheet)
    font, small = ImageFont.load_default(17), ImageFont.load_default(15)
    lefts = [GAP + index * (cell + GAP) for index in range(len(COLUMNS))]
    for left, name in zip(lefts, COLUMNS, strict=True):
        draw.text((left + cell / 2, HEAD / 2), name, INK, font, anchor="mm")
    top = HEAD
    for row, height in zip(rows, heights, strict=True):
        for left, pixels in zip(lefts, row.pictures, strict=True):
            picture = Image.fromarray(pixels)
            kind = Image.Resampling.BOX if picture.width > cell else Image.Resampling.BICUBIC
            sheet.paste(picture.resize((cell, height), kind), (left, top))
        draw.text((GAP, top + height + FOOT / 2), row.caption, SOFT, small, anchor="lm")
        top += height + FOOT
    draw.text((lefts[-1] + cell, top - FOOT / 2), title, SOFT, small, anchor="rm")
    return sheet


def encode(sheet: Image.Image) -> bytes:
    """JPEG of at most MAX_BYTES, at the best quality that allows it."""
    content = b""
    for quality in QUALITIES:
        buffer = io.BytesIO()
        sheet.save(buffer, "JPEG", quality=quality, subsampling=0 if quality >= 80 else 2, optimize=True)
        content = buffer.getvalue()
        if len(content) <= MAX_BYTES:
            return content
    raise RtgsError(f"the picture has {len(content):,} bytes even at quality {QUALITIES[-1]}: choose fewer views")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    parser.add_argument("run", type=Path, help="a folder that `rtgs run` filled")
    parser.add_argument("output", type=Path)
    parser.add_argument("--views", nargs="+", help="names of test views, one row each")
    arguments = parser.parse_args()
    table = read_json(arguments.run / TABLE_JSON)
    names = arguments.views or choose(table)
    views = {view.name: view for view in read_scene(artifact(arguments.run, "import_scene")).test}
    if unknown := sorted(set(names) - set(views)):
        raise SystemExit(f"no test view {', '.join(unknown)}; {arguments.run} has {', '.join(views)}")
    rendered = artifact(arguments.run, "render")
    facts = table.facts
    title = f"{facts.scene}, {facts.method}, preset {facts.preset}: {facts.surfels:,} surfels"
    sheet = compose([make_row(views[name], rendered, table) for name in names], title)
    content = encode(sheet)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_bytes(content)
    print(json.dumps({"output": str(arguments.output), "views": names, "size": sheet.size, "bytes": len(content)}))


if __name__ == "__main__":
    main()
