"""Ground truth of path-traced views: exact geometry, and the image split into light paths; one folder of PNGs a view.

``truth/<image stem>/`` holds (H, W) pictures of the photo's size; nothing is pickled, every viewer opens them:

| file | content | precision |
|---|---|---|
| ``depth.png``, ``second_depth.png`` | 16-bit grey x ``scale`` (text chunk, metres a step): z-depth, 0 = nothing | half a level of 8,191: 1/16382 of the view's largest depth |
| ``normal.png`` | 8-bit RGB, 2 rgb / 255 - 1, camera frame (x right, y down, z forward); black = nothing | 0.4 degrees at most |
| ``objects.png`` | 8-bit grey: shape id + 1, 0 = nothing | exact |
| ``specular.png`` | 1 bit: mirror, glossy or glass | exact |
| ``diffuse.png``, ``reflected.png``, ``transmitted.png`` | 8-bit sRGB curve of light / ``scale`` (text chunk, a power of two) | half a step of 8 bits; the brightest 0.1 % of a layer may be clipped at ``scale`` |
| ``inner.png``, ``contents.png``, ``behind.png`` | likewise, nothing clipped: together ``transmitted``; all three, or none in captures that do not tell them apart | half a step of 8 bits |
"""  # noqa: E501

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from PIL import Image, PngImagePlugin
from torch import Tensor

from rtgs.scenes.images import READ_ERRORS, nearest_resize, open_picture, refuse_pixels
from rtgs.scenes.settings import CaptureError
from rtgs.scenes.truth_files import GLASS_MAPS, truth_files

LAYERS = ("diffuse", "reflected", "transmitted")
_DEPTHS = ("depth", "second_depth")
_DEPTH_LEVELS = 8191  # finer ones would be half of a shipped capture's truth, and say nothing that 13 bits do not
_LEVEL_STEP = 8  # 8,191 levels over 16 bits, so that a viewer shows them
_LARGEST_SCALE = 16.0  # of a layer; brighter light is clipped
_CLIPPED_SHARE = 1e-3  # of a layer's pixels that may be, so that a few sparks do not coarsen the rest


@dataclass(frozen=True)
class ViewTruth:
    """What is truly seen in one view."""

    depth: Tensor  # (H, W) float32 z-depth of the first surface, glass included; 0 where nothing
    second_depth: Tensor  # (H, W) float32 z-depth of the next surface on the same straight ray; 0 where none
    normal: Tensor  # (3, H, W) float32 unit normal of the first surface, camera frame, facing it; 0 where nothing
    objects: Tensor  # (H, W) int16 id of the shape of the first surface, -1 where nothing
    specular: Tensor  # (H, W) bool: the first surface is mirror, glossy or glass
    diffuse: Tensor  # (3, H, W) float32 linear light x exposure: neither of the two below
    reflected: Tensor  # (3, H, W) float32 linear light x exposure: reflected specularly by the first surface
    transmitted: Tensor  # (3, H, W) float32 linear light x exposure: come through the first surface
    # Parts of the transmitted light, (3, H, W) float32 each, all three or none: the capture does not tell them apart.
    inner: Tensor | None = None  # mirrored at glass after the first surface: off the inside of the far wall
    contents: Tensor | None = None  # straight from what is inside the glass
    behind: Tensor | None = None  # straight through the glass

    @property
    def image(self) -> Tensor:
        """(3, H, W) float32: the layers' sum, clipped and sRGB encoded, as the photo is."""
        total = self.diffuse + self.reflected + self.transmitted
        return torch.from_numpy(srgb_from_linear(total.numpy())).float()

    def tensors(self) -> dict[str, Tensor]:
        """Every field by its name, but the unknown ones."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def resized(self, width: int, height: int) -> ViewTruth:
        """Shrunk like its photo: light is averaged over area, geometry is taken at the new pixels' centres (an average
        over an edge would be a depth where nothing is)."""
        if self.depth.shape == (height, width):
            return self
        light = {name: value for name, value in self.tensors().items() if name in (*LAYERS, *GLASS_MAPS)}
        nearest = {name: _nearest(value, width, height) for name, value in self.tensors().items() if name not in light}
        return ViewTruth(**nearest, **{name: _averaged(value, width, height) for name, value in light.items()})


def _nearest(values: Tensor, width: int, height: int) -> Tensor:
    if values.ndim == 2:
        return torch.from_numpy(nearest_resize(values.numpy(), width, height).copy())
    return torch.stack([_nearest(channel, width, height) for channel in values])


def _averaged(light: Tensor, width: int, height: int) -> Tensor:
    from rtgs.scenes.images import area_resize

    picture = area_resize(np.ascontiguousarray(light.numpy().transpose(1, 2, 0)), width, height)
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)))


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """The sRGB curve (IEC 61966-2-1) of light clipped to 0..1, float64."""
    x = np.clip(linear.astype(np.float64), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-12) ** (1 / 2.4) - 0.055)


def linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """Inverse of :func:`srgb_from_linear` on 0..1, float64."""
    y = encoded.astype(np.float64)
    return np.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4)


def write_truth(folder: Path, truth: ViewTruth) -> None:
    """Write the pictures of one view into ``folder`` (made if missing).

    Raises:
        ValueError: more than 254 shapes, which 8 bits cannot tell apart; some parts of the transmitted light, not all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in _DEPTHS:
        depth = getattr(truth, name).numpy()
        scale = float(depth.max()) / (_DEPTH_LEVELS * _LEVEL_STEP) or 1.0
        levels = np.maximum(np.rint(depth / (scale * _LEVEL_STEP)), depth > 0).astype(np.uint16)
        _save(folder / f"{name}.png", levels * np.uint16(_LEVEL_STEP), scale)
    normal = truth.normal.numpy().transpose(1, 2, 0)
    encoded = np.rint((normal + 1) * 127.5) * (np.abs(normal).max(-1, keepdims=True) > 0)
    _save(folder / "normal.png", encoded.astype(np.uint8))
    objects = truth.objects.numpy()
    if objects.max(initial=-1) > 254:
        raise ValueError(f"truth {folder} holds shape id {objects.max()}: the format tells 255 shapes apart")
    _save(folder / "objects.png", (objects + 1).astype(np.uint8))
    _save(folder / "specular.png", truth.specular.numpy())
    for name in LAYERS:
        _save_light(folder / f"{name}.png", getattr(truth, name), _CLIPPED_SHARE)
    parts = {name: part for name in GLASS_MAPS if (part := getattr(truth, name)) is not None}
    if parts:
        write_glass(folder, parts)


def write_glass(folder: Path, parts: Mapping[str, Tensor]) -> None:
    """Write the parts of the transmitted light, (3, H, W) each by its name, beside the pictures of their view.

    Raises:
        ValueError: not all of the parts.
    """
    if set(parts) != set(GLASS_MAPS):
        raise ValueError(f"truth {folder} would hold {', '.join(parts)} only: write all of {', '.join(GLASS_MAPS)}")
    for name in GLASS_MAPS:
        _save_light(folder / f"{name}.png", parts[name], 0.0)


def _save_light(path: Path, light: Tensor, clipped_share: float) -> None:
    """``clipped_share``: of the pixels, those that may be brighter than the scale."""
    pixels = light.numpy().transpose(1, 2, 0)
    brightest = float(np.quantile(pixels.max(-1), 1 - clipped_share))
    scale = float(np.clip(2.0 ** np.ceil(np.log2(max(brightest, 1e-6))), 1.0, _LARGEST_SCALE))
    _save(path, np.rint(srgb_from_linear(pixels / scale) * 255).astype(np.uint8), scale)


def _save(path: Path, pixels: np.ndarray, scale: float | None = None) -> None:
    chunk = PngImagePlugin.PngInfo()
    if scale is not None:
        chunk.add_text("scale", repr(scale))
    Image.fromarray(pixels).save(path, optimize=True, pnginfo=chunk)


def read_truth(folder: Path) -> ViewTruth:
    """Read what :func:`write_truth` wrote.

    Raises:
        CaptureError: a file is missing or damaged, lacks its scale, or differs in size from the others.
    """
    loaded = {path.stem: _load(path) for path in truth_files(folder)}
    sizes = {pixels.shape[:2] for pixels, _ in loaded.values()}
    if len(sizes) != 1:
        raise CaptureError(f"truth {folder} has pictures of the sizes {sorted(sizes)}: make the capture again")
    values: dict[str, np.ndarray] = {}
    for name, (pixels, scale) in loaded.items():
        if name in _DEPTHS:
            values[name] = (pixels.astype(np.float64) * _scale(folder / f"{name}.png", scale)).astype(np.float32)
        elif name in (*LAYERS, *GLASS_MAPS):
            values[name] = _light(folder / f"{name}.png", pixels, scale)
    known = loaded["objects"][0] > 0
    normal = loaded["normal"][0] / np.float32(127.5) - 1
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6) * known[..., None]
    values["normal"] = normal.astype(np.float32).transpose(2, 0, 1)
    values["objects"] = loaded["objects"][0].astype(np.int16) - np.int16(1)
    values["specular"] = loaded["specular"][0].astype(bool)
    return ViewTruth(**{name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in values.items()})


def read_light(folder: Path, name: str) -> Tensor:
    """(3, H, W) one layer of light by itself.

    Raises:
        CaptureError: its file is missing or damaged, or lacks its scale.
    """
    path = folder / f"{name}.png"
    return torch.from_numpy(np.ascontiguousarray(_light(path, *_load(path))))


def _light(path: Path, pixels: np.ndarray, scale: str | None) -> np.ndarray:
    if pixels.shape[2:] != (3,):
        raise CaptureError(f"truth {path} is no colour picture: make the capture again")
    return (linear_from_srgb(pixels / 255.0) * _scale(path, scale)).astype(np.float32).transpose(2, 0, 1)


def _load(path: Path) -> tuple[np.ndarray, str | None]:
    try:
        with open_picture(path) as picture:
            refuse_pixels(picture.size, path)
            picture.load()
            return np.asarray(picture), getattr(picture, "text", {}).get("scale")
    except READ_ERRORS as error:
        raise CaptureError(
            f"truth {path} cannot be read ({error}): restore the file, make the capture again, or remove the truth "
            "folder"
        ) from error


def _scale(path: Path, text: str | None) -> float:
    try:
        scale = float(text or "")
    except ValueError as error:
        raise CaptureError(f"truth {path} has no scale in its text chunk ({text!r}): make the capture again") from error
    if not 0 < scale < 1e6:
        raise CaptureError(f"truth {path} has the scale {scale:g} in its text chunk: make the capture again")
    return scale
