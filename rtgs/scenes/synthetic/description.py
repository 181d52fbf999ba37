"""A synthetic scene as a small readable TOML file: shapes with materials, lights, viewpoints.

Frame: right-handed, z up, metres. Nothing here needs the renderer; see ``render.py`` for how it becomes pictures.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

SCENES = Path(__file__).parent / "scenes"

KINDS = ("lathe", "box", "sphere", "knot", "plane", "dome", "sculpt", "kernels")
MATERIALS = ("diffuse", "glossy", "mirror", "thin_glass", "glass")
TRANSPARENT = ("thin_glass", "glass")  # what masks show
SPECULAR = (*TRANSPARENT, "glossy", "mirror")  # what a picture of diffuse surfaces alone cannot explain
TEXTURES = (
    "plain", "checker", "noise", "wood", "stripes", "posters",
    "tiles", "brick", "grass", "marble", "terrazzo", "mural", "shelf", "label", "window", "sky", "facade",
)  # fmt: skip
FORMS = ("ellipsoid", "box", "outline")


@dataclass(frozen=True)
class Material:
    """How a shape scatters light."""

    kind: str = "diffuse"
    texture: str = "plain"
    color: tuple[float, float, float] = (0.7, 0.7, 0.7)  # linear reflectance, first colour of the texture; mirror: tint
    color2: tuple[float, float, float] = (0.2, 0.2, 0.2)  # second colour of the texture
    texture_scale: float = 1.0  # repetitions over the unit UV square
    roughness: float = 0.1  # glossy and mirror only
    ior: float = 1.5  # thin_glass, glass and glossy only


@dataclass(frozen=True)
class Part:
    """One lump of a sculpted shape, in the shape's frame. Parts are joined, or cut away, in the order of the file."""

    form: str = "ellipsoid"
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    size: tuple[float, float, float] = (0.1, 0.1, 0.1)  # half axes, half extents; outline: y alone counts
    turn: float = 0.0  # degrees about z
    tilt: float = 0.0  # degrees about y, before the turn: positive lowers the front (+x)
    outline: tuple[tuple[float, float], ...] = ()  # outline: (x, z) corners of a plate of half thickness size.y
    round: float = 0.0  # metres: radius of the edges of a box or an outline
    taper: float = 0.0  # outline: share of the half thickness lost a metre upwards (leaning car windows)
    bow: float = 0.0  # outline: share of the half thickness lost at x = +-1 metre, grows as x squared (a car's plan)
    blend: float = 0.0  # metres over which the joint is smoothed
    cut: bool = False  # cut away instead of joined
    mirror: bool = False  # also on the other side of y = 0


@dataclass(frozen=True)
class Shape:
    """One object. ``size``: half extents of a box or plane; in its x a sphere's or dome's radius, a knot's scale, the
    radius of a kernel."""

    name: str
    kind: str
    material: Material = field(default_factory=Material)
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    size: tuple[float, float, float] = (1.0, 1.0, 1.0)
    turn: float = 0.0  # degrees about z
    tilt: float = 0.0  # degrees about x, before the turn
    copies: tuple[tuple[float, float, float], ...] = ()  # further positions: the same thing again, one object
    profile: tuple[tuple[float, float], ...] = ()  # lathe, from bottom to top; kernels, the heap: (radius, height)
    arc: float = 360.0  # lathe: degrees of the full turn that exist (a label)
    parts: tuple[Part, ...] = ()  # sculpt
    cell: float = 0.01  # sculpt: metres, grid on which the surface is found
    relief: float = 0.0  # sculpt: metres, height of the random relief
    relief_size: float = 0.1  # sculpt: metres, its longest wave
    count: int = 100  # kernels: how many
    inward: bool = False  # box: normals point inside (a room)
    emission: tuple[float, float, float] | None = None  # radiance: makes the shape an area light
    glow: str = "plain"  # texture (in the material's colours) that the emission is multiplied by; plain: none


@dataclass(frozen=True)
class Viewpoints:
    """Cameras on rings, or arcs of rings, around a target, named in order of capture."""

    count: int = 48
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: tuple[float, float] = (2.0, 2.4)
    elevation: tuple[float, float] = (12.0, 50.0)  # degrees: lowest and highest ring
    rings: int = 3
    start: float = 0.0  # degrees: azimuth of the first camera
    arc: float = 360.0  # degrees of azimuth that the rings cover
    jitter: float = 0.05  # share of the radius
    field_of_view: float = 50.0  # degrees, horizontal


@dataclass(frozen=True)
class SceneDescription:
    name: str
    title: str
    shapes: tuple[Shape, ...]
    viewpoints: Viewpoints
    constant_light: tuple[float, float, float] = (0.05, 0.05, 0.05)
    exposure: float = 1.0  # radiance times exposure = linear picture
    stand_in_for: str = ""  # whose data this scene stands in for; empty: it stands for itself

    @property
    def transparent(self) -> tuple[Shape, ...]:
        """Shapes that are looked through: what masks show."""
        return tuple(shape for shape in self.shapes if shape.material.kind in TRANSPARENT)


T = TypeVar("T")


def _build(cls: type[T], values: dict[str, Any], where: str) -> T:
    """A dataclass from a TOML table; an unknown key stops with its name and place."""
    known = {f.name for f in fields(cls)}  # type: ignore[arg-type]
    unknown = sorted(set(values) - known)
    if unknown:
        raise ValueError(f"{where}: unknown key {unknown[0]!r}; known keys are {', '.join(sorted(known))}")

    def frozen(value: Any) -> Any:
        return tuple(frozen(v) for v in value) if isinstance(value, list) else value

    return cls(**{key: frozen(value) for key, value in values.items()})


def _check_choice(value: str, allowed: tuple[str, ...], where: str) -> None:
    if value not in allowed:
        raise ValueError(f"{where}: {value!r} is not one of {', '.join(allowed)}")


def read_description(path: Path) -> SceneDescription:
    """Read and check one scene file. Raises ValueError naming file, shape and key."""
    with open(path, "rb") as file:
        data = tomllib.load(file)
    shapes = []
    for values in data.pop("shape", []):
        where = f"{path.name}, shape {values.get('name', '?')!r}"
        material = _build(Material, values.pop("material", {}), where + ", material")
        _check_choice(material.kind, MATERIALS, where + ", material.kind")
        _check_choice(material.texture, TEXTURES, where + ", material.texture")
        parts = tuple(_build(Part, part, where + ", part") for part in values.pop("part", []))
        for part in parts:
            _check_choice(part.form, FORMS, where + ", part.form")
        shape = _build(Shape, {**values, "material": material, "parts": parts}, where)
        _check_choice(shape.glow, TEXTURES, where + ", glow")
        _check_choice(shape.kind, KINDS, where + ", kind")
        if shape.kind == "lathe" and len(shape.profile) < 2:
            raise ValueError(f"{where}: a lathe needs a profile of at least two (radius, height) pairs")
        if shape.kind == "sculpt" and not shape.parts:
            raise ValueError(f"{where}: a sculpt needs at least one [[shape.part]]")
        if shape.kind == "kernels" and len(shape.profile) < 2:
            raise ValueError(f"{where}: kernels need the profile of their heap, (radius, height) pairs")
        shapes.append(shape)
    if not shapes:
        raise ValueError(f"{path.name}: no [[shape]] in the file")
    viewpoints = _build(Viewpoints, data.pop("viewpoints", {}), f"{path.name}, viewpoints")
    return _build(
        SceneDescription, {**data, "name": path.stem, "shapes": tuple(shapes), "viewpoints": viewpoints}, path.name
    )


def list_scenes() -> list[str]:
    """Names of the scene files shipped with rtgs."""
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def named_scene(name: str) -> SceneDescription:
    """A shipped scene by name. Raises ValueError listing the names there are."""
    path = SCENES / f"{name}.toml"
    if not path.is_file():
        raise ValueError(f"no synthetic scene {name!r}; there are {', '.join(list_scenes())}")
    return read_description(path)
