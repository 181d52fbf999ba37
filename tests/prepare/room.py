"""Photos of the corner of a room with patterned walls, ray-cast in numpy: real enough for SIFT, with known poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
CALIBRATION = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


@dataclass(frozen=True)
class Pose:
    """World to camera, z of the world is up."""

    rotation: np.ndarray
    translation: np.ndarray


@cache
def texture(seed: int) -> np.ndarray:
    """(512, 512, 3) float32 in 0..1: noise of several sizes, so that corners are found near and far."""
    import cv2

    rng = np.random.default_rng(seed)
    result = np.zeros((512, 512, 3), dtype=np.float32)
    for size, strength in ((16, 0.3), (64, 0.4), (192, 0.5)):
        noise = rng.random((size, size, 3), dtype=np.float32) - 0.5
        result += strength * cv2.resize(noise, (512, 512), interpolation=cv2.INTER_CUBIC)
    return np.clip(result + 0.5, 0, 1)


def look(center: tuple[float, float, float], target: tuple[float, float, float]) -> Pose:
    """A level camera at ``center`` that looks at ``target``."""
    forward = np.subtract(target, center)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ np.asarray(center))


def walk(count: int) -> list[Pose]:
    """Cameras on an arc before the corner at the origin, some higher, some lower."""
    poses = []
    for index in range(count):
        share = index / max(count - 1, 1)
        angle = math.radians(20 + 50 * share)
        height = 1.4 + 0.5 * math.sin(5 * share)
        poses.append(look((4 * math.cos(angle), 4 * math.sin(angle), height), (0.6, 0.6, 0.7)))
    return poses


def photo(pose: Pose, seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """(H, W, 3) uint8: floor z = 0 and walls x = 0, y = 0, seen from ``pose``."""
    import cv2

    focal = FOCAL * max(width, height) / WIDTH
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x / focal, y / focal, np.ones_like(x)], axis=-1) @ pose.rotation
    center = -pose.rotation.T @ pose.translation
    best = np.full((height, width), np.inf)
    picture = np.zeros((height, width, 3), dtype=np.float32)
    for axis in range(3):
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -center[axis] / rays[..., axis]
        hit = (depth > 1e-6) & (depth < best)
        spot = np.delete(center + np.where(hit, depth, 0)[..., None] * rays, axis, axis=-1)
        grid = (spot * 100 % 511).astype(np.float32)
        colors = cv2.remap(texture(10 * seed + axis), grid[..., 0], grid[..., 1], cv2.INTER_LINEAR)
        picture = np.where(hit[..., None], colors, picture)
        best = np.where(hit, depth, best)
    return np.round(picture * 255).astype(np.uint8)


def write_photos(folder: Path, poses: list[Pose], seed: int = 0, name: str = "photo_{:02d}.jpg") -> list[Path]:
    """Photos of the poses, as files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name.format(index) for index in range(len(poses))]
    for path, pose in zip(paths, poses):
        Image.fromarray(photo(pose, seed)).save(path, quality=95)
    return paths


def normal_photo(pose: Pose, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """(H, W, 3) uint8: the camera-frame normals of floor and walls, painted as (n + 1) / 2."""
    focal = FOCAL * max(width, height) / WIDTH
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x / focal, y / focal, np.ones_like(x)], axis=-1) @ pose.rotation
    center = -pose.rotation.T @ pose.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -center / rays
    axis = np.where(depth > 1e-6, depth, np.inf).argmin(axis=-1)
    return np.round((np.eye(3)[axis] @ pose.rotation.T + 1) / 2 * 255).astype(np.uint8)


def write_normal_capture(root: Path, count: int = 4, points: int = 600) -> Path:
    """A COLMAP text model of photos that show their own normals, with points on floor and walls."""
    (root / "images").mkdir(parents=True)
    (root / "sparse/0").mkdir(parents=True)
    lines = []
    for index, pose in enumerate(walk(count)):
        Image.fromarray(normal_photo(pose)).save(root / f"images/photo_{index:02d}.png")
        x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat()
        numbers = " ".join(f"{value:.12f}" for value in (w, x, y, z, *pose.translation))
        lines += [f"{index + 1} {numbers} 1 photo_{index:02d}.png", ""]
    (root / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    lens = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    (root / "sparse/0/cameras.txt").write_text(lens)
    rng = np.random.default_rng(0)
    spots = rng.random((points, 3)) * 2
    spots[np.arange(points), np.arange(points) % 3] = 0
    rows = [f"{i + 1} {p[0]:.6f} {p[1]:.6f} {p[2]:.6f} 200 100 50 0.5" for i, p in enumerate(spots)]
    (root / "sparse/0/points3D.txt").write_text("\n".join(rows) + "\n")
    return root
