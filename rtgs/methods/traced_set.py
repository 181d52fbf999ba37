"""Tracing a set of surfels: the tree that follows its changes, and the call."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.gaussians.activate import activate_geometry
from rtgs.gaussians.initialize import surfels_from_points
from rtgs.gaussians.settings import InitSettings
from rtgs.gaussians.surfels import Surfels
from rtgs.render.buffers import TraceBuffers, TraceOptions
from rtgs.render.trace import SurfelTree, trace_surfels


class FollowingTree:
    """The tree of surfels that change: refitted when they have moved, rebuilt now and then and when their number
    changes. A refitted and a new tree trace the same, bit for bit, so it is no part of a checkpoint."""

    def __init__(self, rebuild_every: int) -> None:
        self._rebuild_every = rebuild_every
        self._tree: SurfelTree | None = None
        self._refits = 0
        self._moved = True

    def moved(self) -> None:
        """The surfels have other values, and are as many."""
        self._moved = True

    def clear(self) -> None:
        """Other surfels."""
        self._tree = None

    def current(self, shape: tuple[Tensor, ...], alpha_cutoff: float) -> SurfelTree:
        """The tree of the surfels as they are: means, tangents u, v, scales, opacities."""
        detached = tuple(tensor.detach() for tensor in shape)
        if self._tree is None or self._refits >= self._rebuild_every or self._tree.surfels != len(detached[0]):
            self._tree = SurfelTree()
            self._tree.build(*detached, alpha_cutoff=alpha_cutoff)
            self._refits, self._moved = 0, False
        elif self._moved:
            self._tree.refit(*detached, alpha_cutoff=alpha_cutoff)
            self._refits += 1
            self._moved = False
        return self._tree


def trace_set(
    surfels: Surfels,
    tree: FollowingTree,
    origins: Tensor,
    directions: Tensor,
    options: TraceOptions,
    probe: Tensor | None = None,
) -> TraceBuffers:
    """What rays (R, 3) from ``origins`` along ``directions`` meet of raw ``surfels``: SH colours, and what is asked."""
    active = activate_geometry(surfels)
    shape = (active.means, active.tangent_u, active.tangent_v, active.scales, active.opacities)
    return trace_surfels(
        *shape,
        origins,
        directions,
        tree=tree.current(shape, options.alpha_cutoff),
        sh_dc=surfels.sh_dc,
        sh_rest=surfels.sh_rest,
        options=options,
        probe=probe,
    )


def stratified_surfels(
    box: Tensor,
    cells: int,
    per_cell: int,
    init: InitSettings,
    generator: torch.Generator,
    color: Tensor | None = None,
) -> Surfels:
    """Stratified random surfels in a box (2, 3), world (method.md 6.1), of this ``color`` (3,) or of random ones.

    Each of ``cells``^3 cells gets ``per_cell`` points.
    """
    axis = torch.arange(cells)
    corner = torch.cartesian_prod(axis, axis, axis).repeat_interleave(per_cell, dim=0)
    share = (corner + torch.rand(corner.shape, generator=generator)) / cells
    positions = box[0] + (box[1] - box[0]) * share
    colors = torch.rand(corner.shape, generator=generator) if color is None else color.expand(corner.shape).clone()
    return surfels_from_points(positions, colors, init, generator)
