"""How well a method knows the surface of a transparent object, on which its third stage depends."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.records import read_record, write_json
from rtgs.evaluate.surface import DEPTH_TOLERANCE, NORMAL_TOLERANCE, surface_errors
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.mesh.silhouettes import bounding
from rtgs.train.losses import surface_depth
from rtgs.train.method import Mode, RenderedView, RenderOptions

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene, View
    from rtgs.train.method import Method

BOUNDARY_FILE = "boundary.json"
RENDERED_VIEWS = 12  # about so many training views are rendered for their k_s


@dataclass(frozen=True)
class BoundaryScores:
    """Shares are of masked pixels, over the test views with truth; None: no test view has truth and a mask."""

    silhouette_iou: float | None  # of the mesh with those masks of the training views that bound something; None: none
    depth_share: float | None  # rasterised first surface within 3 % of the truth
    normal_share: float | None  # rasterised normal within 15 degrees of the truth
    normal_degrees: float | None  # median angle to the true normal
    mesh_depth_share: float | None  # the mesh's first surface within 3 % of the truth
    specular: float | None  # mean k_s in the masks of some training views

    def __str__(self) -> str:
        words = {
            "silhouettes IoU": self.silhouette_iou,
            "depth within 3 %": self.depth_share,
            "normal within 15 deg": self.normal_share,
            "median normal error deg": self.normal_degrees,
            "mesh within 3 %": self.mesh_depth_share,
            "mean k_s": self.specular,
        }
        return ", ".join(f"{name} {value:.3g}" for name, value in words.items() if value is not None)


@dataclass(frozen=True)
class BoundaryRecord:
    """``boundary.json`` of a training artifact: the scores where the third stage begins, and where it ends."""

    before: BoundaryScores
    after: BoundaryScores

    def write(self, folder: Path) -> None:
        """Write ``folder/boundary.json``."""
        write_json(folder / BOUNDARY_FILE, asdict(self))

    @staticmethod
    def read(folder: Path) -> BoundaryRecord | None:
        """Read ``folder/boundary.json``; None: there is none, as after a training without a third stage.

        Raises:
            RtgsError: it is damaged.
        """
        path = folder / BOUNDARY_FILE
        return read_record(BoundaryRecord, path) if path.is_file() else None


def boundary_scores(method: Method, scene: Scene, mesh: ObjectMesh, step: int) -> BoundaryScores:
    """Render the views of a scene and compare the object's surface in its masks with the truth, where there is one."""
    guide = ObjectGuide(mesh)
    common = whole = 0
    weights = pixels = 0.0
    masked = [(view, mask) for view in scene.train if (mask := bounding(view.mask)) is not None]
    for index, (view, mask) in enumerate(masked):
        hit = guide.surfaces(view.camera).hit
        common, whole = common + int((hit & mask).sum()), whole + int((hit | mask).sum())
        if index % max(1, len(masked) // RENDERED_VIEWS):
            continue
        specular = _rendered(method, view, step).maps.get("specular")
        if specular is not None:
            weights, pixels = weights + float(specular[mask].sum()), pixels + float(mask.sum())
    parts = [_against_truth(method, view, guide, step) for view in _with_truth(scene.test)]
    depth, angle, near = (torch.cat([part[k] for part in parts]) if parts else torch.zeros(0) for k in range(3))
    return BoundaryScores(
        silhouette_iou=common / whole if whole else None,
        depth_share=_share(depth < DEPTH_TOLERANCE),
        normal_share=_share(angle < NORMAL_TOLERANCE),
        normal_degrees=float(angle.median()) if len(angle) else None,
        mesh_depth_share=_share(near < DEPTH_TOLERANCE),
        specular=weights / pixels if pixels else None,
    )


def _with_truth(views: Iterable[View]) -> list[View]:
    return [view for view in views if view.truth is not None and view.mask is not None and bool(view.mask.any())]


def _rendered(method: Method, view: View, step: int) -> RenderedView:
    options = RenderOptions(depth=True, normal="normal" in method.maps)
    with torch.no_grad():
        return method.render(view.camera, step, Mode.EVALUATE, options, view.mask)


def _against_truth(method: Method, view: View, guide: ObjectGuide, step: int) -> tuple[Tensor, Tensor, Tensor]:
    """In the mask: relative error of the rasterised depth, degrees between normals, relative error of the mesh."""
    truth, mask = view.truth, view.mask
    assert truth is not None
    assert mask is not None
    buffers = _rendered(method, view, step).buffers
    assert buffers.depth is not None
    assert buffers.normal is not None
    local = torch.einsum("ij,jhw->ihw", view.camera.rotation.float(), buffers.normal)
    depth, angle = surface_errors(surface_depth(buffers.depth, buffers.alpha), local, truth, mask)
    near, _ = surface_errors(guide.surfaces(view.camera).near, None, truth, mask)
    return depth, angle, near


def _share(found: Tensor) -> float | None:
    return float(found.double().mean()) if len(found) else None
