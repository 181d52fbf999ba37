"""``python -m rtgs.scenes.synthetic.retake CAPTURE OUT``: new training photos, the test views as they were.

A path-traced capture is made again in ``OUT``, with other training viewpoints and more samples. Its test views are
copied, not rendered again: what they cost buys samples of the photos, and figures before and after are of the same
pixels. That is refused unless the scene without its wide lens, the seed, the size and the renderer are those of the
old capture, by which a test view would come out the same. A run that was killed goes on with the views it lacks.
"""

from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from rtgs.core.errors import RtgsError
from rtgs.scenes.settings import CaptureError
from rtgs.scenes.synthetic.capture import copy_folder, description_digest, tracer_of, write_capture
from rtgs.scenes.synthetic.description import SceneDescription, Viewpoints, named_scene
from rtgs.scenes.synthetic.record import CaptureRecord, ViewRecord
from rtgs.scenes.synthetic.settings import CaptureSettings
from rtgs.scenes.synthetic.viewpoints import cameras
from rtgs.scenes.truth_files import TRUTH_FOLDER


def retake(earlier: Path, out: Path, samples: int, *, variant: str | None = None) -> CaptureRecord:
    """Make a shipped scene's capture again in ``out`` with the test views of ``earlier``.

    Finished views are kept in a folder beside ``out``, ``<name>.views``, until all are there.

    Args:
        earlier: a capture of the same scene.
        out: where the new one goes; must not exist.
        samples: paths a pixel of the training photos.
        variant: of Mitsuba; None: the fastest here.

    Raises:
        CaptureError: ``earlier`` holds no path-traced capture, or its test views would come out otherwise now.
        RtgsError: ``out`` exists; an earlier attempt left views of other samples; Mitsuba or the wanted variant is not
            there.
    """
    if out.exists():
        raise RtgsError(f"{out} is there already: name a new folder, or remove that one")
    record = CaptureRecord.read(earlier)
    if record is None:
        raise CaptureError(f"{earlier} holds no record of a path-traced capture: name the folder of one")
    description = named_scene(record.name)
    settings = CaptureSettings(
        record.width,
        record.height,
        samples=samples,
        test_samples=record.test_samples,
        truth="test",
        seed=record.seed,
    )
    refuse_other(record, description, settings, earlier)
    _refuse_other_renderer(record, tracer_of(description, settings, variant).renderer, earlier)
    work = out.with_name(f"{out.name}.views")
    _copy_test_views(earlier, description, settings, work)
    said = {"clock": time.perf_counter(), "cpu": time.process_time()}

    def tell(name: str, share: float) -> None:
        wall, cpu = time.perf_counter() - said["clock"], time.process_time() - said["cpu"]
        print(f"{record.name} {name}: {100 * share:.0f} % after {wall:.0f} s, {cpu:.0f} s of CPU time", flush=True)

    temporary = out.with_name(f"{out.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    made = write_capture(description, temporary, work, settings, variant=variant, progress=tell, test_views_of=record)
    temporary.rename(out)
    return made


def refuse_other(
    record: CaptureRecord, description: SceneDescription, settings: CaptureSettings, earlier: Path
) -> None:
    """Refuse a capture whose test views would come out otherwise.

    Raises:
        CaptureError: scene, number of views or lens of the test views changed since.
    """
    if any(description.viewpoints.is_wide(index) for index in range(record.views) if settings.is_test(index)):
        raise CaptureError(f"{record.name}: wide_every makes test views wide, which those of {earlier} are not")
    plain = Viewpoints()
    narrow = replace(
        description.viewpoints,
        wide_every=plain.wide_every,
        wide_elevation=plain.wide_elevation,
        wide_field_of_view=plain.wide_field_of_view,
    )
    known = {description_digest(description), description_digest(replace(description, viewpoints=narrow))}
    if record.description_sha256 not in known:
        raise CaptureError(
            f"{earlier}: the scene {record.name} changed after it was rendered, by more than its wide lens; make all "
            f"its views again with `rtgs run synthesize scene={record.name}`"
        )


def _refuse_other_renderer(record: CaptureRecord, renderer: str, earlier: Path) -> None:
    """Another version or variant draws other numbers: its test views would have other noise.

    Raises:
        CaptureError: names both.
    """
    if record.renderer != renderer:
        raise CaptureError(
            f"{earlier} was rendered by {record.renderer}, here it would be {renderer}; install and choose that "
            f"renderer, or make all its views again with `rtgs run synthesize scene={record.name}`"
        )


def _copy_test_views(earlier: Path, description: SceneDescription, settings: CaptureSettings, work: Path) -> None:
    """The test views of a capture as finished views in ``work``, beside those that an earlier attempt left."""
    views = cameras(description.viewpoints, settings.width, settings.height, settings.seed)
    for index, camera in enumerate(views):
        if (work / camera.name).is_dir():
            _refuse_other_samples(work / camera.name, settings.view_samples(index))
        elif settings.is_test(index):
            _copy_test_view(earlier, camera.name, settings, work)


def _copy_test_view(earlier: Path, name: str, settings: CaptureSettings, work: Path) -> None:
    temporary = work / f"{name}.tmp"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    shutil.copyfile(earlier / "images" / f"{name}.png", temporary / "image.png")
    shutil.copyfile(earlier / "normals" / f"{name}.png", temporary / "normal.png")
    mask = earlier / "masks" / f"{name}.png"
    if mask.exists():
        shutil.copyfile(mask, temporary / "mask.png")
    truth = earlier / TRUTH_FOLDER / name
    copy_folder(truth, temporary / "truth")
    ViewRecord(
        image=f"{name}.png",
        samples=settings.test_samples,
        seconds=0.0,
        masked=_share(mask) if mask.exists() else 0.0,
        specular=_share(truth / "specular.png"),
        reflected_in_mask=None,
        reflected_in_specular=None,
        noise=None,
    ).write(temporary)
    temporary.rename(work / name)


def _refuse_other_samples(folder: Path, samples: int) -> None:
    found = ViewRecord.read(folder).samples
    if found != samples:
        raise RtgsError(
            f"{folder} was rendered with {found} samples, not {samples}: remove {folder.parent}, or ask for {found}"
        )


def _share(path: Path) -> float:
    """Share of the pixels that are not black."""
    with Image.open(path) as picture:
        return float(np.mean(np.asarray(picture) > 0))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m rtgs.scenes.synthetic.retake", description=__doc__)
    parser.add_argument("capture", type=Path, help="folder of a path-traced capture")
    parser.add_argument("out", type=Path, help="folder of the new one")
    parser.add_argument("--samples", type=int, default=CaptureSettings.samples, help="paths a pixel of training views")
    parser.add_argument("--threads", type=int, help="of the renderer (default: all)")
    options = parser.parse_args()
    try:
        if options.threads:
            import drjit

            drjit.set_thread_count(options.threads)
        record = retake(options.capture, options.out, options.samples)
    except RtgsError as error:
        parser.error(str(error))
    print(f"{record.name}: {record.views} views in {options.out}, {record.points} points, {record.seconds:.0f} s")


if __name__ == "__main__":
    main()
