"""``rtgs show``: any Gaussian splat as pictures, and measured against a capture's test views when one is given."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.cli.words import size
from rtgs.core.documents import load_json
from rtgs.core.errors import RtgsError
from rtgs.core.names import unique_stems

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.evaluate.evaluate import TimedRender
    from rtgs.evaluate.records import EvaluationTable
    from rtgs.gaussians.ellipsoids import Ellipsoids
    from rtgs.gaussians.surfels import Surfels
    from rtgs.scenes.scene import Scene

NEAR = 0.2  # world units, 3DGS
_NO_SETS = ("mesh", "hull", "object")  # stems of meshes in a run's folder
NEAR_SHARE = 0.02  # of the orbit's radius or the scene's extent, where that is less: scenes in small units

DESCRIPTION = """Render a Gaussian splat: any .ply of 3DGS, 2DGS, nerfstudio, gsplat or this program (SH degree 0 to 3,
text or binary), or a compressed .ply of PlayCanvas. Writes frames of an orbit and turntable.html, which turns the model
under the mouse. With --scene, also the test views of that capture, and their PSNR and SSIM against the photos."""


def show(words: list[str], root: Path) -> int:
    """The command: of a file if one is named, else of a run; returns the exit code.

    Args:
        root: holds ``runs/``.
    """
    from pipelines.cli.show_run import HELP, show_run

    if words[:1] in (["-h"], ["--help"]):
        print(HELP)
        return 0
    if any(word.startswith("-") or is_splat(word) for word in words):
        return show_file(words)
    return show_run(words, root)


def is_splat(word: str) -> bool:
    """Whether a word names a file of Gaussians."""
    return word.lower().endswith(".ply") or ("=" not in word and Path(word).is_file())


def show_file(words: list[str]) -> int:
    """``rtgs show FILE.ply``; returns the exit code."""
    options = _parser().parse_intermixed_args(words)
    if options.settings and options.scene is None:
        raise RtgsError(f"{options.settings[0]}: settings of a scene need --scene")
    from rtgs.gaussians.ply import read_gaussians

    gaussians = read_gaussians(options.file, skip_broken=options.skip_broken)
    if not len(gaussians):
        raise RtgsError(f"{options.file} holds 0 Gaussians: there is nothing to show; was another file meant?")
    kind = type(gaussians).__name__.lower()
    print(f"{options.file}: {len(gaussians):,} {kind}, SH degree {gaussians.sh_degree}")
    if note := one_of_several(options.file, gaussians):
        print(note)
    out = options.out or Path(f"{options.file.name.removesuffix('.ply')}-shown")
    scene = _scene(options) if options.scene is not None else None
    if scene is not None:
        _measure(gaussians, scene, options, out)
    if options.frames:
        _turn(gaussians, scene, options, out)
    return 0


def one_of_several(file: Path, gaussians: Surfels | Ellipsoids) -> str:
    """Why pictures of this file alone are not what the method shows, and what to call instead; empty: they are."""
    from rtgs.gaussians.materials import has_materials
    from rtgs.runs.record import RUN_FILE

    in_run = (file.parent / RUN_FILE).is_file()
    sets = sorted(path.name for path in file.parent.glob("*.ply") if path.stem not in _NO_SETS) if in_run else []
    others = [name for name in sets if name != file.name]
    if others:
        return (
            f"note: this is one of {len(sets)} sets of Gaussians of a method that shades them together; the others are "
            f"{', '.join(others)}. Alone it lacks what they show, reflections or what lies behind glass, and figures "
            f"are too low. All layers together: rtgs show {file.parent}"
        )
    if has_materials(gaussians):
        return (
            "note: these Gaussians have materials of mirrors or glass; what is seen in them is in other sets, which do "
            "not lie beside this file. All layers together: rtgs show RUN"
        )
    return ""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("rtgs show", usage="rtgs show FILE.ply [options]", description=DESCRIPTION)
    parser.add_argument("file", type=Path, help="the .ply")
    parser.add_argument(
        "settings", nargs="*", default=[], metavar="scene.key=value", help="settings of the scene, as for rtgs run"
    )
    parser.add_argument("--scene", help="a scene's name or a capture's folder: measure on its test views")
    parser.add_argument("--transform", type=Path, help="nerfstudio's dataparser_transforms.json of the file")
    parser.add_argument("--out", type=Path, help="folder (default: the file's name and -shown)")
    parser.add_argument("--frames", type=int, default=36, help="of the orbit; 0: none (default: %(default)s)")
    parser.add_argument("--size", type=_size, default=(800, 600), help="of the frames, WxH (default: 800x600)")
    parser.add_argument("--fov", type=float, default=50.0, help="degrees, of the longer side (default: %(default)s)")
    parser.add_argument("--elevation", type=float, default=15.0, help="degrees (default: %(default)s)")
    parser.add_argument("--up", type=_vector, default=(0.0, -1.0, 0.0), help="x,y,z (default: 0,-1,0 as in COLMAP)")
    parser.add_argument("--background", type=_vector, default=(0.0, 0.0, 0.0), help="r,g,b in 0..1 (default: black)")
    parser.add_argument("--sh-degree", type=int, default=3, choices=range(4), help="colours up to it (default: 3)")
    parser.add_argument("--antialiased", action="store_true", help="for models trained with antialiasing")
    parser.add_argument("--skip-broken", action="store_true", help="leave out Gaussians with NaN or inf")
    return parser


def _size(text: str) -> tuple[int, int]:
    try:
        return size(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} {error}") from error


def _vector(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not three numbers such as 0,-1,0") from error
    return x, y, z


def _scene(options: argparse.Namespace) -> Scene:
    from rtgs.config import compose
    from rtgs.config.words import friendly_overrides
    from rtgs.scenes.scene import load_scene

    config, _ = compose(friendly_overrides([f"scene={options.scene}", "scene.long_side=800", *options.settings]))
    scene = load_scene(config.scene)
    if not scene.test:
        raise RtgsError(f"scene {scene.name} has no test views; scene.split_every=8 holds out every 8th")
    return scene


def _measure(gaussians: Surfels | Ellipsoids, scene: Scene, options: argparse.Namespace, out: Path) -> None:
    """Test views of a capture: renders, error maps, tables."""
    from rtgs.evaluate.evaluate import TimedRender, evaluate_views, write_error_maps
    from rtgs.evaluate.images import to_bytes, write_png
    from rtgs.evaluate.records import RunFacts, write_csv, write_json

    transform = read_transform(options.transform)
    near = min(NEAR, NEAR_SHARE * scene.extent)
    renders: list[TimedRender] = []
    stems = unique_stems(view.name for view in scene.test)
    for view in scene.test:
        camera = view.camera if transform is None else _moved(view.camera, *transform)
        scaled = near if transform is None else near * transform[1]
        start = time.perf_counter()
        image = _render(gaussians, camera, scaled, options)
        renders.append(TimedRender(image, time.perf_counter() - start))
        write_png(out / "renders" / f"{stems[view.name]}.png", to_bytes(image))
    write_error_maps(renders, scene.test, out / "errors")
    facts = RunFacts(scene.name, options.file.name, "imported", surfels=len(gaussians))
    table = evaluate_views(renders, scene.test, facts)
    write_json(out / "metrics.json", table)
    write_csv(out / "metrics.csv", table)
    print(_figures(table))


def _figures(table: EvaluationTable) -> str:
    psnr, ssim, seconds = table.mean("psnr"), table.mean("ssim"), table.mean("render_seconds")
    hint = ""
    if psnr is not None and psnr < 12:
        hint = "\nSo low a PSNR means another frame: was the model trained on this capture's poses? (--transform)"
    return (
        f"{table.facts.scene}: {psnr:.2f} dB, SSIM {ssim:.4f} over {len(table.rows)} test views of {table.resolution}, "
        f"{seconds:.3f} s each{hint}"
    )


def _turn(gaussians: Surfels | Ellipsoids, scene: Scene | None, options: argparse.Namespace, out: Path) -> None:
    """Frames of an orbit and the page that turns them."""
    import torch

    from rtgs.evaluate.images import to_bytes, write_png
    from rtgs.render.orbit import Picture, orbit_cameras, orbit_of_cameras, orbit_of_gaussians
    from rtgs.report.turntable import write_turntable

    width, height = options.size
    picture = Picture(width, height, options.fov)
    if scene is None:
        up = torch.tensor(options.up, dtype=torch.float64)
        orbit = orbit_of_gaussians(gaussians, up, picture, options.elevation)
    else:
        transform = read_transform(options.transform)
        cameras = [view.camera for view in (*scene.train, *scene.test)]
        orbit = orbit_of_cameras(cameras if transform is None else [_moved(c, *transform) for c in cameras])
    near = min(NEAR, NEAR_SHARE * orbit.radius)
    frames = []
    start = time.perf_counter()
    for camera in orbit_cameras(orbit, picture, options.frames):
        frames.append(to_bytes(_render(gaussians, camera, near, options)))
    seconds = (time.perf_counter() - start) / len(frames)
    for index, frame in enumerate(frames):
        write_png(out / "frames" / f"{index:03d}.png", frame)
    note = f"{len(gaussians):,} Gaussians"
    page = out / "turntable.html"
    write_turntable(page, frames, options.file.name, note)
    print(f"{len(frames)} frames of {picture.width}x{picture.height}, {seconds:.3f} s each: {page}")


def _render(gaussians: Surfels | Ellipsoids, camera: Camera, near: float, options: argparse.Namespace) -> Tensor:
    import torch

    from rtgs.render.splats import render_splats

    return render_splats(
        gaussians,
        camera,
        near=near,
        background=torch.tensor(options.background),
        sh_degree=options.sh_degree,
        antialiased=options.antialiased,
    )


def read_transform(path: Path | None) -> tuple[Tensor, float] | None:
    """(3, 4) and scale of nerfstudio's file: a point of the model is scale (R x + t) of one of the capture.

    Raises:
        RtgsError: not such a file.
    """
    if path is None:
        return None
    import torch

    try:
        values = load_json(path)
        matrix = torch.tensor(values["transform"], dtype=torch.float64)
        scale = float(values["scale"])
    except (OSError, ValueError, LookupError, TypeError, RuntimeError) as error:
        raise RtgsError(f"{path} is no dataparser_transforms.json (keys transform and scale): {error}") from error
    rotation = matrix[:3, :3] if matrix.ndim == 2 and matrix.shape[0] >= 3 and matrix.shape[1] == 4 else None
    eye = torch.eye(3, dtype=torch.float64)
    if (
        rotation is None
        or not 0 < scale < math.inf
        or not bool(torch.isfinite(matrix).all())
        or not torch.allclose(rotation @ rotation.T, eye, atol=1e-4)
    ):
        raise RtgsError(f"{path}: transform must be 3x4 with a rotation, and scale positive")
    return matrix[:3], scale


def _moved(camera: Camera, matrix: Tensor, scale: float) -> Camera:
    """The camera in the model's frame; lengths along its axes are ``scale`` times as long, pixels stay."""
    from dataclasses import replace

    rotation = camera.rotation @ matrix[:, :3].T
    return replace(camera, rotation=rotation, translation=scale * (camera.translation - rotation @ matrix[:, 3]))
