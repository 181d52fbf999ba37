"""Write docs/api.md from the docstrings of what ``rtgs`` exports: ``make docs``, or `python docs/make_api.py PAGE`.

The source is read, not imported. A name that is exported and has no docstring stops the build, and so does a docstring
that names a parameter which the function does not have.
"""

from __future__ import annotations

import ast
import logging
import re
import sys
import textwrap
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path

import griffe

ROOT = Path(__file__).resolve().parents[1]
WIDTH = 120
INTRODUCTION = """# API

What `import rtgs` gives. `examples/` shows each name at work. This page is made of the docstrings by `make docs`.
"""
GROUPS = {
    "Scenes and cameras": ("rtgs.core", "rtgs.scenes"),
    "Gaussians": ("rtgs.gaussians",),
    "Rendering": ("rtgs.render",),
    "Training": ("rtgs.train", "rtgs.methods"),
    "Finished runs": ("rtgs.runs",),
    "Pictures and figures": ("rtgs.evaluate",),
}
"""Headings by the rooms whose names stand below them."""
PARTS = {"parameters": "Parameters", "returns": "Returns", "raises": "Raises"}


class Problems(logging.Handler):
    """What the parser of docstrings complains about."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.found: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.found.append(record.getMessage())


def build(root: Path = ROOT) -> str:
    """The page.

    Raises:
        ValueError: an exported name is not documented, or its docstring does not fit its signature.
    """
    problems = Problems()
    logging.getLogger("griffe").addHandler(problems)
    try:
        page = _page(root)
    finally:
        logging.getLogger("griffe").removeHandler(problems)
    if problems.found:
        raise ValueError("\n".join(problems.found))
    return page


def _page(root: Path) -> str:
    options = {"docstring_parser": "numpy", "allow_inspection": False, "try_relative_path": False}
    package = griffe.load("rtgs", search_paths=[root], **options)
    assert isinstance(package, griffe.Module)
    lines = [INTRODUCTION]
    left = {str(name) for name in package.exports or () if not str(name).startswith("__")}
    for heading, rooms in GROUPS.items():
        names = [name for name in sorted(left) if _target(package, name).path.startswith(rooms)]
        left -= set(names)
        lines.append(f"## {heading}\n")
        for name in names:
            lines += _entry(name, _target(package, name))
    if left:
        raise ValueError(f"no heading of GROUPS in docs/make_api.py takes {', '.join(sorted(left))}")
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines))


def _target(package: griffe.Module, name: str) -> griffe.Object:
    found = package[name]
    return found.final_target if isinstance(found, griffe.Alias) else found


def _entry(name: str, thing: griffe.Object) -> Iterator[str]:
    if not thing.docstring:
        raise ValueError(f"{thing.path} is exported by rtgs and has no docstring")
    yield f"### {name}\n"
    yield f"`{thing.path}`\n"
    if isinstance(thing, griffe.Function):
        yield f"```python\n{_signature(name, thing)}\n```\n"
    yield from _docstring(thing)
    if isinstance(thing, griffe.Class):
        yield from _fields(thing)
        for method in thing.functions.values():
            if method.docstring and not method.name.startswith("_"):
                kind = "" if "property" in method.labels else f"{_arguments(method)}"
                yield f"**`{name}.{method.name}{kind}`**\n"
                yield from _docstring(method)
        for attribute in thing.attributes.values():
            if "property" in attribute.labels and attribute.docstring and not attribute.name.startswith("_"):
                yield f"**`{name}.{attribute.name}`**\n"
                yield from _docstring(attribute)


def _signature(name: str, function: griffe.Function) -> str:
    """On one line where it fits, else each parameter on its own."""
    whole = str(function.signature(name=name))
    if len(whole) <= WIDTH:
        return whole
    lines = []
    for parameter in function.parameters:
        if parameter.kind is griffe.ParameterKind.keyword_only and "    *," not in lines:
            lines.append("    *,")
        default = "" if parameter.default is None else f" = {parameter.default}"
        default = " = ..." if default.startswith(" = _") else default  # a value that has no public name
        lines.append(f"    {parameter.name}: {parameter.annotation}{default},")
    return "\n".join([f"{name}(", *lines, f") -> {function.returns}"])


def _arguments(function: griffe.Function) -> str:
    return f"({', '.join(one.name for one in function.parameters if one.name not in ('self', 'cls'))})"


def _docstring(thing: griffe.Object) -> Iterator[str]:
    """The docstring as Markdown: text as it is, sections as lists."""
    assert thing.docstring is not None
    for section in thing.docstring.parse("numpy"):
        kind = section.kind.value
        if kind in PARTS:
            yield f"{PARTS[kind]}:\n"
            yield from _items(_named(section.value, kind))
        elif kind == "text" or section.title == "References":
            text = section.value if kind == "text" else section.value.description
            if re.search(r"^(Args|Returns|Raises|Attributes):$", text, re.MULTILINE):
                raise ValueError(
                    f"{thing.path}: what rtgs exports has sections with underlined titles (CONTRIBUTING.md)"
                )
            yield "" if kind == "text" else "References:\n"
            yield _plain(re.sub(r"^\.\. \[(\d+)\] ", r"\1. ", text, flags=re.MULTILINE)) + "\n"
        else:
            raise ValueError(f"{thing.path}: a section {kind!r}, which docs/make_api.py does not know")


def _named(items: Iterable[griffe.DocstringElement], kind: str) -> Iterator[tuple[str, str]]:
    """What stands before the colon, and the description; parameters that are described together in one."""
    for about, group in groupby(items, lambda item: (str(item.annotation), item.description)):
        names = ", ".join(f"`{getattr(item, 'name', '')}`" for item in group)
        yield (f"{names} ({about[0]})" if kind == "parameters" else about[0]), about[1]


def _fields(thing: griffe.Class) -> Iterator[str]:
    """Fields of a dataclass or an enum, inherited ones too: each with its docstring or the comments at it.

    A class whose docstring has parameters says there what its fields are.
    """
    assert thing.docstring is not None
    if any(section.kind.value == "parameters" for section in thing.docstring.parse("numpy")):
        return
    found = []
    for member in thing.attributes.values():
        field = member.final_target if isinstance(member, griffe.Alias) else member
        assert isinstance(field, griffe.Attribute)
        set_in_init = field.annotation is None and "class-attribute" not in field.labels
        if "property" in field.labels or field.name.startswith("_") or set_in_init:
            continue
        about = field.docstring.value if field.docstring else _comment(field)
        default = "" if (value := _default(field)) is None else f" = {value}"
        found.append((f"`{field.name}{f': {field.annotation}' if field.annotation else ''}{default}`", about))
    if found:
        yield "Fields:\n"
        yield from _items(found)


def _default(field: griffe.Attribute) -> str | None:
    """As it is written, also within ``field(default=...)``; None: there is none, or a function makes it."""
    if field.value is None:
        return None
    call = ast.parse(str(field.value), mode="eval").body
    if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "field":
        given = {keyword.arg: keyword.value for keyword in call.keywords}
        return ast.unparse(given["default"]) if "default" in given else None
    return str(field.value)


def _comment(field: griffe.Attribute) -> str:
    """The comments above the line of a field, then the one at its end."""
    assert isinstance(field.filepath, Path)
    assert field.lineno is not None
    *above, line = field.filepath.read_text(encoding="utf-8").splitlines()[: field.lineno]
    found: list[str] = []
    while above and above[-1].strip().startswith("#"):
        found.insert(0, above.pop().strip().lstrip("# "))
    _, mark, own = line.partition("  # ")
    return " ".join([*found, own] if mark else found)


def _items(items: Iterable[tuple[str, str]]) -> Iterator[str]:
    for name, about in items:
        yield _plain(f"- {name}: {' '.join(about.split())}" if about else f"- {name}")
    yield ""


def _plain(text: str) -> str:
    """Docstring text as Markdown: roles and double backticks become code, and long lines are wrapped."""
    pieces = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text).replace("``", "`").split("`")
    pieces[::2] = [piece.replace("*", r"\*") for piece in pieces[::2]]
    return "\n".join(_wrapped(line) for line in "`".join(pieces).splitlines())


def _wrapped(line: str) -> str:
    indent = "  " if line.startswith("- ") else ""
    options = {"subsequent_indent": indent, "break_long_words": False, "break_on_hyphens": False}
    return "\n".join(textwrap.wrap(line, WIDTH, **options))


if __name__ == "__main__":
    page = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "api.md"
    page.write_text(build().rstrip() + "\n", encoding="utf-8")
