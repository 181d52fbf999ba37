"""Pictures of the report: maps in colour, encoded images, training curves as SVG."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.evaluate.images import colorize
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.triangles import TriangleMesh

DEPTH_COLORMAP = "turbo"
MASK_COLOR = (60, 220, 230)  # cyan: no colour of the error map
_ROUNDS = ("-", "--", ":")  # lines of curves that share a colour
_LEGEND_ROW = 0.17  # inches
_FEW_DECADES = 1.5  # of a logarithmic axis, below which 2 and 5 are labelled as well
_LEGEND_WIDTH, _LEGEND_HANDLE = 72, 5  # characters of a legend's row; a line and its gaps take as much as so many
COVERED = 0.5  # alpha from which a pixel counts when the depth range is chosen
DEPTH_QUANTILES = (0.02, 0.98)
# Colours of the curves: blue, orange, green, red-violet, grey; told apart on light and dark grounds.
SERIES_COLORS = ("#3b7dd8", "#d9822b", "#3a9c6b", "#b0508f", "#7c8794")
_INK, _GRID = "#010203", "#040506"  # place holders in the SVG, replaced by the page's own colours


@dataclass(frozen=True)
class Curve:
    """One series over training steps."""

    name: str
    steps: tuple[int, ...]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.steps) != len(self.values):
            raise ValueError(f"curve {self.name!r}: {len(self.steps)} steps and {len(self.values)} values")


@dataclass(frozen=True)
class DepthPicture:
    """A coloured depth map and the range of its colours."""

    pixels: np.ndarray  # (H, W, 3) uint8
    near: float  # world units
    far: float


def depth_picture(
    depth: Tensor, alpha: Tensor | None = None, limits: tuple[float, float] | None = None
) -> DepthPicture | None:
    """Turbo colours over disparity, near warm and far cold; pixels with alpha below one half stay grey.

    ``depth`` (H, W) is z-depth of the surface (already divided by alpha). The range is ``limits``, near and far in
    world units; None: the 2nd to 98th percentile of the covered pixels. None when no pixel is covered.
    """
    depth = depth.detach().double()
    covered = torch.isfinite(depth) & (depth > 0)
    if alpha is not None:
        covered &= alpha >= COVERED
    if not covered.any():
        return None
    near, far = limits or tuple(float(each) for each in np.quantile(depth[covered].numpy(), DEPTH_QUANTILES))
    if not far > near * (1 + 1e-6):
        near, far = near * 0.99, far * 1.01
    disparity = torch.where(covered, 1 / depth.clamp_min(1e-12), torch.nan)
    return DepthPicture(colorize(disparity, 1 / far, 1 / near, DEPTH_COLORMAP), near, far)


def normal_picture(normal: Tensor, camera: Camera) -> np.ndarray:
    """World normals (3, H, W), any length up to 1, as (H, W, 3) uint8.

    Camera frame in the usual colours: red right, green up, blue towards the viewer; length 0 is mid grey.
    """
    rotation = camera.rotation.to(normal.dtype)
    local = torch.einsum("ij,jhw->ihw", rotation, normal.detach())
    shown = local * torch.tensor([1.0, -1.0, -1.0], dtype=local.dtype).view(3, 1, 1)
    pixels = ((shown * 0.5 + 0.5).clamp(0, 1) * 255).round()
    return pixels.nan_to_num(nan=128.0).to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


def alpha_picture(alpha: Tensor) -> np.ndarray:
    """(H, W) accumulated alpha as grey levels, black 0 and white 1."""
    grey = (alpha.detach().clamp(0, 1) * 255).round().nan_to_num(nan=0.0).to(torch.uint8)
    return grey.unsqueeze(-1).expand(-1, -1, 3).contiguous().numpy()


def outlined(pixels: np.ndarray, mask: Tensor) -> np.ndarray:
    """(H, W, 3) uint8 with the border of ``mask`` (H, W) bool drawn two pixels thick, one on either side."""
    from skimage.segmentation import find_boundaries

    border = find_boundaries(mask.numpy(), mode="thick")
    return np.where(border[..., None], np.array(MASK_COLOR, dtype=np.uint8), pixels)


def mesh_picture(mesh: TriangleMesh, camera: Camera) -> np.ndarray:
    """(H, W, 3) uint8: the mesh as grey clay lit from the camera, back faces tinted red, white where there is none."""
    guide = MeshGuide(mesh, 0.0)
    pair = guide.surfaces(camera)
    normals = mesh.face_normals()
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)
    toward = torch.nn.functional.normalize(camera.rays(torch.float64).directions, dim=-1).numpy()
    facing = np.abs(np.einsum("hwc,hwc->hw", normals[pair.near_triangle.numpy()], toward))
    clay = np.where(pair.near_back_facing.numpy()[..., None], (0.80, 0.45, 0.42), (0.74, 0.76, 0.80))
    shaded = clay * (0.25 + 0.75 * facing)[..., None]
    return (np.where(pair.hit.numpy()[..., None], shaded, 1.0) * 255).round().astype(np.uint8)


def image_bytes(pixels: np.ndarray, long_side: int, quality: int) -> bytes:
    """JPEG of (H, W, 3) uint8, shrunk by area averaging to ``long_side`` at most; never enlarged."""
    from PIL import Image

    picture = Image.fromarray(pixels)
    scale = long_side / max(picture.size)
    if scale < 1:
        size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
        picture = picture.resize(size, Image.Resampling.BOX)
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=quality, subsampling=0)
    return buffer.getvalue()


def data_uri(content: bytes, media_type: str = "image/jpeg") -> str:
    """The bytes as an address that needs no file and no network."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}"


def colorbar_uri(colormap: str) -> str:
    """A horizontal bar of a colour map, low on the left, as a data address."""
    from PIL import Image

    ramp = colorize(torch.linspace(0, 1, 128).expand(4, 128), 0.0, 1.0, colormap)
    buffer = io.BytesIO()
    Image.fromarray(ramp).save(buffer, "PNG")
    return data_uri(buffer.getvalue(), "image/png")


def curve_svg(curves: Sequence[Curve], *, label: str, log: bool = False) -> str:
    """One panel of curves over the training step as an inline SVG in the page's colours.

    Values that are not finite (or not positive on a logarithmic axis) leave gaps. Empty when nothing can be drawn.
    """
    import matplotlib
    from matplotlib.figure import Figure

    drawable = [curve for curve in curves if any(_shown(value, log) for value in curve.values)]
    if not drawable:
        return ""
    with matplotlib.rc_context():
        matplotlib.rcParams["svg.fonttype"] = "none"
        matplotlib.rcParams["svg.hashsalt"] = label
        matplotlib.rcParams["font.family"] = "sans-serif"
        matplotlib.rcParams["font.size"] = 8.5
        names = [curve.name for curve in drawable]
        rows = math.ceil(len(names) / _legend_columns(names)) if len(names) > 1 else 0
        figure = Figure(figsize=(4.1, 2.5 + _LEGEND_ROW * rows), layout="constrained")
        figure.patch.set_alpha(0)
        axes = figure.add_subplot()
        for index, curve in enumerate(drawable):
            values = [value if _shown(value, log) else math.nan for value in curve.values]
            marker = "o" if len(values) < 12 else ""
            color = SERIES_COLORS[index % len(SERIES_COLORS)]
            style = _ROUNDS[index // len(SERIES_COLORS) % len(_ROUNDS)]
            axes.plot(curve.steps, values, style, color=color, lw=1.5, marker=marker, ms=3.5, label=curve.name)
        _style(axes, label, log)
        if len(drawable) > 1:
            figure.legend(
                frameon=False,
                labelcolor=_INK,
                fontsize=7.5,
                handlelength=1.0,
                handletextpad=0.5,
                ncols=_legend_columns(names),
                columnspacing=0.9,
                loc="outside lower left",
            )
        buffer = io.StringIO()
        no_metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))  # RDF, full of addresses
        figure.savefig(buffer, format="svg", metadata=no_metadata, transparent=True)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = svg.replace(_INK, "var(--ink-soft)").replace(_GRID, "var(--line)")
    about = (
        f"{label} over the training step: {', '.join(names)}" if len(names) > 1 else f"{label} over the training step"
    )
    return svg.replace("<svg ", f'<svg role="img" aria-label="{html.escape(about)}" ', 1)


def _legend_columns(names: Sequence[str]) -> int:
    """As many as fit into one row of a legend, so that the axes keep their room however many curves there are."""
    widest = max(map(len, names)) + _LEGEND_HANDLE
    return max(1, min(len(names), _LEGEND_WIDTH // widest))


def _shown(value: float, log: bool) -> bool:
    return math.isfinite(value) and (value > 0 or not log)


def _style(axes, label: str, log: bool) -> None:
    """Quiet axes: a light grid, no box."""
    from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, MaxNLocator, NullLocator

    if log:
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        decades = math.log10(high / low)
        subs = (1.0, 2.0, 5.0) if decades < _FEW_DECADES else (1.0,)  # labels keep apart
        axes.yaxis.set_major_locator(LogLocator(subs=subs, numticks=8))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
        axes.yaxis.set_minor_locator(NullLocator())
    else:
        axes.yaxis.set_major_locator(MaxNLocator(5))
        low, high = axes.get_ylim()
        if max(abs(low), abs(high)) >= 10_000:
            axes.yaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_xlabel("step", color=_INK)
    axes.set_title(label, loc="left", color=_INK, fontsize=9.5)
    axes.grid(True, which="major", color=_GRID, lw=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", colors=_INK, length=0)
    axes.patch.set_alpha(0)
    for spine in axes.spines.values():
        spine.set_visible(False)
