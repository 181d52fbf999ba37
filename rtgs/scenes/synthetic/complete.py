"""``python -m rtgs.scenes.synthetic.complete CAPTURE ...``: adds the truth that captures of older versions lack.

Those do not tell the parts of the transmitted light apart: inner, contents, behind (``glass.py``). They are path-traced
for each view that has a truth, and written beside its other pictures, none of which changes. ``rtgs run synthesize``
does the same as it makes a capture. Ends with the mean light of the layers on glass.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import torch

from rtgs.core.errors import RtgsError
from rtgs.scenes.settings import CaptureError
from rtgs.scenes.synthetic.capture import description_digest
from rtgs.scenes.synthetic.description import TRANSPARENT, SceneDescription, named_scene
from rtgs.scenes.synthetic.glass_truth import add_glass_truth, glass_samples
from rtgs.scenes.synthetic.record import CaptureRecord
from rtgs.scenes.synthetic.render import PathTracer
from rtgs.scenes.synthetic.shrink import shrink_picture
from rtgs.scenes.synthetic.viewpoints import cameras
from rtgs.scenes.truth import read_truth
from rtgs.scenes.truth_files import GLASS_MAPS, existing_truth, glass_files

LAYERS = ("reflected", "transmitted", *GLASS_MAPS)


def complete(
    folder: Path,
    samples: int | None = None,
    *,
    variant: str | None = None,
    tell: Callable[[str], None] = print,
) -> None:
    """Add the parts of the transmitted light to every view of a shipped scene's capture that has a truth without them.

    Args:
        folder: of the capture.
        samples: paths a pixel; None: half of those of its test views.
        variant: of Mitsuba; None: the fastest here.
        tell: told of every view.

    Raises:
        CaptureError: no path-traced capture, or of a scene that is not what rtgs describes.
        RtgsError: Mitsuba or the wanted variant is not there.
    """
    record, description = _of(folder)
    if not description.transparent:
        tell(f"{record.name}: nothing transparent, nothing to add")
        return
    tracer = PathTracer(description, record.seed, variant)
    for camera in cameras(description.viewpoints, record.width, record.height, record.seed):
        truth = existing_truth(folder, camera.name)
        if truth is None or all(path.exists() for path in glass_files(truth)):
            continue
        wall, cpu = time.perf_counter(), time.process_time()
        add_glass_truth(tracer, camera, truth, samples or glass_samples(record.test_samples))
        for path in glass_files(truth):
            shrink_picture(path)
        seconds = f"{time.perf_counter() - wall:.1f} s, {time.process_time() - cpu:.1f} s of CPU time"
        tell(f"{record.name} {camera.name}: {seconds}, {sum(path.stat().st_size for path in glass_files(truth))} bytes")


def _of(folder: Path) -> tuple[CaptureRecord, SceneDescription]:
    record = CaptureRecord.read(folder)
    if record is None:
        raise CaptureError(f"{folder} holds no record of a path-traced capture: name the folder of one")
    try:
        description = named_scene(record.name)
    except ValueError as error:
        raise CaptureError(f"{folder}: {error}; make the capture again with `rtgs run synthesize`") from error
    if record.description_sha256 != description_digest(description):
        raise CaptureError(
            f"{folder}: the scene {record.name} changed after it was rendered; make the capture again with "
            f"`rtgs run synthesize scene={record.name}`"
        )
    return record, description


def layer_means(folder: Path) -> dict[str, float]:
    """Mean linear light of each layer on glass, over all views of a capture whose truth knows it."""
    record, description = _of(folder)
    glass = [index for index, shape in enumerate(description.shapes) if shape.material.kind in TRANSPARENT]
    sums, count = dict.fromkeys(LAYERS, 0.0), 0
    for camera in cameras(description.viewpoints, record.width, record.height, record.seed):
        place = existing_truth(folder, camera.name)
        truth = None if place is None else read_truth(place)
        if truth is None or truth.inner is None:
            continue
        seen = torch.isin(truth.objects, torch.tensor(glass, dtype=truth.objects.dtype))
        count += 3 * int(seen.sum())
        for name in LAYERS:
            sums[name] += float(truth.tensors()[name][:, seen].double().sum())
    return {name: value / max(count, 1) for name, value in sums.items()}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m rtgs.scenes.synthetic.complete", description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+", help="folders of path-traced captures")
    parser.add_argument("--samples", type=int, help="paths a pixel (default: half of those of the test views)")
    options = parser.parse_args()
    try:
        for folder in options.captures:
            complete(folder, options.samples, tell=lambda line: print(line, flush=True))
        print(f"| scene | {' | '.join(LAYERS)} |\n|{'---|' * (1 + len(LAYERS))}")
        for folder in options.captures:
            print(f"| {folder.name} | {' | '.join(f'{mean:.3f}' for mean in layer_means(folder).values())} |")
    except RtgsError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
