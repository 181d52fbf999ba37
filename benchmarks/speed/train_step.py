"""What a training step costs beside its rasteriser call: ``python -m benchmarks.speed.train_step``.

400 x 300 pixels, 20,000 surfels, SH degree 3, normal loss on, one thread. One step is what the trainer does:
activation, rasterisation, L1 + D-SSIM, normal consistency, backward pass, density statistics, Adam. Each part is also
timed alone on the step's own tensors, in the same rounds. Times are milliseconds of CPU time of this process (one
thread, so that a busy machine counts little), the lowest of all rounds. ``step_over_raster`` is the whole step over
the very rasteriser call the step makes: project, bin, forward, backward, with the step's optional outputs. Last line: a
JSON object.
"""

from __future__ import annotations

import argparse
import json
import platform
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.common.yardstick_scene import yardstick_case
from rtgs.core.cameras import Camera
from rtgs.core.work_time import work_time
from rtgs.gaussians.settings import OptimizerSettings
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.methods import create_method
from rtgs.methods.parts.gaussian_set import GaussianSet
from rtgs.methods.parts.kinds import surfel_options
from rtgs.methods.settings import MethodSettings
from rtgs.native import core
from rtgs.render.buffers import RasterBuffers
from rtgs.render.surfels import rasterize_surfels
from rtgs.scenes.scene import Scene, View
from rtgs.train.guard import check_loss
from rtgs.train.losses import normal_consistency_loss, photometric_loss
from rtgs.train.method import LossValues, Mode, RenderedView
from rtgs.train.settings import LossSettings, ScheduleSettings

STEP = 10  # any step at which all SH degrees are active


class StepBench:
    """A method on the yardstick scene, and each part of its step as a function without arguments."""

    def __init__(self, count: int) -> None:
        surfels, camera = yardstick_case(count)
        generator = torch.Generator().manual_seed(0)
        blank = View(camera, torch.rand(3, camera.height, camera.width, generator=generator), None, None, "yardstick")
        scene = Scene("yardstick", (blank,), (), surfels.means[:100], torch.rand(100, 3, generator=generator), 8.0, "")
        still = OptimizerSettings(1e-12, 1e-12, 1e-9, 1e-9, 1e-9, 1e-9, 1e-9)  # full work, but nothing moves
        settings = MethodSettings(optimizer=still, loss=LossSettings(normal=0.05, normal_start=0))
        schedule = ScheduleSettings(sh_every=1, densify_until=0)
        self.method = create_method(settings, scene, schedule, generator)
        self.method.base.set = GaussianSet(
            "base", surfels, optimizer=still, density=settings.density, means_lr_steps=100, extent=scene.extent
        )
        with torch.no_grad():  # a target near the picture, as late in training
            picture = self.method.render(camera, STEP, Mode.TRAIN).image
            target = (picture + 0.05 * torch.randn(picture.shape, generator=generator)).clamp(0, 1)
        self.view = replace(blank, image=target)
        self.camera: Camera = camera

    def forward(self) -> tuple[RenderedView, LossValues]:
        rendered = self.method.render(self.camera, STEP, Mode.TRAIN)
        return rendered, self.method.losses(rendered, self.view, STEP)

    def whole(self) -> None:
        """One step as in ``Trainer._train_step``."""
        rendered, terms = self.forward()
        check_loss(terms, self.method, STEP, self.view.name)
        terms.total.backward()
        self.method.after_step(STEP, rendered.observations)

    def parts(self) -> dict[str, Callable[[], object]]:
        """The parts of the step on the tensors and with the upstream gradients of a real one."""
        rendered, terms = self.forward()
        buffers, base = rendered.buffers, self.method["base"]
        outputs = _with_gradient(buffers)
        upstream = torch.autograd.grad(terms.total, outputs, allow_unused=True)
        activated = base.activated(self.camera.center.float(), 3)
        inputs = [activated.means, *_shaded(activated)]
        shaded_upstream = [torch.randn(t.shape) for t in inputs[1:]]
        leaves = [tensor.detach().clone().requires_grad_() for tensor in inputs]
        means, tangent_u, tangent_v, scales, opacities, colors = leaves
        options = surfel_options(
            self.method.loss.needs(STEP), self.method.settings.render, self.method.extent, weight_sum=True
        )
        background = torch.zeros(3)
        weights = self.method.settings.loss
        image = buffers.features.detach().requires_grad_()
        normal, depth, alpha = (
            tensor.detach().requires_grad_()
            for tensor in (buffers.normal, buffers.depth, buffers.alpha)
            if tensor is not None
        )
        gradients = {name: torch.randn(tensor.shape) for name, tensor in base.gaussians.items()}
        signal, weight_sum = torch.rand(len(base), 2), torch.rand(len(base))

        def activate() -> None:
            torch.autograd.backward(_shaded(base.activated(self.camera.center.float(), 3)), shaded_upstream)
            base.optimizer.zero_grad()

        def raster() -> None:
            probe = base.new_probe()
            found = rasterize_surfels(
                means,
                tangent_u,
                tangent_v,
                scales,
                opacities,
                colors,
                self.camera,
                background=background,
                options=options,
                screen_probe=probe,
            )
            pairs = [(o, g) for o, g in zip(_with_gradient(found), upstream, strict=True) if g is not None]
            torch.autograd.backward([o for o, _ in pairs], [g for _, g in pairs])
            for leaf in leaves:
                leaf.grad = None

        def photometric() -> None:
            photometric_loss(image, self.view.image, weights.l1, weights.dssim).total.backward()
            image.grad = None

        def normals() -> None:
            normal_consistency_loss(normal, depth, alpha, self.camera).backward()
            normal.grad = depth.grad = alpha.grad = None

        def adam() -> None:
            for name, tensor in base.gaussians.items():
                tensor.grad = gradients[name]
            base.optimizer.step(STEP, 3)
            base.optimizer.zero_grad()

        def density() -> None:
            base.density.observe(signal, weight_sum)

        return {
            "activate": activate,
            "raster": raster,
            "photometric": photometric,
            "normal": normals,
            "adam": adam,
            "density": density,
        }


def _with_gradient(buffers: RasterBuffers) -> list[Tensor]:
    found = (buffers.features, buffers.alpha, buffers.depth, buffers.normal)
    return [tensor for tensor in found if tensor is not None]


def _shaded(activated: ActivatedGaussians) -> list[Tensor]:
    return [activated.tangent_u, activated.tangent_v, activated.scales, activated.opacities, activated.colors]


def lowest_ms(functions: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Lowest CPU time of each function, in ms; the functions take turns."""
    lowest = dict.fromkeys(functions, float("inf"))
    for _ in range(rounds):
        for name, function in functions.items():
            start = work_time()
            function()
            lowest[name] = min(lowest[name], 1e3 * (work_time() - start))
    return lowest


def measure(count: int, rounds: int) -> dict[str, object]:
    """All figures of the benchmark."""
    bench = StepBench(count)
    parts = bench.parts()
    bench.whole()
    times = lowest_ms({"step": bench.whole, **parts}, rounds)
    step = times["step"]
    shares = {name: round(times[name] / step, 3) for name in parts}
    shares["rest"] = round(1 - sum(times[name] for name in parts) / step, 3)
    return {
        "step_over_raster": round(step / times["raster"], 3),
        "step_ms": round(step, 2),
        **{f"{name}_ms": round(times[name], 2) for name in parts},
        **{f"share_{name}": share for name, share in shares.items()},
        "surfels": count,
        "threads": torch.get_num_threads(),
        "isa": core.isa(),
        "machine": platform.processor() or platform.machine(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--surfels", type=int, default=20_000, choices=(20_000, 100_000))
    parser.add_argument("--rounds", type=int, default=40)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    figures = measure(arguments.surfels, arguments.rounds)
    for name, value in figures.items():
        print(f"{name:20} {value}")
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
