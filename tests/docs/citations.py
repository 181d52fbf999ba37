"""Finds what code and docs cite, and what of it is not there.

Read from the text alone: nothing of the project is imported.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from tests.docs.modules import Modules

FOLDERS = ("rtgs", "pipelines", "hydra_plugins", "conf", "docs", "tests", "benchmarks", "lab", "examples", "docker")
SINGLE = ("README.md", "CONTRIBUTING.md", "Makefile", "CMakeLists.txt", "pyproject.toml")
SUFFIXES = frozenset({".py", ".pyi", ".md", ".yaml", ".yml", ".toml", ".cpp", ".h", ".cmake", ""})
SKIPPED = frozenset({"__pycache__", "data", "images", ".venv", "build"})
EXAMPLES = frozenset({"citations.py", "test_citations.py"})  # of tests/docs: full of citations that lead nowhere
# By a person or a command, and experiments of MLflow.
MADE = frozenset({"docker/.env", "benchmarks/results", "lab/results", "rtgs/runs", "rtgs/steps"})

_BREAK = re.compile(r"\n[ \t]*(?:#+|//+|\*|>)?[ \t]*")
_NUMBER = r"\d+(?:\.\d+)*"
_NEXT = rf"(?:(?:, (?:and |to )?| and | to ){_NUMBER})*"
_LIST = rf"{_NUMBER}{_NEXT}"
_SECTION = re.compile(rf"\bmethod\.md(?:'s)?\)?,? +({_NUMBER}(?: \"[^\"\n]*\")?{_NEXT})(?![\w%])")
_TITLE = re.compile(r"([\w/-]+\.md)(?:#[\w-]+)?\)?(?:,? +[\d.]+)?,? +\"([^\"\n]{3,60})\"")
_DECISION = re.compile(rf"\b[Dd]ecisions? ({_LIST})(?!\w)")
_OLD = re.compile(r"\b[Rr]egister rows? \d+")
_EQUATION = re.compile(rf"\b(?:paper(?:'s)?,? eq\.|eq\. ?\(?(?=\d+\)? of the paper)) ?\(?({_LIST})")
_WRITTEN = re.compile(r"PRESET|SCENE|smoke|^table\.md$")  # Markdown files that commands write
_MARKDOWN = re.compile(r"(?<![\w/.*<{:-])(\w[\w./-]*\w\.md|\.\.?/[\w./-]*\w\.md|\w\.md)\b(?!\w)")
_LINK = re.compile(r"(?<!`)!?\[[^\]]*\]\(([^()\s]+)\)")
_CODE = re.compile(r"(?<![:`])(`+)([^`\n]+)\1")
_PLACE = re.compile(rf"(?<![\w/.-])((?:{'|'.join(FOLDERS)})/[\w./*<>{{}},\[\]-]*[\w>}}*/])")
_ROLE = re.compile(r":(mod|func|class|meth|attr|data|exc|obj):`~?([^`]+)`")
_DOTTED = re.compile(r"^(?:rtgs|pipelines|benchmarks|lab|tests)(?:\.\w\w+)+$")  # rtgs.x.y stands for any name


@dataclass(frozen=True)
class Broken:
    """One citation that leads nowhere."""

    file: str
    line: int
    what: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.what}"


def flattened(text: str) -> str:
    """The text with every line break, the indentation after it and a comment sign as blanks; no character moves."""
    return _BREAK.sub(lambda found: " " * len(found[0]), text)


def numbers_of(cited: str) -> list[str]:
    """``"4.2 to 4.4, 6"`` to every number that is meant: of a range both ends, and whole numbers in between."""
    found: list[str] = []
    for separator, number in re.findall(rf"(?:^|(, (?:and |to )?| and | to ))({_NUMBER})", cited):
        if "to" in separator and found and "." not in number + found[-1]:
            found += [str(between) for between in range(int(found[-1]) + 1, int(number))]
        found.append(number)
    return found


def headings(text: str) -> list[str]:
    """The headings of a Markdown text, without those in code blocks."""
    return re.findall(r"^#{1,6} +(.+?) *#*$", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL), re.M)


def anchor(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
    return re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")


class Library:
    """What can be cited: the files below ``root``."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def files(self) -> Iterator[Path]:
        """Every text file whose citations count."""
        for name in SINGLE:
            if (self.root / name).is_file():
                yield self.root / name
        for folder in FOLDERS:
            for path in sorted((self.root / folder).rglob("*")):
                inner = path.relative_to(self.root).parts
                if path.suffix not in SUFFIXES or not path.is_file() or SKIPPED.intersection(inner):
                    continue
                if inner[:2] != ("tests", "docs") or path.name not in EXAMPLES:
                    yield path

    def text(self, name: str) -> str:
        """Of a file by its place below the root; empty when it is not there."""
        path = self.root / name
        return path.read_text(encoding="utf-8") if path.is_file() else ""

    @cached_property
    def sections(self) -> frozenset[str]:
        """Numbers of the sections of docs/method.md."""
        return frozenset(_leading_number(heading) for heading in headings(self.text("docs/method.md")))

    @cached_property
    def decisions(self) -> frozenset[str]:
        """Numbers of the decisions of docs/decisions.md."""
        return frozenset(_leading_number(heading) for heading in headings(self.text("docs/decisions.md")))

    @cached_property
    def equations(self) -> frozenset[str]:
        """Numbers of the paper's equations that docs/method.md finds a place for."""
        table = self.text("docs/method.md").partition("| eq. |")[2].partition("\n\n")[0]
        return frozenset(re.findall(r"^\| (\d+) \|", table, re.MULTILINE))

    @cached_property
    def names(self) -> frozenset[str]:
        """Last parts of every file."""
        return frozenset(path.name for path in self.files())

    @cached_property
    def made(self) -> frozenset[str]:
        """What looks like a place in the tree and is none: files that a person makes, experiments of MLflow."""
        return MADE | {f"rtgs/{path.stem}" for path in (self.root / "conf/experiment").glob("*.yaml")}

    @cached_property
    def modules(self) -> Modules:
        return Modules(self.root)

    def markdown(self, name: str, near: Path) -> Path | None:
        """The file that a Markdown name means: beside the text, below the root, in docs/."""
        places = (near.parent / name, self.root / name, self.root / "docs" / name)
        return next((place for place in places if place.is_file()), None)

    def exists(self, place: str) -> bool:
        """Whether a path below the root is there; ``<name>``, ``*`` and ``{a,b}`` stand for anything."""
        pattern = re.sub(r"<[^>]*>|\{[^}]*\}|\*+", "*", place.partition("::")[0].rstrip("/"))
        if "*" not in pattern:
            return (self.root / pattern).exists()
        return next(self.root.glob(pattern), None) is not None


def _leading_number(heading: str) -> str:
    found = re.match(rf"({_NUMBER})\.? ", heading)
    return found[1] if found else ""


Finding = tuple[int, str]  # offset in the text, what is wrong
Check = Callable[[Library, Path, str], Iterator[Finding]]


def section_numbers(library: Library, path: Path, text: str) -> Iterator[Finding]:
    """``method.md 4.2 to 4.4``: numbered headings of that page."""
    for found in _SECTION.finditer(flattened(text)):
        for number in numbers_of(found[1]):
            if number not in library.sections:
                yield found.start(), f"docs/method.md has no section {number}"


def quoted_titles(library: Library, path: Path, text: str) -> Iterator[Finding]:
    """``rasterizer.md, "Ellipsoids"``: a heading or a bold word of that page."""
    for found in _TITLE.finditer(flattened(text)):
        page = library.markdown(found[1], path)
        if page is not None:
            body = page.read_text(encoding="utf-8")
            titles = [*headings(body), *re.findall(r"\*\*([^*]+)\*\*", body)]
            if not any(found[2].strip(" .:") in title for title in titles):
                yield found.start(), f"{found[1]} has no heading or bold word {found[2]!r}"


def decision_numbers(library: Library, path: Path, text: str) -> Iterator[Finding]:
    """``decision 8``, ``decisions 1 to 5``: entries of docs/decisions.md."""
    for found in _DECISION.finditer(flattened(text)):
        for number in numbers_of(found[1]):
            if number not in library.decisions:
                yield found.start(), f"docs/decisions.md has no decision {number}"
    for found in _OLD.finditer(flattened(text)):
        yield found.start(), f"{found[0]!r}: entries of docs/decisions.md are cited as 'decision N'"


def equation_numbers(library: Library, path: Path, text: str) -> Iterator[Finding]:
    """``paper eq. 8``: an equation of the table in docs/method.md."""
    for found in _EQUATION.finditer(flattened(text)):
        for number in numbers_of(found[1]):
            if number not in library.equations:
                yield found.start(), f"docs/method.md has no place for the paper's eq. {number}"


def markdown_files(library: Library, path: Path, text: str) -> Iterator[Finding]:
    """``docs/mesh.md``, ``mesh.md``: a file beside the text, below the root or in docs/."""
    for found in _MARKDOWN.finditer(text):
        if not _WRITTEN.search(Path(found[1]).name) and library.markdown(found[1], path) is None:
            yield found.start(), f"there is no {found[1]}"


def links(library: Library, path: Path, text: str) -> Iterator[Finding]:
    """``[words](page.md#heading)`` of Markdown: the file, and its heading."""
    if path.suffix != ".md":
        return
    for found in _LINK.finditer(re.sub(r"`[^`\n]*`", lambda code: " " * len(code[0]), text)):
        if "://" in found[1] or found[1].startswith("mailto:"):
            continue
        place, _, wanted = found[1].partition("#")
        target = path.parent / place if place else path
        if not target.exists():
            yield found.start(), f"link to {place}, which is not there"
        elif wanted and wanted not in map(anchor, headings(target.read_text(encoding="utf-8"))):
            yield found.start(), f"{place or path.name} has no heading for #{wanted}"


def places(library: Library, path: Path, text: str) -> Iterator[Finding]:
    """``rtgs/mesh/hull.py``, and in backticks ``hull.py``: files and folders of the tree."""
    for found in _PLACE.finditer(text):
        place = found[1] if "{" in found[1] else found[1].rstrip("}")
        judged = path.suffix == ".md" or Path(place).suffix in (".py", ".cpp", ".h", ".md", ".yaml", ".toml")
        if judged and place.rstrip("/") not in library.made and not library.exists(place):
            yield found.start(), f"there is no {place}"
    if path.suffix == ".md":
        for found in _CODE.finditer(text):
            if re.fullmatch(r"\w+\.(py|cpp|h)", found[2]) and found[2] not in library.names:
                yield found.start(), f"no file is called {found[2]}"


def roles(library: Library, path: Path, text: str) -> Iterator[Finding]:
    """``:func:`rtgs.x.y``` and ``:meth:`begin``` of docstrings."""
    if path.suffix not in (".py", ".pyi"):
        return
    module = ".".join(path.relative_to(library.root).with_suffix("").parts).removesuffix(".__init__")
    for found in _ROLE.finditer(text):
        name = " ".join(found[2].split()).removesuffix("()")
        own = name.split(".")[0] in FOLDERS
        if not (library.modules.resolves(name) if own else library.modules.known_in(module, name)):
            yield found.start(), f":{found[1]}: {name} is nowhere defined"


def dotted_names(library: Library, path: Path, text: str) -> Iterator[Finding]:
    """Dotted names in backticks that begin with a package of the project, and ``python -m`` of one."""
    for found in _CODE.finditer(text):
        name = found[2].removesuffix("()")
        words = re.findall(r"python -m ((?:rtgs|pipelines|benchmarks|lab)[\w.]*)", name)
        for dotted in [name] * bool(_DOTTED.match(name)) + words:
            if not library.modules.resolves(dotted) and not re.fullmatch(r"rtgs\.(yaml|toml|step|fingerprint)", dotted):
                yield found.start(), f"{dotted} is nowhere defined"


CHECKS: tuple[Check, ...] = (
    section_numbers,
    quoted_titles,
    decision_numbers,
    equation_numbers,
    markdown_files,
    links,
    places,
    roles,
    dotted_names,
)


def broken_citations(library: Library, path: Path, text: str) -> list[Broken]:
    """What a text at ``path`` cites and is not there."""
    name = path.relative_to(library.root).as_posix()
    findings = {finding for check in CHECKS for finding in check(library, path, text)}
    return [Broken(name, text.count("\n", 0, offset) + 1, what) for offset, what in sorted(findings)]
