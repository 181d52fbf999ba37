"""``rtgs show RUN``: what a trained model looks like from anywhere, all its layers together or each by itself."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.cli.words import THREADS, Reader, place, read_words, size, some_of, whole
from rtgs.core.errors import RtgsError

if TYPE_CHECKING:
    import numpy as np

    from rtgs.core.cameras import Camera
    from rtgs.report.shown import DepthRange
    from rtgs.runs.shown import ShownRun

HELP = """rtgs show [RUN] [key=value ...]       a run: a folder, a name in runs/; without one, the newest

  path=orbit|cameras|spiral|FILE   round the scene, through the places of the photos, a spiral before it, or a
                                   camera_path.json of nerfstudio (default: orbit; cameras if nothing is gone round)
  layer=NAME[,NAME...]|all         final diffuse reflection transmission normal depth weights (default: final)
  frames=60 fps=20 size=WxH        of the film; size: as the photos were trained on
  format=png,mp4,webp              mp4 needs the package av (default: all that can be written)
  transform=FILE                   nerfstudio's dataparser_transforms.json, of a FILE in the frame of its model
  out=FOLDER                       default: shown/PATH-LAYERS in the run's folder
  threads=N root=FOLDER            root holds runs/ and store/

rtgs show FILE.ply [--scene NAME]     any Gaussian splat: rtgs show FILE.ply --help"""

PATHS = ("orbit", "cameras", "spiral")
FORMATS = ("png", "mp4", "webp")
MOST_FRAMES = 20_000
_PROBES = 6  # cameras of the path from which the colours of depth are chosen
_PREVIEW_FRAMES = 60  # of the webp


@dataclass(frozen=True)
class ShowWords:
    """The words of the command; None: not given."""

    run: str | None = None
    path: str | None = None
    layer: str = "final"
    frames: int = 60
    fps: int = 20
    size: tuple[int, int] | None = None
    format: tuple[str, ...] | None = None
    transform: Path | None = None
    out: Path | None = None
    threads: int | None = None
    root: Path | None = None


def show_run(words: Sequence[str], root: Path) -> int:
    """The command; returns the exit code.

    Raises:
        RtgsError: a word that is not understood, no such run, layer, path or file.
    """
    from pipelines.cli.threads import with_threads
    from pipelines.steps.report import PAGE
    from rtgs.report.files import link_files
    from rtgs.report.shown import choose_layers, layers_of
    from rtgs.runs.shown import locate_run, open_run

    asked = parse_words(words)
    formats = _formats(asked)
    folder = locate_run(asked.root or root, asked.run)
    with with_threads(asked.threads):
        run = open_run(folder)
        title, cameras = _cameras(asked, run)
        has = layers_of(run.maps(cameras[0].resized(16, 16)))
        layers = choose_layers(asked.layer.split(","), has, run.method.name)
        out = asked.out or folder / "shown" / f"{title}-{'all' if asked.layer == 'all' else '-'.join(layers)}"
        print(f"{folder.name}: {', '.join(layers)} from {len(cameras)} cameras, path {title}", flush=True)
        _refuse_others(out / "frames")
        _write(run, cameras, layers, formats, asked.fps, out)
    if (folder / PAGE).is_file():
        link_files(folder / PAGE)
    return 0


def parse_words(words: Sequence[str]) -> ShowWords:
    """The words of ``rtgs show`` for a run.

    Raises:
        RtgsError: names the word and what may stand there.
    """
    options = "is for FILE.ply, as all options are: of a run write key=value"
    return ShowWords(**read_words("rtgs show", words, _READERS, options=options, help=HELP))


_READERS: dict[str, Reader] = {
    "path": str,
    "layer": str,
    "frames": whole(1, MOST_FRAMES),
    "fps": whole(1, 240),
    "size": size,
    "format": some_of(FORMATS),
    "transform": place,
    "out": place,
    "threads": THREADS,
    "root": place,
}


def _formats(asked: ShowWords) -> tuple[str, ...]:
    """What is written; an mp4 that was asked for must be possible before anything is rendered."""
    from rtgs.report.films import NEEDS_AV, has_mp4

    if asked.format is None:
        if has_mp4():
            return FORMATS
        print(f"no mp4: {NEEDS_AV}")
        return ("png", "webp")
    if "mp4" in asked.format and not has_mp4():
        raise RtgsError(NEEDS_AV)
    return asked.format


def _cameras(asked: ShowWords, run: ShownRun) -> tuple[str, list[Camera]]:
    """A name for the path, and its cameras."""
    from rtgs.render.paths import cameras_path, is_orbit, orbit_path, picture_of, several_places, spiral_path

    name = asked.path
    if name is not None and name not in PATHS:
        return Path(name).stem, _cameras_of_file(Path(name).expanduser(), asked)
    cameras = run.cameras
    if not several_places(cameras):
        raise RtgsError(f"{run.scene.name} has photos from one place only: give a path=FILE of nerfstudio")
    name = name or ("orbit" if is_orbit(cameras) else "cameras")
    make = {"orbit": orbit_path, "cameras": cameras_path, "spiral": spiral_path}[name]
    picture = picture_of(cameras)
    if asked.size is not None:
        from dataclasses import replace

        picture = replace(picture, width=asked.size[0], height=asked.size[1])
    return name, make(cameras, picture, asked.frames)


def _cameras_of_file(path: Path, asked: ShowWords) -> list[Camera]:
    from pipelines.cli.show import read_transform
    from rtgs.render.camera_path import from_model_frame, read_camera_path

    if not path.is_file():
        raise RtgsError(
            f"path={path}: there is no such file; a path is one of {', '.join(PATHS)} or a camera_path.json"
        )
    cameras = read_camera_path(path, asked.size)
    transform = read_transform(asked.transform)
    return cameras if transform is None else [from_model_frame(camera, *transform) for camera in cameras]


def _refuse_others(frames: Path) -> None:
    """Frames are replaced as a folder, so nothing else may lie there.

    Raises:
        RtgsError: names what does.
    """
    other = next((each for each in sorted(frames.glob("*")) if not re.fullmatch(r"\d{5}\.png", each.name)), None)
    if other is not None:
        raise RtgsError(f"{other} is no frame of a film, and {frames} would be replaced: choose another out=FOLDER")


def _write(
    run: ShownRun, cameras: Sequence[Camera], layers: Sequence[str], formats: Sequence[str], rate: int, out: Path
) -> None:
    """Render frame by frame; films are made from the files, so that long ones need no memory."""
    import shutil
    from tempfile import TemporaryDirectory

    import numpy as np
    from PIL import Image

    from rtgs.evaluate.images import write_png
    from rtgs.report.films import write_mp4, write_preview

    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=out) as working:
        frames = Path(working) / "frames"
        frames.mkdir()
        start = time.perf_counter()
        for index, pixels in enumerate(_frames(run, cameras, layers)):
            write_png(frames / f"{index:05d}.png", pixels)
            _tell(index + 1, len(cameras), time.perf_counter() - start)
        files = sorted(frames.glob("*.png"))
        read = lambda path: np.asarray(Image.open(path).convert("RGB"))  # noqa: E731
        made = []
        if "mp4" in formats:
            write_mp4(out / "film.mp4", map(read, files), rate)
            made.append(out / "film.mp4")
        if "webp" in formats:
            every = -(-len(files) // _PREVIEW_FRAMES)
            write_preview(out / "preview.webp", [read(path) for path in files[::every]], max(1, round(rate / every)))
            made.append(out / "preview.webp")
        if "png" in formats:
            shutil.rmtree(out / "frames", ignore_errors=True)
            frames.rename(out / "frames")
            made.append(out / "frames")
    seconds = (time.perf_counter() - start) / len(cameras)
    print(f"{len(cameras)} frames, {seconds:.2f} s each:", *(f"  {path}" for path in made), sep="\n")


def _frames(run: ShownRun, cameras: Sequence[Camera], layers: Sequence[str]) -> Iterator[np.ndarray]:
    from rtgs.report.shown import shown_layer, side_by_side

    depths = _depths(run, cameras) if "depth" in layers else None
    for camera in cameras:
        maps = run.maps(camera)
        yield side_by_side({name: shown_layer(name, maps, camera, depths) for name in layers})


def _depths(run: ShownRun, cameras: Sequence[Camera]) -> DepthRange | None:
    """One range for the whole film, from a few small pictures: else its colours would flicker."""
    from rtgs.report.shown import DepthRange

    chosen = cameras[:: max(1, len(cameras) // _PROBES)]
    small = (camera.resized(max(8, camera.width // 4), max(8, camera.height // 4)) for camera in chosen)
    return DepthRange.of([run.maps(camera) for camera in small])


def _tell(done: int, total: int, seconds: float) -> None:
    if done in (1, total) or done % max(1, total // 5) == 0:
        print(f"  frame {done}/{total}, {seconds / done:.2f} s each", flush=True)
