"""The guard against a forgotten version bump: a hash of each step's source, kept under review in a small lock file.

Hashing source at run time would throw caches away on a comment and miss helpers. Here a test compares the hash with
the recorded one, and a person decides: bump the version (old artifacts no longer count) or accept (same meaning).
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import re
from collections.abc import Iterable
from pathlib import Path

from rtgs.core.errors import RtgsError
from rtgs.workflow.step import StepKind


def source_hash(kind: StepKind) -> str:
    """SHA-256 over the module of ``kind.run`` and its helper modules; comments, blanks and docstrings do not count.

    A helper that is a package counts with the C++ sources beside its ``__init__``: ``rtgs.native`` is all kernels.
    """
    digest = hashlib.sha256()
    for module in (kind.run.__module__, *kind.helpers):
        digest.update(module.encode())
        source = _source(module, kind.name)
        digest.update(_normalised(source).encode())
        if source.name == "__init__.py":
            for native in sorted(path for path in source.parent.iterdir() if path.suffix in (".cpp", ".h")):
                digest.update(native.name.encode())
                digest.update(_normalised_native(native).encode())
    return digest.hexdigest()


def _source(module: str, step: str) -> Path:
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise RtgsError(f"step {step} declares the helper module {module!r}, which does not exist")
    return Path(spec.origin)


def _normalised(path: Path) -> str:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and ast.get_docstring(
            node
        ):
            assert isinstance(body, list)
            body.pop(0)
    return ast.dump(tree)


def _normalised_native(path: Path) -> str:
    code = re.sub(r"//[^\n]*|/\*.*?\*/", " ", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    return " ".join(code.split())


def check_sources(kinds: Iterable[StepKind], lock_file: Path) -> list[str]:
    """What is wrong between the steps and the lock file, one message each; empty when all agree."""
    recorded = json.loads(lock_file.read_text(encoding="utf-8")) if lock_file.exists() else {}
    problems = []
    kinds = list(kinds)
    for kind in kinds:
        entry = recorded.get(kind.name)
        if entry is None:
            problems.append(f"step {kind.name} is new: run `make accept-steps`")
        elif entry["version"] != kind.version:
            problems.append(
                f"version of step {kind.name} is {kind.version}, recorded {entry['version']}: run `make accept-steps`"
            )
        elif entry["source"] != source_hash(kind):
            problems.append(f"source of step {kind.name} changed: bump version or run `make accept-steps`")
    gone = sorted(set(recorded) - {kind.name for kind in kinds})
    problems += [f"step {name} is gone: run `make accept-steps`" for name in gone]
    return problems


def accept_sources(kinds: Iterable[StepKind], lock_file: Path) -> None:
    """Record version and source hash of every step."""
    record = {kind.name: {"version": kind.version, "source": source_hash(kind)} for kind in kinds}
    lock_file.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n", encoding="utf-8")
