"""A set of surfels in training: parameters, their optimiser, their density control. Every method is made of these."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.gaussians.activate import activate_surfels
from rtgs.gaussians.adam import GaussianAdam
from rtgs.gaussians.density import DensityReport
from rtgs.gaussians.mcmc import density_control
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.surfels import ActivatedSurfels
from rtgs.train.settings import DensitySettings, OptimizerSettings


@dataclass(frozen=True)
class Observation:
    """What density control learns from one rendered training view."""

    probe: Tensor  # (N, 2 or 3); after the backward pass its gradient is the densification signal
    weight_sum: Tensor  # (N,)


class SurfelSet:
    """Gaussians of one kind + :class:`GaussianAdam` + density control, kept consistent through every change of N.

    ``name`` prefixes its tensors in a checkpoint and its lines in reports; ``extent`` is the scene's, world units.
    """

    def __init__(
        self,
        name: str,
        surfels: Gaussians,
        *,
        optimizer: OptimizerSettings,
        density: DensitySettings,
        means_lr_steps: int,
        extent: float,
    ) -> None:
        self.name = name
        self.surfels = surfels.requires_grad_()
        self.extent = extent
        self._optimizer_settings = optimizer
        self._means_lr_steps = means_lr_steps
        self.optimizer = self._new_optimizer()
        self.density = density_control(density, extent)
        self._observation: Observation | None = None

    def __len__(self) -> int:
        return len(self.surfels)

    def _new_optimizer(self) -> GaussianAdam:
        return GaussianAdam(self.surfels, self._optimizer_settings, self.extent, means_lr_steps=self._means_lr_steps)

    def activated(self, camera_center: Tensor, sh_degree: int) -> ActivatedSurfels:
        """Activated surfels as seen from ``camera_center`` (3,) world, SH up to ``sh_degree``."""
        return activate_surfels(self.surfels, camera_center, sh_degree)

    def adopt(self, surfels: Gaussians) -> None:
        """Go on with the same rows and more or fewer kinds of parameters; Adam keeps the moments of those that stay."""
        if len(surfels) != len(self):
            raise ValueError(f"set {self.name!r} has {len(self)} rows, {len(surfels)} were given; use apply_plan")
        before = self.optimizer
        self.surfels = surfels.requires_grad_()
        self.optimizer = self._new_optimizer()
        self.optimizer.inherit(before)

    def new_probe(self, columns: int = 2) -> Tensor:
        """A (N, columns) zero tensor to hand to the renderer of a training view: 2 of a rasteriser, 3 of the tracer."""
        return torch.zeros(len(self), columns, requires_grad=True)

    def watch(self, probe: Tensor, weight_sum: Tensor) -> None:
        """Remember what the renderer of this step's view returned, until :meth:`step`."""
        self._observation = Observation(probe, weight_sum)

    def step(self, step: int, sh_degree: int, *, held: tuple[str, ...] = ()) -> None:
        """Hand the view's signal to density control, then one step of Adam and the clamps that keep values finite.

        ``sh_degree`` is the degree that :meth:`activated` used in this step; parameters named in ``held`` stand still.

        Raises:
            NonFiniteGradientError: a gradient held NaN or inf; gradients are kept for the report.
        """
        if self._observation is not None and self._observation.probe.grad is not None:
            self.density.observe(self._observation.probe.grad, self._observation.weight_sum)
        self._observation = None
        for name in held:
            self.surfels[name].grad = None  # Adam leaves a parameter without one alone
        self.optimizer.step(step, sh_degree)
        self.optimizer.zero_grad()
        self._clamp()

    def perturb(self, step: int, generator: torch.Generator) -> None:
        """The noise that density control puts on the means after a step, at that step's learning rate."""
        self.density.perturb(self.surfels, self.optimizer.learning_rates(step)["means"], generator)

    def densify(self, generator: torch.Generator, *, after_reset: bool = True) -> DensityReport:
        """Clone, split, prune with the signal gathered since the last call.

        ``after_reset``: opacities have been reset before.
        """
        return self.density.densify(self.surfels, self.optimizer, generator, after_reset=after_reset)

    def reset_opacity(self) -> None:
        """Lower every opacity to the settings' reset value."""
        self.density.reset_opacity(self.surfels, self.optimizer)

    def _clamp(self) -> None:
        self.optimizer.clamp()

    def state(self) -> dict[str, Tensor]:
        """Every tensor of the set under dotted names."""
        parts = {
            "surfels": {name: tensor.detach() for name, tensor in self.surfels.items()},
            "adam": self.optimizer.state(),
            "density": self.density.state(),
        }
        return {
            f"{self.name}.{part}.{name}": tensor for part, tensors in parts.items() for name, tensor in tensors.items()
        }

    def load(self, state: dict[str, Tensor]) -> None:
        """Take over the tensors of :meth:`state`, whatever the number of surfels now.

        Raises:
            ValueError: a parameter of this set is missing in ``state``.
        """

        def part(key: str) -> dict[str, Tensor]:
            prefix = f"{self.name}.{key}."
            return {name[len(prefix) :]: tensor for name, tensor in state.items() if name.startswith(prefix)}

        parameters = part("surfels")
        for name, _ in self.surfels.items():
            if name not in parameters:
                raise ValueError(
                    f"the checkpoint has no {self.name}.surfels.{name}: it was written by another method or version; "
                    "train again from the start"
                )
            self.surfels[name] = parameters[name].clone().requires_grad_()
        self.optimizer = self._new_optimizer()  # moments of the loaded number of surfels
        self.optimizer.load(part("adam"))
        self.density.load(part("density"))
        self._observation = None
