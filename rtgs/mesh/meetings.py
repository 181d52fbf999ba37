"""Where rays meet a mesh whose vertices move: which triangle, where on it, and the normal there."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.mesh.normals import corner_shares, interpolated
from rtgs.mesh.triangles import TriangleMesh


@dataclass(frozen=True)
class Meetings:
    """Of L rays, one each."""

    vertices: Tensor  # (L, 3) int32: corners of the triangle
    shares: Tensor  # (L, 3) float32 that they have in the point; negative where ``normal`` looks inward; 0: it stays
    normal: Tensor  # (L, 3) float32 unit: smoothed, against the ray
    turn: Tensor  # (L, 3, 3) float32: by how much the normal turns along the triangle, for each world unit

    @property
    def bytes(self) -> int:
        """Of all tensors."""
        return sum(each.numel() * each.element_size() for each in vars(self).values())

    def rows(self, chosen: Tensor) -> Meetings:
        """The meetings ``chosen`` (int64)."""
        return Meetings(*(getattr(self, each.name)[chosen] for each in fields(self)))

    def at(self, values: Tensor) -> Tensor:
        """(L, K) values (V, K) of the vertices, towards ``normal``: what is a height above the mesh is one below it
        where the normal looks inward. No bit of the gradient depends on the number of threads."""
        return _At.apply(values, self.vertices, self.shares)  # type: ignore[return-value]


class _At(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, vertices: Tensor, shares: Tensor):
        ctx.count = len(values)
        ctx.save_for_backward(vertices, shares)
        found = values.detach().index_select(0, vertices.flatten()).reshape(*vertices.shape, values.shape[1])
        return (found * shares.to(values.dtype)[..., None]).sum(1)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        vertices, shares = (each.numpy() for each in ctx.saved_tensors)
        flat, wide = vertices.reshape(-1), upstream.double().numpy()
        sums = [
            np.bincount(flat, weights=(shares * wide[:, k : k + 1]).reshape(-1), minlength=ctx.count)
            for k in range(wide.shape[1])
        ]
        return torch.from_numpy(np.stack(sums, axis=1)).to(upstream.dtype), None, None


def meetings(
    mesh: TriangleMesh, corners: np.ndarray, triangle: np.ndarray, points: np.ndarray, normal: np.ndarray
) -> Meetings:
    """Of rays that meet the faces ``triangle`` (L,) in ``points`` (L, 3).

    Args:
        mesh, corners: with the (F, 3, 3) normals of its faces' corners.
        triangle: -1: nothing moves there.
        normal: (L, 3) unit, against the rays.
    """
    there = triangle >= 0
    face = np.where(there, triangle, 0)
    inward = (interpolated(mesh, corners, face, points) * normal).sum(1) < 0
    sign = there * np.where(inward, -1.0, 1.0)
    shares = corner_shares(mesh, face, points) * sign[:, None]
    turn = (corners[face].astype(np.float64).transpose(0, 2, 1) @ _share_gradients(mesh, face)) * sign[:, None, None]
    numbers = torch.from_numpy(np.ascontiguousarray(mesh.faces[face], np.int32))
    values = (torch.from_numpy(np.ascontiguousarray(each, np.float32)) for each in (shares, normal, turn))
    return Meetings(numbers, *values)


def _share_gradients(mesh: TriangleMesh, triangle: np.ndarray) -> np.ndarray:
    """(N, 3, 3) float64: of the share of each corner, by place."""
    corners = mesh.vertices[mesh.faces[triangle]].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    square = np.maximum((normal * normal).sum(1), 1e-300)
    opposite = np.stack([corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3] for k in range(3)], axis=1)
    return np.cross(normal[:, None], opposite) / square[:, None, None]
