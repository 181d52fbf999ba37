"""Far light, native beside its plain-torch twins in float32, forward and backward, one thread.

``python -m benchmarks.speed.light``: CPU milliseconds of the calling thread, the fastest of many calls, for 256 x 192
pixels and the pyramid 64/32/16/16 of the short presets. Twins of the prefilter multiply dense matrices of the same
weights. ``features`` is the light of Ref-GS: a map of 64 rows with a network of 32. The last line is a JSON object:
``{part}_ms``, ``{part}_torch_ms``, ``{part}_ratio`` (torch / native) and the instruction set; ``step`` is the sum of a
step with a prefilter (lookup with mips, prefilter, irradiance with its lookup), ``made_seconds`` what making the
weights takes, once per process.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rtgs.light.faces import texel_areas, texel_directions
from rtgs.light.feature_map import box_pyramid
from rtgs.light.feature_network import DIRECTION, SURFACE, first_weights, mirrored_light, mirrored_light_twin
from rtgs.light.lookup import cube_lookup, cube_lookup_twin, texel_count
from rtgs.light.prefilter import filter_of, filtered, level_roughness, lobe, shrunk
from rtgs.native import core

SIZE = (256, 192)
SIDES = (64, 32, 16, 16)
DIFFUSE = 16
ONE_LEVEL = 128  # 3DGS-DR
NATIVE_CALLS, TORCH_CALLS = 40, 5
FEATURES, WIDTH = 64, 32  # rows of the map of Ref-GS, width of its network
STEP = ("lookup", "prefilter", "diffuse_lookup", "diffuse_prefilter")


@dataclass(frozen=True)
class Part:
    """A part of a step: leaves, and what is computed of them natively and in plain torch."""

    leaves: tuple[Tensor, ...]
    native: Callable[[], Tensor]
    twin: Callable[[], Tensor]


def dense_weights(side: int, roughness: float | None) -> Tensor:
    """(T, T) float32 weights of one level."""
    directions = texel_directions(side)
    weights = lobe(np.clip(directions @ directions.T, -1, 1), roughness) * texel_areas(side)
    np.fill_diagonal(weights, np.maximum(np.diagonal(weights), 1e-9))
    return torch.from_numpy((weights / weights.sum(1, keepdims=True)).astype(np.float32))


def parts(size: tuple[int, int], sides: tuple[int, ...], one_level: int) -> dict[str, Part]:
    """The parts by name. Dense weights of the first level would be too large: its twin leaves it as it is."""
    width, height = size
    generator = torch.Generator().manual_seed(0)
    across, down = torch.meshgrid(torch.linspace(-1, 1, width), torch.linspace(-1, 1, height), indexing="xy")
    directions = torch.stack((across, down, torch.full_like(across, 0.8)), -1).reshape(-1, 3)
    directions = (directions + 0.05 * torch.randn(directions.shape, generator=generator)).requires_grad_()
    level = ((len(sides) - 1) * torch.rand(len(directions), generator=generator)).requires_grad_()

    def drawn(count: int) -> Tensor:
        return torch.randn(count, 3, generator=generator).requires_grad_()

    def lookup(texels: Tensor, sides: tuple[int, ...], level: Tensor | None) -> Part:
        leaves = (texels, directions) if level is None else (texels, directions, level)
        given = (texels, sides, directions, level)
        return Part(leaves, lambda: cube_lookup(*given), lambda: cube_lookup_twin(*given))

    def prefilter(levels: list[tuple[int, float | None]]) -> Part:
        texels = drawn(texel_count(sides[:1]))
        dense = [None if side == sides[0] else dense_weights(side, rough) for side, rough in levels]

        def small(side: int) -> Tensor:
            return shrunk(texels.reshape(6, sides[0], sides[0], 3), side).reshape(-1, 3)

        def twin() -> Tensor:
            pairs = zip(levels, dense)
            return torch.cat([small(side) if each is None else each @ small(side) for (side, _), each in pairs])

        return Part((texels,), lambda: torch.cat([filtered(small(side), side, rough) for side, rough in levels]), twin)

    def features() -> Part:
        texels = torch.randn(FEATURES, 2 * FEATURES, DIRECTION, generator=generator).requires_grad_()
        roughness = torch.rand(len(directions), generator=generator).requires_grad_()
        surface = torch.randn(len(directions), SURFACE, generator=generator).requires_grad_()
        weights = {name: each.requires_grad_() for name, each in first_weights(WIDTH, generator).items()}
        rest = (FEATURES, directions, roughness, surface)

        def twin() -> Tensor:  # its levels are made in the call: what is made before has a gradient once
            levels = (FEATURES.bit_length() - 1) * roughness
            return mirrored_light_twin(weights, box_pyramid(texels), FEATURES, directions, levels, surface)

        return Part(
            (texels, directions, roughness, surface, *weights.values()),
            lambda: mirrored_light(weights, box_pyramid(texels), *rest),
            twin,
        )

    return {
        "features": features(),
        "lookup": lookup(drawn(texel_count(sides)), sides, level),
        "prefilter": prefilter(list(zip(sides, level_roughness(len(sides))))),
        "diffuse_lookup": lookup(drawn(texel_count((DIFFUSE,))), (DIFFUSE,), None),
        "diffuse_prefilter": prefilter([(DIFFUSE, None)]),
        f"lookup_{one_level}": lookup(drawn(texel_count((one_level,))), (one_level,), None),
    }


def fastest_ms(function: Callable[[], Tensor], leaves: tuple[Tensor, ...], calls: int) -> float:
    """Least CPU time of one forward and backward."""
    best, upstream = float("inf"), torch.ones_like(function())
    for _ in range(calls):
        for leaf in leaves:
            leaf.grad = None
        start = time.thread_time()
        function().backward(upstream)
        best = min(best, time.thread_time() - start)
    return 1e3 * best


def figures(
    size: tuple[int, int] = SIZE, sides: tuple[int, ...] = SIDES, one_level: int = ONE_LEVEL, calls: int = NATIVE_CALLS
) -> dict[str, float]:
    """Milliseconds by part, with their sum."""
    start = time.thread_time()
    for side, rough in (*zip(sides, level_roughness(len(sides))), (DIFFUSE, None)):
        filter_of(side, rough)
    found = {"made_seconds": time.thread_time() - start}
    for name, part in parts(size, sides, one_level).items():
        ours = fastest_ms(part.native, part.leaves, calls)
        theirs = fastest_ms(part.twin, part.leaves, min(calls, TORCH_CALLS))
        found |= {f"{name}_ms": ours, f"{name}_torch_ms": theirs, f"{name}_ratio": theirs / ours}
    ours, theirs = (sum(found[f"{name}_{kind}"] for name in STEP) for kind in ("ms", "torch_ms"))
    return found | {"step_ms": ours, "step_torch_ms": theirs, "step_ratio": theirs / ours}


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    torch.set_num_threads(1)
    found = figures()
    for name in (*STEP, "step", f"lookup_{ONE_LEVEL}", "features"):
        ours, theirs = found[f"{name}_ms"], found[f"{name}_torch_ms"]
        print(f"{name:20s} native {ours:8.2f} ms   torch {theirs:8.2f} ms   {theirs / ours:6.1f}x")
    print(json.dumps({"isa": core.isa()} | {key: round(value, 3) for key, value in found.items()}))


if __name__ == "__main__":
    main()
