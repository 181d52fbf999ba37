"""The trained method seen from the test cameras: images and maps."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.steps.training import last_training, load_method
from pipelines.steps.views import read_render, view_maps
from rtgs.workflow import StepContext, StepKind

if TYPE_CHECKING:
    from rtgs.core.cameras import Camera
    from rtgs.evaluate.evaluate import TimedRender

TIMES_FILE = "render.json"
GIVEN = "image_given_masks"  # of methods with a third stage: seen through the view's own mask, not the silhouette


@dataclass(frozen=True)
class RenderParams:
    """Which maps are kept besides the image."""

    maps: bool = True
    """Also depth, normal and alpha."""


def render(params: RenderParams, context: StepContext) -> None:
    """Render every test view.

    Writes ``images/<stem>.png`` (8 bit), ``views/<stem>.safetensors`` (float32: image (3, H, W) not clamped, depth
    (H, W) z-depth divided by alpha in world units, normal (3, H, W) world frame where the method has one, alpha (H, W);
    with a third stage also ``image_given_masks``) and ``render.json`` (seconds of each image).
    """
    import torch
    from safetensors.torch import save_file

    from rtgs.evaluate.images import file_stem, to_bytes, write_png
    from rtgs.methods import Mode, RenderOptions
    from rtgs.scenes.canonical import read_scene

    scene = read_scene(context.inputs["import_scene"])
    method, stage = load_method(last_training(context.inputs), scene)
    seconds: dict[str, float] = {}
    (context.out / "views").mkdir()
    for view in scene.test:
        stem = file_stem(view.name)
        with torch.no_grad():
            start = time.perf_counter()
            rendered = method.render(view.camera, stage.until, Mode.EVALUATE, RenderOptions(), view.mask)
            seconds[view.name] = time.perf_counter() - start
            image = rendered.image
            tensors = {"image": image.contiguous()}
            if rendered.transparent is not None and view.mask is not None:
                given = RenderOptions(masks="given")
                tensors[GIVEN] = method.render(
                    view.camera, stage.until, Mode.EVALUATE, given, view.mask
                ).image.contiguous()
            if params.maps:
                options = RenderOptions(depth=True, normal="normal" in method.maps, layers=True)
                tensors |= view_maps(method.render(view.camera, stage.until, Mode.EVALUATE, options, view.mask))
        save_file(tensors, context.out / "views" / f"{stem}.safetensors")
        write_png(context.out / "images" / f"{stem}.png", to_bytes(image))
    (context.out / TIMES_FILE).write_text(json.dumps({"seconds": seconds}, indent=1) + "\n", encoding="utf-8")
    if seconds:
        context.log.info("rendered %d test views, %.3f s each", len(seconds), sum(seconds.values()) / len(seconds))


def read_timed(folder: Path, view_name: str, camera: Camera | None = None) -> TimedRender:
    """One rendered view with the time it took; normals, in the camera's frame, only with its ``camera``."""
    import torch

    from rtgs.evaluate.evaluate import TimedRender

    seconds = json.loads((folder / TIMES_FILE).read_text(encoding="utf-8"))["seconds"]
    tensors = read_render(folder, view_name)
    layers = (tensors.get("reflection"), tensors.get("transmission"))
    normal = tensors.get("normal")
    if normal is not None:
        normal = None if camera is None else torch.einsum("ij,jhw->ihw", camera.rotation.float(), normal)
    surface = (tensors.get("depth"), normal)
    return TimedRender(tensors["image"], seconds[view_name], *layers, tensors.get(GIVEN), *surface)


STEP = StepKind("render", 3, render)
