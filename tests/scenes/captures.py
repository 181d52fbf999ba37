"""Tiny captures for the tests: a ring of cameras around the origin, written by pycolmap or by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 64, 48
PINHOLE = (60.0, 58.0, 33.0, 23.0)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def ring_pose(index: int, count: int, radius: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotation (3, 3) and translation (3,) of a camera on a ring that looks at the origin."""
    angle = 2 * math.pi * index / count
    center = radius * np.array([math.cos(angle), 0.3 * math.sin(3 * angle), math.sin(angle)])
    forward = -center / np.linalg.norm(center)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rotation, -rotation @ center


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth colour (..., 3) of the ray (x, y, 1) in the camera frame."""
    return np.stack(
        [0.5 + 0.4 * np.sin(9 * x + 1), 0.5 + 0.4 * np.cos(8 * y), 0.5 + 0.3 * np.sin(6 * x + 7 * y)], axis=-1
    )


def pixel_centers(width: int, height: int) -> np.ndarray:
    """(H, W, 2) pixel centres, COLMAP's convention."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], axis=-1)


def save_image(path: Path, pixels: np.ndarray) -> None:
    """Write floats in 0..1 or uint8 through Pillow."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if pixels.dtype != np.uint8:
        pixels = np.round(np.clip(pixels, 0, 1) * 255).astype(np.uint8)
    Image.fromarray(pixels).save(path)


def pinhole_picture(params: tuple[float, ...] = PINHOLE, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """The pattern through a pinhole (fx, fy, cx, cy): (H, W, 3)."""
    fx, fy, cx, cy = params
    centers = pixel_centers(width, height)
    return pattern((centers[..., 0] - cx) / fx, (centers[..., 1] - cy) / fy)


@dataclass
class ColmapCapture:
    """What to write. ``picture`` makes the photo of view ``index``."""

    root: Path
    views: int = 10
    model: str = "PINHOLE"
    params: tuple[float, ...] = PINHOLE
    size: tuple[int, int] = (WIDTH, HEIGHT)
    text: bool = False
    points: int = 60
    folder: str = "sparse/0"
    images_dir: str = "images"
    names: list[str] = field(default_factory=list)
    broken_pose: int | None = None  # this view gets a NaN translation
    picture: Callable[[int], np.ndarray] | None = None
    errors: tuple[float, ...] = ()  # reprojection errors in pixels of the first points, which every view shows
    unseen_by: int = 0  # so many views, the first ones, show no point

    def write(self) -> Path:
        """Write model and photos; returns the root."""
        import pycolmap

        rng = np.random.default_rng(0)
        names = self.names or [f"photo_{index:02d}.png" for index in range(self.views)]
        model = pycolmap.Reconstruction()
        width, height = self.size
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model=self.model, width=width, height=height, params=list(self.params), camera_id=1)
        )
        for index, name in enumerate(names):
            rotation, translation = ring_pose(index, len(names))
            if self.broken_pose == index:
                translation = np.array([np.nan, 0, 0])
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
            image = pycolmap.Image(name=name, camera_id=1, image_id=index + 1)
            image.points2D = [pycolmap.Point2D(np.array([5.0, 5.0])) for _ in range(len(self.errors) + 1)]
            model.add_image_with_trivial_frame(image, pose)
            picture = self.picture(index) if self.picture else pinhole_picture(width=width, height=height)
            save_image(self.root / self.images_dir / name, picture)
        for _ in range(self.points):
            color = rng.integers(0, 256, 3).astype(np.uint8)
            model.add_point3D(rng.uniform(-1, 1, 3), pycolmap.Track(), color)
        for point, error in enumerate(self.errors):
            for image in range(self.unseen_by, len(names)):
                model.add_observation(point + 1, pycolmap.TrackElement(image + 1, point))
            model.points3D[point + 1].error = error
        target = self.root / self.folder
        target.mkdir(parents=True, exist_ok=True)
        (model.write_text if self.text else model.write_binary)(str(target))
        return self.root


def opengl_pose(index: int, count: int) -> list[list[float]]:
    """The ring pose as transforms.json stores it: camera to world, OpenGL axes."""
    rotation, translation = ring_pose(index, count)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ translation
    return (matrix @ OPENGL).tolist()


def write_transforms(root: Path, views: int = 10, frame_keys: dict | None = None, **keys: object) -> Path:
    """Write transforms.json with photos; ``keys`` override the shared keys (None removes one)."""
    fx, fy, cx, cy = PINHOLE
    shared = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": WIDTH, "h": HEIGHT, **keys}
    frames = []
    for index in range(views):
        name = f"images/photo_{index:02d}.png"
        save_image(root / name, pinhole_picture())
        frames.append({"file_path": name, "transform_matrix": opengl_pose(index, views), **(frame_keys or {})})
    content = {key: value for key, value in shared.items() if value is not None} | {"frames": frames}
    (root / "transforms.json").write_text(json.dumps(content))
    return root


def edit_transforms(root: Path, edit: Callable[[dict], object], file: str = "transforms.json") -> None:
    """Change the content of a transforms file in place."""
    content = json.loads((root / file).read_text())
    edit(content)
    (root / file).write_text(json.dumps(content))


def write_ply(path: Path, positions: np.ndarray, colors: np.ndarray | None = None) -> None:
    """A PLY point file with x y z and, where given, uint8 red green blue."""
    from plyfile import PlyData, PlyElement

    fields = [("x", "f4"), ("y", "f4"), ("z", "f4")]
    if colors is not None:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.zeros(len(positions), dtype=fields)
    for axis, values in zip("xyz", positions.T):
        vertices[axis] = values
    if colors is not None:
        for channel, values in zip(("red", "green", "blue"), colors.T):
            vertices[channel] = values
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))
