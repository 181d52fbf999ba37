"""A set of Gaussians in training: parameters, their optimiser, their density control. Every method is made of these."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import torch
from torch import Tensor

from rtgs.core.errors import RtgsError
from rtgs.gaussians.activate import activate_gaussians
from rtgs.gaussians.adam import GaussianAdam
from rtgs.gaussians.density import DensityReport
from rtgs.gaussians.mcmc import density_control
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.settings import DensitySettings, OptimizerSettings
from rtgs.gaussians.smoothing import Smoothing
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.train.method import Observation, StepEvent


class GaussianSet:
    """Gaussians of one kind + :class:`GaussianAdam` + density control, kept consistent through every change of N.

    ``name`` prefixes its tensors in a checkpoint and its lines in reports; ``extent`` is the scene's, world units.
    ``smoothing`` is the filter that the Gaussians are shown with; its owner keeps it up to date.
    """

    def __init__(
        self,
        name: str,
        gaussians: Gaussians,
        *,
        optimizer: OptimizerSettings,
        density: DensitySettings,
        means_lr_steps: int,
        extent: float,
    ) -> None:
        self.name = name
        self.gaussians = _leaves(gaussians)
        self.extent = extent
        self._optimizer_settings = optimizer
        self._means_lr_steps = means_lr_steps
        self._scheduled: Mapping[str, Callable[[int], float]] = {}
        self.optimizer = self._new_optimizer()
        self.density = density_control(density, extent)
        self.smoothing: Smoothing | None = None

    def __len__(self) -> int:
        return len(self.gaussians)

    def _new_optimizer(self) -> GaussianAdam:
        found = GaussianAdam(self.gaussians, self._optimizer_settings, self.extent, means_lr_steps=self._means_lr_steps)
        found.scheduled = self._scheduled
        return found

    def schedule_rates(self, rates: Mapping[str, Callable[[int], float]]) -> None:
        """From now on these parameters, as far as they are there, learn at the rate that is given for each step."""
        self._scheduled = rates
        self.optimizer.scheduled = rates

    def activated(self, camera_center: Tensor, sh_degree: int) -> ActivatedGaussians:
        """Activated Gaussians as seen from ``camera_center`` (3,) world, SH up to ``sh_degree``."""
        shape = activate_gaussians(self.gaussians, camera_center, sh_degree)
        return shape if self.smoothing is None else self.smoothing.apply(shape)

    def shown(self) -> Gaussians:
        """The Gaussians with the filter they are shown with in their own scales and opacities; no copy without one."""
        return self.gaussians if self.smoothing is None else self.smoothing.fused(self.gaussians)

    def tensors(self) -> Iterable[tuple[str, Tensor]]:
        """(name, tensor) of every raw parameter."""
        return self.gaussians.items()

    def adopt(self, gaussians: Gaussians) -> None:
        """Go on with the same rows and more or fewer kinds of parameters; Adam keeps the moments of those that stay."""
        if len(gaussians) != len(self):
            raise ValueError(f"set {self.name!r} has {len(self)} rows, {len(gaussians)} were given; use apply_plan")
        before = self.optimizer
        self.gaussians = _leaves(gaussians)
        self.optimizer = self._new_optimizer()
        self.optimizer.inherit(before)

    def new_probe(self, columns: int = 2) -> Tensor:
        """A (N, columns) zero tensor to hand to the renderer of a training view: 2 of a rasteriser, 3 of the tracer."""
        return torch.zeros(len(self), columns, requires_grad=True)

    def step(
        self, step: int, sh_degree: int, observation: Observation | None = None, *, held: tuple[str, ...] = ()
    ) -> None:
        """Hand the view's signal to density control, then one step of Adam and the clamps that keep values finite.

        ``sh_degree`` is the degree that :meth:`activated` used in this step; ``observation`` is what the renderer of
        the view returned for this set; parameters named in ``held`` stand still.

        Raises:
            NonFiniteGradientError: a gradient held NaN or inf; gradients are kept for the report.
        """
        if observation is not None and observation.probe.grad is not None:
            self.density.observe(observation.probe.grad, observation.weight_sum)
        for name in held:
            self.gaussians[name].grad = None  # Adam leaves a parameter without one alone
        self.optimizer.step(step, sh_degree)
        self.optimizer.zero_grad()
        self._clamp()

    def perturb(self, step: int, generator: torch.Generator) -> None:
        """The noise that density control puts on the means after a step, at that step's learning rate."""
        self.density.perturb(self.gaussians, self.optimizer.learning_rates(step)["means"], generator)

    def densify(self, generator: torch.Generator, *, after_reset: bool = True) -> DensityReport:
        """Clone, split, prune with the signal gathered since the last call.

        ``after_reset``: opacities have been reset before.
        """
        return self.density.densify(self.gaussians, self.optimizer, generator, after_reset=after_reset)

    def reset_opacity(self) -> None:
        """Lower every opacity to the settings' reset value."""
        self.density.reset_opacity(self.gaussians, self.optimizer)

    def _clamp(self) -> None:
        """Keep the activations finite whatever the learning rate."""
        self.optimizer.clamp()

    def state(self) -> dict[str, Tensor]:
        """Every tensor of the set under dotted names (checkpoints call the parameters of any kind ``surfels``)."""
        parts = {
            "surfels": {name: tensor.detach() for name, tensor in self.gaussians.items()},
            "adam": self.optimizer.state(),
            "density": self.density.state(),
        }
        if self.smoothing is not None:
            parts["smoothing"] = {"intervals": self.smoothing.intervals}
        return {
            f"{self.name}.{part}.{name}": tensor for part, tensors in parts.items() for name, tensor in tensors.items()
        }

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Take over the tensors of :meth:`state`, whatever the number of rows now.

        Raises:
            ValueError: a parameter of this set is missing in ``state``, or the state has a channel that this set lacks.
        """

        def part(key: str) -> dict[str, Tensor]:
            prefix = f"{self.name}.{key}."
            return {name[len(prefix) :]: tensor for name, tensor in state.items() if name.startswith(prefix)}

        parameters = part("surfels")
        self._refuse_more(parameters)
        for name, _ in self.gaussians.items():
            if name not in parameters:
                raise ValueError(
                    f"the checkpoint has no {self.name}.surfels.{name}: it was written by another method or version; "
                    "train again from the start"
                )
            self.gaussians[name] = parameters[name].clone().contiguous().requires_grad_()
        self.optimizer = self._new_optimizer()  # moments of the loaded number of rows
        self.optimizer.load(part("adam"))
        self.density.load(part("density"))
        if self.smoothing is not None:
            self.smoothing.intervals = part("smoothing").get("intervals", self.smoothing.intervals[:0]).clone()

    def _refuse_more(self, parameters: Mapping[str, Tensor]) -> None:
        if more := sorted(name for name in parameters if name not in self.gaussians):
            held = ", ".join(channel.name for channel in self.gaussians.channels) or "none"
            raise ValueError(
                f"the checkpoint has {self.name}.surfels.{more[0]}, but set {self.name!r} lacks this channel (it has "
                f"{held}): the `restore` of the part that owns the set must first bring it to the channels of the "
                "state, with `GaussianSet.adopt` or as a new set"
            )


def _leaves(gaussians: Gaussians) -> Gaussians:
    """Ready to train: contiguous, since Adam moves them in place and a checkpoint holds no other layout."""
    for name, tensor in gaussians.items():
        if not tensor.is_contiguous():
            gaussians[name] = tensor.detach().contiguous()
    return gaussians.requires_grad_()


def densified(
    part: GaussianSet, settings: DensitySettings, generator: torch.Generator, following: int, *, after_reset: bool
) -> StepEvent:
    """Density control of one set before step ``following``.

    Raises:
        RtgsError: it left no Gaussian.
    """
    report = part.densify(generator, after_reset=after_reset)
    if report.total == 0:
        raise RtgsError(
            f"density control removed all {report.pruned} Gaussians of set {part.name!r} before step {following}: "
            f"every opacity was below method.density.min_opacity {settings.min_opacity}. Lower it, or the "
            "learning rate method.optimizer.opacity_logits; the last checkpoint is intact"
        )
    detail = f"{report.cloned} cloned, {report.split} split, {report.pruned} pruned, {report.total} Gaussians"
    return StepEvent("density", part.name, detail)


def opacity_reset(part: GaussianSet, settings: DensitySettings) -> StepEvent:
    """Opacity reset of one set."""
    part.reset_opacity()
    return StepEvent("opacity_reset", part.name, f"opacities lowered to {settings.reset_opacity}")
