"""The ellipsoid rasteriser beside our own surfel rasteriser.

    python -m benchmarks.speed.raster_ellipsoids [--repeat 15]

The yardstick scenes (400 x 300 pixels, 20,000 and 100,000 Gaussians) with 3 channels; as ellipsoids their third scale
is a tenth of the smaller. Both kernels take turns in every round, on one thread; times are milliseconds of CPU time of
that thread, the median of all rounds. ``ratio_*`` are ellipsoids / surfels of one stage: projection with binning,
forward, backward with the projection's backward. ``speedup_2_threads`` and ``wall_speedup_2_threads`` as in
benchmarks.speed.raster (the larger scene as ellipsoids).

``splat_*``: a trained model (``$RTGS_SHARED/data/splats/playbot_lod2.ply``, default ``../shared``) that fills a view of
800 x 600; ``splat_mgaussians_per_s`` counts all its Gaussians over projection, binning and forward,
``splat_mgaussians_per_s_with_backward`` over backward as well, one thread. ``splat`` is "absent" where the file is not
there, and these figures null. The last line is JSON.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch loads: its waiting threads sleep

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.common.machine import machine, peak_memory_mb
from benchmarks.common.yardstick_scene import HEIGHT, SCALES, WIDTH, made_arrays, shared_arrays
from benchmarks.speed.raster import Ours, Stage, interleaved_ms, scene_inputs, thread_figures, yardstick_view
from rtgs.gaussians.ply import read_gaussians
from rtgs.gaussians.surfels import activate
from rtgs.native import core
from rtgs.render.buffers import EllipsoidOptions, RasterOptions

CHANNELS = 3
SPLAT = Path("data") / "splats" / "playbot_lod2.ply"
SPLAT_SIZE = (800, 600)
View = tuple[np.ndarray, np.ndarray, float, float, float, float, int, int]


@dataclass
class Scene:
    inputs: list[np.ndarray]  # means, tangent_u, tangent_v, scales, opacities, features
    view: View


class OursAsEllipsoids:
    """One scene through the native core, stage by stage, with the arrays that rasterize_ellipsoids would allocate."""

    def __init__(self, scene: Scene, threads: int = 1) -> None:
        self.inputs, self.threads = scene.inputs, threads
        options = EllipsoidOptions()
        self.arguments = (
            core.RasterCamera(*scene.view, options.near, math.inf),
            options.dilation,
            options.radius_sigmas,
            options.antialiased,
            options.depth,
        )
        self.native: core.EllipsoidRasterization | None = None
        rng = np.random.default_rng(1)
        width, height = scene.view[6:]
        self.image = np.empty((CHANNELS, height, width), np.float32)
        self.alpha = np.empty((height, width), np.float32)
        self.upstream = [rng.normal(size=p.shape).astype(np.float32) for p in (self.image, self.alpha)]
        self.gradients = [np.empty_like(array) for array in self.inputs]
        self.gradients.append(np.empty((len(self.inputs[0]), 2), np.float32))

    def project(self) -> None:
        self.native = None  # its memory goes back to the pool first, as between two training steps
        native = self.native = core.EllipsoidRasterization(*self.arguments)
        native.project(*self.inputs, self.threads)

    def forward(self) -> None:
        assert self.native is not None
        self.native.forward(None, self.image, self.alpha, None, None)

    def backward(self) -> None:
        assert self.native is not None
        self.native.backward(*self.inputs, self.image, None, *self.upstream, None, *self.gradients)

    def stages(self) -> dict[str, Stage]:
        return {"project": self.project, "forward": self.forward, "backward": self.backward}


def yardstick_arrays(count: int) -> dict[str, np.ndarray]:
    return shared_arrays(count) or made_arrays(count, SCALES[count])


def as_ellipsoids(arrays: dict[str, np.ndarray]) -> Scene:
    """The yardstick's surfels with a third scale, a tenth of the smaller."""
    inputs = scene_inputs(arrays, CHANNELS)
    inputs[3] = np.concatenate((inputs[3], 0.1 * inputs[3].min(1, keepdims=True)), 1)
    return Scene(inputs, yardstick_view())


def case_figures(count: int, repeat: int) -> dict[str, object]:
    arrays = yardstick_arrays(count)
    runs = {
        "ellipsoids": OursAsEllipsoids(as_ellipsoids(arrays)).stages(),
        "surfels": Ours(arrays, RasterOptions(), channels=CHANNELS).stages(),
    }
    times = interleaved_ms(runs, repeat)
    label = f"{count // 1000}k"
    figures: dict[str, object] = {f"ms_{label}": times}
    for stage, ms in times["ellipsoids"].items():
        figures[f"ratio_{stage}_{label}"] = round(ms / times["surfels"][stage], 3)
    return figures


def splat_scene() -> Scene | None:
    """The trained model before a camera that looks along z at its middle; None where the file is not there."""
    path = Path(os.environ.get("RTGS_SHARED", "../shared")) / SPLAT
    if not path.is_file():
        return None
    model = read_gaussians(path)
    width, height = SPLAT_SIZE
    low, high = torch.quantile(model.means, torch.tensor([0.02, 0.98]), dim=0)
    translation = np.array([0.0, 0.0, 1.6 * float((high - low).max())]) - ((low + high) / 2).double().numpy()
    view = (np.eye(3), translation, 0.9 * width, 0.9 * width, width / 2, height / 2, width, height)
    active = activate(model, torch.from_numpy(-translation), model.sh_degree)
    tensors = (active.means, active.tangent_u, active.tangent_v, active.scales, active.opacities, active.colors)
    return Scene([np.ascontiguousarray(t.detach().float().numpy()) for t in tensors], view)


def splat_figures(repeat: int) -> dict[str, object]:
    scene = splat_scene()
    keys = ("splat_ms", "splat_visible", "splat_mgaussians_per_s", "splat_mgaussians_per_s_with_backward")
    if scene is None:
        absent: dict[str, object] = {"splat": "absent"}
        return absent | dict.fromkeys(keys)
    ours = OursAsEllipsoids(scene)
    ms = interleaved_ms({"splat": ours.stages()}, repeat)["splat"]
    assert ours.native is not None
    count = len(scene.inputs[0])
    picture = ms["project"] + ms["forward"]
    values = (
        ms,
        ours.native.visible,
        round(count / picture * 1e-3, 2),
        round(count / (picture + ms["backward"]) * 1e-3, 2),
    )
    figures: dict[str, object] = {"splat": f"{SPLAT.name}, {count} Gaussians"}
    return figures | dict(zip(keys, values, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    parser.add_argument("--repeat", type=int, default=15)
    parser.add_argument("--counts", type=int, nargs="+", default=[20_000, 100_000])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    figures: dict[str, object] = {"machine": machine(), "image": [WIDTH, HEIGHT], "channels": CHANNELS}
    for count in arguments.counts:
        figures |= case_figures(count, arguments.repeat)
    scene = as_ellipsoids(yardstick_arrays(max(arguments.counts)))
    figures |= thread_figures(lambda threads: OursAsEllipsoids(scene, threads), arguments.repeat)
    figures |= splat_figures(arguments.repeat)
    figures["peak_memory_mb"] = round(peak_memory_mb())
    for name, value in figures.items():
        print(name, value)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
