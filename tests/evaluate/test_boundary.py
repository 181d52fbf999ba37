"""What is told where the third stage begins: rasterised surface and mesh against the true one, silhouettes."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.evaluate.boundary import BoundaryRecord, BoundaryScores, boundary_scores
from rtgs.mesh.container import ObjectMesh
from rtgs.methods import Mode, RenderedView, RenderOptions
from rtgs.render.buffers import RasterBuffers
from rtgs.scenes.scene import Scene, View
from tests.mesh.shapes import camera_at, sphere, sphere_depths

ROWS, COLUMNS, ALPHA = 20, 30, 0.8  # above and left of these the rendered sphere is right
MESH = ObjectMesh(sphere(1.0, 64), "given", 0.02, flat=False)


@dataclass(frozen=True)
class Truth:
    depth: Tensor
    normal: Tensor


def surface(camera: Camera) -> tuple[Tensor, Tensor]:
    """(H, W) depth of the unit sphere, 0 beside it, and (3, H, W) its normals, world frame."""
    near = sphere_depths(camera, 1.0)[0]
    depth = torch.where(torch.isfinite(near), near, 0.0)
    rays = camera.rays(torch.float64)
    points = (rays.origin + depth[..., None] * rays.directions).permute(2, 0, 1)
    return depth.float(), torch.where(depth > 0, points, 0.0).float()


class Painter:
    """Renders the sphere with alpha 0.8, 5 % too far from ROWS on, its normals 20 degrees off from COLUMNS on."""

    maps = ("depth", "normal")

    def render(
        self, camera: Camera, step: int, mode: Mode, options: RenderOptions, mask: Tensor | None
    ) -> RenderedView:
        depth, normal = surface(camera)
        depth = torch.where(torch.arange(camera.height)[:, None] < ROWS, depth, 1.05 * depth)
        across = torch.nn.functional.normalize(
            torch.linalg.cross(normal, torch.tensor([0.3, 0.5, 0.8])[:, None, None], dim=0), dim=0
        )
        angle = math.radians(20)
        tilted = math.cos(angle) * normal + math.sin(angle) * across
        normal = torch.where(torch.arange(camera.width) < COLUMNS, normal, tilted)
        alpha = ALPHA * (depth > 0).float()
        image = torch.zeros(3, camera.height, camera.width)
        buffers = RasterBuffers(image, alpha, depth=ALPHA * depth, normal=ALPHA * normal)
        return RenderedView(camera, image, buffers, maps={"specular": torch.full_like(alpha, 0.4)})


def seen(angle: float, truth: bool) -> View:
    camera = replace(camera_at((3 * math.cos(angle), 3 * math.sin(angle), 0.8)), name=f"{angle:.1f}")
    depth, normal = surface(camera)
    local = torch.einsum("ij,jhw->ihw", camera.rotation.float(), normal)
    photo = torch.zeros(3, camera.height, camera.width)
    return View(camera, photo, depth > 0, None, camera.name, Truth(depth, local) if truth else None)  # type: ignore[arg-type]


def scene(truth: bool) -> Scene:
    train = tuple(seen(0.9 * k, False) for k in range(5))
    nothing = torch.zeros(0, 3)
    return Scene("sphere", train, (seen(0.4, truth), seen(2.0, truth)), nothing, nothing, 3.0, "test")


def test_shares_are_of_the_masked_pixels_of_the_test_views():
    made = scene(True)
    found = boundary_scores(Painter(), made, MESH, 10)  # type: ignore[arg-type]
    masks = [view.mask for view in made.test if view.mask is not None]
    masked = sum(int(mask.sum()) for mask in masks)
    assert found.depth_share == pytest.approx(sum(int(mask[:ROWS].sum()) for mask in masks) / masked)
    assert found.normal_share == pytest.approx(sum(int(mask[:, :COLUMNS].sum()) for mask in masks) / masked)
    assert 0.2 < found.normal_share < 0.8
    assert found.mesh_depth_share is not None
    assert found.mesh_depth_share > 0.97
    assert found.silhouette_iou is not None
    assert found.silhouette_iou > 0.98
    assert found.specular == pytest.approx(0.4)


def test_without_truth_the_silhouettes_are_left_and_only_masks_that_bound_something_count():
    made = scene(False)
    found = boundary_scores(Painter(), made, MESH, 10)  # type: ignore[arg-type]
    assert (found.depth_share, found.normal_share, found.mesh_depth_share) == (None, None, None)
    first, *others = made.train
    full = replace(first, mask=torch.ones(first.camera.height, first.camera.width, dtype=torch.bool))
    again = boundary_scores(Painter(), replace(made, train=(full, *others)), MESH, 10)  # type: ignore[arg-type]
    rest = boundary_scores(Painter(), replace(made, train=tuple(others)), MESH, 10)  # type: ignore[arg-type]
    assert again.silhouette_iou == rest.silhouette_iou
    smaller = ObjectMesh(sphere(0.7, 32), "given", 0.02, flat=False)
    wrong = boundary_scores(Painter(), made, smaller, 10).silhouette_iou  # type: ignore[arg-type]
    assert wrong == pytest.approx(0.47, abs=0.06), "area of the smaller disc, 0.7 squared"


def test_scores_at_the_boundary_come_back(tmp_path: Path) -> None:
    assert BoundaryRecord.read(tmp_path) is None  # of a training without a third stage
    before = BoundaryScores(0.99, None, None, None, None, 0.1)
    record = BoundaryRecord(before, BoundaryScores(0.99, 0.9, 0.8, 3.0, 0.99, 0.9))
    record.write(tmp_path)
    assert BoundaryRecord.read(tmp_path) == record
    assert list(json.loads((tmp_path / "boundary.json").read_text())) == ["before", "after"]
    (tmp_path / "boundary.json").write_text('{"before": {}}')
    with pytest.raises(RtgsError, match=r"boundary\.json cannot be read as a record"):
        BoundaryRecord.read(tmp_path)
