"""Every import follows the tables of rooms in docs/architecture.md: downwards only, and only where a row says so."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCUMENT = ROOT / "docs" / "architecture.md"
PACKAGES = ("rtgs", "pipelines", "hydra_plugins")
WHOLE_LIBRARY = "every room of the library"
SHORT = ("rtgs/", "pipelines/")  # what the third column leaves out


@cache
def rooms() -> dict[str, frozenset[str]]:
    """What each room may import by room, in the order of the tables."""
    found: dict[str, frozenset[str]] = {}
    for line in DOCUMENT.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if len(cells) == 3 and cells[0].startswith("`") and cells[0].strip("`").startswith(PACKAGES):
            room = cells[0].strip("`")
            assert room not in found, f"{room} has two rows"
            found[room] = frozenset(_named(cells[2], tuple(found)))
    return found


def _named(cell: str, before: tuple[str, ...]) -> Iterator[str]:
    if WHOLE_LIBRARY in cell:
        yield from (room for room in before if room.startswith("rtgs/"))
        cell = cell.replace(WHOLE_LIBRARY, "")
    for word in cell.replace(",", " ").replace("-", " ").split():
        named = [room for room in before if word in (room, *(room.removeprefix(front) for front in SHORT))]
        assert len(named) == 1, f"{word!r} names none of the rooms above the row that lists it, or several: {named}"
        yield named[0]


def room_of(file: str) -> str:
    """The room a file is in, by its path from the root."""
    named = [room for room in rooms() if file == room or file.startswith(f"{room}/")]
    assert len(named) == 1, f"{file} is in the rooms {named}: docs/architecture.md must have one for it"
    return named[0]


def module_files() -> dict[str, str]:
    """Every module of the project by dotted name, with its path from the root."""
    paths = [path.relative_to(ROOT) for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return {".".join(path.with_suffix("").parts).removesuffix(".__init__"): path.as_posix() for path in paths}


def imports_of(module: str, file: str, modules: dict[str, str], text: str) -> Iterator[str]:
    """The modules of the project that a module names in an import anywhere in its text; the deepest that each names."""
    package = module.split(".") if file.endswith("__init__.py") else module.split(".")[:-1]
    for node in ast.walk(ast.parse(text)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            around = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*around, *([node.module] if node.module else [])])
            names = [deep if (deep := f"{base}.{alias.name}") in modules else base for alias in node.names]
        for name in names:
            if name.split(".")[0] in PACKAGES:
                assert name in modules, f"{file} imports {name}, which is not there"
                yield name


def every_import() -> set[tuple[str, str]]:
    modules = module_files()
    return {
        (module, other)
        for module, file in modules.items()
        for other in imports_of(module, file, modules, (ROOT / file).read_text(encoding="utf-8"))
    }


def forbidden(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """Those of the imports (who, whom) that the tables do not allow."""
    modules = module_files()
    ends = {pair: (room_of(modules[pair[0]]), room_of(modules[pair[1]])) for pair in pairs}
    return {pair for pair, (here, there) in ends.items() if here != there and there not in rooms()[here]}


def test_every_import_follows_the_tables_but_for_those_that_are_listed():
    found = every_import()
    assert len(found) > 500
    against = forbidden(found)
    found = "; ".join(f"{who} imports {whom}" for who, whom in sorted(against))
    assert not against, f"against docs/architecture.md: {found}"


def test_the_tables_have_a_row_for_every_folder_and_no_other():
    library = {f"rtgs/{path.name}" for path in (ROOT / "rtgs").iterdir() if (path / "__init__.py").is_file()}
    library |= {f"rtgs/{path.name}" for path in (ROOT / "rtgs").glob("*.py")}
    above = {f"pipelines/{path.name}" for path in (ROOT / "pipelines").iterdir() if (path / "__init__.py").is_file()}
    above |= {f"pipelines/{path.name}" for path in (ROOT / "pipelines").glob("*.py")}
    assert set(rooms()) == library | above | {"hydra_plugins"}
    for file in module_files().values():
        room_of(file)


@pytest.mark.parametrize(
    ("who", "whom"),
    [
        ("rtgs.core.errors", "rtgs.train.losses"),
        ("rtgs.native", "rtgs.core.errors"),
        ("rtgs.prepare.source", "rtgs.workflow.store"),
        ("rtgs.workflow.store", "pipelines.steps.render"),
        ("pipelines.steps.render", "pipelines.planning.plan"),
        ("pipelines.planning.plan", "pipelines.publishing.results"),
    ],
)
def test_an_import_that_runs_up_would_be_found(who: str, whom: str):
    modules = module_files()
    assert forbidden({(who, whom)}) == {(who, whom)}
    parent, _, name = whom.rpartition(".")
    for text in (
        f"import {whom}",
        f"def late():\n    from {parent} import {name}",
        f"if TYPE_CHECKING:\n    from {whom} import thing",
    ):
        assert list(imports_of(who, modules[who], modules, text)) == [whom]


def test_a_relative_import_is_followed():
    modules = module_files()
    text = "from ..train import losses\nfrom . import cameras"
    assert list(imports_of("rtgs.core.errors", "rtgs/core/errors.py", modules, text)) == [
        "rtgs.train.losses",
        "rtgs.core.cameras",
    ]
