"""Poses from images alone, beside the poses a capture brings.

``python -m benchmarks.quality.sfm [SCENE ...] [--photos N] [--threads 2]``: the photos of each real set in
``$RTGS_SHARED/data`` are taken without their model, poses are looked for, and compared with the given ones after
alignment. Each set in a process of its own, so that the peak of memory is its own; ``--keep FOLDER`` keeps each row,
and what is kept is not measured again. The last line is a JSON object.
Columns: photos the given model holds, of which found; degrees and per mille of the cameras' extent (median, largest);
focal length; reprojection error; seconds and CPU seconds per photo; peak resident memory, and how much of it was there
before the first photo (imports).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.common.machine import machine, peak_memory_mb

SCENES = ("fox", "bonsai", "glass_clock", "gold_cape", "desk_kettle", "facade_a")


@dataclass(frozen=True)
class Row:
    """Figures of one set."""

    scene: str
    given: int
    found: int
    missing: tuple[str, ...]
    rotation_median: float  # degrees
    rotation_max: float
    translation_median: float  # share of the extent
    translation_max: float
    focal: float  # relative error
    reprojection_error: float  # pixels
    roll: float  # degrees: rms angle of the photos to the level of the found world
    seconds_per_photo: float
    cpu_per_photo: float
    memory_mb: float
    imports_mb: float


def measure(capture: Path, photos: int | None, threads: int) -> Row:
    """Find poses for the photos of ``capture`` and compare them with its own."""
    import numpy as np

    from rtgs.prepare.poses.compare import compare_poses
    from rtgs.prepare.poses.find import Request, find_poses
    from rtgs.prepare.settings import SfmSettings
    from rtgs.scenes.importers.registry import read_capture
    from rtgs.scenes.settings import SceneSettings

    given = read_capture(SceneSettings(path=str(capture)))
    views = given.views[:photos]
    before = peak_memory_mb()
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        for name in ("source/images", "work", "out"):
            (root / name).mkdir(parents=True)
        for view in views:
            (root / "source/images" / view.image.name).symlink_to(view.image.resolve())
        wall, cpu = time.perf_counter(), _cpu_seconds()
        request = Request.of(SceneSettings(), root / "source")
        report = find_poses(request, SfmSettings(), root / "work", root / "out", threads, _say)
        wall, cpu = time.perf_counter() - wall, _cpu_seconds() - cpu
        found = read_capture(SceneSettings(path=str(root / "out")))
    errors = compare_poses(found.views, views)
    tilt = np.array([view.rotation[0, 2] for view in found.views])  # of the right axis out of the level plane
    return Row(
        scene=capture.name,
        given=len(views),
        found=len(errors.names),
        missing=errors.missing,
        rotation_median=float(np.median(errors.rotation)),
        rotation_max=float(errors.rotation.max()),
        translation_median=float(np.median(errors.translation)),
        translation_max=float(errors.translation.max()),
        focal=errors.focal,
        reprojection_error=report.reprojection_error,
        roll=float(np.degrees(np.sqrt((tilt**2).mean()))),
        seconds_per_photo=wall / len(views),
        cpu_per_photo=cpu / len(views),
        memory_mb=peak_memory_mb(),
        imports_mb=before,
    )


def _say(text: str) -> None:
    print(f"  {text}", file=sys.stderr, flush=True)


def _cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def table(rows: list[Row]) -> str:
    """Rows as Markdown."""
    lines = [
        "| set | found | rotation, degrees | position, ‰ of extent | focal | error, px | roll, degrees | s/photo "
        "| CPU s/photo | memory |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        missing = f" (not {', '.join(row.missing)})" if row.missing else ""
        lines.append(
            f"| {row.scene} | {row.found} of {row.given}{missing} "
            f"| {row.rotation_median:.3f}, max {row.rotation_max:.3f} "
            f"| {1e3 * row.translation_median:.2f}, max {1e3 * row.translation_max:.2f} | {row.focal:+.2%} "
            f"| {row.reprojection_error:.2f} | {row.roll:.1f} | {row.seconds_per_photo:.2f} "
            f"| {row.cpu_per_photo:.2f} | {row.memory_mb:.0f} MB ({row.imports_mb:.0f}) |"
        )
    return "\n".join(lines)


def measured(capture: Path, photos: int | None, threads: int, keep: Path | None) -> str:
    """The row of one set as JSON, from ``keep`` or by a process of its own; empty when that fails."""
    kept = keep / f"{capture.name}-{photos or 'all'}-{threads}.json" if keep else None
    if kept is not None and kept.is_file():
        return kept.read_text(encoding="utf-8")
    words = ["--one", str(capture), "--threads", str(threads)]
    words += ["--photos", str(photos)] if photos else []
    result = subprocess.run(
        [sys.executable, "-m", "benchmarks.quality.sfm", *words], stdout=subprocess.PIPE, check=False
    )
    if result.returncode:
        return ""
    text = result.stdout.decode().splitlines()[-1]
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(text + "\n", encoding="utf-8")
    return text


def main(arguments: list[str] | None = None) -> None:
    """Measure every set in a process of its own; print the table and the JSON."""
    parser = argparse.ArgumentParser("python -m benchmarks.quality.sfm", description=__doc__)
    parser.add_argument("scenes", nargs="*", help=f"names in $RTGS_SHARED/data (default: {' '.join(SCENES)})")
    parser.add_argument("--photos", type=int, help="only the first so many photos of each set")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder of rows measured before, which are not measured again")
    parser.add_argument("--one", metavar="FOLDER", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.one:
        print(json.dumps(asdict(measure(options.one, options.photos, options.threads))))
        return
    data = Path(os.environ.get("RTGS_SHARED", "../shared")) / "data"
    rows = []
    for name in options.scenes or SCENES:
        if not (data / name).is_dir():
            print(f"{name}: not in {data}", file=sys.stderr)
            continue
        text = measured(data / name, options.photos, options.threads, options.keep)
        if not text:
            print(f"{name}: failed, see above", file=sys.stderr)
            continue
        values = json.loads(text)
        rows.append(Row(**{**values, "missing": tuple(values["missing"])}))
        print(table(rows[-1:]).splitlines()[-1], file=sys.stderr, flush=True)
    print(table(rows))
    print(json.dumps({"rows": [asdict(row) for row in rows], "threads": options.threads, **machine()}))


if __name__ == "__main__":
    main()
