"""A described scene as an ordinary COLMAP capture: images/, sparse/0, masks/, normals/ and truth/."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtgs.cameras import Camera
from rtgs.scenes.synthetic.description import SceneDescription
from rtgs.scenes.synthetic.geometry import sample_surface
from rtgs.scenes.synthetic.render import Geometry, PathTracer
from rtgs.scenes.synthetic.textures import fractal_noise
from rtgs.scenes.synthetic.viewpoints import cameras as make_cameras


@dataclass(frozen=True)
class CaptureSettings:
    width: int = 320
    height: int = 240
    samples: int = 256  # paths a pixel
    points: int = 6000  # sampled before visibility
    point_noise: float = 0.004  # metres, standard deviation of the triangulated points
    min_track: int = 3  # views that must see a point, as a feature matcher wants
    normal_noise: float = 6.0  # degrees, smooth perturbation of the monocular normals
    jpeg_quality: int = 95
    truth: bool = True  # also write truth/: exact depths, normals and shape indices of every view
    seed: int = 0


def to_srgb(linear: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Linear radiance to 8-bit sRGB, clipped at 1."""
    x = np.clip(linear, 0, 1)
    encoded = np.where(
        x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4, where=x > 0, out=np.zeros_like(x)) - 0.055
    )
    return (encoded * 255 + 0.5).astype(np.uint8)


def perturbed_normals(normal: NDArray[np.float32], degrees: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Exact normals tilted by a smooth random field of ``degrees`` (one standard deviation a component)."""
    height, width, _ = normal.shape
    size = 1 << max(height, width).bit_length()
    field = np.stack([fractal_noise(size, rng, octaves=3, periodic_power=1.5)[:height, :width] for _ in range(3)], -1)
    tilt = (field - field.mean((0, 1))) / field.std((0, 1)) * np.tan(np.radians(degrees))
    tilted = normal + tilt
    length = np.linalg.norm(tilted, axis=-1, keepdims=True)
    known = np.linalg.norm(normal, axis=-1, keepdims=True) > 0.5
    return np.where(known, tilted / np.maximum(length, 1e-6), 0).astype(np.float32)


def feature_points(
    tracer: PathTracer, views: list[Camera], see_through: list[Geometry], settings: CaptureSettings
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points a feature matcher would triangulate: on textured shapes, also *through* the glass, none on the glass."""
    import torch

    rng = np.random.default_rng(settings.seed + 1)
    described = tracer.description
    textured = [s for s in described.shapes if s.material.kind in ("diffuse", "glossy") and s.emission is None]
    areas = np.array([np.ptp(tracer.meshes[s.name].vertices, axis=0).max() for s in textured])
    share = areas**0.7 / (areas**0.7).sum()  # small objects hold more features than their area says
    samples = [
        sample_surface(tracer.meshes[s.name], int(np.ceil(w * settings.points)), rng)[0]
        for s, w in zip(textured, share)
    ]
    points = np.concatenate(samples)
    track = np.zeros(len(points), int)
    for camera, geometry in zip(views, see_through):
        pixel, depth = (t.numpy() for t in camera.project(torch.from_numpy(points)))
        x, y = np.floor(pixel).T
        inside = (depth > 0.05) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        surface = np.zeros(len(points))
        surface[inside] = geometry.depth[y[inside].astype(int), x[inside].astype(int)]
        track += inside & (np.abs(surface - depth) < 0.02 * depth)
    kept = points[track >= settings.min_track]
    return kept + rng.normal(0, settings.point_noise, kept.shape), track[track >= settings.min_track].astype(np.uint8)


def _point_colors(
    points: NDArray[np.float64], views: list[Camera], pictures: list[NDArray[np.uint8]], depths: list[Geometry]
) -> NDArray[np.uint8]:
    """Mean colour of each point over the views that see it."""
    import torch

    total, seen = np.zeros((len(points), 3)), np.zeros(len(points))
    for camera, picture, geometry in zip(views, pictures, depths):
        pixel, depth = (t.numpy() for t in camera.project(torch.from_numpy(points)))
        x, y = np.floor(pixel).T
        inside = np.flatnonzero((depth > 0.05) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height))
        row, column = y[inside].astype(int), x[inside].astype(int)
        visible = np.abs(geometry.depth[row, column] - depth[inside]) < 0.03 * depth[inside]
        total[inside[visible]] += picture[row[visible], column[visible]]
        seen[inside[visible]] += 1
    return np.where(seen[:, None] > 0, total / np.maximum(seen, 1)[:, None], 128).astype(np.uint8)


def write_colmap_text(
    folder: Path, views: list[Camera], points: NDArray[np.float64], colors: NDArray[np.uint8]
) -> None:
    """``sparse/0`` in COLMAP's text format; one shared PINHOLE camera, tracks left empty."""
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True, exist_ok=True)
    c = views[0]
    (folder / "cameras.txt").write_text(f"1 PINHOLE {c.width} {c.height} {c.fx!r} {c.fy!r} {c.cx!r} {c.cy!r}\n")
    lines = []
    for number, camera in enumerate(views, start=1):
        x, y, z, w = Rotation.from_matrix(camera.rotation.numpy()).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *camera.translation.numpy()))
        lines.append(f"{number} {pose} 1 {camera.name}.jpg\n\n")
    (folder / "images.txt").write_text("".join(lines))
    rows = (
        f"{i} {p[0]:.5f} {p[1]:.5f} {p[2]:.5f} {c[0]} {c[1]} {c[2]} 0.5\n"
        for i, (p, c) in enumerate(zip(points, colors), start=1)
    )
    (folder / "points3D.txt").write_text("".join(rows))


def _write_truth(file: Path, first: Geometry, behind: Geometry) -> None:
    """Exact geometry of one view: the visible surfaces, and what stands behind the glass."""
    np.savez_compressed(
        file,
        depth=first.depth,
        depth_behind=behind.depth,
        normal=first.normal.astype(np.float16),
        shape=first.shape.astype(np.int8),
    )


def write_capture(
    description: SceneDescription,
    folder: Path,
    settings: CaptureSettings | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> None:
    """Path-trace the scene and write the capture. Deterministic for a seed on one Mitsuba variant."""
    from PIL import Image

    settings = settings or CaptureSettings()
    tracer = PathTracer(description, settings.seed)
    views = make_cameras(description.viewpoints, settings.width, settings.height, settings.seed)
    glass = [i for i, s in enumerate(description.shapes) if s.material.kind == "thin_glass"]
    for name in ("images", "normals", *(["masks"] if glass else []), *(["truth"] if settings.truth else [])):
        (folder / name).mkdir(parents=True, exist_ok=True)
    pictures, see_through = [], []
    for number, camera in enumerate(views):
        if progress:
            progress(camera.name, number, len(views))
        rng = np.random.default_rng((settings.seed, number))
        picture = to_srgb(tracer.image(camera, settings.samples))
        first = tracer.geometry(camera)
        behind = tracer.geometry(camera, without_glass=True)
        mask = np.isin(first.shape, glass)
        mono = perturbed_normals(first.normal, settings.normal_noise, rng)
        image_file = folder / "images" / f"{camera.name}.jpg"
        Image.fromarray(picture).save(image_file, quality=settings.jpeg_quality, subsampling=0)
        if glass:
            Image.fromarray((mask * 255).astype(np.uint8)).save(folder / "masks" / f"{camera.name}.png", optimize=True)
        encoded = np.clip((mono + 1) * 127.5 + 0.5, 0, 255).astype(np.uint8)
        Image.fromarray(encoded).save(folder / "normals" / f"{camera.name}.png", optimize=True)
        if settings.truth:
            _write_truth(folder / "truth" / f"{camera.name}.npz", first, behind)
        pictures.append(picture)
        see_through.append(behind)
    points, _ = feature_points(tracer, views, see_through, settings)
    colors = _point_colors(points, views, pictures, see_through)
    write_colmap_text(folder / "sparse" / "0", views, points, colors)
