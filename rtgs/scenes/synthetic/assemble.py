"""A description as a Mitsuba scene: meshes, scattering, light."""

from __future__ import annotations

from typing import Any

import numpy as np

from rtgs.scenes.synthetic.description import Material, SceneDescription, Shape
from rtgs.scenes.synthetic.geometry import Mesh
from rtgs.scenes.synthetic.textures import texture

TRANSPARENT = ("thin_glass", "glass")  # kinds of material the masks show
SPECULAR = (*TRANSPARENT, "mirror", "glossy")  # kinds that reflect what stands around
_FLAT_KINDS = ("box", "plane")
# a glowing picture stands for what lies beyond an opening: light that meets it does not come back
_DARK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}


def scene_of(mi: Any, description: SceneDescription, meshes: dict[str, Mesh], seed: int, *, thin_glass: bool) -> Any:
    """The Mitsuba scene of all shapes, or of all but the thin glass; shape i of it is the i-th of those kept."""
    light = {"type": "constant", "radiance": {"type": "rgb", "value": list(description.constant_light)}}
    scene: dict[str, Any] = {"type": "scene", "sky": light}
    for number, shape in enumerate(description.shapes):
        if thin_glass or shape.material.kind != "thin_glass":
            # Mitsuba keeps the order of keys; names are numbered so that two shapes of one name stay apart
            scene[f"s{number:03d}_{shape.name}"] = _mesh(mi, shape, meshes[shape.name], seed + 17 * number)
    return mi.load_dict(scene)


def _mesh(mi: Any, shape: Shape, mesh: Mesh, seed: int) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_DARK if shape.glow != "plain" else _bsdf(mi, shape.material, seed))
    if shape.emission is not None:
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": _radiance(mi, shape, seed)})
    smooth = shape.kind not in _FLAT_KINDS
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


def _radiance(mi: Any, shape: Shape, seed: int) -> dict[str, Any]:
    """What a lamp sends out: one colour, or that colour times the picture ``glow``."""
    emission = np.asarray(shape.emission, float)
    if shape.glow == "plain":
        return {"type": "rgb", "value": emission.tolist()}
    picture = texture(shape.material, seed, name=shape.glow) * emission
    return {"type": "bitmap", "bitmap": mi.Bitmap(picture.astype(np.float32)), "raw": True}


def _bsdf(mi: Any, material: Material, seed: int) -> dict[str, Any]:
    if material.kind == "thin_glass":
        return {"type": "thindielectric", "int_ior": material.ior, "ext_ior": 1.0}
    if material.kind == "glass":
        return {"type": "dielectric", "int_ior": material.ior, "ext_ior": 1.0}
    if material.kind == "mirror":
        silver = {"material": "Ag", "specular_reflectance": {"type": "rgb", "value": list(material.color)}}
        rough = {"type": "roughconductor", "alpha": material.roughness}
        return {"type": "twosided", "nested": silver | (rough if material.roughness >= 1e-3 else {"type": "conductor"})}
    picture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(texture(material, seed).astype(np.float32)),
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
