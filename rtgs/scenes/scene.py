"""Scene: what training reads. Read-only after import."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.scenes.capture import Capture, CaptureView, PointCloud, raise_errors
from rtgs.scenes.findings import capture_findings
from rtgs.scenes.images import (
    area_resize,
    nearest_resize,
    read_mask,
    read_normals,
    read_photo,
    same_aspect,
    target_size,
    unit_or_zero,
)
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.points import camera_extent, filter_points, random_points, too_few_points
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.splits import choose_split, hold_out, select_views
from rtgs.scenes.synthetic.record import CaptureRecord
from rtgs.scenes.truth import ViewTruth, read_truth
from rtgs.scenes.undistort import Lens, undistort_image, undistort_nearest

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class View:
    """One undistorted photo with its camera."""

    camera: Camera
    image: Tensor  # (3, H, W) float32 in 0..1, the photo's own sRGB encoding
    mask: Tensor | None  # (H, W) bool, True = transparent object
    normal: Tensor | None  # (3, H, W) float32, camera frame (x right, y down, z forward), unit or zero where unknown
    name: str
    truth: ViewTruth | None = None  # of the test views of path-traced captures


@dataclass(frozen=True)
class Scene:
    """Views, points and scale of a capture, in the capture's world frame."""

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: Tensor  # (P, 3) float32
    point_colors: Tensor  # (P, 3) float32 in 0..1
    extent: float  # 1.1 x largest distance of the training cameras to their mean, world units
    source: str  # where it came from: format, split rule, origin of the points
    held: tuple[View, ...] = ()  # neither trained on nor tested: methods are compared on them, then trained
    noise_psnr: float | None = None  # dB of the test photos against noise-free ones, mean; where that is known
    random_points: bool = False  # the points are drawn at random: no photo agrees on them
    pose_error: float | None = None  # pixels of the training views: median standard error of a pose, where it is known
    pseudo: tuple[View, ...] = ()  # pictures of models around the photos, trained on beside them (rtgs.runs.pseudo)

    @property
    def has_masks(self) -> bool:
        """True when any view has a mask."""
        return any(view.mask is not None for view in self.train + self.test)

    @property
    def has_normals(self) -> bool:
        """True when any training view has a normal map."""
        return any(view.normal is not None for view in self.train)

    def summary(self) -> SceneSummary:
        """What the scene consists of, without pictures."""
        views = self.train + self.test
        sizes = sorted({(view.camera.width, view.camera.height) for view in views})
        return SceneSummary(
            name=self.name,
            train_views=len(self.train),
            test_views=len(self.test),
            sizes=tuple(sizes),
            points=len(self.points),
            extent=self.extent,
            masks=sum(view.mask is not None for view in views),
            normals=sum(view.normal is not None for view in views),
            source=self.source,
            held_views=len(self.held),
        )


@dataclass(frozen=True)
class SceneSummary:
    """Figures of a scene for logs, tables and the report."""

    name: str
    train_views: int
    test_views: int
    sizes: tuple[tuple[int, int], ...]  # distinct (width, height)
    points: int
    extent: float
    masks: int  # views with a mask
    normals: int  # views with a normal map
    source: str
    held_views: int = 0

    def __str__(self) -> str:
        sizes = ", ".join(f"{width}x{height}" for width, height in self.sizes[:3])
        sizes += f" and {len(self.sizes) - 3} more sizes" if len(self.sizes) > 3 else ""
        held = f"{self.held_views} more held out, " if self.held_views else ""
        return (
            f"{self.name}: {self.train_views} training and {self.test_views} test views of {sizes}, {held}"
            f"{self.points} points, extent {self.extent:.4g}, {self.masks} masks, {self.normals} normal maps "
            f"({self.source})"
        )


def load_scene(settings: SceneSettings) -> Scene:
    """Import a capture: read, undistort, shrink and split the photos, filter the points.

    Parameters
    ----------
    settings : SceneSettings
        Where the capture lies and what to make of it.

    Returns
    -------
    Scene
        Training views, test views and points, in the capture's world frame.

    Raises
    ------
    CaptureError
        The capture cannot be trained on; the message lists every problem that was found before reading pixels, or the
        first unreadable file.
    """
    capture = read_capture(settings)
    findings = capture_findings(capture)
    raise_errors(findings, capture.root)
    for finding in findings:
        log.log(logging.WARNING if finding.severity == "warning" else logging.INFO, "%s", finding.message)
    views = select_views(capture, settings)
    split = hold_out(choose_split(capture, [view.name for view in views], settings), settings.hold_out)
    by_name = {view.name: view for view in views}
    inner = (*split.train, *split.held)  # extent and points are those of a run that holds out nothing
    try:
        extent = camera_extent(np.array([by_name[name].center for name in sorted(inner)]).reshape(-1, 3))
    except CaptureError as error:
        raise CaptureError(f"capture {capture.root}: {error}") from error
    used = [by_name[name] for name in (*sorted(inner), *split.test)]
    points, point_source, at_random = _scene_points(capture, settings, used, extent)
    record = CaptureRecord.read(capture.root)
    train = tuple(load_view(by_name[name], settings) for name in split.train)
    scene = Scene(
        name=record.labelled(settings.name) if record else settings.name,
        train=train,
        test=tuple(load_view(by_name[name], settings, with_truth=True) for name in split.test),
        points=torch.from_numpy(points.positions.astype(np.float32)),
        point_colors=torch.from_numpy(points.colors.astype(np.float32)),
        extent=extent,
        held=tuple(load_view(by_name[name], settings) for name in split.held),
        random_points=at_random,
        pose_error=_pose_error(train, by_name),
        noise_psnr=None if record is None else _noise_psnr(record, [by_name[name] for name in split.test], settings),
        source=f"{capture.format}; test views: {split.rule}; points: {point_source}{record.origin if record else ''}",
    )
    log.info("%s", scene.summary())
    return scene


def _pose_error(views: Sequence[View], by_name: Mapping[str, CaptureView]) -> float | None:
    """Median over the views, in their pixels; None: of half of them, or more, it is unknown."""
    known = []
    for view in views:
        told, lens = by_name[view.name].pose_error, by_name[view.name].lens
        if told is not None and lens is not None:
            known.append(told * view.camera.width / lens.width)
    return float(np.median(known)) if 2 * len(known) > len(views) else None


def _noise_psnr(record: CaptureRecord, tests: list[CaptureView], settings: SceneSettings) -> float | None:
    """Of path-traced test photos at the size at which they were rendered; others were averaged, or are other views."""
    size = (record.width, record.height)
    rendered = [view.lens is not None and (view.lens.width, view.lens.height) == size for view in tests]
    shrunk = target_size(*size, settings) != size
    pictures = [view.image.suffix == ".png" for view in tests]  # photos for training are JPEG, and noisier
    return record.noise_psnr if tests and all(rendered) and all(pictures) and not shrunk else None


def _scene_points(
    capture: Capture, settings: SceneSettings, views: list[CaptureView], extent: float
) -> tuple[PointCloud, str, bool]:
    """The points surfels start from, filtered, a line on their origin, and whether they are random."""
    centers = np.array([view.center for view in views])
    at_random = settings.points == "random" or capture.points is None
    if at_random:
        axes = np.array([view.rotation[2] for view in views])
        points = random_points(capture, centers, axes, settings)
        origin = points.source
    else:
        assert capture.points is not None
        points = capture.points
        origin = capture.format
    result = filter_points(points, centers, extent, settings.near_camera, settings.far_factor)
    problem = too_few_points(len(result.points), len(points), points.source, settings.min_points)
    if problem:
        raise CaptureError(f"capture {capture.root}: {problem}")
    return result.points, f"{origin}, {result.summary}", at_random


def load_view(view: CaptureView, settings: SceneSettings, *, with_truth: bool = False) -> View:
    """Read one photo with its mask and normals, and its truth where it is wanted and there; undistort and shrink it.

    Raises:
        CaptureError: an unreadable file, or sizes that do not belong together.
    """
    assert view.lens is not None, "capture_findings refuses views without a lens"
    photo = read_photo(view.image, settings.background, (view.lens.width, view.lens.height))
    lens = view.lens.fitted(photo.shape[1], photo.shape[0], str(view.image))
    pinhole = lens.pinhole()
    width, height = target_size(pinhole.width, pinhole.height, settings)
    image = area_resize(undistort_image(photo, lens), width, height)
    return View(
        camera=_camera(view, pinhole).resized(width, height),
        image=torch.from_numpy(np.ascontiguousarray(np.clip(image, 0.0, 1.0).transpose(2, 0, 1))),
        mask=_load_mask(view, lens, width, height) if view.mask else None,
        normal=_load_normal(view, lens, width, height, settings.normals_frame) if view.normal else None,
        name=view.name,
        truth=_load_truth(view.truth, view, lens, width, height) if view.truth and with_truth else None,
    )


def _camera(view: CaptureView, pinhole: Lens) -> Camera:
    fx, fy, cx, cy = pinhole.params
    left, _, right = np.linalg.svd(view.rotation)  # poses from text files are rotations to a few digits only
    rotation = left @ right
    translation = rotation @ np.linalg.solve(view.rotation, view.translation)  # the camera stays where it was
    return Camera(
        torch.from_numpy(rotation),
        torch.from_numpy(translation),
        fx,
        fy,
        cx,
        cy,
        pinhole.width,
        pinhole.height,
        name=view.name,
    )


def _load_mask(view: CaptureView, lens: Lens, width: int, height: int) -> Tensor:
    assert view.mask is not None
    mask = read_mask(view.mask, (lens.width, lens.height))
    _check_side_size("mask", view, mask, lens)
    full = nearest_resize(mask, lens.width, lens.height)
    return torch.from_numpy(nearest_resize(undistort_nearest(full, lens), width, height).copy())


def _load_normal(view: CaptureView, lens: Lens, width: int, height: int, frame: str) -> Tensor:
    """Normals are averaged like colours, then normalised. Undistortion keeps the camera's axes, so vectors stay."""
    assert view.normal is not None
    normal = read_normals(view.normal, frame, (lens.width, lens.height))
    _check_side_size("normal map", view, normal, lens)
    if not lens.is_pinhole and normal.shape[:2] != (lens.height, lens.width):
        normal = unit_or_zero(_enlarge(normal, lens.width, lens.height))
    normal = undistort_image(normal, lens)
    if normal.shape[0] < height or normal.shape[1] < width:
        normal = _enlarge(normal, width, height)
    normal = unit_or_zero(area_resize(normal, width, height))
    return torch.from_numpy(np.ascontiguousarray(normal.transpose(2, 0, 1)))


def _load_truth(folder: Path, view: CaptureView, lens: Lens, width: int, height: int) -> ViewTruth:
    truth = read_truth(folder)
    size = (truth.depth.shape[1], truth.depth.shape[0])
    if not lens.is_pinhole or size != (lens.width, lens.height):
        raise CaptureError(
            f"truth {folder} is of a {size[0]}x{size[1]} pinhole image, its photo {view.image} is {lens.width}x"
            f"{lens.height} with a {lens.model} lens: truth belongs to the very photo it was made with; remove it"
        )
    return truth.resized(width, height)


def _enlarge(image: np.ndarray, width: int, height: int) -> np.ndarray:
    import cv2

    return cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)


def _check_side_size(kind: str, view: CaptureView, pixels: np.ndarray, lens: Lens) -> None:
    size = (pixels.shape[1], pixels.shape[0])
    if not same_aspect(size, (lens.width, lens.height)):
        path = view.mask if kind == "mask" else view.normal
        raise CaptureError(
            f"{kind} {path} is {size[0]}x{size[1]}, its photo {view.image} {lens.width}x{lens.height}: the aspect "
            f"ratios differ; make the {kind} from this very photo"
        )
