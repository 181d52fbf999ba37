"""Losses: native forward + backward beside the plain-torch twins in float32, one thread.

``python -m benchmarks.speed.losses``: CPU milliseconds of the calling thread, which other work on the machine disturbs
least, the fastest of many calls. The last line is a JSON object: ``{loss}_{size}_ms``, ``{loss}_{size}_torch_ms``,
``{loss}_{size}_ratio`` (torch / native) and the instruction set. The perceptual loss, with random weights of VGG-16's
shapes: ``perceptual_crop_ms`` (the random crop that training looks at) and ``perceptual_{size}_ms`` (the whole image).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import ModuleType

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.native import core
from rtgs.pretrained.lpips import Lpips
from rtgs.pretrained.vgg import BLOCKS, VGG16_WIDTHS, Vgg16Features
from rtgs.train import losses, reference_losses
from rtgs.train.perceptual import PerceptualLoss
from rtgs.train.settings import LossSettings

SIZES = ((400, 300), (800, 600))  # width, height
PERCEPTUAL_SIZE = (256, 192)
NATIVE_CALLS, TORCH_CALLS, PERCEPTUAL_CALLS = 60, 10, 4


@dataclass(frozen=True)
class Case:
    """One rendered view beside its target."""

    camera: Camera
    image: Tensor
    target: Tensor
    normal: Tensor
    depth: Tensor
    alpha: Tensor
    mono_normal: Tensor


def make_case(width: int, height: int) -> Case:
    generator = torch.Generator().manual_seed(0)
    draw = partial(torch.rand, generator=generator)
    camera = Camera(torch.eye(3), torch.zeros(3), width, width, width / 2, height / 2, width, height)
    image, alpha = draw(3, height, width), draw(height, width)
    noise = 0.1 * torch.randn(3, height, width, generator=generator)
    unit = torch.nn.functional.normalize(draw(3, height, width) - 0.5, dim=0)
    leaves = (image, unit * alpha, (2 + draw(height, width)) * alpha, alpha)
    image, normal, depth, alpha = (leaf.requires_grad_() for leaf in leaves)
    return Case(camera, image, (image.detach() + noise).clamp(0, 1), normal, depth, alpha, unit)


def steps(module: ModuleType, case: Case) -> dict[str, Callable[[], Tensor]]:
    """The losses of a module by name, each a call that returns the scalar to go back from."""
    normal_loss = partial(module.normal_consistency_loss, case.normal, case.depth, case.alpha, case.camera)
    return {
        "photometric": lambda: module.photometric_loss(case.image, case.target, 0.8, 0.2).total,
        "normal": normal_loss,
        "normal_depth_weighted": partial(normal_loss, inverse_depth_weight=True),
        "mono_normal": partial(module.mono_normal_loss, case.normal, case.mono_normal, case.camera),
    }


def fastest_ms(step: Callable[[], Tensor], case: Case, calls: int) -> float:
    """Least CPU time of one forward and backward."""
    best = float("inf")
    for _ in range(calls):
        for leaf in (case.image, case.normal, case.depth, case.alpha):
            leaf.grad = None
        start = time.thread_time()
        step().backward()
        best = min(best, time.thread_time() - start)
    return 1e3 * best


def random_vgg(widths: tuple[int, ...]) -> Lpips:
    """The perceptual network with random weights: what it costs does not depend on them."""
    generator, tensors, channels = torch.Generator().manual_seed(0), {}, 3
    for width, block in zip(widths, BLOCKS, strict=True):
        for position in block:
            deviation = (2 / (9 * channels)) ** 0.5  # activations keep their size
            shape = (width, channels, 3, 3)
            tensors[f"features.{position}.weight"] = deviation * torch.randn(shape, generator=generator)
            tensors[f"features.{position}.bias"] = torch.zeros(width)
            channels = width
    heads = {f"lin{k}.model.1.weight": torch.rand(1, width, 1, 1) for k, width in enumerate(widths)}
    return Lpips(Vgg16Features(tensors), heads)


def perceptual_figures(size: tuple[int, int], widths: tuple[int, ...] = VGG16_WIDTHS) -> dict[str, float]:
    """CPU milliseconds of the perceptual loss, on a crop and on the whole image."""
    network, case = random_vgg(widths), make_case(*size)
    found = {}
    for name, crop in (("crop", LossSettings().perceptual_crop), ("x".join(map(str, size)), max(size))):
        loss, generator = PerceptualLoss(LossSettings(perceptual_crop=crop), network), torch.Generator().manual_seed(0)
        step = partial(loss, case.image, case.target, generator)
        found[f"perceptual_{name}_ms"] = fastest_ms(step, case, PERCEPTUAL_CALLS)
    return found


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    torch.set_num_threads(1)
    results: dict[str, float | str] = {"isa": core.isa()}
    for width, height in SIZES:
        case = make_case(width, height)
        native, twins = steps(losses, case), steps(reference_losses, case)
        for name in native:
            ours = fastest_ms(native[name], case, NATIVE_CALLS)
            theirs = fastest_ms(twins[name], case, TORCH_CALLS)
            key = f"{name}_{width}x{height}"
            results |= {f"{key}_ms": ours, f"{key}_torch_ms": theirs, f"{key}_ratio": theirs / ours}
            print(f"{key:32s} native {ours:8.2f} ms   torch {theirs:8.2f} ms   {theirs / ours:6.1f}x")
    perceptual = perceptual_figures(PERCEPTUAL_SIZE)
    for key, value in perceptual.items():
        print(f"{key:32s} {value:8.1f} ms")
    results |= perceptual
    print(json.dumps({key: round(value, 3) if isinstance(value, float) else value for key, value in results.items()}))


if __name__ == "__main__":
    main()
