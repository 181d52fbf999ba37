"""The sets of a transparent object: how its contents begin, and with which rates and density control they train."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.surfels import Surfels
from rtgs.mesh.container import ObjectMesh
from rtgs.methods.parts.gaussian_set import GaussianSet
from rtgs.methods.parts.interface_set import InterfaceSet
from rtgs.methods.parts.traced_set import TracedSet
from rtgs.methods.parts.transmittance_init import initial_box, random_surfels, rows_inside, take_out
from rtgs.methods.settings import MethodSettings


@dataclass(frozen=True)
class Taken:
    """What the base set gives to the transmittance set."""

    surfels: Surfels | None  # None: too little
    found: int  # base surfels in the object
    all_of_them: bool  # none would stay in the base set
    detail: str = ""


def taken_from_base(
    settings: MethodSettings, base: GaussianSet, mesh: ObjectMesh, cameras: Sequence[Camera], kept: Tensor
) -> Taken:
    """Take the base surfels in the object (behind a pane: copies of them), where there are enough and some stay.

    ``kept`` (N,) bool: those that stay in the base set as well, for they are seen bare.
    """
    transmittance = settings.transmittance
    inside = torch.zeros(len(base), dtype=torch.bool)
    if transmittance.split:
        assert isinstance(base.gaussians, Surfels)
        inside = rows_inside(base.gaussians, mesh, transmittance.split_margin * mesh.voxel, cameras)
    found = int(inside.sum())
    some_stay = mesh.flat or found < len(inside)
    if found < transmittance.init.min_points or not some_stay:
        return Taken(None, found, not some_stay)
    detail = f"{found} base surfels {_place(mesh)}"
    if mesh.flat:
        detail = f"copies of {detail}"
    elif both := int((inside & kept).sum()):
        detail += f", {both} of them seen bare too: they also stay in the base set"
    kept = torch.ones_like(kept) if mesh.flat else kept  # what is behind a pane is seen beside it, too
    taken = take_out(base, inside, kept)
    if transmittance.start_opacity < 1:
        with torch.no_grad():
            taken.opacity_logits.clamp_(max=math.log(transmittance.start_opacity / (1 - transmittance.start_opacity)))
    return Taken(taken, found, False, detail)


def drawn_in_box(
    settings: MethodSettings,
    mesh: ObjectMesh,
    cameras: Sequence[Camera],
    points: Tensor,
    taken: Taken,
    generator: torch.Generator,
) -> tuple[Surfels, str]:
    """Random surfels in the settings' box, and what the log says of them; ``taken``: why the base set gave none."""
    transmittance = settings.transmittance
    surfels = random_surfels(transmittance, initial_box(transmittance, mesh, cameras, points), generator)
    many = f"all {taken.found}" if taken.all_of_them else f"only {taken.found}"
    why = f", for {many} base surfels are {_place(mesh)}" if transmittance.split else ""
    return surfels, f"{len(surfels)} random surfels in the box of the {transmittance.box}{why}"


def _place(mesh: ObjectMesh) -> str:
    return "behind the pane" if mesh.flat else "inside the object"


def transmittance_set(settings: MethodSettings, surfels: Surfels, means_lr_steps: int, extent: float) -> TracedSet:
    """The set that straight rays meet first."""
    transmittance = settings.transmittance
    return TracedSet(
        "transmittance",
        surfels,
        optimizer=settings.optimizer.learning_faster(transmittance.rate_gain),
        density=transmittance.density,
        means_lr_steps=means_lr_steps,
        extent=extent,
        rebuild_every=transmittance.rebuild_every,
    )


def interface_set(settings: MethodSettings, surfels: Surfels, means_lr_steps: int, extent: float) -> InterfaceSet:
    """The surface of the object, held where it was put."""
    made = InterfaceSet(
        "interface",
        surfels,
        optimizer=settings.optimizer,
        density=settings.density,
        means_lr_steps=means_lr_steps,
        extent=extent,
    )
    return made.put(settings.transmittance.interface.floor)
