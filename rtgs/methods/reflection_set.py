"""The reflection set: surfels that only mirror rays see, with the tree that finds them."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.gaussians.activate import activate_geometry
from rtgs.gaussians.density import DensityReport
from rtgs.gaussians.initialize import points_box, surfels_from_points
from rtgs.gaussians.surfels import Surfels
from rtgs.methods.surfel_set import SurfelSet
from rtgs.render.buffers import TraceBuffers, TraceOptions
from rtgs.render.trace import SurfelTree, trace_surfels
from rtgs.train.settings import DensitySettings, OptimizerSettings, ReflectionSettings


class ReflectionSet(SurfelSet):
    """A set of surfels that is traced. Its tree follows every change: refitted, or rebuilt now and then."""

    def __init__(
        self,
        name: str,
        surfels: Surfels,
        *,
        optimizer: OptimizerSettings,
        density: DensitySettings,
        means_lr_steps: int,
        extent: float,
        rebuild_every: int,
    ) -> None:
        super().__init__(
            name, surfels, optimizer=optimizer, density=density, means_lr_steps=means_lr_steps, extent=extent
        )
        self._rebuild_every = rebuild_every
        self._tree: SurfelTree | None = None
        self._refits = 0
        self._moved = True

    def trace(self, origins: Tensor, directions: Tensor, options: TraceOptions, *, watched: bool) -> TraceBuffers:
        """Colours that rays (R, 3) from ``origins`` along unit ``directions`` meet.

        ``watched``: density control learns from this view (``options.weight_sum`` must be set).
        """
        surfels = activate_geometry(self.surfels)
        shape = (surfels.means, surfels.tangent_u, surfels.tangent_v, surfels.scales, surfels.opacities)
        probe = self.new_probe(3) if watched else None
        traced = trace_surfels(
            *shape,
            origins,
            directions,
            tree=self._current_tree(shape, options.alpha_cutoff),
            sh_dc=self.surfels.sh_dc,
            sh_rest=self.surfels.sh_rest,
            options=options,
            probe=probe,
        )
        if probe is not None and traced.weight_sum is not None:
            self.watch(probe, traced.weight_sum)
        return traced

    def _current_tree(self, shape: tuple[Tensor, ...], alpha_cutoff: float) -> SurfelTree:
        """The tree of the surfels as they are. A refitted and a new tree trace the same, bit for bit."""
        detached = tuple(tensor.detach() for tensor in shape)
        if self._tree is None or self._refits >= self._rebuild_every:
            self._tree = SurfelTree()
            self._tree.build(*detached, alpha_cutoff=alpha_cutoff)
            self._refits, self._moved = 0, False
        elif self._moved:
            self._tree.refit(*detached, alpha_cutoff=alpha_cutoff)
            self._refits += 1
            self._moved = False
        return self._tree

    def step(self, step: int, sh_degree: int, *, held: tuple[str, ...] = ()) -> None:
        super().step(step, sh_degree, held=held)
        self._moved = True

    def densify(self, generator: torch.Generator, *, after_reset: bool = True) -> DensityReport:
        report = super().densify(generator, after_reset=after_reset)
        self._tree = None
        return report

    def perturb(self, step: int, generator: torch.Generator) -> None:
        super().perturb(step, generator)
        self._moved = True

    def reset_opacity(self) -> None:
        super().reset_opacity()
        self._moved = True

    def load(self, state: dict[str, Tensor]) -> None:
        super().load(state)
        self._tree = None


def reflection_surfels(settings: ReflectionSettings, points: Tensor, generator: torch.Generator) -> Surfels:
    """The initial reflection set: stratified random surfels of random colour in its box (methods.md 6.1).

    The box is that of the points (P, 3), 0.5 to 99.5 percentile per axis, or a cube around the origin
    (``box_half`` > 0). Each of ``cells``^3 cells gets ``per_cell`` points.
    """
    if settings.box_half > 0:
        box = settings.box_half * torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    else:
        usable = torch.isfinite(points).all(dim=1)
        box = points_box(points[usable])
    axis = torch.arange(settings.cells)
    cells = torch.cartesian_prod(axis, axis, axis).repeat_interleave(settings.per_cell, dim=0)
    share = (cells + torch.rand(cells.shape, generator=generator)) / settings.cells
    positions = box[0] + (box[1] - box[0]) * share
    colors = torch.rand(cells.shape, generator=generator)
    return surfels_from_points(positions, colors, settings.init, generator)
