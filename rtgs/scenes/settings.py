"""Where a capture lies and how it becomes a Scene: the schema of the ``scene`` config group, a frozen dataclass."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.errors import RtgsError
from rtgs.core.recipe import UNLESS_DEFAULT
from rtgs.core.refuse import refuse_below, refuse_unknown_words, refuse_unless

CaptureFormat = Literal["auto", "colmap", "transforms", "blender"]
NormalFrame = Literal["opencv", "opengl"]


class CaptureError(RtgsError):
    """A capture that cannot be read. The message says what is wrong, where, and what to do about it."""


@dataclass(frozen=True)
class SceneSettings:
    """Import settings of one capture. Every relative path is relative to ``path``.

    Raises
    ------
    RtgsError
        A value outside its documented range (a misspelt format, a negative size).
    """

    name: str = "scene"
    """Name of the scene in tables, folders and logs."""
    path: str = ""
    """Folder of the capture, or ``embedded:<name>`` for a capture shipped with rtgs."""
    format: CaptureFormat = "auto"
    """``colmap``, ``transforms`` (nerfstudio), ``blender`` (synthetic), or ``auto``: the first of the three found."""
    long_side: int | None = None
    """Long side of the views in pixels, reached by area averaging; never enlarged. None: the photo's own size."""
    resize_ratio: float | None = None
    """A factor in (0, 1] on width and height, truncated by int() as EnvGS does (method.md 8.1: 0.25 for Ref-Real);
    with a ``long_side`` as well, as the presets set it, the smaller size of the two."""
    split_every: int = 8
    """Views whose index in name order is divisible by it are test views (method.md 8.1). 0: no test views."""
    split_file: str | None = None
    """JSON with lists ``train`` and ``test`` of image names; goes before the format's own split and ``split_every``.
    Without ``train`` every other view is for training; views in neither list are left out."""
    images_dir: str | None = None
    """Folder of the photos (COLMAP). None: ``images``, ``input``, ``rgb``, the largest ``images_<N>``, or ``path``."""
    model_dir: str | None = None
    """Folder of the COLMAP model. None: sparse/0, sparse, colmap/sparse/0, colmap/sparse, or ``path``."""
    masks_dir: str = "masks"
    """Folder of ``<image stem>.png`` or ``<image name>.png``, non-zero = transparent object (method.md 7).
    Empty string: ignore masks."""
    normals_dir: str = "normals"
    """Folder of ``<image stem>.png`` (2 rgb - 1) or ``.npy`` ((H, W, 3)) camera-frame normals. Empty string: ignore."""
    normals_frame: NormalFrame = "opencv"
    """Axes of the stored normals: ``opencv`` x right, y down, z forward (rtgs's own) or ``opengl`` x right, y up,
    z backward."""
    max_views: int | None = None
    """At most this many views, spread evenly over name order, chosen before the split. None: all."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour (0..1) behind images with an alpha channel; use the renderer's background."""
    points: Literal["auto", "random"] = "auto"
    """``auto``: the capture's points, random ones where the format carries none (Blender, transforms.json without a
    point file); a COLMAP model without points is refused. ``random``: random points always."""
    random_points: int = 20_000
    """How many random points, if random points are drawn."""
    random_box: float | None = None
    """Half side of the cube random points fill, in world units. None: 1.3 for Blender (as 3DGS), otherwise the mean
    distance of the cameras to the point they look at, around which the cube is centred."""
    min_points: int = 10
    """A capture with fewer usable points is refused."""
    min_track_length: int = 0
    """COLMAP points seen in fewer images are dropped. 0: keep all."""
    max_point_error: float | None = None
    """COLMAP points with a larger mean reprojection error in pixels are dropped. None: keep all."""
    near_camera: float = 1e-2
    """Points nearer than this times the scene extent to a camera centre are dropped (method.md 13, 14)."""
    far_factor: float = 30.0
    """Points farther from the cameras' mean than this times the 90th percentile of that distance are dropped as
    mis-triangulated. 0: keep all."""
    seed: int = 0
    """Seed of random points."""
    hold_out: int = field(default=0, metadata=UNLESS_DEFAULT)
    """About every n-th training view is neither trained on nor a test view, spread evenly; at least 2, at most 12, and
    none of fewer than 8. 0: none. The judge compares methods on them (``judge.every``) and then trains on them."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "background", tuple(float(c) for c in self.background))
        refuse_unknown_words(self, "scene")
        colour = len(self.background) == 3 and all(0 <= c <= 1 for c in self.background)
        refuse_unless(colour, "scene.background", self.background, "three numbers between 0 and 1")
        ratio = self.resize_ratio
        refuse_unless(ratio is None or 0 < ratio <= 1, "scene.resize_ratio", ratio, "in (0, 1]")
        for key, least in (("long_side", 1), ("max_views", 1), ("max_point_error", 0), ("random_box", 0)):
            refuse_below(f"scene.{key}", getattr(self, key), least)
        for key in ("split_every", "min_points", "min_track_length", "near_camera", "far_factor", "hold_out"):
            refuse_below(f"scene.{key}", getattr(self, key), 0)
        refuse_below("scene.random_points", self.random_points, 1)
