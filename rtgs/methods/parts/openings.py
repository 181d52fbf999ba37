"""Openings of an object: parts of its mesh where no wall is, judged from training views.

A hull closes what no outline shows: it puts a lid on a cup. Light that such a lid mirrors is missing in the photos. The
sets learn to do with whatever walls they are given, so before a part is judged it is a wall and an opening by turns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rtgs.core.decisions import Decision
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.mesh.panels import parts_between_creases
from rtgs.methods.parts.glass_evidence import masked_views

if TYPE_CHECKING:
    from rtgs.scenes.scene import View

Shown = Callable[["View", Tensor], Tensor]
"""The (3, H, W) picture of a view with these faces (F,) bool as openings."""

_VIEWS = 12  # that are looked at
_UPRIGHT = 0.7  # cosine between what looks up and the cameras' mean upward direction
_FEWEST = 200  # masked pixels of all these views that show a part
_PART, _FOUND = "openings.part", "openings.found"  # in the state


@dataclass(frozen=True)
class Openings:
    """The parts of a mesh that were judged."""

    part: Tensor  # (F,) uint8: number of the part that a face is in, from 1 on; 0: of none
    found: Tensor  # (K, 2) float64: its share of the mesh's area; by which share its squared error falls without a wall
    least: float  # of the latter, from which on a part is an opening

    @property
    def faces(self) -> Tensor:
        """(F,) bool: where there is no wall."""
        opened = torch.cat((torch.zeros(1, dtype=torch.bool), self.found[:, 1] >= self.least))
        return opened[self.part.long()]

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """What was found open."""
        return tuple(
            Decision("an opening", f"no wall in {share:.0%} of the object's mesh: the error there falls by {gain:.0%}")
            for share, gain in self.found.tolist()
            if gain >= self.least
        )

    def __str__(self) -> str:
        said = [f"{share:.0%} of the mesh, error without a wall {-gain:+.1%}" for share, gain in self.found.tolist()]
        return f"{int((self.found[:, 1] >= self.least).sum())} of {len(said)} parts ({'; '.join(said)})"

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        return {_PART: self.part, _FOUND: self.found}

    @staticmethod
    def of(state: Mapping[str, Tensor], least: float) -> Openings | None:
        """Those of a checkpoint's state; None: nothing was judged."""
        return Openings(state[_PART], state[_FOUND], least) if _PART in state else None


def upward_parts(mesh: ObjectMesh, views: Sequence[View]) -> list[Tensor]:
    """(F,) bool each: parts of the mesh that look up, as things that are open stand; the largest part is no opening."""
    normals = mesh.mesh.face_normals()
    up = -torch.stack([view.camera.rotation[1] for view in views]).double().sum(0).numpy()
    found = []
    for part in parts_between_creases(mesh.mesh, mesh.voxel)[1:]:
        mean = normals[part].sum(0)
        if mean @ up > _UPRIGHT * np.linalg.norm(mean) * np.linalg.norm(up):
            found.append(torch.from_numpy(part))
    return found


@torch.no_grad()
def judged_openings(
    guide: ObjectGuide, parts: Sequence[Tensor], views: Sequence[View], shown: Shown, least: float
) -> Openings | None:
    """Show the views with and without a wall in each of the ``parts`` (F,) bool; None: no view shows one."""
    area = torch.from_numpy(np.linalg.norm(guide.mesh.mesh.face_normals(), axis=1))
    masked = list(masked_views(views))
    masked = [masked[k] for k in sorted({round(k) for k in np.linspace(0, len(masked) - 1, _VIEWS)})] if masked else []
    none, gains = torch.zeros(len(area), dtype=torch.bool), []
    walls = [shown(view, none) for view, _ in masked] if parts else []
    for part in parts:
        pixels, closed, opened = 0, 0.0, 0.0
        for (view, mask), wall in zip(masked, walls, strict=True):
            surfaces = guide.surfaces(view.camera)
            where = mask & surfaces.hit & part[surfaces.triangle.clamp_min(0).long()]
            if not where.any():
                continue
            pixels += int(where.sum())
            closed += _error(wall, view, where)
            opened += _error(shown(view, part), view, where)
        if pixels >= _FEWEST and closed > 0:
            gains.append((part, 1 - opened / closed))
    if not gains:
        return None
    number = torch.zeros(len(area), dtype=torch.uint8)
    for index, (part, _) in enumerate(gains):
        number[part] = index + 1
    found = [(float(area[part].sum() / area.sum()), gain) for part, gain in gains]
    return Openings(number, torch.tensor(found, dtype=torch.float64), least)


def _error(image: Tensor, view: View, where: Tensor) -> float:
    """Sum of the squared error, the picture as bright as a photo can be."""
    return float((image.clamp(0, 1) - view.image)[:, where].double().square().sum())
