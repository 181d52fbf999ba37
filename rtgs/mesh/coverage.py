"""Pixels at the outline of a transparent object: which share of each shows it, and how its samples meet it.

A pixel is a square, and the object covers part of it there. Rays through a grid of points in the pixel say which part,
and at which angles it is met: reflectance rises steeply towards the outline, and one ray says little of its mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.mesh.container import ObjectGuide, camera_key
from rtgs.mesh.spread import ObjectRows, ObjectSurfaces, spread


@dataclass(frozen=True)
class Coverage:
    """K pixels at the outline of one camera, S samples in each; no gradient."""

    pixels: Tensor  # (K,) int64 into the flattened image, ascending; some sample of each meets the object
    triangle: Tensor  # (K, S) int32 of the first surface; -1: the sample misses the object
    cosine: Tensor  # (K, S) float32 of the angle of incidence there; 1 where it misses
    beside: ObjectRows  # of those pixels whose centre misses it: the sample nearest to the middle of what meets it

    @cached_property
    def share(self) -> Tensor:
        """(K,) of the pixel that shows the object, above 0."""
        return (self.triangle >= 0).float().mean(1)

    def rows(self, wanted: Tensor) -> tuple[Tensor, Tensor]:
        """Of pixels ``wanted`` (P,) int64 those that are here: (E,) places in ``wanted``, (E,) rows."""
        if len(self.pixels) == 0:
            return torch.zeros(2, 0, dtype=torch.int64).unbind(0)  # type: ignore[return-value]
        last = max(int(self.pixels[-1]), int(wanted.max()) if len(wanted) else 0)
        known = torch.zeros(last + 1, dtype=torch.bool).index_fill_(0, self.pixels, True)
        here = known.index_select(0, wanted).nonzero()[:, 0]  # few: only these are worth a search
        return here, torch.searchsorted(self.pixels, wanted.index_select(0, here))


class CoverageGuide:
    """The coverage of each camera, found once; as many cameras are remembered as ``guide`` remembers.

    ``side``: samples along each side of a pixel, at least 1.
    """

    def __init__(self, guide: ObjectGuide, side: int) -> None:
        if side < 1:
            raise ValueError(f"side is {side}: a pixel has at least 1 sample along each side")
        self.guide, self.side = guide, side
        self._cache: dict[tuple[object, ...], Coverage] = {}

    def coverage(self, camera: Camera) -> Coverage:
        """Of the pixels that have the outline in them or beside them."""
        key = camera_key(camera)
        found = self._cache.pop(key, None) or self._sampled(camera)
        self._cache[key] = found  # the newest is last
        while len(self._cache) > max(self.guide.cache_views, 1):
            del self._cache[next(iter(self._cache))]
        return found

    def surfaces(self, camera: Camera) -> ObjectSurfaces:
        """As the guide's; pixels whose centre misses the object and which show some of it have a sample's."""
        return spread([self.guide.rows(camera), self.coverage(camera).beside], camera.height, camera.width)

    def _sampled(self, camera: Camera) -> Coverage:
        hit = self.guide.silhouette(camera)
        pixels = _at_outline(hit).flatten().nonzero()[:, 0]
        side, samples = self.side, self.side * self.side
        x, y = pixels % camera.width, pixels // camera.width
        grid = (torch.arange(side, dtype=torch.float64) + 0.5) / side
        right = (x[:, None, None] + grid).expand(-1, side, -1).reshape(-1)
        down = (y[:, None, None] + grid[:, None]).expand(-1, -1, side).reshape(-1)
        local = ((right - camera.cx) / camera.fx, (down - camera.cy) / camera.fy, torch.ones_like(right))
        directions = torch.stack(local, 1) @ camera.rotation
        points = self.guide.points(camera.center, directions)
        unit = directions / directions.norm(dim=1, keepdim=True)
        cosine = torch.where(points.hit, -(points.normal.double() * unit).sum(1), 1.0).float()
        triangle = torch.where(points.hit, points.triangle, -1).reshape(-1, samples)
        covered = points.hit.reshape(-1, samples)
        some = covered.any(1).nonzero()[:, 0]
        missed = some[~hit.flatten()[pixels[some]]]
        near = points.rows(missed * samples + _in_the_middle(covered[missed], grid))
        shown = (near.near, near.far, near.second, near.normal.T.contiguous(), near.triangle.int())
        beside = ObjectRows(pixels[missed].int(), *shown)
        return Coverage(pixels[some], triangle[some].int(), cosine.reshape(-1, samples)[some], beside)


def _at_outline(hit: Tensor) -> Tensor:
    """(H, W) bool: some pixel of the 3x3 around shows the object at its centre, and some does not."""
    values = torch.nn.functional.pad(hit[None, None].float(), (1, 1, 1, 1), mode="replicate")
    most = torch.nn.functional.max_pool2d(values, 3, stride=1)
    least = -torch.nn.functional.max_pool2d(-values, 3, stride=1)
    return (most > least)[0, 0]


def _in_the_middle(covered: Tensor, grid: Tensor) -> Tensor:
    """(K,) of the samples ``covered`` (K, S) the one nearest to their mean; each row has one."""
    places = torch.stack((grid.repeat(len(grid)), grid.repeat_interleave(len(grid))), 1)  # (S, 2) x, y
    weight = covered.double() / covered.sum(1, keepdim=True)
    away = (places[None] - (weight @ places)[:, None]).square().sum(2)
    return torch.where(covered, away, torch.inf).argmin(1)
