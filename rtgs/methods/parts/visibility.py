"""What a mirror direction sees of the scene itself: a mesh of the base set, made anew now and then (Ref-Gaussian).

Depths of the training views are fused, as `mesh.of=scene` does it; Embree tells which mirror rays are free.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.settings import TsdfSettings
from rtgs.mesh.triangles import TriangleMesh
from rtgs.mesh.tsdf import DepthView, fuse_depths, import_open3d
from rtgs.methods.parts.part import Frame
from rtgs.train.losses import surface_depth
from rtgs.train.method import Mode, RenderOptions, StepEvent

if TYPE_CHECKING:
    from rtgs.core.cameras import Camera
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.ref_gaussian import RefGaussianSettings

NAME = "visibility"


class Visibility:
    """The mesh as it was at its last refresh; there is none before the first."""

    def __init__(self, settings: RefGaussianSettings, base: BaseSet, cameras: Sequence[Camera]) -> None:
        self._settings = settings
        self._base = base
        self._cameras = cameras
        self._guide: MeshGuide | None = None
        self._voxel = 0.0
        self._why_none = ""

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """Why there is no mesh, if one was asked for."""
        return (Decision("every mirror direction is free", self._why_none),) if self._why_none else ()

    def refresh(self, step: int) -> StepEvent:
        """Fuse the base set's depths as of ``step``.

        Raises:
            RtgsError: Open3D does not load.
        """
        import_open3d()
        tsdf = TsdfSettings(resolution=self._settings.mesh_cells, keep_clusters=self._settings.mesh_pieces)
        self._why_none, self._guide = "", None
        try:
            found = fuse_depths(self._views(step), self._cameras, tsdf)
        except RtgsError as error:  # nothing opaque yet: the next refresh asks again
            self._why_none = str(error)
            return StepEvent("decision", NAME, f"every mirror direction is free: {error}")
        self._have(in_order(found.mesh), found.voxel)
        return StepEvent("begin", NAME, f"a mesh of {len(found.mesh.faces)} triangles, voxel {found.voxel:.4g}")

    def _views(self, step: int) -> Iterator[DepthView]:
        wanted = RenderOptions(depth=True)
        for camera in self._cameras:
            with torch.no_grad():
                buffers = self._base.rasterize(Frame(camera, step, Mode.EVALUATE, wanted), wanted).buffers
            assert buffers.depth is not None
            yield DepthView(camera, surface_depth(buffers.depth, buffers.alpha), None, buffers.alpha)

    def _have(self, mesh: TriangleMesh, voxel: float) -> None:
        self._guide, self._voxel = MeshGuide(mesh, 0.0), voxel

    @property
    def offset(self) -> float:
        """How far mirror rays start along the normal, world units."""
        return self._settings.ray_offset * self._voxel

    @torch.no_grad()
    def free(self, origins: Tensor, directions: Tensor, asked: Tensor) -> Tensor:
        """(P,) float32, 0 where a ray from ``origins`` (P, 3) along unit ``directions`` (P, 3) meets the mesh within
        reach, else 1; also where nobody asked: ``asked`` (P,) bool."""
        if self._guide is None:
            return torch.ones(len(origins))
        sound = asked & torch.isfinite(origins).all(1) & (directions.square().sum(1) > 0.5)
        starts, along, there = origins.contiguous().numpy(), directions.numpy(), sound.numpy()
        if not there.all():
            starts, along = starts[there], along[there]
        free = np.ones(len(origins), np.float32)
        free[there] = ~self._guide.blocked(starts, along, self._settings.reach or np.inf)
        return torch.from_numpy(free)

    # ---- state

    def state(self) -> dict[str, Tensor]:
        if self._why_none:
            return {f"{NAME}.none": torch.from_numpy(np.frombuffer(self._why_none.encode(), np.uint8).copy())}
        if self._guide is None:
            return {}
        mesh = self._guide.mesh
        return {
            f"{NAME}.vertices": torch.from_numpy(mesh.vertices),
            f"{NAME}.faces": torch.from_numpy(mesh.faces),
            f"{NAME}.voxel": torch.tensor(self._voxel, dtype=torch.float64),
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """The mesh that the state has, or none."""
        self._guide, self._why_none = None, ""
        if f"{NAME}.none" in state:
            self._why_none = state[f"{NAME}.none"].numpy().tobytes().decode()
        if f"{NAME}.vertices" in state:
            vertices, faces = (state[f"{NAME}.{name}"].clone().numpy() for name in ("vertices", "faces"))
            self._have(TriangleMesh(vertices, faces), float(state[f"{NAME}.voxel"]))


def in_order(mesh: TriangleMesh) -> TriangleMesh:
    """The same mesh with vertices and faces in an order that does not depend on how many threads have made it."""
    order = np.lexsort(mesh.vertices.T)
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    faces = place[mesh.faces]
    first = faces.argmin(1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, 1)
    faces = faces[_by_rows(faces, len(order))]
    return TriangleMesh(np.ascontiguousarray(mesh.vertices[order]), np.ascontiguousarray(faces))


def _by_rows(faces: np.ndarray, vertices: int) -> np.ndarray:
    """The order of faces (F, 3) by their first vertex, then their second, then their third."""
    edges = faces[:, 0].astype(np.int64) * vertices + faces[:, 1]
    order = np.argsort(edges, kind="stable")
    edges = edges[order]
    if bool((edges[1:] == edges[:-1]).any()):  # two faces share an edge in the same direction
        return np.lexsort(faces.T[::-1])
    return order
