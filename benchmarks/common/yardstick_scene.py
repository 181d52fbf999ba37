"""The scene that rasteriser and training step are timed on: the prototypes' own where present, else made by its rules.

``RTGS_SHARED`` (default ``../shared``) names the folder with ``prototypes/yardstick.py``.
"""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.surfels import Surfels

WIDTH, HEIGHT = 400, 300
SCALES = {20_000: 0.034, 100_000: 0.0152}  # 20-30 contributing surfels a pixel
SPHERES = (
    ((-1.6, -0.6, 4.2), 0.8),
    ((0.0, -0.3, 3.6), 0.6),
    ((1.5, -0.5, 4.0), 0.9),
    ((-0.8, 0.7, 5.0), 0.7),
    ((0.9, 0.8, 4.8), 0.8),
    ((0.0, 0.2, 6.0), 1.2),
)


def yardstick_case(count: int) -> tuple[Surfels, Camera]:
    """Surfels with SH degree 3 and the camera of the yardstick; ``count`` is 20,000 or 100,000."""
    arrays = shared_arrays(count) or made_arrays(count, SCALES[count])
    tensors = {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}
    generator = torch.Generator().manual_seed(0)
    surfels = Surfels(
        means=tensors["pos"],
        log_scales=tensors["sc"].log(),
        quaternions=quaternions(tensors["tu"], tensors["tv"]),
        opacity_logits=torch.logit(tensors["op"].clamp(1e-5, 1 - 1e-5)),
        sh_dc=(tensors["col"][:, :3] - 0.5) / 0.28209479,
        sh_rest=0.05 * torch.randn(count, 15, 3, generator=generator),
    )
    focal = 0.9 * WIDTH
    return surfels, Camera(torch.eye(3), torch.zeros(3), focal, focal, WIDTH / 2 + 0.3, HEIGHT / 2 - 0.2, WIDTH, HEIGHT)


def shared_arrays(count: int) -> dict[str, np.ndarray] | None:
    """``raster_case(count)`` of the shared yardstick: pos, tu, tv (N, 3), sc (N, 2), op (N,), col (N, 12); or None."""
    path = Path(os.environ.get("RTGS_SHARED", "../shared")) / "prototypes" / "yardstick.py"
    if not path.is_file():
        return None
    spec = importlib.util.spec_from_file_location("shared_yardstick", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    scene, _ = module.raster_case(count, WIDTH, HEIGHT)
    return {name: scene[name] for name in ("pos", "tu", "tv", "sc", "op", "col")}


def made_arrays(count: int, scale: float) -> dict[str, np.ndarray]:
    """A scene by the same rules: six spheres, a floor and a back wall, surfels along the surface with some jitter."""
    rng = np.random.default_rng(0)
    positions, normals = [], []
    for index, (center, radius) in enumerate(SPHERES):
        rows = count // 2 // 6 if index < 5 else count // 2 - 5 * (count // 2 // 6)
        direction = _unit(rng.normal(size=(rows, 3)))
        positions.append(np.array(center) + radius * direction)
        normals.append(direction)
    floor = count // 4
    x, y, z = rng.uniform(-3.6, 3.6, floor), 1.4 + 0.02 * rng.normal(size=floor), rng.uniform(2.2, 7.5, floor)
    positions.append(np.stack([x, y, z], 1))
    normals.append(np.tile([0.0, -1.0, 0.0], (floor, 1)))
    wall = count - count // 2 - floor
    x, y, z = rng.uniform(-5, 5, wall), rng.uniform(-4, 4, wall), 7.5 + 0.05 * rng.normal(size=wall)
    positions.append(np.stack([x, y, z], 1))
    normals.append(np.tile([0.0, 0.0, -1.0], (wall, 1)))
    normal = _unit(np.concatenate(normals) + 0.25 * rng.normal(size=(count, 3)))
    tangent_u = _unit(np.cross(rng.normal(size=(count, 3)), normal))
    arrays = {
        "pos": np.concatenate(positions),
        "tu": tangent_u,
        "tv": np.cross(normal, tangent_u),
        "sc": scale * np.exp(0.5 * rng.normal(size=(count, 1)) + 0.45 * rng.normal(size=(count, 2))),
        "op": 1 / (1 + np.exp(1 - 1.6 * rng.normal(size=count))),
        "col": rng.uniform(0, 1, (count, 12)),
    }
    order = rng.permutation(count)
    return {name: array[order].astype(np.float32) for name, array in arrays.items()}


def quaternions(tangent_u: Tensor, tangent_v: Tensor) -> Tensor:
    """(N, 4) w, x, y, z of the rotations with columns tangent_u, tangent_v, tangent_u x tangent_v."""
    from scipy.spatial.transform import Rotation

    matrices = torch.stack((tangent_u, tangent_v, torch.linalg.cross(tangent_u, tangent_v)), dim=-1)
    return torch.from_numpy(Rotation.from_matrix(matrices.double().numpy()).as_quat()).float()[:, [3, 0, 1, 2]]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
