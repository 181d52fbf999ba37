"""How hard the shipped scenes are for a method without reflections.

``python -m benchmarks.quality.difficulty [SCENE ...]``

Trains ``method=2dgs preset=quick`` on each (cached like any run) and compares the test images on mirror, gloss and
glass with the rest. Both figures go into the scene's ``synthetic.json``; a Markdown table is printed, last line: a
JSON object. A scene tests something when the first is at least 3 dB below the second.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from pipelines.cli import main as cli
from pipelines.steps.evaluate import TABLE_JSON
from rtgs.evaluate.records import EvaluationTable, read_json
from rtgs.scenes.importers.embedded import embedded_capture, embedded_names
from rtgs.scenes.synthetic.record import CaptureRecord

GAP = 3.0  # dB


def trained(scene: str, root: Path) -> EvaluationTable:
    """The evaluation of 2dgs (quick) on an embedded scene.

    Raises:
        SystemExit: the run failed; its message is on the screen.
    """
    words = [f"scene={scene}", "method=2dgs", "preset=quick", "tracking=off", f"paths.root={root}"]
    if code := cli.run(words):
        raise SystemExit(code)
    return read_json(root / "runs" / f"{scene}-2dgs-quick" / TABLE_JSON)


def recorded(scene: str, table: EvaluationTable) -> CaptureRecord:
    """The scene's record with the figures of the evaluation, as it now lies beside the images.

    Raises:
        ValueError: no path-traced scene, whose specular surfaces nobody knows.
    """
    folder = embedded_capture(scene)
    record = CaptureRecord.read(folder)
    if record is None:
        raise ValueError(f"embedded scene {scene!r} has no record: it was not path-traced by `rtgs run synthesize`")
    specular, rest = table.mean("psnr_specular"), table.mean("psnr_diffuse_part")
    record = replace(record, psnr_specular_2dgs=_rounded(specular), psnr_rest_2dgs=_rounded(rest))
    record.write(folder)
    return record


def row(record: CaptureRecord) -> str:
    """One line of the table."""
    specular, rest = record.psnr_specular_2dgs, record.psnr_rest_2dgs
    gap = rest - specular if specular is not None and rest is not None else None
    cells = (
        record.labelled(record.name), _percent(record.masked), _percent(record.specular),
        _percent(record.reflected_in_specular), f"{record.noise_psnr:.1f}", _decibels(specular), _decibels(rest),
        _decibels(gap),
    )  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _decibels(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _percent(share: float | None) -> str:
    return "-" if not share else f"{100 * share:.0f} %"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality.difficulty", description=__doc__)
    parser.add_argument("scenes", nargs="*", help=f"of {', '.join(embedded_names())}; none: all of them")
    parser.add_argument("--root", type=Path, default=Path(), help="folder of runs and store")
    options = parser.parse_args()
    records = [recorded(scene, trained(scene, options.root)) for scene in options.scenes or embedded_names()]
    print("| scene | glass | mirror, gloss, glass | reflected light there | noise, dB | 2dgs there | elsewhere | gap |")
    print("|---|---|---|---|---|---|---|---|")
    print("\n".join(row(record) for record in records))
    gaps = {
        record.name: round(record.psnr_rest_2dgs - record.psnr_specular_2dgs, 2)
        for record in records
        if record.psnr_specular_2dgs is not None and record.psnr_rest_2dgs is not None
    }
    print(json.dumps({"gap_db": gaps, "all_test_something": all(gap >= GAP for gap in gaps.values())}))


if __name__ == "__main__":
    main()
