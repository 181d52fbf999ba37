"""The trained method seen from the test cameras: images and maps."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.errors import RtgsError
from rtgs.core.recipe import UNLESS_DEFAULT
from rtgs.core.records import read_record, write_json
from rtgs.runs.framing import covered, framing_counts
from rtgs.runs.mixture import Mixture, read_mixture
from rtgs.runs.training import last_training, load_method
from rtgs.runs.views import COVERAGE, read_coverage, read_render, view_maps
from rtgs.workflow import StepContext, StepKind

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.evaluate.evaluate import TimedRender
    from rtgs.methods import RenderOptions
    from rtgs.methods.model import Model
    from rtgs.runs.mixture import Mixture
    from rtgs.scenes.scene import Scene, View

TIMES_FILE = "render.json"
GIVEN = "image_given_masks"  # of methods with a third stage: seen through the view's own mask, not the silhouette

REFINED = "image_refined_pose"  # from the pose that was fitted to the view's photo
PREVIEW = "preview.webp"
PREVIEW_SIDE = 256  # pixels
WARM_UP = "warm-up"  # name of the camera of a picture that is rendered before any time is taken
_WARM = 16  # its pixels a side
PREVIEW_RATE = 8  # frames a second
PREVIEW_BYTES = 400_000
ENVIRONMENT = "environment"  # folder of pictures of the far light, of methods that have one
_ENVIRONMENT_SIDE = 128  # of its cubemap; the panorama is 512 x 256
FULL = "image_full"  # where the picture is not of the run's model alone: that model's


@dataclass(frozen=True)
class RenderTimes:
    """``render.json``: how long the test views took.

    Attributes:
        seconds: by the wall, by view name; None: another program rendered the view, and nobody took its time.
        with_maps: the time is that of the image together with its maps; False: of the image alone.
    """

    seconds: dict[str, float | None]
    with_maps: bool = False  # artifacts of older versions do not say

    def of(self, view_name: str) -> float | None:
        """Seconds of one view; None: not known.

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
    supersample: int = field(default=1, metadata=UNLESS_DEFAULT)
    """Images, not maps, are rendered so many times finer and averaged."""
    refine_steps: int = field(default=0, metadata=UNLESS_DEFAULT)
    """Steps in which each view's pose is fitted to its photo for one image more; 0: there is none."""
    refine_all: bool = field(default=False, metadata=UNLESS_DEFAULT)
    """Fitted where the training learned no poses as well."""
    preview: int = 24
    """Frames of the looping preview; 0: none."""


def render(params: RenderParams, context: StepContext) -> None:
    """Render every test view.

    Writes ``images/<stem>.png`` (8 bit, stems of ``unique_stems``), ``views/<stem>.safetensors`` (float32: image (3,
    H, W), not clamped unless it is a mean, depth (H, W) z-depth divided by alpha in world units, normal (3, H, W) world
    frame where the method has one, alpha (H, W); with a third stage also ``image_given_masks``; of an ensemble, and
    where a judge kept the plain method, ``image_full``, which is of the run's model alone, as all maps and layers are;
    with ``refine_steps``, where poses were learned or ``refine_all`` is on, also ``image_refined_pose``),
    ``coverage.safetensors`` (by view name (H, W) int16: training views that show what the pixel shows),
    ``preview.webp`` (a way round the scene that plays for ever, small) and ``render.json`` (:class:`RenderTimes`).
    ``params.supersample`` is of the other images. Of methods with a far light also ``environment/``
    (:func:`rtgs.light.pictures.save_environment`; up is that of the cameras).
    """
    import torch
    from safetensors.torch import save_file

    from rtgs.core.names import unique_stems
    from rtgs.evaluate.images import to_bytes, write_png
    from rtgs.light.pictures import mean_frame, save_environment
    from rtgs.methods import Mode, RenderOptions
    from rtgs.methods.parts.poses import Poses
    from rtgs.scenes.canonical import read_scene

    scene = context.read("import_scene", read_scene)
    method, stage = load_method(last_training(context.inputs), scene)
    mixture = read_mixture(context.inputs, scene)
    options = RenderOptions()
    if params.maps:  # they change no bit of the image
        options = RenderOptions(depth=True, normal="normal" in method.maps, layers=True)
    finer = _Finer(method, mixture, stage.until, params.supersample)
    seconds: dict[str, float] = {}
    (context.out / "views").mkdir()
    surfaces: dict[str, Tensor] = {}
    stems = unique_stems(view.name for view in scene.test)
    for view in scene.test[:1]:  # what is loaded and made once is no view's time
        with torch.no_grad():
            small = replace(view.camera.resized(_WARM, _WARM), name=WARM_UP)
            first = method.render(small, stage.until, Mode.EVALUATE, options, None).image
            if mixture is not None:
                mixture.of(small, first)
    for view in scene.test:
        stem = stems[view.name]
        with torch.no_grad():
            start = time.perf_counter()
            rendered = method.render(view.camera, stage.until, Mode.EVALUATE, options, view.mask)
            full = rendered.image
            if params.supersample > 1:  # the picture that counts; ``rendered`` is for its maps alone
                start = time.perf_counter()
                full = finer.full(view, RenderOptions())
            image = full
            if mixture is not None:
                image = finer.mixed(view, full, RenderOptions())
            seconds[view.name] = time.perf_counter() - start
            tensors = {"image": image.contiguous()}
            if mixture is not None:
                tensors[FULL] = full.contiguous()
            if params.maps:
                tensors |= view_maps(rendered)
                surfaces[view.name] = _first_surface(view, tensors)
            if "transparent" in rendered.maps and view.mask is not None:
                given = RenderOptions(masks="given")
                seen = finer.full(view, given)
                tensors[GIVEN] = (seen if mixture is None else finer.mixed(view, seen, given)).contiguous()
        if params.refine_steps and (params.refine_all or Poses.name in method.parts):
            tensors[REFINED] = _from_refined_pose(finer, view, params.refine_steps)
        save_file(tensors, context.out / "views" / f"{stem}.safetensors")
        write_png(context.out / "images" / f"{stem}.png", to_bytes(image))
    if surfaces:
        photos = (*scene.train, *scene.held) if stage.joined else scene.train
        save_file(framing_counts(method, stage.until, scene.test, surfaces, photos), context.out / COVERAGE)
    if params.preview:
        _write_preview(method, scene, stage.until, mixture, params.preview, context.out / PREVIEW)
    if method.light is not None:
        frame = mean_frame(torch.stack([view.camera.rotation for view in scene.train]))
        save_environment(context.out / ENVIRONMENT, method.light, frame, _ENVIRONMENT_SIDE)
    RenderTimes({**seconds}, params.maps and params.supersample == 1).write(context.out)
    if seconds:
        context.log.info("rendered %d test views, %.3f s each", len(seconds), sum(seconds.values()) / len(seconds))


@dataclass(frozen=True)
class _Finer:
    """The images of a method without maps, ``times`` finer and averaged."""

    method: Model
    mixture: Mixture | None
    step: int
    times: int

    def full(self, view: View, options: RenderOptions) -> Tensor:
        """(3, H, W) of the method alone."""
        from rtgs.evaluate.supersample import supersampled

        return supersampled(lambda camera, mask: self._image(camera, mask, options), view.camera, view.mask, self.times)

    def mixed(self, view: View, full: Tensor, options: RenderOptions) -> Tensor:
        """(3, H, W) what counts of a view, of an image ``full`` of the method alone."""
        from rtgs.evaluate.supersample import supersampled

        mixture = self.mixture
        assert mixture is not None
        if self.times == 1:
            return mixture.of(view.camera, full, view.mask, options)

        def render(camera: Camera, mask: Tensor | None) -> Tensor:
            return mixture.of(camera, self._image(camera, mask, options), mask, options)

        return supersampled(render, view.camera, view.mask, self.times)

    def _image(self, camera: Camera, mask: Tensor | None, options: RenderOptions) -> Tensor:
        from rtgs.methods import Mode

        return self.method.render(camera, self.step, Mode.EVALUATE, options, mask).image


def _from_refined_pose(finer: _Finer, view: View, steps: int) -> Tensor:
    """(3, H, W) the view from the pose that is best fitted to its photo, made as its image from the given pose is."""
    import torch

    from rtgs.methods import RenderOptions
    from rtgs.methods.refine_pose import refine_pose

    refined = replace(view, camera=refine_pose(finer.method, view, finer.step, steps=steps))
    with torch.no_grad():
        full = finer.full(refined, RenderOptions())
        return (full if finer.mixture is None else finer.mixed(refined, full, RenderOptions())).contiguous()


def _write_preview(method: Model, scene: Scene, step: int, mixture: Mixture | None, count: int, path: Path) -> None:
    """``count`` frames on a path that suits the capture; nothing where its photos are from one place."""
    import torch

    from rtgs.evaluate.images import to_bytes
    from rtgs.methods import Mode
    from rtgs.render.paths import picture_of, suited_path
    from rtgs.report.films import write_preview

    cameras = [view.camera for view in (*scene.train, *scene.test)]
    frames = []
    for camera in suited_path(cameras, picture_of(cameras, PREVIEW_SIDE), count):
        with torch.no_grad():
            image = method.render(camera, step, Mode.EVALUATE).image
            frames.append(to_bytes(image if mixture is None else mixture.of(camera, image)))
    if frames:
        write_preview(path, frames, PREVIEW_RATE, PREVIEW_BYTES)


def _first_surface(view: View, maps: dict[str, Tensor]) -> Tensor:
    """(H, W) z-depth of what a test view shows, the true one where it is known; 0: nothing."""
    return view.truth.depth if view.truth is not None else covered(maps["depth"], maps["alpha"])


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
    return TimedRender(
        tensors["image"],
        seconds,
        *layers,
        tensors.get(GIVEN),
        *surface,
        **glass,
        framed=framed,
        refined=tensors.get(REFINED),
    )


STEP = StepKind("render", 11, render)
