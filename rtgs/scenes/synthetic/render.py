"""Path tracing of a described scene with Mitsuba 3 (extra ``synthetic``)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtgs.cameras import Camera
from rtgs.scenes.synthetic.description import Material, SceneDescription, Shape
from rtgs.scenes.synthetic.geometry import Mesh, build
from rtgs.scenes.synthetic.textures import texture

# LLVM 14 crashes on AVX-512 machines; these are looked for at run time, newest first.
LLVM_NAMES = (
    "libLLVM.so.20.1",
    "libLLVM.so.19.1",
    "libLLVM-18.so.1",
    "libLLVM-17.so.1",
    "libLLVM-16.so.1",
    "libLLVM-15.so.1",
)
LLVM_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/opt/homebrew/opt/llvm/lib",
)


def find_llvm() -> Path | None:
    """The shared library that Mitsuba's fast variant needs: ``DRJIT_LIBLLVM_PATH`` or a system LLVM 15 to 20."""
    if given := os.environ.get("DRJIT_LIBLLVM_PATH"):
        return Path(given)
    candidates = (Path(folder) / name for name in LLVM_NAMES for folder in LLVM_FOLDERS)
    return next((path for path in candidates if path.exists()), None)


def load_mitsuba() -> Any:
    """Import Mitsuba with its fastest variant here. Raises ImportError that says how to install it."""
    llvm = find_llvm()
    if llvm is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(llvm))
    try:
        import mitsuba
    except ImportError as error:
        raise ImportError("path tracing needs Mitsuba 3: pip install 'rtgs[synthetic]'") from error
    mitsuba.set_variant("llvm_ad_rgb" if llvm is not None else "scalar_rgb")
    return mitsuba


@dataclass(frozen=True)
class Geometry:
    """What the first surface of every pixel is, exactly."""

    depth: NDArray[np.float32]  # (H, W) z-depth, 0 where nothing
    normal: NDArray[np.float32]  # (H, W, 3) unit, camera frame (x right, y down, z forward), facing the camera
    shape: NDArray[np.int32]  # (H, W) index into the description's shapes, -1 where nothing


class PathTracer:
    """One described scene, ready to be seen from any camera."""

    def __init__(self, description: SceneDescription, seed: int = 0) -> None:
        self.description = description
        self.seed = seed
        self._mi = load_mitsuba()
        self.meshes: dict[str, Mesh] = {shape.name: build(shape) for shape in description.shapes}

    @property
    def variant(self) -> str:
        return str(self._mi.variant())

    def image(self, camera: Camera, samples: int, max_depth: int = 12) -> NDArray[np.float32]:
        """(H, W, 3) linear radiance times exposure, not clipped."""
        integrator = self._mi.load_dict({"type": "path", "max_depth": max_depth})
        seed = (hash_name(camera.name) + self.seed) & 0x7FFFFFFF
        picture = self._mi.render(
            self._scene,
            integrator=integrator,
            sensor=self._sensor(camera, samples, jittered=True),
            spp=samples,
            seed=seed,
        )
        return np.array(picture)[..., :3] * np.float32(self.description.exposure)

    def geometry(self, camera: Camera, *, without_glass: bool = False) -> Geometry:
        """First surfaces through the pixel centres; ``without_glass`` looks through the transparent shapes."""
        import torch

        mi = self._mi
        scene = self._opaque_scene if without_glass else self._scene
        kept = [i for i, s in enumerate(self.description.shapes) if not (without_glass and _is_glass(s))]
        rays = camera.rays(torch.float64)
        directions = rays.directions.reshape(-1, 3).numpy()
        lengths = np.linalg.norm(directions, axis=1)
        hit = self._intersect(mi, scene, rays.origin.numpy(), directions / lengths[:, None])
        distance, normal, index = hit
        valid = np.isfinite(distance)
        local = normal @ camera.rotation.numpy().T
        facing = np.sign((local * (directions @ camera.rotation.numpy().T)).sum(1, keepdims=True))
        local = np.where(valid[:, None], -facing * local, 0.0)
        size = (camera.height, camera.width)
        return Geometry(
            np.where(valid, distance / lengths, 0.0).reshape(size).astype(np.float32),
            local.reshape(*size, 3).astype(np.float32),
            np.where(valid, np.asarray(kept)[np.clip(index, 0, len(kept) - 1)], -1).reshape(size).astype(np.int32),
        )

    @staticmethod
    def _intersect(mi: Any, scene: Any, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Distance, geometric normal and shape index along unit directions, in one way for both variants."""
        shapes = scene.shapes()
        if "scalar" in mi.variant():
            rows = []
            for direction in directions:
                si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction)))
                found = si.is_valid()
                rows.append(
                    (
                        si.t if found else np.inf,
                        *(si.n if found else (0, 0, 0)),
                        shapes.index(si.shape) if found else -1,
                    )
                )
            table = np.asarray(rows)
            return table[:, 0], table[:, 1:4], table[:, 4].astype(int)
        count = len(directions)
        ray = mi.Ray3f(
            mi.Point3f(*(mi.Float(float(o)) for o in origin)),
            mi.Vector3f(*(mi.Float(c.astype(np.float32)) for c in directions.T)),
        )
        si = scene.ray_intersect(ray)
        index = np.full(count, -1)
        pointers = [mi.ShapePtr(shape) for shape in shapes]
        for number, pointer in enumerate(pointers):
            index[np.array(si.shape == pointer)] = number
        distance = np.where(index >= 0, np.array(si.t), np.inf)
        return distance, np.stack([np.array(c) for c in si.n], -1), index

    @cached_property
    def _scene(self) -> Any:
        return self._mi.load_dict(self._scene_dict(self.description.shapes))

    @cached_property
    def _opaque_scene(self) -> Any:
        return self._mi.load_dict(self._scene_dict(tuple(s for s in self.description.shapes if not _is_glass(s))))

    def _scene_dict(self, shapes: tuple[Shape, ...]) -> dict[str, Any]:
        light = {"type": "constant", "radiance": {"type": "rgb", "value": list(self.description.constant_light)}}
        scene: dict[str, Any] = {"type": "scene", "sky": light}
        for number, shape in enumerate(shapes):
            # Mitsuba keeps the order of keys; names are numbered so that shape i of the scene is shapes[i]
            scene[f"s{number:03d}_{shape.name}"] = self._mesh(shape, number)
        return scene

    def _mesh(self, shape: Shape, number: int) -> Any:
        mi, mesh = self._mi, self.meshes[shape.name]
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(self._bsdf(shape.material, self.seed + 17 * number))
        if shape.emission is not None:
            properties["emitter"] = mi.load_dict(
                {"type": "area", "radiance": {"type": "rgb", "value": list(shape.emission)}}
            )
        smooth = shape.kind in ("lathe", "sphere", "knot")
        built = mi.Mesh(
            shape.name,
            len(mesh.vertices),
            len(mesh.faces),
            has_vertex_normals=smooth,
            has_vertex_texcoords=True,
            props=properties,
        )
        parameters = mi.traverse(built)
        parameters["vertex_positions"] = mesh.vertices.astype(np.float32).ravel()
        parameters["faces"] = mesh.faces.astype(np.uint32).ravel()
        parameters["vertex_texcoords"] = (mesh.uvs * shape.material.texture_scale).astype(np.float32).ravel()
        if smooth:
            parameters["vertex_normals"] = mesh.normals.astype(np.float32).ravel()
        parameters.update()
        return built

    def _bsdf(self, material: Material, seed: int) -> dict[str, Any]:
        if material.kind == "thin_glass":
            return {"type": "thindielectric", "int_ior": material.ior, "ext_ior": 1.0}
        if material.kind == "mirror":
            return {"type": "roughconductor", "alpha": max(material.roughness, 1e-3), "material": "Ag"}
        picture = {
            "type": "bitmap",
            "bitmap": self._mi.Bitmap(texture(material, seed).astype(np.float32)),
            "raw": True,
            "wrap_mode": "repeat",
        }
        if material.kind == "glossy":
            inner = {
                "type": "roughplastic",
                "diffuse_reflectance": picture,
                "alpha": material.roughness,
                "int_ior": material.ior,
            }
        else:
            inner = {"type": "diffuse", "reflectance": picture}
        return {"type": "twosided", "nested": inner}

    def _sensor(self, camera: Camera, samples: int, jittered: bool) -> Any:
        mi = self._mi
        flip = np.diag([-1.0, -1.0, 1.0])  # Mitsuba's camera: x left, y up, z forward
        to_world = np.eye(4)
        to_world[:3, :3] = camera.rotation.numpy().T @ flip
        to_world[:3, 3] = camera.center.numpy()
        fov = 2 * np.degrees(np.arctan(0.5 * camera.width / camera.fx))
        return mi.load_dict({
            "type": "perspective",
            "fov": float(fov),
            "fov_axis": "x",
            "near_clip": 1e-3,
            "far_clip": 1e3,
            "to_world": mi.ScalarTransform4f(to_world),
            "sampler": {"type": "independent", "sample_count": samples},
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "rgb",
                "rfilter": {"type": "gaussian" if jittered else "box"},
            },
        })  # fmt: skip


def _is_glass(shape: Shape) -> bool:
    return shape.material.kind == "thin_glass"


def hash_name(name: str) -> int:
    """A stable 31-bit number from a name (Python's own hash changes from run to run)."""
    import zlib

    return zlib.crc32(name.encode()) & 0x7FFFFFFF
