"""A run as one page that any browser turns."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.core.errors import RtgsError

if TYPE_CHECKING:
    from pipelines.publishing.exported_run import ExportedRun
    from rtgs.export.formats import Export
    from rtgs.export.page import GlassScene
    from rtgs.runs.shown import ShownRun

BLURRED = "reflections are in their colours: sharp ones are blurred"
_OUTSIDE = 0.9  # of the object's radius: what is nearer than this is no surrounding of it


def write_run_page(run: ShownRun, found: ExportedRun, path: Path) -> None:
    """Write the page of a run: ``found`` is without the glass where the model has one."""
    from rtgs.export.page import write_page
    from rtgs.render.orbit import orbit_of_cameras

    export = found.export(run)
    cameras = run.cameras
    glass = None if export.glass is None else _glass(run, export)
    target = glass.center if glass is not None else orbit_of_cameras(cameras).target.numpy()
    write_page(
        path,
        f"{run.scene.name}, {run.method.name}",
        export.splats,
        cameras,
        target,
        export.frame,
        run.scene.extent,
        background=run.method.settings.render.background,
        glass=glass,
        note=BLURRED if glass is None and found.record.psnr is not None else "",
    )


def _glass(run: ShownRun, export: Export) -> GlassScene:
    """Raises: RtgsError: the model has glass, and no light that it reflects."""
    import numpy as np

    from rtgs.export.environment import bake_environment
    from rtgs.export.glass import glass_part
    from rtgs.export.page import GlassScene

    part = glass_part(run.method)
    assert part is not None
    assert part.guide is not None
    assert export.glass is not None
    mesh = part.guide.mesh
    low, high = mesh.bounds
    center = (low + high) / 2
    near = _OUTSIDE * float(np.linalg.norm(high - low)) / 2 / 3**0.5
    environment = bake_environment(run.method, run.step, center, near, export.frame)
    if environment is None:
        raise RtgsError(f"{run.folder.name}: its glass has no set of reflections; format=ply shows the model as it is")
    linear = run.method.settings.optics.blend == "linear"
    return GlassScene(export.glass, environment, mesh.inside(export.splats.means), center, linear)
