"""The tracer's levers end to end: PSNR of method ``rtgs`` after equal time, for ``lab.levers``.

Each setting is trained for as many steps as the reference (equal steps), and for as many as fit into its CPU seconds
(equal time, predicted from the first run, and once more where that was off; the seconds it took are reported). Preset
``quick``, its schedule shrunk along; a matte verdict is switched off, because it would end what is to be measured. One
run per point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log
from typing import TYPE_CHECKING

from torch.nn.functional import avg_pool2d, normalize

from benchmarks.common.training_runs import schedule_overrides, train_run

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene, View

PRESET = "quick"
TRACED = "method.reflection.traced"
# The presets share rays and cut more: the levers are measured against what was published.
PUBLISHED = (
    f"{TRACED}.shared_below=0",
    "method.reflection.alpha_cutoff=0.00392157",
    "method.reflection.transmittance_cutoff=1e-4",
)
SETTINGS: dict[str, tuple[str, ...]] = {  # the first is the reference: every pixel traced, published cuts
    "all traced": (f"{TRACED}.threshold=0",),
    "threshold 0.01, 1/4 of the rest": (f"{TRACED}.threshold=0.01", f"{TRACED}.share=0.25"),
    "threshold 0.03, 1/4 of the rest": (f"{TRACED}.threshold=0.03", f"{TRACED}.share=0.25"),
    "threshold 0.03, 1/10 of the rest": (f"{TRACED}.threshold=0.03", f"{TRACED}.share=0.1"),
    "rebuilt every 10 steps": (f"{TRACED}.threshold=0", "method.reflection.rebuild_every=10"),
    "rebuilt every 1000 steps": (f"{TRACED}.threshold=0", "method.reflection.rebuild_every=1000"),
    "transmittance cutoff 1e-2": (f"{TRACED}.threshold=0", "method.reflection.transmittance_cutoff=0.01"),
    "alpha cutoff 1/64": (f"{TRACED}.threshold=0", "method.reflection.alpha_cutoff=0.015625"),
    "half the resolution": (f"{TRACED}.threshold=0",),  # of the training views, for rasteriser and tracer alike
}
HALVED = "half the resolution"
CLOSE_ENOUGH = 0.1  # of the reference's seconds
NOT_MATTE = "method.reflection.matte.probation=0"


@dataclass(frozen=True)
class EndToEndPoint:
    """One run."""

    setting: str
    equal: str  # to the reference: "steps" or "time"
    steps: int
    cpu_seconds: float
    psnr: float | None
    psnr_specular: float | None  # on specular objects, where truth is known


def end_to_end_points(
    scene: Sequence[str], steps: int, long_side: int | None, settings: Sequence[str] = tuple(SETTINGS)
) -> list[EndToEndPoint]:
    """Train every setting. ``scene``: config words that name it; ``settings``: of SETTINGS, the reference first."""
    points: list[EndToEndPoint] = []
    for name in settings:
        point = _train(scene, name, "steps", steps, long_side)
        points.append(point)
        print(point, flush=True)
        if name != settings[0]:
            points.append(_train_as_long(scene, point, points[0].cpu_seconds, long_side))
            print(points[-1], flush=True)
    return points


def _train_as_long(scene: Sequence[str], known: EndToEndPoint, seconds: float, long_side: int | None) -> EndToEndPoint:
    """The setting of ``known``, trained for about ``seconds``: later steps are dearer, the first guess may be off."""
    steps = max(2, round(known.steps * seconds / known.cpu_seconds))
    found = _train(scene, known.setting, "time", steps, long_side)
    if steps == known.steps or abs(found.cpu_seconds / seconds - 1) < CLOSE_ENOUGH:
        return found
    return _train(scene, known.setting, "time", afforded_steps(known, found, seconds), long_side)


def afforded_steps(first: EndToEndPoint, second: EndToEndPoint, seconds: float) -> int:
    """Steps that take ``seconds`` if the time is a power of the number of steps, as two runs tell it."""
    growth = log(second.cpu_seconds / first.cpu_seconds) / log(second.steps / first.steps)
    growth = max(growth, 0.5)  # of two runs that a busy machine has disturbed
    return max(2, round(first.steps * (seconds / first.cpu_seconds) ** (1 / growth)))


def _train(scene: Sequence[str], name: str, equal: str, steps: int, long_side: int | None) -> EndToEndPoint:
    words = [*scene, "method=rtgs", f"preset={PRESET}", *schedule_overrides(steps, PRESET), NOT_MATTE]
    words += [*PUBLISHED, *SETTINGS[name]]
    run = train_run(words, long_side, half_resolution if name == HALVED else None)
    quality = run.quality()
    psnr, specular = (
        None if value is None else round(value, 3) for value in (quality["psnr"], quality["psnr_specular"])
    )
    return EndToEndPoint(name, equal, steps, round(run.cpu_seconds, 2), psnr, specular)


def half_resolution(scene: Scene) -> Scene:
    """The scene with training views of half the width and height; test views stay as they are."""
    return replace(scene, train=tuple(_halved(view) for view in scene.train))


def _halved(view: View) -> View:
    height, width = (size // 2 * 2 for size in view.image.shape[1:])
    normal = view.normal if view.normal is None else normalize(avg_pool2d(view.normal[:, :height, :width], 2), dim=0)
    camera = replace(view.camera, width=width, height=height).resized(width // 2, height // 2)
    mask = view.mask if view.mask is None else view.mask[:height:2, :width:2]
    return replace(view, camera=camera, image=avg_pool2d(view.image[:, :height, :width], 2), mask=mask, normal=normal)
