"""Lenses: every camera model COLMAP knows, used directly when it is a pinhole and undistorted when it is not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from rtgs.core.refuse import shown
from rtgs.scenes.settings import CaptureError

# model -> how many leading parameters are a pinhole's; the rest is distortion that vanishes when it is zero.
_PINHOLE_PARAMETERS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 3,
    "RADIAL": 3,
    "OPENCV": 4,
    "FULL_OPENCV": 4,
    "SIMPLE_DIVISION": 3,
    "DIVISION": 4,
}
_TWO_FOCALS = {model for model, count in _PINHOLE_PARAMETERS.items() if count == 4} | {
    "OPENCV_FISHEYE",
    "FOV",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "FISHEYE",
    "EUCM",
}
MAX_SIDE = 65_535
"""Pixels; of the longest side of a photo. JPEG ends there."""
_FOCAL_RANGE = (1e-3, 1e4)  # of a lens, in long sides of its picture; phones have 0.7, a fisheye 0.3, a telescope 100
_CENTER_RANGE = 100.0  # sides that the principal point of a crop may be off
ENLARGED = 8.0
"""Times a photo may be larger than its camera says."""
_PROBE_SIDE = 128  # pixels; long side at which a lens is tried out
_MAX_OUTSIDE_SHARE = 0.01  # of the undistorted pixels; above it the lens parameters cannot be right


@dataclass(frozen=True)
class Lens:
    """A camera model in COLMAP's names and parameter order, for images of ``width`` x ``height`` pixels.

    Pixel centres lie at (i + 0.5, j + 0.5), COLMAP's convention.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def is_pinhole(self) -> bool:
        """True when no resampling is needed: a pinhole model, or one whose distortion is zero."""
        count = _PINHOLE_PARAMETERS.get(self.model)
        return count is not None and not any(self.params[count:])

    def pinhole(self) -> Lens:
        """The PINHOLE lens (fx, fy, cx, cy) of the undistorted image.

        Raises:
            CaptureError: the lens sees all around (EQUIRECTANGULAR) or cannot be undistorted.
        """
        if self.is_pinhole:
            if _PINHOLE_PARAMETERS[self.model] == 3:
                focal, cx, cy = self.params[:3]
                return Lens("PINHOLE", self.width, self.height, (focal, focal, cx, cy))
            return Lens("PINHOLE", self.width, self.height, self.params[:4])
        return undistorted_lens(self)

    def resized(self, width: int, height: int) -> Lens:
        """The lens for the same photo resized to ``width`` x ``height``; pixel edges are kept."""
        if (width, height) == (self.width, self.height):
            return self
        if self.is_pinhole:
            sx, sy = width / self.width, height / self.height
            fx, fy, cx, cy = self.pinhole().params
            return Lens("PINHOLE", width, height, (fx * sx, fy * sy, cx * sx, cy * sy))
        camera = _colmap_camera(self)
        camera.rescale(width, height)
        return replace(self, width=width, height=height, params=tuple(float(p) for p in camera.params))

    def fitted(self, width: int, height: int, name: str) -> Lens:
        """The lens for an image found on disk, which may be an enlarged or shrunk copy (``images_4``).

        Raises:
            CaptureError: the aspect ratios differ by more than the rounding of one pixel.
        """
        if (width, height) == (self.width, self.height):
            return self
        scale = (width / self.width + height / self.height) / 2
        if scale > ENLARGED:
            raise CaptureError(
                f"image {name} is {width}x{height} pixels, its camera {self.width}x{self.height}: copies may be up to "
                f"{ENLARGED:g} times larger; use the images the poses were computed from"
            )
        if abs(width - scale * self.width) > 1 or abs(height - scale * self.height) > 1:
            raise CaptureError(
                f"image {name} is {width}x{height} pixels, its camera {self.width}x{self.height}: the aspect ratios "
                "differ, so the image was cropped, rotated or belongs to another camera; "
                "use the images the poses were computed from"
            )
        return self.resized(width, height)


def refuse_size(width: float, height: float, where: str) -> None:
    """Refuse pictures that no camera takes.

    Raises:
        CaptureError: a side that is no whole number of 1 to :data:`MAX_SIDE` pixels; ``where`` says who gives it.
    """
    if not all(1 <= side <= MAX_SIDE for side in (width, height)):
        raise CaptureError(
            f"{where}: image size {shown(width)}x{shown(height)}: sides are 1 to {MAX_SIDE} pixels; calibrate again"
        )


def check_lens(lens: Lens, name: str) -> str | None:
    """What is wrong with a lens, or None. ``name`` is where it comes from."""
    if not np.isfinite(lens.params).all():
        return f"camera of {name}: parameters {lens.params} hold NaN or inf"
    try:
        refuse_size(lens.width, lens.height, f"camera of {name}")
    except CaptureError as error:
        return str(error)
    if lens.model != "EQUIRECTANGULAR" and lens.params[0] <= 0:
        return f"camera of {name}: focal length {lens.params[0]} is not positive"
    if not lens.is_pinhole and lens.model != "EQUIRECTANGULAR" and (wrong := _absurd(lens)):
        return f"camera of {name}: {wrong}"
    try:
        pinhole = lens.pinhole()
    except CaptureError as error:
        return str(error)
    if min(pinhole.params[:2]) <= 0:
        return f"camera of {name}: focal lengths {pinhole.params[:2]} must be positive"
    if wrong := _absurd(pinhole):
        return f"camera of {name}: {wrong}"
    if not lens.is_pinhole:
        scale = min(1.0, _PROBE_SIDE / max(lens.width, lens.height))
        try:
            undistortion_map(lens.resized(max(2, round(lens.width * scale)), max(2, round(lens.height * scale))))
        except CaptureError as error:
            return str(error)
    return None


def _absurd(lens: Lens) -> str:
    """What of focal length and principal point no lens has, before a library computes with it; empty: nothing."""
    side = max(lens.width, lens.height)
    count = 2 if lens.model in _TWO_FOCALS else 1
    low, high = (share * side for share in _FOCAL_RANGE)
    if wrong := [focal for focal in lens.params[:count] if not low <= focal <= high]:
        return f"focal length {wrong[0]:g} is not plausible for {lens.width}x{lens.height} pixels ({low:g} to {high:g})"
    center = lens.params[count : count + 2]
    if any(abs(place) > _CENTER_RANGE * side for place in center):
        return f"principal point {center} lies far from the {lens.width}x{lens.height} photo"
    return ""


@lru_cache(maxsize=256)
def undistorted_lens(lens: Lens) -> Lens:
    """COLMAP's choice of the PINHOLE lens that covers a distorted image without blank pixels.

    Raises:
        CaptureError: spherical lenses, and parameters COLMAP cannot undistort.
    """
    from rtgs.core.colmap import pycolmap

    camera = _colmap_camera(lens)
    if lens.model == "EQUIRECTANGULAR":
        raise CaptureError(
            "camera model EQUIRECTANGULAR sees all around, no single pinhole image can hold it: cut the panoramas "
            "into perspective images first (colmap's panorama_sfm example does) and import those"
        )
    try:
        target = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    except (RuntimeError, ValueError) as error:
        raise CaptureError(f"camera {lens.model} {lens.params} cannot be undistorted: {str(error)[:200]}") from error
    params = tuple(float(p) for p in target.params)
    if target.model_name not in ("PINHOLE", "SIMPLE_PINHOLE") or not np.isfinite(params).all():
        raise CaptureError(
            f"camera {lens.model} {lens.params} cannot be undistorted to a pinhole: check its parameters"
        )
    return Lens(target.model_name, int(target.width), int(target.height), params).pinhole()


@lru_cache(maxsize=2)
def undistortion_map(lens: Lens) -> np.ndarray:
    """Column and row in the distorted image of each pixel of the undistorted one: (2, H, W) float32.

    They are array indices (pixel centres at integers), as ``cv2.remap`` wants them.

    Raises:
        CaptureError: more than 1 % of the undistorted pixels fall outside the photo or where the model folds over.
    """
    target = lens.pinhole()
    fx, fy, cx, cy = target.params
    camera = _colmap_camera(lens)
    x = (np.arange(target.width, dtype=np.float64) + 0.5 - cx) / fx
    result = np.empty((2, target.height, target.width), dtype=np.float32)
    ray = np.ones((target.width, 3))
    ray[:, 0] = x
    with np.errstate(over="ignore", invalid="ignore"):  # what lies beyond float32 is not valid
        for row in range(target.height):
            ray[:, 1] = (row + 0.5 - cy) / fy
            result[:, row] = np.asarray(camera.img_from_cam(ray)).T - 0.5
        bad_share = 1 - float(_valid(result, lens).mean())
    if not bad_share <= _MAX_OUTSIDE_SHARE:
        raise CaptureError(
            f"camera {lens.model} {lens.params}: {bad_share:.1%} of the undistorted pixels fall outside the "
            f"{lens.width}x{lens.height} photo or where the distortion folds over; the parameters are not plausible, "
            "calibrate again"
        )
    return result


def _valid(grid: np.ndarray, lens: Lens) -> np.ndarray:
    """(H, W) bool: the pixel comes from inside the photo, and the map keeps its orientation around it."""
    inside = (grid >= -1).all(0) & (grid[0] <= lens.width) & (grid[1] <= lens.height)
    if min(inside.shape) < 2:
        return inside
    down, right = np.gradient(grid, axis=(1, 2))
    return inside & (right[0] * down[1] - right[1] * down[0] > 0)


def project(lens: Lens, local: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of the distorted image, centres at i + 0.5, of points (N, 3) before the camera (x, y, z > 0)."""
    if lens.is_pinhole:
        fx, fy, cx, cy = lens.pinhole().params
        return local[:, :2] / local[:, 2:] * (fx, fy) + (cx, cy)
    return np.asarray(_colmap_camera(lens).img_from_cam(local / local[:, 2:])).reshape(-1, 2)


def unproject(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Rays (N, 3) with z = 1 of pixels (N, 2) of the distorted image, centres at i + 0.5: :func:`project` undone."""
    if lens.is_pinhole:
        fx, fy, cx, cy = lens.pinhole().params
        plane = (np.asarray(pixels, dtype=np.float64) - (cx, cy)) / (fx, fy)
    else:
        points = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 2)
        plane = np.asarray(_colmap_camera(lens).cam_from_img(points), dtype=np.float64).reshape(-1, 2)
    return np.column_stack([plane, np.ones(len(plane))])


def undistort_image(image: np.ndarray, lens: Lens) -> np.ndarray:
    """Resample a float32 photo (H, W, C) to the pinhole of ``lens`` by bilinear interpolation; edge pixels repeat."""
    if lens.is_pinhole:
        return image
    import cv2

    grid = undistortion_map(lens)
    return cv2.remap(image, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def undistort_nearest(image: np.ndarray, lens: Lens) -> np.ndarray:
    """Resample a mask (H, W) to the pinhole of ``lens`` by the nearest pixel."""
    if lens.is_pinhole:
        return image
    grid = undistortion_map(lens)
    column = np.clip(np.rint(grid[0]), 0, lens.width - 1).astype(np.intp)
    row = np.clip(np.rint(grid[1]), 0, lens.height - 1).astype(np.intp)
    return image[row, column]


def _colmap_camera(lens: Lens) -> Any:
    from rtgs.core.colmap import pycolmap

    try:
        camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
    except (RuntimeError, ValueError, TypeError) as error:
        raise CaptureError(
            f"camera model {shown(lens.model)} with parameters {shown(lens.params)}: {str(error)[:200]}"
        ) from error
    if not camera.verify_params():
        raise CaptureError(f"camera model {lens.model} takes {camera.params_info}, got {len(lens.params)} numbers")
    return camera
