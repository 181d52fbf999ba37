"""Which methods there are: those of this package, those of installed ones, and any that a config names by its place.

Without torch. ``method.name`` is one of

- ``2dgs``, ``3dgs``, ``3dgs_dr``, ``gaussian_shader``, ``ref_gaussian``, ``ref_gs``, ``envgs``, ``rtgs``,
  ``rtgs_printed``: of this package;
- ``external``: pictures of another program, nothing is trained;
- a name that an installed package declares as an entry point of the group ``rtgs.methods``;
- ``package.module:ATTRIBUTE``, any importable :class:`~rtgs.methods.spec.MethodSpec`.
"""

from __future__ import annotations

import difflib
import importlib
from importlib import metadata

from rtgs.methods import (
    envgs,
    external,
    gaussian_shader,
    gs2d,
    gs3d,
    gs3d_dr,
    ref_gaussian,
    ref_gs,
    rtgs,
    rtgs_printed,
)
from rtgs.methods.spec import MethodSpec

ENTRY_POINTS = "rtgs.methods"
REACHES = ()  # by name only what others install: the digest of its source is in the recipe of its steps
_SPECS = (
    gs2d.SPEC,
    gs3d.SPEC,
    gs3d_dr.SPEC,
    gaussian_shader.SPEC,
    ref_gaussian.SPEC,
    ref_gs.SPEC,
    envgs.SPEC,
    rtgs.SPEC,
    rtgs_printed.SPEC,
)
_OWN = {spec.name: spec for spec in _SPECS}


def method_names() -> tuple[str, ...]:
    """The names of what trains and needs no place: those of this package, then those of installed ones."""
    return (*_OWN, *sorted(set(_entry_points()) - set(_OWN)))


def own_methods() -> tuple[MethodSpec, ...]:
    """The methods of this package that train."""
    return tuple(_OWN.values())


def find_method(name: str) -> MethodSpec:
    """The method ``name``.

    Raises:
        ValueError: there is none of this name, or its place holds none.
    """
    if name in _OWN:
        return _OWN[name]
    if name == external.SPEC.name:
        return external.SPEC
    place = name if ":" in name else _entry_points().get(name, "")
    if not place:
        names = (*method_names(), external.SPEC.name)
        close = difflib.get_close_matches(name, names, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        raise ValueError(
            f"method.name is {name!r}: choose one of {', '.join(names)}, or package.module:ATTRIBUTE of your own{hint}"
        )
    return _load(place, name)


def is_own(spec: MethodSpec) -> bool:
    """The method is one of this package."""
    return spec in _OWN.values()


def _entry_points() -> dict[str, str]:
    return {point.name: point.value for point in metadata.entry_points(group=ENTRY_POINTS)}


def _load(place: str, name: str) -> MethodSpec:
    module, _, attribute = place.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"method.name={name!r} names {place}, which does not import ({error}): install the package that holds it, "
            "or put its folder on PYTHONPATH"
        ) from error
    if not isinstance(found, MethodSpec):
        raise ValueError(f"method.name={name!r}: {place} is a {type(found).__name__}, not a rtgs.methods.MethodSpec")
    return found
