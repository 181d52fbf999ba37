"""The trained method seen from the test cameras: images and maps."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.steps.judge import read_mixture
from pipelines.steps.training import last_training, load_method
from pipelines.steps.views import COVERAGE, read_coverage, read_render, view_maps
from rtgs.core.errors import RtgsError
from rtgs.core.records import read_record, write_json
from rtgs.workflow import StepContext, StepKind

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.evaluate.evaluate import TimedRender
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene, View

TIMES_FILE = "render.json"
GIVEN = "image_given_masks"  # of methods with a third stage: seen through the view's own mask, not the silhouette

FULL = "image_full"  # where the judge kept the plain method: of the full method alone


@dataclass(frozen=True)
class RenderTimes:
    """``render.json``: how long the test views took.

    Attributes:
        seconds: by the wall, by view name.
        with_maps: the time is that of the image together with its maps; False: of the image alone.
    """

    seconds: dict[str, float]
    with_maps: bool = False  # artifacts of older versions do not say

    def of(self, view_name: str) -> float:
        """Seconds of one view.

        Raises:
            RtgsError: the view was not rendered.
        """
        if view_name not in self.seconds:
            raise RtgsError(
                f"view {view_name!r} was not rendered: {TIMES_FILE} has {', '.join(self.seconds) or 'none'}"
            )
        return self.seconds[view_name]

    def write(self, folder: Path) -> None:
        """Write ``folder/render.json``."""
        write_json(folder / TIMES_FILE, asdict(self))

    @staticmethod
    def read(folder: Path) -> RenderTimes:
        """Read ``folder/render.json``.

        Raises:
            RtgsError: it is missing or damaged.
        """
        return read_record(RenderTimes, folder / TIMES_FILE)


@dataclass(frozen=True)
class RenderParams:
    """Which maps are kept besides the image."""

    maps: bool = True
    """Also depth, normal and alpha."""


def render(params: RenderParams, context: StepContext) -> None:
    """Render every test view.

    Writes ``images/<stem>.png`` (8 bit, stems of ``unique_stems``), ``views/<stem>.safetensors`` (float32: image (3,
    H, W) not clamped, depth (H, W) z-depth divided by alpha in world units, normal (3, H, W) world frame where the
    method has one, alpha (H, W); with a third stage also ``image_given_masks``; where a judge kept the plain method
    ``image_full``, the full one's image: maps and layers are the full method's), ``coverage.safetensors`` (by view name
    (H, W) int16: training views that show what the pixel shows) and ``render.json`` (:class:`RenderTimes`).
    """
    import torch
    from safetensors.torch import save_file

    from rtgs.core.names import unique_stems
    from rtgs.evaluate.images import to_bytes, write_png
    from rtgs.methods import Mode, RenderOptions
    from rtgs.scenes.canonical import read_scene

    scene = context.read("import_scene", read_scene)
    method, stage = load_method(last_training(context.inputs), scene)
    mixture = read_mixture(context.inputs, scene)
    options = RenderOptions()
    if params.maps:  # they change no bit of the image
        options = RenderOptions(depth=True, normal="normal" in method.maps, layers=True)
    seconds: dict[str, float] = {}
    (context.out / "views").mkdir()
    surfaces: dict[str, Tensor] = {}
    stems = unique_stems(view.name for view in scene.test)
    for view in scene.test:
        stem = stems[view.name]
        with torch.no_grad():
            start = time.perf_counter()
            rendered = method.render(view.camera, stage.until, Mode.EVALUATE, options, view.mask)
            image = rendered.image if mixture is None else mixture.of(view.camera, rendered.image)
            seconds[view.name] = time.perf_counter() - start
            tensors = {"image": image.contiguous()}
            if mixture is not None:
                tensors[FULL] = rendered.image.contiguous()
            if params.maps:
                tensors |= view_maps(rendered)
                surfaces[view.name] = _first_surface(view, tensors)
            if "transparent" in rendered.maps and view.mask is not None:
                given = RenderOptions(masks="given")
                seen = method.render(view.camera, stage.until, Mode.EVALUATE, given, view.mask).image
                tensors[GIVEN] = (seen if mixture is None else mixture.of(view.camera, seen)).contiguous()
        save_file(tensors, context.out / "views" / f"{stem}.safetensors")
        write_png(context.out / "images" / f"{stem}.png", to_bytes(image))
    if surfaces:
        save_file(_coverage(method, scene, stage.until, surfaces), context.out / COVERAGE)
    RenderTimes(seconds, params.maps).write(context.out)
    if seconds:
        context.log.info("rendered %d test views, %.3f s each", len(seconds), sum(seconds.values()) / len(seconds))


def _coverage(method: Model, scene: Scene, step: int, surfaces: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """By test view: (H, W) int16 training views that show what the pixel shows, where it is ``surfaces`` (z-depth)."""
    from rtgs.evaluate.coverage import at_size, framed_by, judged

    pictures = []
    for view in scene.test:
        camera = judged(view.camera)
        pictures.append((camera, at_size(surfaces[view.name], camera.height, camera.width)))
    cameras = (judged(view.camera) for view in scene.train)
    counts = framed_by(pictures, ((camera, _base_surface(method, camera, step)) for camera in cameras))
    sizes = ((view.camera.height, view.camera.width) for view in scene.test)
    return {view.name: at_size(count, *size) for view, count, size in zip(scene.test, counts, sizes, strict=True)}


def _base_surface(method: Model, camera: Camera, step: int) -> Tensor:
    """(H, W) z-depth of the base set, 0 where it covers less than half of the pixel."""
    import torch

    from rtgs.methods import Mode, RenderOptions
    from rtgs.methods.parts.part import Frame
    from rtgs.train.losses import surface_depth

    wanted = RenderOptions(depth=True)
    with torch.no_grad():
        found = method.base.rasterize(Frame(camera, step, Mode.EVALUATE, wanted), wanted).buffers
    assert found.depth is not None
    return _covered(surface_depth(found.depth, found.alpha), found.alpha)


def _first_surface(view: View, maps: dict[str, Tensor]) -> Tensor:
    """(H, W) z-depth of what a test view shows, the true one where it is known; 0: nothing."""
    return view.truth.depth if view.truth is not None else _covered(maps["depth"], maps["alpha"])


def _covered(depth: Tensor, alpha: Tensor) -> Tensor:
    return depth * (alpha > 0.5)


def read_timed(folder: Path, times: RenderTimes, view_name: str, camera: Camera | None = None) -> TimedRender:
    """One rendered view with the time it took; normals, in the camera's frame, only with its ``camera``.

    Raises:
        RtgsError: the view was not rendered.
    """
    import torch

    from rtgs.evaluate.evaluate import TimedRender
    from rtgs.evaluate.layers import GLASS_LAYERS

    tensors = read_render(folder, view_name)
    layers = (tensors.get("reflection"), tensors.get("transmission"))
    normal = tensors.get("normal")
    if normal is not None:
        normal = None if camera is None else torch.einsum("ij,jhw->ihw", camera.rotation.float(), normal)
    surface, glass = (tensors.get("depth"), normal), {name: tensors.get(name) for name in GLASS_LAYERS}
    seconds, framed = times.of(view_name), read_coverage(folder, view_name)
    return TimedRender(tensors["image"], seconds, *layers, tensors.get(GIVEN), *surface, **glass, framed=framed)


STEP = StepKind("render", 5, render)
