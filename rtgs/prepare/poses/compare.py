"""How far two sets of poses of the same photos are apart, after the best similarity between their worlds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtgs.prepare.poses.world import WorldChange
from rtgs.scenes.capture import CaptureView


@dataclass(frozen=True)
class PoseErrors:
    """Errors of estimated poses against given ones, over the photos both have."""

    names: tuple[str, ...]
    missing: tuple[str, ...]  # given, not estimated
    rotation: np.ndarray  # (N,) degrees
    translation: np.ndarray  # (N,) share of the given cameras' extent (largest distance to their mean)
    focal: float  # median of estimated focal over given focal, less 1
    change: WorldChange  # from the estimated world to the given one

    @property
    def found(self) -> float:
        """Share of the given photos that were estimated."""
        return len(self.names) / max(len(self.names) + len(self.missing), 1)


def compare_poses(estimated: Sequence[CaptureView], given: Sequence[CaptureView]) -> PoseErrors:
    """Errors by photo name, extensions aside.

    The worlds are aligned by the mean of the relative rotations (chordal: Hartley et al. 2013, "Rotation averaging")
    and then scale and shift by least squares over camera centres: this holds for cameras on a line, too.

    Raises:
        ValueError: fewer than two photos in common.
    """
    found = {view.name.rsplit(".", 1)[0]: view for view in estimated}
    both = [(found[key], view) for view in given if (key := view.name.rsplit(".", 1)[0]) in found]
    missing = tuple(view.name for view in given if view.name.rsplit(".", 1)[0] not in found)
    if len(both) < 2:
        raise ValueError(f"{len(both)} photos have both an estimated and a given pose: at least 2 are needed")
    new = np.array([view.rotation for view, _ in both])
    old = np.array([view.rotation for _, view in both])
    left, _, right = np.linalg.svd(np.einsum("nji,njk->ik", old, new))
    turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right  # given world from estimated world
    centers = np.array([view.center for view, _ in both])
    truth = np.array([view.center for _, view in both])
    turned = (centers - centers.mean(axis=0)) @ turn.T
    spread = truth - truth.mean(axis=0)
    scale = float((turned * spread).sum() / max((turned**2).sum(), 1e-30))
    shift = truth.mean(axis=0) - scale * turn @ centers.mean(axis=0)
    change = WorldChange(scale, tuple(tuple(row) for row in turn.tolist()), tuple(shift.tolist()))
    relative = np.einsum("nij,jk,nlk->nil", new, turn.T, old)
    cosine = np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)
    extent = max(float(np.linalg.norm(spread, axis=1).max()), 1e-30)
    errors = np.linalg.norm(change.apply(centers) - truth, axis=1) / extent
    ratios = [a.lens.params[0] / a.lens.width / (b.lens.params[0] / b.lens.width) for a, b in both if a.lens and b.lens]
    focal = float(np.median(ratios)) - 1 if ratios else 0.0
    return PoseErrors(
        tuple(view.name for _, view in both), missing, np.degrees(np.arccos(cosine)), errors, focal, change
    )
