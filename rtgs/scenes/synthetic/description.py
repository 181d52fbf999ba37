"""A synthetic scene as a small readable TOML file: shapes with materials, lights, viewpoints.

Frame: right-handed, z up, metres. Nothing here needs the renderer; see ``render.py`` for how it becomes pictures.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import MISSING, dataclass, field, fields
from math import isfinite
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from rtgs.core.documents import DocumentError, load_toml
from rtgs.core.errors import RtgsError
from rtgs.core.recipe import UNLESS_DEFAULT
from rtgs.core.refuse import shown

SCENES = Path(__file__).parent / "scenes"
REACHES = ("scenes/*.toml",)

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
    wide_every: int = field(
        default=0, metadata=UNLESS_DEFAULT
    )  # one view of so many is taken from low with a wide lens
    wide_elevation: tuple[float, float] = field(default=(10.0, 30.0), metadata=UNLESS_DEFAULT)  # as ``elevation``
    wide_field_of_view: float = field(default=90.0, metadata=UNLESS_DEFAULT)  # degrees, horizontal

    def is_wide(self, index: int) -> bool:
        """Whether a view has the wide lens: the one in the middle of every ``wide_every``, so that none is a test view
        where one of a multiple of so many is, the first of them."""
        return self.wide_every > 1 and index % self.wide_every == self.wide_every // 2


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
    """A dataclass from a TOML table; an unknown key, a missing one, a value of another kind stops with its place."""
    known = get_type_hints(cls)
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ValueError(f"{where}: unknown key {shown(unknown[0])}; known keys are {', '.join(sorted(known))}")
    for item in fields(cls):  # type: ignore[arg-type]
        if item.default is MISSING and item.default_factory is MISSING and item.name not in values:
            raise ValueError(f"{where}: the key {item.name!r} is missing")

    def frozen(value: Any) -> Any:
        return tuple(frozen(v) for v in value) if isinstance(value, list) else value

    given = {key: frozen(value) for key, value in values.items()}
    for key, value in given.items():
        if not _fits(value, known[key]):
            raise ValueError(f"{where}: {key} = {shown(values[key])} does not fit, give {_in_words(known[key])}")
    return cls(**given)


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value out of a TOML file is what a field's type says; whole numbers are numbers, infinities are not."""
    inner = get_args(hint)
    if isinstance(hint, UnionType):
        return any(_fits(value, one) for one in inner)
    if get_origin(hint) is tuple:
        if not isinstance(value, tuple):
            return False
        kinds = inner[:1] * len(value) if inner[-1] is Ellipsis else inner
        return len(kinds) == len(value) and all(_fits(one, kind) for one, kind in zip(value, kinds))
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and isfinite(value)
    return isinstance(value, hint) and (hint is bool or not isinstance(value, bool))


def _in_words(hint: Any) -> str:
    inner = get_args(hint)
    if isinstance(hint, UnionType):
        return _in_words(inner[0])
    if get_origin(hint) is not tuple:
        return {str: "a text", bool: "true or false", int: "a whole number", float: "a number"}.get(hint, "a table")
    if inner[-1] is Ellipsis:
        return f"a list, each of it {_in_words(inner[0])}"
    return f"a list of {len(inner)} numbers"


_FARTHEST = 1e5  # metres
_MOST_LIGHT = 1e6  # radiance, or times it
_MOST_KERNELS, _MOST_VIEWS = 100_000, 10_000
_SIZES_USED = {"box": 3, "plane": 2, "sphere": 1, "dome": 1, "knot": 1, "kernels": 1}  # the first so many of ``size``


def _check_positive(where: str, **values: float) -> None:
    for name, value in values.items():
        if value <= 0:
            raise ValueError(f"{where}: {name} = {value:g} must be more than 0")


def _check_range(where: str, low: float, high: float, **values: float | tuple[Any, ...]) -> None:
    """Every number, those in tuples too, lies in ``low`` to ``high``."""
    for name, value in values.items():
        parts = value if isinstance(value, tuple) else (value,)
        for part in parts:
            if isinstance(part, tuple):
                _check_range(where, low, high, **{name: part})
            elif not low <= part <= high:
                raise ValueError(f"{where}: {name} = {part:g} must be {low:g} to {high:g}")


def _check_material(material: Material, where: str) -> None:
    _check_choice(material.kind, MATERIALS, where + ".kind")
    _check_choice(material.texture, TEXTURES, where + ".texture")
    _check_range(where, 0, 1, color=material.color, color2=material.color2, roughness=material.roughness)
    _check_range(where, 1, 10, ior=material.ior)
    _check_range(where, 0, 1e4, texture_scale=material.texture_scale)


def _check_part(part: Part, where: str) -> None:
    _check_choice(part.form, FORMS, where + ".form")
    _check_range(where, -_FARTHEST, _FARTHEST, position=part.position, outline=part.outline)
    _check_range(where, 0, _FARTHEST, size=part.size, round=part.round, blend=part.blend)
    if part.form == "outline" and len(part.outline) < 3:
        raise ValueError(f"{where}: an outline needs at least three (x, z) corners")


def _check_shape(shape: Shape, where: str) -> None:
    _check_choice(shape.glow, TEXTURES, where + ", glow")
    _check_choice(shape.kind, KINDS, where + ", kind")
    for axis in range(_SIZES_USED.get(shape.kind, 0)):
        _check_positive(where, **{f"size[{axis}]": shape.size[axis]})
    _check_positive(where, count=shape.count, cell=shape.cell, arc=shape.arc, relief_size=shape.relief_size)
    _check_range(where, -_FARTHEST, _FARTHEST, position=shape.position, copies=shape.copies, profile=shape.profile)
    _check_range(where, 0, _FARTHEST, size=shape.size, relief=shape.relief)
    _check_range(where, 1, _MOST_KERNELS, count=shape.count)
    _check_range(where, 0, _MOST_LIGHT, emission=shape.emission or ())
    if shape.kind == "lathe" and len(shape.profile) < 2:
        raise ValueError(f"{where}: a lathe needs a profile of at least two (radius, height) pairs")
    if shape.kind == "sculpt" and not shape.parts:
        raise ValueError(f"{where}: a sculpt needs at least one [[shape.part]]")
    if shape.kind == "kernels" and len(shape.profile) < 2:
        raise ValueError(f"{where}: kernels need the profile of their heap, (radius, height) pairs")


def _check_viewpoints(viewpoints: Viewpoints, where: str) -> None:
    _check_positive(where, count=viewpoints.count, rings=viewpoints.rings, radius=min(viewpoints.radius))
    for name in ("field_of_view", "wide_field_of_view"):
        angle = getattr(viewpoints, name)
        _check_positive(where, **{name: angle})
        if angle >= 180:
            raise ValueError(f"{where}: {name} = {angle:g} must be below 180 degrees")
    _check_range(where, 1, _MOST_VIEWS, count=viewpoints.count, rings=viewpoints.rings)
    _check_range(where, -_FARTHEST, _FARTHEST, target=viewpoints.target, radius=viewpoints.radius)
    _check_range(where, 0, 1, jitter=viewpoints.jitter)
    if viewpoints.wide_every not in (0, *range(2, _MOST_VIEWS + 1)):
        raise ValueError(
            f"{where}: wide_every = {viewpoints.wide_every} must be 0 (no wide lens) or 2 to {_MOST_VIEWS}"
        )
    for name in ("elevation", "wide_elevation"):
        steepest = max(abs(elevation) for elevation in getattr(viewpoints, name))
        if steepest >= 90:
            raise ValueError(f"{where}: {name} = {steepest:g} must be below 90 degrees, where up has no direction")


def _check_choice(value: str, allowed: tuple[str, ...], where: str) -> None:
    if value not in allowed:
        raise ValueError(f"{where}: {shown(value)} is not one of {', '.join(allowed)}")


def read_description(path: Path) -> SceneDescription:
    """Read and check one scene file.

    Raises:
        RtgsError: no TOML, an unknown key, a missing one, a value that does not fit; names file, shape and key.
    """
    try:
        return _described(load_toml(path), path)
    except (OSError, DocumentError) as error:
        raise RtgsError(f"scene file {path} is no TOML ({error}): mend it there") from error
    except ValueError as error:
        raise RtgsError(str(error)) from error


def _described(data: dict[str, Any], path: Path) -> SceneDescription:
    shapes = [_read_shape(values, path.name) for values in _tables(data, "shape", path.name)]
    if not shapes:
        raise ValueError(f"{path.name}: no [[shape]] in the file")
    twice = [name for name, number in Counter(shape.name for shape in shapes).items() if number > 1]
    if twice:
        raise ValueError(f"{path.name}: more than one shape is called {shown(twice[0])}, give each a name of its own")
    where = f"{path.name}, viewpoints"
    viewpoints = _build(Viewpoints, _table(data.pop("viewpoints", {}), where), where)
    _check_viewpoints(viewpoints, where)
    if reserved := sorted({"name", "shapes"} & set(data)):
        raise ValueError(f"{path.name}: unknown key {reserved[0]!r}: a scene is called as its file is")
    scene = _build(
        SceneDescription, {**data, "name": path.stem, "shapes": tuple(shapes), "viewpoints": viewpoints}, path.name
    )
    _check_positive(path.name, exposure=scene.exposure)
    _check_range(path.name, 0, _MOST_LIGHT, constant_light=scene.constant_light, exposure=scene.exposure)
    return scene


def _read_shape(values: dict[str, Any], file: str) -> Shape:
    where = f"{file}, shape {shown(values.get('name', '?'))}"
    material = _build(Material, _table(values.pop("material", {}), where + ", material"), where + ", material")
    _check_material(material, where + ", material")
    parts = tuple(_build(Part, part, where + ", part") for part in _tables(values, "part", where))
    for part in parts:
        _check_part(part, where + ", part")
    shape = _build(Shape, {**values, "material": material, "parts": parts}, where)
    _check_shape(shape, where)
    return shape


def _table(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{where}: {shown(value)} is no table of keys and values")
    return value


def _tables(data: dict[str, Any], key: str, where: str) -> list[dict[str, Any]]:
    """The tables [[key]] taken out of ``data``."""
    found = data.pop(key, [])
    if not isinstance(found, list):
        raise ValueError(f"{where}: {key} = {shown(found)} is no list of tables, write [[{key}]] above each")
    return [_table(one, f"{where}, {key}") for one in found]


def list_scenes() -> list[str]:
    """Names of the scene files shipped with rtgs."""
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def named_scene(name: str) -> SceneDescription:
    """A shipped scene by name. Raises ValueError listing the names there are."""
    path = SCENES / f"{name}.toml"
    if not path.is_file():
        raise ValueError(f"no synthetic scene {name!r}; there are {', '.join(list_scenes())}")
    return read_description(path)
