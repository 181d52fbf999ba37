"""JSON, YAML and TOML from files that anybody may have written: size, depth, aliases and numbers have limits.

Every function raises :class:`DocumentError` with the reason alone; the caller names the file and says what to do.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rtgs.core.errors import RtgsError
from rtgs.core.refuse import shown

JSON_BYTES = 32 * 2**20  # 30,000 frames of transforms.json; Python objects take 25 times as much
TYPED_BYTES = 2**20  # of YAML and TOML, which people write
DEPTH = 64
PARTS = 1_000_000  # of a YAML file after its aliases are written out
LARGEST_INTEGER = 2**64  # the largest id anybody stores


class DocumentError(RtgsError):
    """Text that cannot be read, or not within the limits; the message does not name the file."""


def load_json(path: Path) -> Any:
    """What a JSON file holds. NaN and Infinity are allowed, as Python and NumPy write them.

    Raises:
        DocumentError: it is no JSON, or goes beyond the limits.
        OSError: it cannot be read at all.
    """
    return parse_json(_text(path, JSON_BYTES))


def parse_json(text: str | bytes) -> Any:
    """What a JSON text holds.

    Raises:
        DocumentError: as :func:`load_json`.
    """
    if len(text) > JSON_BYTES:
        raise DocumentError(f"{len(text)} bytes of JSON, at most {JSON_BYTES} are read")
    with _refused(ValueError):
        return _within_limits(json.loads(text))


def load_toml(path: Path) -> dict[str, Any]:
    """What a TOML file holds.

    Raises:
        DocumentError, OSError: as :func:`load_json`.
    """
    import tomllib

    text = _text(path, TYPED_BYTES)
    with _refused(ValueError):
        return _within_limits(tomllib.loads(text))


def load_yaml(path: Path) -> Any:
    """What a YAML file holds: plain values only, no tags that make objects.

    Raises:
        DocumentError, OSError: as :func:`load_json`; aliases count as what they stand for.
    """
    import yaml

    text = _text(path, TYPED_BYTES)
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    with _refused(yaml.YAMLError, ValueError, TypeError, AttributeError, LookupError):  # PyYAML on odd tags
        _refuse_large_yaml(yaml.parse(text, Loader=loader))
        return _within_limits(yaml.load(text, Loader=loader))


@contextmanager
def _refused(*errors: type[Exception]) -> Iterator[None]:
    """These errors of a parser, and nesting beyond its depth, as a :class:`DocumentError`."""
    try:
        yield
    except RecursionError as error:
        raise DocumentError(f"it is nested more than {DEPTH} levels deep") from error
    except errors as error:
        raise _reason(error) from error


def _text(path: Path, most: int) -> str:
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise DocumentError(f"it is larger than {most} bytes")
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise DocumentError(f"it is no UTF-8 text: {error.reason} at byte {error.start}") from error


def _reason(error: Exception) -> DocumentError:
    if "nesting depth" in str(error):  # libyaml's own limit, met where its scanner looks ahead
        return DocumentError(f"it is nested more than {DEPTH} levels deep")
    return error if isinstance(error, DocumentError) else DocumentError(_shortened(" ".join(str(error).split())))


def _shortened(text: str) -> str:
    """For a message: what an attacker writes into a file may be long."""
    return text[:200] + ("..." if len(text) > 200 else "")


def _refuse_large_yaml(events: Iterable[Any]) -> None:
    """Count what the text will become, before anything is made of it."""
    import yaml

    open_counts, anchors, sizes = [0], list[str | None](), dict[str, int]()
    for event in events:
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise DocumentError(f"the alias *{_shortened(event.anchor)} stands for nothing, or for itself")
            open_counts[-1] += sizes[event.anchor]
        elif isinstance(event, yaml.CollectionStartEvent):
            open_counts.append(1)
            anchors.append(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            size, anchor = open_counts.pop(), anchors.pop()
            open_counts[-1] += size
            sizes |= {anchor: size} if anchor else {}
        elif isinstance(event, yaml.ScalarEvent):
            open_counts[-1] += 1
            sizes |= {event.anchor: 1} if event.anchor else {}
        if open_counts[-1] > PARTS:
            raise DocumentError(f"it holds more than {PARTS} values, aliases written out")
        if len(anchors) > DEPTH:
            raise DocumentError(f"it is nested more than {DEPTH} levels deep")


def _within_limits(content: Any) -> Any:
    """The content, after a look at every part of it. Whoever nests or counts too far is told where."""
    parts: list[tuple[Any, int, str]] = [(content, 1, "")]
    while parts:
        value, depth, where = parts.pop()
        if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
            raise DocumentError(f"{where or 'it'} is {shown(value)}: whole numbers go up to {LARGEST_INTEGER}")
        if not isinstance(value, dict | list):
            continue
        if depth > DEPTH:
            raise DocumentError(f"it is nested more than {DEPTH} levels deep")
        items = value.items() if isinstance(value, dict) else enumerate(value)
        parts += [(each, depth + 1, _key(where, key)) for key, each in items if type(each) in (dict, list, int)]
    return content


def _key(where: str, key: object) -> str:
    name = key if isinstance(key, str | int) else type(key).__name__
    return f"{where}.{name}"[-80:].lstrip(".")
