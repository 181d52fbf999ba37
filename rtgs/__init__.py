"""rtgs: Gaussian models of scenes with glass and mirrors, on the CPU.

What a user of the library imports. A name is looked up when it is first used, so ``import rtgs`` loads no torch.
``examples/`` shows each name at work, docs/api.md describes it.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from rtgs.core.version import VERSION as __version__

if TYPE_CHECKING:
    from rtgs.core.cameras import Camera, Rays
    from rtgs.core.errors import RtgsError
    from rtgs.evaluate.images import to_bytes, write_png
    from rtgs.evaluate.metrics import psnr
    from rtgs.gaussians.activate import activate_gaussians
    from rtgs.gaussians.ellipsoids import Ellipsoids
    from rtgs.gaussians.initialize import gaussians_from_points
    from rtgs.gaussians.ply import read_gaussians, write_ply
    from rtgs.gaussians.settings import InitSettings
    from rtgs.gaussians.surfels import ActivatedGaussians, Surfels
    from rtgs.methods import create_method
    from rtgs.methods.model import Model
    from rtgs.methods.settings import MethodSettings
    from rtgs.render.buffers import (
        EllipsoidBuffers,
        EllipsoidOptions,
        RasterBuffers,
        RasterOptions,
        TraceBuffers,
        TraceOptions,
    )
    from rtgs.render.ellipsoids import rasterize_ellipsoids
    from rtgs.render.orbit import Orbit, Picture, orbit_cameras, orbit_of_cameras
    from rtgs.render.rasterization import rasterization, rasterization_2dgs
    from rtgs.render.splats import render_splats
    from rtgs.render.surfels import rasterize_surfels
    from rtgs.render.trace import SurfelTree, trace_surfels
    from rtgs.runs.shown import LayeredView, ShownRun, load
    from rtgs.scenes.scene import Scene, View, load_scene
    from rtgs.scenes.settings import SceneSettings
    from rtgs.train.method import Mode, RenderedView, RenderOptions
    from rtgs.train.seeds import generator_for
    from rtgs.train.settings import LossSettings, ScheduleSettings
    from rtgs.train.terms import LossTerm
    from rtgs.train.trainer import Trainer, TrainSummary

__all__ = [
    "ActivatedGaussians",
    "Camera",
    "EllipsoidBuffers",
    "EllipsoidOptions",
    "Ellipsoids",
    "InitSettings",
    "LayeredView",
    "LossSettings",
    "LossTerm",
    "MethodSettings",
    "Mode",
    "Model",
    "Orbit",
    "Picture",
    "RasterBuffers",
    "RasterOptions",
    "Rays",
    "RenderOptions",
    "RenderedView",
    "RtgsError",
    "Scene",
    "SceneSettings",
    "ScheduleSettings",
    "ShownRun",
    "SurfelTree",
    "Surfels",
    "TraceBuffers",
    "TraceOptions",
    "TrainSummary",
    "Trainer",
    "View",
    "__version__",
    "activate_gaussians",
    "create_method",
    "gaussians_from_points",
    "generator_for",
    "load",
    "load_scene",
    "orbit_cameras",
    "orbit_of_cameras",
    "psnr",
    "rasterization",
    "rasterization_2dgs",
    "rasterize_ellipsoids",
    "rasterize_surfels",
    "read_gaussians",
    "render_splats",
    "to_bytes",
    "trace_surfels",
    "write_ply",
    "write_png",
]
REACHES = ()  # the front door: no step and no room comes in by it

_PLACES = {
    "rtgs.core.cameras": "Camera Rays",
    "rtgs.core.errors": "RtgsError",
    "rtgs.evaluate.images": "to_bytes write_png",
    "rtgs.evaluate.metrics": "psnr",
    "rtgs.gaussians.activate": "activate_gaussians",
    "rtgs.gaussians.ellipsoids": "Ellipsoids",
    "rtgs.gaussians.initialize": "gaussians_from_points",
    "rtgs.gaussians.ply": "read_gaussians write_ply",
    "rtgs.gaussians.settings": "InitSettings",
    "rtgs.gaussians.surfels": "ActivatedGaussians Surfels",
    "rtgs.methods": "create_method",
    "rtgs.methods.model": "Model",
    "rtgs.methods.settings": "MethodSettings",
    "rtgs.render.buffers": ("EllipsoidBuffers EllipsoidOptions RasterBuffers RasterOptions TraceBuffers TraceOptions"),
    "rtgs.render.ellipsoids": "rasterize_ellipsoids",
    "rtgs.render.orbit": "Orbit Picture orbit_cameras orbit_of_cameras",
    "rtgs.render.rasterization": "rasterization rasterization_2dgs",
    "rtgs.render.splats": "render_splats",
    "rtgs.render.surfels": "rasterize_surfels",
    "rtgs.render.trace": "SurfelTree trace_surfels",
    "rtgs.runs.shown": "LayeredView ShownRun load",
    "rtgs.scenes.scene": "Scene View load_scene",
    "rtgs.scenes.settings": "SceneSettings",
    "rtgs.train.method": "Mode RenderOptions RenderedView",
    "rtgs.train.seeds": "generator_for",
    "rtgs.train.settings": "LossSettings ScheduleSettings",
    "rtgs.train.terms": "LossTerm",
    "rtgs.train.trainer": "TrainSummary Trainer",
}
"""Names by the module that defines them, as in the imports for type checkers above; a test compares the two."""
_MODULE_OF = {name: module for module, names in _PLACES.items() for name in names.split()}

if not TYPE_CHECKING:  # else a type checker would believe any name

    def __getattr__(name: str) -> object:
        if name not in _MODULE_OF:
            raise AttributeError(f"module 'rtgs' has no attribute {name!r}; it exports {', '.join(__all__)}")
        value = getattr(import_module(_MODULE_OF[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
