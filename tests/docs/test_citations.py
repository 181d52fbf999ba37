"""Every citation in code and docs leads somewhere, and the check itself sees one that does not."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.docs.citations import (
    CHECKS,
    Library,
    anchor,
    broken_citations,
    equation_numbers,
    flattened,
    numbers_of,
    section_numbers,
)
from tests.docs.register import ROOT

METHOD = """# The method

## 4. Shading

### 4.2 The remap

**Post.** Words.

| eq. | what |
|---|---|
| 8 | BRDF |
| 10 | remap |

## 14. Safety
"""
DECISIONS = "# Decisions\n\n## 1. One\n\n## 2. Two\n\n## 3. Three\n"
MODULE = '''"""A module."""

from numpy import ndarray

from rtgs.base import Base

LIMIT = 3


class Box(Base):
    side: float

    def grow(self) -> None:
        self.grown = True


def fill(box: Box) -> ndarray: ...
'''
BASE = "class Base:\n    def shrink(self): ...\n"


@pytest.fixture
def library(tmp_path: Path) -> Library:
    """A small project with a page of every kind."""
    files = {
        "docs/method.md": METHOD,
        "docs/decisions.md": DECISIONS,
        "docs/mesh.md": "# The mesh\n\n## Which mesh: `auto`\n",
        "README.md": "# Read\n",
        "rtgs/box.py": MODULE,
        "rtgs/base.py": BASE,
        "conf/method/envgs.yaml": "name: envgs\n",
        "conf/experiment/table1.yaml": "table: 1\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    return Library(tmp_path)


GOOD_AND_BAD = [  # file, a citation that is there, one that is not, what is said of it
    ("rtgs/box.py", "# method.md 4.2", "# method.md 4.3", "no section 4.3"),
    ("rtgs/box.py", "# method.md 4, 14", "# method.md 4, 15", "no section 15"),
    ("rtgs/box.py", '"""As (method.md\n    14)."""', '"""As (method.md\n    13)."""', "no section 13"),
    ("rtgs/box.cpp", "// see method.md\n// 14", "// see method.md\n// 5", "no section 5"),
    ("docs/mesh.md", "[method.md](method.md) 4.2", "[method.md](method.md) 4.9", "no section 4.9"),
    ("rtgs/box.py", '# method.md 4.2 "Post"', '# method.md 4.2 "Past"', "no heading or bold word 'Past'"),
    ("rtgs/box.py", '# method.md 4.2 "Post", 4 and 14', '# method.md 4.2 "Post", 4 and 9', "no section 9"),
    ("rtgs/box.py", '# docs/mesh.md, "Which mesh"', '# docs/mesh.md, "What mesh"', "no heading or bold word"),
    ("rtgs/box.py", "# decision 3", "# decision 4", "no decision 4"),
    ("conf/method/envgs.yaml", "# decisions 1 to 3", "# decisions 1 to 4", "no decision 4"),
    ("rtgs/box.py", "# decisions 1, 2 and 3", "# Decisions 1, 2 and 7", "no decision 7"),
    ("rtgs/box.py", "# decision 2", "# register row 2", "cited as 'decision N'"),
    ("rtgs/box.py", "# paper eq. 8", "# paper eq. 7", "the paper's eq. 7"),
    ("rtgs/box.py", "# docs/mesh.md", "# docs/glass.md", "no docs/glass.md"),
    ("conf/method/envgs.yaml", "# mesh.md", "# kernels.md", "no kernels.md"),
    ("docs/mesh.md", "[a](../README.md)", "[a](../READ.txt)", "link to ../READ.txt"),
    ("docs/method.md", "[a](mesh.md#which-mesh-auto)", "[a](mesh.md#which-mesh)", "no heading for #which-mesh"),
    ("docs/mesh.md", "[a](#the-mesh)", "[a](#a-mesh)", "no heading for #a-mesh"),
    ("docs/mesh.md", "`rtgs/box.py`", "`rtgs/bag.py`", "no rtgs/bag.py"),
    ("docs/mesh.md", "`box.py`", "`bag.py`", "no file is called bag.py"),
    ("docs/mesh.md", "`conf/method/`", "`conf/methods/`", "no conf/methods/"),
    ("docs/mesh.md", "`conf/method/<name>.yaml`", "`conf/scene/<name>.yaml`", "no conf/scene/<name>.yaml"),
    ("docs/mesh.md", "the experiment `rtgs/table1`", "the experiment `rtgs/table2`", "no rtgs/table2"),
    ("rtgs/box.py", "# as rtgs/base.py", "# as rtgs/basis.py", "no rtgs/basis.py"),
    ("rtgs/box.py", '""":func:`fill`"""', '""":func:`empty`"""', "empty is nowhere defined"),
    ("rtgs/box.py", '""":class:`Base`"""', '""":class:`Basis`"""', "Basis is nowhere defined"),
    ("rtgs/box.py", '""":meth:`grow`"""', '""":meth:`melt`"""', "melt is nowhere defined"),
    ("rtgs/box.py", '""":attr:`Box.grown`"""', '""":attr:`Box.melted`"""', "Box.melted is nowhere defined"),
    ("rtgs/box.py", '""":meth:`shrink`"""', '""":meth:`shrank`"""', "shrank is nowhere defined"),
    ("rtgs/base.py", '""":data:`rtgs.box.LIMIT`"""', '""":data:`rtgs.box.LIMITS`"""', "nowhere defined"),
    ("rtgs/base.py", '""":mod:`rtgs.box`"""', '""":mod:`rtgs.bag`"""', "rtgs.bag is nowhere defined"),
    ("rtgs/base.py", "``rtgs.box.Box.side``", "``rtgs.box.Box.height``", "rtgs.box.Box.height is nowhere"),
    ("docs/mesh.md", "`rtgs.box.fill`", "`rtgs.box.spill`", "rtgs.box.spill is nowhere defined"),
    ("docs/mesh.md", "`python -m rtgs.box`", "`python -m rtgs.bag --x`", "rtgs.bag is nowhere defined"),
]


@pytest.mark.parametrize(("name", "good", "bad", "what"), GOOD_AND_BAD, ids=[case[2] for case in GOOD_AND_BAD])
def test_a_broken_citation_is_found_and_a_right_one_is_not(library: Library, name, good, bad, what):
    path = library.root / name
    before = library.text(name)
    assert broken_citations(library, path, f"{before}\n{good}\n") == []
    found = broken_citations(library, path, f"{before}\n{bad}\n")
    assert len(found) == 1
    assert what in str(found[0])
    assert (found[0].file, found[0].line) == (name, f"{before}\n{bad}".count("\n") + 1 - bad.count("\n"))


@pytest.mark.parametrize(
    "words",
    [
        "https://example.org/docs/absent.md is elsewhere",
        "# method.md 14 % of it",
        "# written to runs/ladder-PRESET.md",
        "# a decision of 40 people",
        "# Kajiya, eq. 99",
    ],
)
def test_what_only_looks_like_a_citation_is_left_alone(library: Library, words: str):
    assert broken_citations(library, library.root / "rtgs/base.py", f"{BASE}\n{words}\n") == []


def test_how_numbers_and_anchors_are_read():
    assert numbers_of("4.2 to 4.4") == ["4.2", "4.4"]
    assert numbers_of("1 to 4, 9 and 11") == ["1", "2", "3", "4", "9", "11"]
    assert anchor("3.1 The rasteriser (base set)") == "31-the-rasteriser-base-set"
    assert anchor("Which mesh: `mesh.source`") == "which-mesh-meshsource"
    broken = "a (method.md\n    # 4)"
    assert len(flattened(broken)) == len(broken)
    assert "method.md       4" in flattened(broken)


def test_every_citation_of_the_tree_leads_somewhere():
    library = Library(ROOT)
    seen: Counter[str] = Counter()
    broken = []
    for path in library.files():
        text = path.read_text(encoding="utf-8")
        seen["files"] += 1
        seen["method.md"] += text.count("method.md ")
        seen["decision"] += text.count("decision ")
        seen["roles"] += text.count(":func:")
        broken += broken_citations(library, path, text)
    assert min(seen.values()) > 30, seen  # what was read is the tree
    assert not broken, "\n".join(["citations that lead nowhere:", *map(str, broken)])


def test_a_page_that_loses_its_numbers_breaks_what_cites_it():
    library = Library(ROOT)
    path = ROOT / "rtgs/optics/microfacet.py"
    text = path.read_text(encoding="utf-8")
    assert broken_citations(library, path, text) == []
    library.sections = frozenset()
    library.equations = frozenset()
    assert list(section_numbers(library, path, text))
    assert list(equation_numbers(library, path, text))
    assert len(CHECKS) == len(set(CHECKS))
