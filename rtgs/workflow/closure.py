"""Which files of a project a module reaches through its imports, and a digest of each: the sources of a step.

Only text is read; nothing is imported. An import counts where it can run: at the top, in a function, in a package's
``__init__`` on the way; not under ``if TYPE_CHECKING``. Whatever a module brings in by other means it declares itself:

    REACHES = ("templates/*", "rtgs.methods.*")

A module that imports by a name made at run time, or asks where its own file lies, and declares nothing is refused.
"""

from __future__ import annotations

import ast
import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from rtgs.core.errors import RtgsError

DECLARATION = "REACHES"
"""A module's own tuple of what its imports do not show: modules (``rtgs.x.y``, ``rtgs.x.*`` for all of a package) and
files beside it (patterns of :meth:`pathlib.Path.glob`). Empty: nothing of it changes what a step computes."""

_IMPORTERS = ("import_module", "__import__")
_LOADERS = (
    *("entry_points", "exec_module", "iter_modules", "load_module", "run_module", "run_path"),
    *("CDLL", "find_spec", "load_library", "resolve_name", "spec_from_file_location", "walk_packages"),
)
_READERS = ("__file__", "__loader__", "__path__", "__spec__", "FileSystemLoader", "PackageLoader", "get_data")
_RUNNERS = ("eval", "exec")  # of text; only as bare names, since models and databases have methods so called
_RESOURCES = ("importlib.resources", "importlib_resources")
_COMMENTED = {
    **dict.fromkeys(
        (".c", ".cc", ".cpp", ".cu", ".cuh", ".h", ".hpp"),
        r"""(R"(\w*)\(.*?\)\2"|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])')|//[^\n]*|/\*.*?\*/""",
    ),
    **dict.fromkeys((".cmake", "CMakeLists.txt"), r'("(?:\\.|[^"\\])*")|#[^\n]*'),
}
"""Comments by a file's suffix or name, after strings and characters, which are kept (the first group)."""


@dataclass(frozen=True)
class _Module:
    """What the text of a module says."""

    digest: str
    imports: tuple[tuple[str, tuple[str, ...]], ...]  # dotted base, names taken from it
    hidden: str  # the first place that needs a declaration; empty: there is none
    declared: tuple[str, ...] | None


class SourceTree:
    """The files of a project, each read and parsed once.

    Attributes:
        root: folder that holds the packages.
        packages: names of the top-level packages that are the project's own.
    """

    def __init__(self, root: Path, packages: Iterable[str]) -> None:
        self.root = root.resolve()
        self.packages = tuple(packages)
        self._edits: Mapping[str, str] = {}
        self._modules: dict[str, _Module] = {}
        self._digests: dict[str, str] = {}
        self._reach: dict[str, tuple[str, ...]] = {}

    def edited(self, file: str, text: str) -> SourceTree:
        """The same tree with other text in one file that it has; nothing is written."""
        other = SourceTree(self.root, self.packages)
        other._edits = {**self._edits, file: text}
        for name in ("_modules", "_digests", "_reach"):
            setattr(other, name, {key: value for key, value in getattr(self, name).items() if key != file})
        return other

    def text(self, file: str) -> str:
        """Content of a file, named by its path from the root."""
        return self._edits[file] if file in self._edits else (self.root / file).read_text("utf-8", "surrogateescape")

    def digest(self, file: str) -> str:
        """16 hexadecimal digits of what a file means: comments, blanks between tokens and docstrings do not count in
        Python, C++ and CMake; every character counts in other files."""
        if file.endswith(".py"):
            return self._module(file).digest
        if file not in self._digests:
            self._digests[file] = _digest(_without_comments(file, self.text(file)))
        return self._digests[file]

    def closure(self, module: str, by: str = "the guard") -> frozenset[str]:
        """Paths from the root of every file that ``module`` (dotted) reaches, its own among them; ``by``: who asks.

        Raises:
            RtgsError: a module of the project does not exist, or one does not say what it reaches.
        """
        found: set[str] = set()
        waiting = self._files_of(module, by)
        while waiting:
            file = waiting.pop()
            if file not in found:
                found.add(file)
                waiting += [other for other in self._reached(file) if other not in found]
        return frozenset(found)

    def file_of(self, module: str) -> str | None:
        """The file of a module of the project; None where there is none (a folder without ``__init__`` has none)."""
        stem = module.replace(".", "/")
        names = (f"{stem}.py", f"{stem}/__init__.py")
        return next((name for name in names if (self.root / name).is_file()), None)

    def _reached(self, file: str) -> tuple[str, ...]:
        if file not in self._reach:
            self._reach[file] = tuple(self._find_reached(file)) if file.endswith(".py") else ()
        return self._reach[file]

    def _find_reached(self, file: str) -> Iterator[str]:
        module = self._module(file)
        if module.hidden and module.declared is None:
            raise RtgsError(
                f"{file}, {module.hidden}: imports alone do not show what this brings in. Declare modules and files in "
                f"the module, `{DECLARATION} = (...)`; empty where no step's result depends on it"
            )
        for base, names in module.imports:
            if base.split(".")[0] in self.packages:
                yield from self._files_of(base, file)
                for name in names:
                    if (submodule := self.file_of(f"{base}.{name}")) is not None:
                        yield submodule
        for entry in module.declared or ():
            yield from self._declared(file, entry)

    def _files_of(self, module: str, by: str) -> list[str]:
        """A module and the packages around it, whose ``__init__`` runs first."""
        parts = module.split(".")
        files = [self.file_of(".".join(parts[:count])) for count in range(1, len(parts) + 1)]
        if files[-1] is None and not (self.root / Path(*parts)).is_dir():
            raise RtgsError(f"{by} reaches the module {module!r}, which does not exist in {self.root}")
        return [file for file in files if file is not None]

    def _declared(self, file: str, entry: str) -> list[str]:
        """The files that one entry of a declaration stands for."""
        if re.fullmatch(r"[\w.]+(\.\*)?", entry) and entry.split(".")[0] in self.packages:
            if not entry.endswith(".*"):
                return self._files_of(entry, file)
            folder = self.root / Path(*entry.split(".")[:-1])
            found = [path.relative_to(self.root).as_posix() for path in sorted(folder.rglob("*.py"))]
        else:
            paths = (path for path in sorted((self.root / file).parent.glob(entry)) if path.is_file())
            found = [Path(os.path.normpath(path)).relative_to(self.root).as_posix() for path in paths]
        if not found:
            raise RtgsError(f"{file} declares {entry!r} in {DECLARATION}: there is no such file")
        return found

    def _module(self, file: str) -> _Module:
        if file not in self._modules:
            self._modules[file] = _read_module(file, self.text(file))
        return self._modules[file]


def _read_module(file: str, text: str) -> _Module:
    tree = ast.parse(text, file)
    package = file.removesuffix(".py").split("/")[:-1]
    reader = _ImportReader(package)
    reader.visit(tree)
    return _Module(_digest(_meaning(tree)), tuple(reader.imports), reader.hidden, _declaration(tree, file))


class _ImportReader(ast.NodeVisitor):
    """Collects the imports of a module that can run, and the first thing that only a declaration explains."""

    def __init__(self, package: list[str]) -> None:
        self.imports: list[tuple[str, tuple[str, ...]]] = []
        self.hidden = ""
        self._package = package

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            if alias.name in _RESOURCES:
                self._needs_declaration(node, alias.name)
        self.imports += [(alias.name, ()) for alias in node.names]

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        around = self._package[: len(self._package) - node.level + 1] if node.level else []
        base = ".".join([*around, *(node.module.split(".") if node.module else ())])
        names = tuple(alias.name for alias in node.names)
        for alias in node.names:
            if alias.name == "*" or (alias.name in (*_IMPORTERS, *_LOADERS) and alias.asname):
                self._needs_declaration(node, f"from {base} import {alias.name}")
            self._look_at_name(node, alias.name, (*_LOADERS, *_READERS))
        if base in _RESOURCES or (base == "importlib" and "resources" in names):
            self._needs_declaration(node, "importlib.resources")
        self.imports.append((base, names))

    def visit_If(self, node: ast.If) -> None:
        if _is_type_checking(node.test):
            for child in node.orelse:
                self.visit(child)
        else:
            self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name == "getattr" and len(node.args) > 1:
            self._look_at_getattr(node)
        if name not in _IMPORTERS:
            self.generic_visit(node)
            return
        constant = node.args[0].value if node.args and isinstance(node.args[0], ast.Constant) else None
        if isinstance(constant, str) and not constant.startswith(".") and len(node.args) == 1 and not node.keywords:
            self.imports.append((constant, ()))
            return
        self._needs_declaration(node, name)
        self.generic_visit(node)

    def _look_at_getattr(self, node: ast.Call) -> None:
        """``getattr(importlib, "import_module")``, and with a name made at run time."""
        owner, attribute = node.args[:2]
        if isinstance(attribute, ast.Constant):
            self._look_at_name(node, str(attribute.value), (*_IMPORTERS, *_LOADERS, *_READERS))
        elif isinstance(owner, ast.Name) and owner.id in ("importlib", "builtins", "pkgutil", "runpy"):
            self._needs_declaration(node, f"getattr({owner.id}, ...)")

    def visit_Name(self, node: ast.Name) -> None:
        self._look_at_name(node, node.id, (*_IMPORTERS, *_LOADERS, *_READERS, *_RUNNERS))

    def visit_Attribute(self, node: ast.Attribute) -> None:
        self._look_at_name(node, node.attr, (*_IMPORTERS, *_LOADERS, *_READERS))
        self.generic_visit(node)

    def _look_at_name(self, node: ast.AST, name: str, watched: tuple[str, ...]) -> None:
        if name in watched:
            self._needs_declaration(node, name)

    def _needs_declaration(self, node: ast.AST, what: str) -> None:
        self.hidden = self.hidden or f"line {getattr(node, 'lineno', '?')}, {what}"


def _is_type_checking(test: ast.expr) -> bool:
    return (test.attr if isinstance(test, ast.Attribute) else getattr(test, "id", "")) == "TYPE_CHECKING"


def _declaration(tree: ast.Module, file: str) -> tuple[str, ...] | None:
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == DECLARATION for target in targets):
            try:
                return tuple(str(entry) for entry in ast.literal_eval(getattr(node, "value", None)))  # pyright: ignore
            except (ValueError, TypeError) as error:
                raise RtgsError(f"{file}: {DECLARATION} must be a literal tuple of strings") from error
    return None


def _meaning(tree: ast.Module) -> str:
    """The syntax tree as text, without strings that stand alone as a statement: they are documentation."""
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            if isinstance(body := getattr(node, name, None), list):
                body[:] = [child for child in body if not _is_documentation(child)]
    return ast.dump(tree)


def _is_documentation(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _without_comments(file: str, text: str) -> str:
    path = Path(file)
    pattern = _COMMENTED.get(path.name, _COMMENTED.get(path.suffix))
    if pattern is None:
        return text
    strings: list[str] = []

    def stand_in(match: re.Match[str]) -> str:
        if match.group(1) is None:
            return " "
        strings.append(match.group(1))
        return f"\0{len(strings) - 1}\0"

    code = re.sub(pattern, stand_in, text, flags=re.DOTALL).replace("\\\n", " ")
    lines = (f"{line} \1" if line.lstrip().startswith("#") else line for line in code.splitlines())
    code = " ".join(" ".join(lines).split())  # blanks count in strings alone, line ends after directives alone
    return re.sub("\0(\\d+)\0", lambda match: strings[int(match.group(1))], code)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]
