"""Time of what surfels cost outside the rasteriser: activation, Adam, density control, PLY.

``python -m benchmarks.speed.gaussians`` prints a table and, as its last line, a JSON object. Times are milliseconds of
wall time, the lowest of many runs, with one thread unless the name says otherwise; ``ratio_*`` compares with plain
torch in the same run.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

from rtgs.gaussians.activate import activate_gaussians
from rtgs.gaussians.adam import GaussianAdam, find_nonfinite
from rtgs.gaussians.density import DensityControl
from rtgs.gaussians.initialize import surfels_from_points
from rtgs.gaussians.ply import read_ply, write_ply
from rtgs.gaussians.settings import DensitySettings, InitSettings, OptimizerSettings
from rtgs.gaussians.surfels import Surfels, activate
from rtgs.native import core

CENTER = torch.tensor([0.1, 0.2, 0.3])
EXTENT = 5.0  # a fifth of the surfels is split, a few are too large
OUTPUTS = ("tangent_u", "tangent_v", "scales", "opacities", "colors")


def make_surfels(count: int) -> Surfels:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(count, 3, generator=generator)
    surfels = surfels_from_points(points, torch.rand(count, 3, generator=generator), InitSettings(), generator)
    with torch.no_grad():
        surfels.sh_rest += 0.1 * torch.randn(surfels.sh_rest.shape, generator=generator)
    return surfels


def lowest_ms(function: Callable[[], object], repeat: int) -> float:
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return round(1e3 * min(times), 3)


def time_activation(surfels: Surfels, function: Callable, repeat: int) -> tuple[float, float]:
    """(forward, forward and backward) in ms; the backward pass writes fresh gradients, as in a training step."""
    outputs = [getattr(function(surfels, CENTER, 3), name) for name in OUTPUTS]
    upstream = [torch.randn(values.shape) for values in outputs]

    def both() -> None:
        activated = function(surfels, CENTER, 3)
        for _, values in surfels.items():
            values.grad = None
        torch.autograd.backward([getattr(activated, name) for name in OUTPUTS], upstream)

    return lowest_ms(lambda: function(surfels, CENTER, 3), repeat), lowest_ms(both, repeat)


def time_adam(surfels: Surfels, repeat: int) -> dict[str, float]:
    for _, values in surfels.items():
        values.grad = torch.randn(values.shape)
    settings = OptimizerSettings()
    adam = GaussianAdam(surfels, settings, EXTENT)
    first_degree = GaussianAdam(surfels, settings, EXTENT)
    fused = torch.optim.Adam([values for _, values in surfels.items()], lr=1e-4, eps=1e-15, fused=True)
    return {
        "adam": lowest_ms(lambda: adam.step(0), repeat),
        "adam_degree_0": lowest_ms(lambda: first_degree.step(0, sh_degree=0), repeat),
        "adam_torch_fused": lowest_ms(fused.step, repeat),
        "find_nonfinite": lowest_ms(lambda: find_nonfinite((n, v.grad) for n, v in surfels.items()), repeat),
    }


def time_changes(count: int) -> dict[str, float]:
    """Density control and files, a few runs: they happen once in 100 steps, or once."""
    surfels = make_surfels(count)
    signal, weight = 2e-4 * torch.rand(count, 2), torch.rand(count)
    control = DensityControl(DensitySettings(), EXTENT)
    observe = lowest_ms(lambda: control.observe(signal, weight), 20)

    def densify() -> None:
        some = surfels.detached().requires_grad_()
        adam = GaussianAdam(some, OptimizerSettings(), EXTENT)
        fresh = DensityControl(DensitySettings(), EXTENT)
        fresh.observe(signal, weight)
        fresh.densify(some, adam, torch.Generator().manual_seed(0))

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        return {
            "observe": observe,
            "densify": lowest_ms(densify, 3),
            "initialize": lowest_ms(lambda: make_surfels(count), 3),
            "write_ply": lowest_ms(lambda: write_ply(path, surfels), 3),
            "read_ply": lowest_ms(lambda: read_ply(path), 3),
        }


def measure(count: int, repeat: int) -> dict[str, float]:
    surfels = make_surfels(count)
    results: dict[str, float] = {}
    for isa in core.available_isas():
        core.select_isa(isa)
        forward, both = time_activation(surfels, activate_gaussians, repeat)
        results[f"activate_forward_{isa}"], results[f"activate_both_{isa}"] = forward, both
    core.select_isa(core.available_isas()[0])
    torch.set_num_threads(2)
    results["activate_both_2_threads"] = time_activation(surfels, activate_gaussians, repeat)[1]
    torch.set_num_threads(1)
    results["activate_both_torch"] = time_activation(surfels, activate, max(repeat // 10, 3))[1]
    results |= time_adam(surfels, repeat)
    results["ratio_activate"] = round(results[f"activate_both_{core.isa()}"] / results["activate_both_torch"], 3)
    results["ratio_adam"] = round(results["adam"] / results["adam_torch_fused"], 3)
    return results | time_changes(count)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[20_000, 100_000], help="numbers of surfels")
    parser.add_argument("--repeat", type=int, default=100)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, object] = {"isa": core.isa()}
    for count in arguments.counts:
        for name, value in measure(count, arguments.repeat).items():
            print(f"{name:28} {count:8} {value:10.3f}")
            results[f"{name}_{count // 1000}k"] = value
    print(json.dumps(results))


if __name__ == "__main__":
    main()
