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
from rtgs.core.upward import find_up
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.panels import parts_between_creases
from rtgs.methods.parts.glass_evidence import masked_views

if TYPE_CHECKING:
    from rtgs.scenes.scene import View

Shown = Callable[["View", Tensor], Tensor]
"""The (3, H, W) picture of a view with these faces (F,) bool as openings."""

_VIEWS = 12  # that are looked at
_UPRIGHT = 0.7  # of its area that a part which looks up has in its vertical projection
_MOST = 0.5  # share of the mesh's area that an opening has at most
_FEWEST = 0.002  # share of the masked pixels of all these views that a wall in the part makes a difference to
_DIFFERENCE = 1 / 255
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
            Decision("an opening", f"no wall in {share:.1%} of the object's mesh: error {-gain:+.1%} without one")
            for share, gain in self.found.tolist()
            if gain >= self.least
        )

    def __str__(self) -> str:
        said = [f"{share:.1%} of the mesh, error without a wall {-gain:+.1%}" for share, gain in self.found.tolist()]
        return f"{int((self.found[:, 1] >= self.least).sum())} of {len(said)} parts ({'; '.join(said)})"

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        return {_PART: self.part, _FOUND: self.found}

    @staticmethod
    def of(state: Mapping[str, Tensor], least: float) -> Openings | None:
        """Those of a checkpoint's state; None: nothing was judged."""
        return Openings(state[_PART], state[_FOUND], least) if _PART in state else None


def upward_parts(mesh: ObjectMesh, views: Sequence[View]) -> list[Tensor]:
    """(F,) bool each: parts of the mesh that look up, as things that are open stand; none is more than half of it."""
    normals = mesh.mesh.face_normals()
    area = np.linalg.norm(normals, axis=1)
    up, _ = find_up(np.stack([view.camera.rotation.double().numpy() for view in views]))
    parts = parts_between_creases(mesh.mesh, mesh.voxel)
    return [
        torch.from_numpy(part)
        for part in parts
        if normals[part].sum(0) @ up > _UPRIGHT * area[part].sum() and area[part].sum() <= _MOST * area.sum()
    ]


@torch.no_grad()
def judged_openings(
    mesh: ObjectMesh, parts: Sequence[Tensor], views: Sequence[View], shown: Shown, least: float
) -> Openings | None:
    """Show the views with and without a wall in each of the ``parts`` (F,) bool, and compare with the photos where that
    makes a difference. None: it makes none, or there is no part."""
    area = torch.from_numpy(np.linalg.norm(mesh.mesh.face_normals(), axis=1))
    masked = list(masked_views(views))
    masked = [masked[k] for k in sorted({round(k) for k in np.linspace(0, len(masked) - 1, _VIEWS)})] if masked else []
    none, gains = torch.zeros(len(area), dtype=torch.bool), []
    walls = [shown(view, none) for view, _ in masked] if parts else []
    every = sum(int(mask.sum()) for _, mask in masked)
    for part in parts:
        pixels, closed, opened = 0, 0.0, 0.0
        for (view, mask), wall in zip(masked, walls, strict=True):
            without = shown(view, part)
            where = mask & ((without - wall).abs().amax(0) > _DIFFERENCE)
            pixels += int(where.sum())
            closed += _error(wall, view, where)
            opened += _error(without, view, where)
        if pixels >= _FEWEST * every and closed > 0:
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
