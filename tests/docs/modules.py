"""The names that modules define, read from their syntax trees: no module is imported for it."""

from __future__ import annotations

import ast
import builtins
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path


class Modules:
    """The names that modules define, read from their syntax trees."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._trees: dict[str, ast.Module | None] = {}

    def tree(self, module: str) -> ast.Module | None:
        """Of a module by its dotted name; None: there is none."""
        if module not in self._trees:
            place = self.root.joinpath(*module.split("."))
            files = (place.with_suffix(".py"), place / "__init__.py", place.with_suffix(".pyi"))
            path = next((file for file in files if file.is_file()), None)
            self._trees[module] = None if path is None else ast.parse(path.read_text(encoding="utf-8"))
        return self._trees[module]

    def is_package(self, module: str) -> bool:
        return self.root.joinpath(*module.split(".")).is_dir()

    def resolves(self, dotted: str) -> bool:
        """Whether a dotted name is a module, a package, or something that one defines."""
        parts = dotted.split(".")
        for cut in range(len(parts), 0, -1):
            module = ".".join(parts[:cut])
            if self.tree(module) is not None and self.defines(module, parts[cut:]):
                return True
            if cut == len(parts) and self.is_package(module):
                return True
        return False

    def defines(self, module: str, parts: list[str], seen: frozenset[tuple[str, str]] = frozenset()) -> bool:
        """Whether ``module`` has the name ``parts`` (none: itself), its own or imported."""
        if not parts:
            return True
        tree = self.tree(module)
        name, rest = parts[0], parts[1:]
        if tree is None or (module, name) in seen:
            return False
        seen |= {(module, name)}
        for source, original in _imported(tree, name):
            other_project = self.tree(source) is None and not self.is_package(source)
            return other_project or self.resolves(".".join((source, original, *rest)))
        return any(not rest or self.member(module, node, rest, seen) for node in _bindings(tree.body, name))

    def member(self, module: str, node: ast.AST, parts: list[str], seen: frozenset[tuple[str, str]]) -> bool:
        """Whether a class has the member ``parts``, of its own or of a base."""
        if not isinstance(node, ast.ClassDef):
            return False
        if any(name == parts[0] for name in _members(node)):
            return True
        bases = (ast.unparse(base).split("[")[0] for base in node.bases)
        return any(self.defines(module, [*base.split("."), *parts], seen) for base in bases)

    def known_in(self, module: str, name: str) -> bool:
        """Whether a bare name of a docstring means something: in the module, in one of its classes, in Python."""
        parts = name.split(".")
        tree = self.tree(module)
        if tree is None or self.defines(module, parts):
            return tree is not None
        if len(parts) > 1:
            return self.resolves(name) or (not self.is_package(parts[0]) and find_spec(parts[0]) is not None)
        classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
        return any(self.member(module, node, parts, frozenset()) for node in classes) or hasattr(builtins, name)


def _imported(tree: ast.Module, name: str) -> Iterator[tuple[str, str]]:
    """(module, name there) of every ``from module import``, lazy ones included, that brings ``name``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from ((node.module, alias.name) for alias in node.names if (alias.asname or alias.name) == name)


def _bindings(body: Iterable[ast.stmt], name: str) -> Iterator[ast.AST]:
    """Statements that define ``name`` at the top of a module (or under its ``if``)."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            if node.name == name:
                yield node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(part, ast.Name) and part.id == name for target in targets for part in ast.walk(target)):
                yield node
        elif isinstance(node, ast.Import):
            if any((alias.asname or alias.name.split(".")[0]) == name for alias in node.names):
                yield node
        elif isinstance(node, ast.If | ast.Try):
            yield from _bindings([*node.body, *node.orelse], name)


def _members(node: ast.ClassDef) -> Iterator[str]:
    """Names of a class: methods, fields, and what its methods set on ``self``."""
    for inner in node.body:
        if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield inner.name
        elif isinstance(inner, ast.Assign | ast.AnnAssign):
            targets = inner.targets if isinstance(inner, ast.Assign) else [inner.target]
            yield from (target.id for target in targets if isinstance(target, ast.Name))
    for inner in ast.walk(node):
        stored = isinstance(inner, ast.Attribute) and isinstance(inner.ctx, ast.Store)
        if stored and isinstance(inner.value, ast.Name) and inner.value.id == "self":
            yield inner.attr
