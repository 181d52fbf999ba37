"""A set of surfels that rays meet: the tree that follows its changes, the call, and the set in training."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from rtgs.gaussians.activate import activate_geometry
from rtgs.gaussians.density import DensityReport
from rtgs.gaussians.settings import DensitySettings, OptimizerSettings
from rtgs.gaussians.surfels import ActivatedGaussians, Surfels
from rtgs.methods.parts.gaussian_set import GaussianSet
from rtgs.render.buffers import TraceBuffers, TraceOptions
from rtgs.render.trace import SurfelTree, trace_surfels
from rtgs.train.method import Observation


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
    active: ActivatedGaussians | None = None,
) -> TraceBuffers:
    """What rays (R, 3) from ``origins`` along ``directions`` meet of raw ``surfels``: SH colours, and what is asked.

    ``active``: their geometry, where it is known already.
    """
    active = active or activate_geometry(surfels)
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


class TracedSet(GaussianSet):
    """A set of surfels that is traced instead of rasterised. Its tree follows every change."""

    def __init__(
        self,
        name: str,
        gaussians: Surfels,
        *,
        optimizer: OptimizerSettings,
        density: DensitySettings,
        means_lr_steps: int,
        extent: float,
        rebuild_every: int,
    ) -> None:
        super().__init__(
            name, gaussians, optimizer=optimizer, density=density, means_lr_steps=means_lr_steps, extent=extent
        )
        self.tree = FollowingTree(rebuild_every)

    def trace(
        self, origins: Tensor, directions: Tensor, options: TraceOptions, *, watched: bool
    ) -> tuple[TraceBuffers, tuple[Observation, ...]]:
        """Colours that rays (R, 3) from ``origins`` along unit ``directions`` meet.

        ``watched``: density control learns from this view (``options.weight_sum`` must be set): the observation is
        returned beside the buffers.
        """
        probe = self.new_probe(3) if watched else None
        assert isinstance(self.gaussians, Surfels)
        traced = trace_set(self.gaussians, self.tree, origins, directions, options, probe)
        if probe is None or traced.weight_sum is None:
            return traced, ()
        return traced, (Observation(self.name, probe, traced.weight_sum),)

    def step(
        self, step: int, sh_degree: int, observation: Observation | None = None, *, held: tuple[str, ...] = ()
    ) -> None:
        super().step(step, sh_degree, observation, held=held)
        self.tree.moved()

    def densify(self, generator: torch.Generator, *, after_reset: bool = True) -> DensityReport:
        report = super().densify(generator, after_reset=after_reset)
        self.tree.clear()
        return report

    def perturb(self, step: int, generator: torch.Generator) -> None:
        super().perturb(step, generator)
        self.tree.moved()

    def reset_opacity(self) -> None:
        super().reset_opacity()
        self.tree.moved()

    def load(self, state: Mapping[str, Tensor]) -> None:
        super().load(state)
        self.tree.clear()
