"""Links from a run's report to the files beside it: only where the page lies is it known which there are."""

from __future__ import annotations

import html
import re
from pathlib import Path
from urllib.parse import quote

from rtgs.core.files import whole_file

BEGIN, END = "<!-- files -->", "<!-- /files -->"
_BLOCK = re.compile(f"{re.escape(BEGIN)}.*?{re.escape(END)}", re.DOTALL)
_KINDS = (
    ("*.ply", {"point_cloud.ply": "base set", "mesh.ply": "mesh"}, "set of Gaussians"),
    ("mesh.*", {}, "mesh"),
    ("exports/*", {}, "export"),
    ("shown/*/film.mp4", {}, "film"),
    ("metrics.csv", {}, "figures"),
    ("metrics.json", {}, "figures"),
    ("config.yaml", {}, "config"),
)
"""Patterns of files in a run folder, what some names hold, and what the others do."""


def link_files(page: Path) -> None:
    """Write the list of the files beside a report into it, in the place of the last one; other files stay alone.

    Call it again when files come or go. A page that has no place for the list stays as it is.
    """
    text = page.read_text(encoding="utf-8")
    linked = _BLOCK.sub(lambda _: f"{BEGIN}{_list(page.parent)}{END}", text, count=1)
    if linked != text:
        with whole_file(page) as working:
            working.write_text(linked, encoding="utf-8")


def _list(folder: Path) -> str:
    """As HTML; empty where there is none."""
    found: dict[Path, str] = {}
    for pattern, named, other in _KINDS:
        for path in sorted(folder.glob(pattern)):
            if path.is_file():
                found.setdefault(path, named.get(path.name, other))
    if not found:
        return ""
    items = "".join(f"<li>{_link(path.relative_to(folder), what, path)}</li>" for path, what in found.items())
    return f'<section><h2>Files</h2><ul class="files">{items}</ul></section>'


def _link(name: Path, what: str, path: Path) -> str:
    size = path.stat().st_size
    amount = f"{size / 1e6:,.1f} MB" if size >= 100_000 else f"{size / 1e3:,.1f} kB"
    address = quote(name.as_posix())
    return f'<a href="{address}">{html.escape(name.as_posix())}</a> <small>{html.escape(what)}, {amount}</small>'
