"""Hand-made surfels and rays for tests of the tracer, float64."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from rtgs.render.buffers import TraceBuffers, TraceOptions
from rtgs.render.reference.trace import trace_surfels

OUTPUTS = ("colors", "features", "alpha", "depth", "normal")


@dataclass(frozen=True)
class TraceTensors:
    """Every differentiable input of the tracer, in its order; ``probe`` last."""

    means: Tensor
    tangent_u: Tensor
    tangent_v: Tensor
    scales: Tensor
    opacities: Tensor
    origins: Tensor
    directions: Tensor
    features: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    probe: Tensor

    def items(self) -> list[tuple[str, Tensor]]:
        return [(f.name, getattr(self, f.name)) for f in fields(self)]

    def all(self) -> tuple[Tensor, ...]:
        return tuple(tensor for _, tensor in self.items())

    def arguments(self) -> tuple[tuple[Tensor, ...], dict[str, Tensor]]:
        """Positional and keyword arguments of ``trace_surfels``."""
        return self.all()[:7], dict(self.items()[7:])

    def leaves(self, dtype: torch.dtype) -> TraceTensors:
        """Fresh leaf tensors of this dtype that require gradients."""
        return TraceTensors(*(t.detach().to(dtype, copy=True).requires_grad_() for t in self.all()))

    def rows(self, index: Tensor) -> TraceTensors:
        """The surfels ``index``; all rays."""
        return TraceTensors(**{n: t if n in ("origins", "directions") else t[index] for n, t in self.items()})

    def rays(self, index: Tensor) -> TraceTensors:
        """All surfels; the rays ``index``."""
        return replace(self, origins=self.origins[index], directions=self.directions[index])


NAMES = tuple(f.name for f in fields(TraceTensors))


def all_outputs(**changes) -> TraceOptions:
    return TraceOptions(depth=True, normal=True, weight_sum=True, **changes)


def surfel(
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    *,
    tangent_u: tuple[float, float, float] = (1.0, 0.0, 0.0),
    tangent_v: tuple[float, float, float] = (0.0, 1.0, 0.0),
    scales: tuple[float, float] = (0.5, 0.25),
    opacity: float = 0.6,
    features: tuple[float, ...] = (1.0,),
    sh_dc: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> TraceTensors:
    """One surfel across the z axis unless told otherwise, and the ray along z from the origin."""

    def row(values) -> Tensor:
        return torch.tensor([values], dtype=torch.float64)

    geometry = (row(mean), row(tangent_u), row(tangent_v), row(scales), row(opacity))
    rays = (row((0.0, 0.0, 0.0)), row((0.0, 0.0, 1.0)))
    return TraceTensors(*geometry, *rays, row(features), row(sh_dc), row([[0.0] * 3] * 15), row((0.0, 0.0, 0.0)))


def join(*parts: TraceTensors) -> TraceTensors:
    """All surfels; the rays of the first part."""
    rays = ("origins", "directions")
    return TraceTensors(
        **{
            n: parts[0].items()[i][1] if n in rays else torch.cat([p.all()[i] for p in parts])
            for i, n in enumerate(NAMES)
        }
    )


def with_rays(scene: TraceTensors, *rays: tuple[tuple[float, ...], tuple[float, ...]]) -> TraceTensors:
    """The surfels of a scene with these (origin, direction) rays."""
    origins, directions = zip(*rays, strict=True)
    return replace(
        scene,
        origins=torch.tensor(origins, dtype=torch.float64),
        directions=torch.tensor(directions, dtype=torch.float64),
    )


def trace(scene: TraceTensors, options: TraceOptions | None = None) -> TraceBuffers:
    """Through the twin."""
    positional, named = scene.arguments()
    return trace_surfels(*positional, **named, options=options or all_outputs())  # type: ignore[arg-type]


def output(buffers: TraceBuffers, name: str) -> Tensor:
    """One that was asked for."""
    found = getattr(buffers, name)
    assert found is not None
    return found
