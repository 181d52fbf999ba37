"""The documentation as a site: ``make docs``, or `python docs/make_site.py FOLDER`. Needs mkdocs-material.

Pages are read where they are. A copy of them, with the README as the first page and with links that fit there, is what
mkdocs takes; the navigation is that of docs/README.md. Nothing on a page comes from another server.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]
REACHES = ()
MD = ".md"
FIRST, ALL = f"index{MD}", f"pages{MD}"
PLACES = {"README.md": FIRST, "docs/README.md": ALL, "CONTRIBUTING.md": f"contributing{MD}"}
"""Where pages go that are not in docs/, or would be a second first page."""
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^()\s]+)\)")
_ADDRESS = re.compile(r"[a-z]+:")
CONFIG = """site_name: rtgs
site_description: Gaussian models of scenes with glass and mirrors, on the CPU
docs_dir: pages
site_dir: {out}
use_directory_urls: false
theme:
  name: material
  font: false
  features: [navigation.tabs, navigation.top, search.highlight, content.code.copy]
  palette:
    - {{ media: "(prefers-color-scheme: light)", scheme: default, primary: blue grey }}
    - {{ media: "(prefers-color-scheme: dark)", scheme: slate, primary: blue grey }}
plugins: [search]
markdown_extensions: [tables, fenced_code, toc, pymdownx.highlight, pymdownx.superfences]
validation: {{ links: {{ anchors: warn, unrecognized_links: warn }} }}
nav:
{nav}
"""


def pages(root: Path) -> dict[str, Path]:
    """Every page by its place in the site."""
    found = {place: root / name for name, place in PLACES.items()}
    for path in sorted((root / "docs").rglob("*.md")):
        if path != root / "docs" / "README.md":
            found[path.relative_to(root / "docs").as_posix()] = path
    return found


def linked(text: str, source: str, root: Path) -> str:
    """The text of a page (``source``, from the root) with links as the site has them.

    What the site does not hold, such as a script, becomes plain text.
    """
    here = PurePosixPath(place_of(source) or source)

    def link(match: re.Match[str]) -> str:
        picture, words, target = match.groups()
        if _ADDRESS.match(target) or target.startswith("#"):
            return match[0]
        path, mark, anchor = target.partition("#")
        whole = (root / source).parent.joinpath(path).resolve()
        name = whole.relative_to(root.resolve()).as_posix() if whole.is_relative_to(root.resolve()) else ""
        place = place_of(name)
        if place is None or not whole.is_file():
            return words
        return f"{picture}[{words}]({_relative(place, here)}{mark}{anchor})"

    return _LINK.sub(link, text)


def place_of(name: str) -> str | None:
    """Where a file of the tree is in the site; None: it is not there."""
    if name in PLACES:
        return PLACES[name]
    inside = name.startswith("docs/") and name.endswith((".md", ".png", ".jpg"))
    return name.removeprefix("docs/") if inside else None


def _relative(place: str, here: PurePosixPath) -> str:
    return "../" * (len(here.parts) - 1) + place


def navigation(root: Path) -> str:
    """The tables of docs/README.md as mkdocs wants them."""
    lines = [f"  - Start: [{FIRST}, {ALL}]"]
    known = {FIRST, ALL}
    index = (root / "docs" / "README.md").read_text(encoding="utf-8")
    for section in index.split("\n## ")[1:]:
        names = list(dict.fromkeys(re.findall(r"\]\(([\w./]+\.md)\)", section.partition("\n`examples/`")[0])))
        names = [name for name in names if name not in known]
        known |= set(names)
        lines += [f"  - {section.splitlines()[0]}:", *(f"    - {name}" for name in names)]
    rest = sorted(set(pages(root)) - known)
    lab = [name for name in rest if name.startswith("lab/")]
    lines += ["  - Lab:", *(f"    - {name}" for name in lab)]
    lines += [f"  - {name}" for name in rest if name not in lab]
    return "\n".join(lines)


def build(out: Path, root: Path = ROOT) -> None:
    """Write the site into ``out``; a link that leads nowhere stops it.

    Raises:
        subprocess.CalledProcessError: mkdocs is not there, or found something wrong.
    """
    working = out.with_name(f"{out.name}_source")
    shutil.rmtree(working, ignore_errors=True)
    for place, path in pages(root).items():
        target = working / "pages" / place
        target.parent.mkdir(parents=True, exist_ok=True)
        source = path.relative_to(root).as_posix()
        target.write_text(linked(path.read_text(encoding="utf-8"), source, root), encoding="utf-8")
    shutil.copytree(root / "docs" / "images", working / "pages" / "images")
    config = working / "mkdocs.yml"
    config.write_text(CONFIG.format(out=out.absolute(), nav=navigation(root)), encoding="utf-8")
    subprocess.run([sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-f", str(config)], check=True)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build" / "site"
    build(target)
    print(target / "index.html")
