"""Pages are short enough to be read: lines, words, and a link to each from an index."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
LONGEST = 120  # characters of a line that is neither a row of a table nor a link
MOST_WORDS = 950  # of a page that has no limit of its own
LIMITS = {
    "README.md": 550,
    "docs/README.md": 420,
    "docs/architecture.md": 1_100,
    "docs/benchmarks.md": 1_000,
    "docs/pipeline.md": 1_000,
    "docs/rasterizer.md": 1_500,
    "docs/transmittance.md": 750,
}
REFERENCES = {"docs/method.md", "docs/decisions.md", "docs/api.md"}  # looked up by number, not read through
METHOD_LINES = 60  # of the page of a method
LAST_LINE = 90  # of README: one screen of substance
TARGET = re.compile(r"\]\([^()\s]+\)")
LINK = re.compile(r"\]\(([^()\s#]+\.md)(?:#[\w-]+)?\)")


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def user_pages() -> list[Path]:
    return [path for path in pages() if path.parent != DOCS / "lab" and name(path) not in REFERENCES]


def too_long(text: str) -> list[int]:
    """Numbers of the lines that are too long without the targets of their links; rows of tables may be."""
    lines = enumerate(text.splitlines(), start=1)
    return [
        number for number, line in lines if len(TARGET.sub("]()", line)) > LONGEST and not line.lstrip().startswith("|")
    ]


def words(text: str) -> int:
    """Words with a letter, of tables and code too."""
    return sum(any(letter.isalpha() for letter in word) for word in text.split())


def linked(path: Path) -> set[Path]:
    """Pages that a page links to."""
    return {(path.parent / target).resolve() for target in LINK.findall(path.read_text(encoding="utf-8"))}


@pytest.mark.parametrize("path", pages(), ids=name)
def test_lines_fit(path: Path) -> None:
    assert too_long(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("path", user_pages(), ids=name)
def test_a_user_page_is_a_page_or_two(path: Path) -> None:
    assert words(path.read_text(encoding="utf-8")) <= LIMITS.get(name(path), MOST_WORDS)


@pytest.mark.parametrize("method", ["3dgs_dr", "gaussian_shader", "ref_gaussian", "ref_gs", "external"])
def test_the_page_of_a_method_has_sixty_lines_at_most(method: str) -> None:
    """Those of 2dgs, 3dgs, envgs and rtgs are parts of other pages."""
    assert len((DOCS / f"{method}.md").read_text(encoding="utf-8").splitlines()) <= METHOD_LINES


def test_readme_is_one_screen_of_substance() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= LAST_LINE


def test_every_page_is_linked_from_readme_or_an_index() -> None:
    reached = {(ROOT / "README.md").resolve()}
    for index in (ROOT / "README.md", DOCS / "README.md", DOCS / "lab" / "README.md"):
        reached |= linked(index)
    assert [name(path) for path in pages() if path.resolve() not in reached] == []


def test_the_checks_see_what_they_are_for() -> None:
    long = "word " * 30
    assert too_long(f"short\n{long}\n| {long}|\n") == [2]
    assert too_long(f"![a picture](images/{'x' * 130}.png)\n") == []
    assert words("a | 20.5 / 17.3 | b-c `d`") == 3
    assert linked(DOCS / "README.md") >= {DOCS / "training.md", DOCS / "lab" / "README.md"}
