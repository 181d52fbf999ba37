"""``make docs``: every page is in the site, links lead somewhere, and nothing comes from another server."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
MD = ".md"  # written so, links that are made up are no citations


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_site", ROOT / "docs" / "make_site.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("source", "text", "expected"),
    [
        ("README.md", "[a](docs/look.md)", "[a](look.md)"),
        ("README.md", "![a](docs/images/demo.jpg)", "![a](images/demo.jpg)"),
        (
            "README.md",
            "[all](docs/README.md), [c](CONTRIBUTING.md#habits)",
            f"[all](pages{MD}), [c](contributing{MD}#habits)",
        ),
        ("docs/look.md", "[a](method.md#3) [b](../README.md)", f"[a](method.md#3) [b](index{MD})"),
        ("docs/lab/mesh.md", f"[a](../mesh{MD}) [b](README.md)", f"[a](../mesh{MD}) [b](../lab/README.md)"),
        ("docs/benchmarks.md", "[lab/README.md](../lab/README.md)", "lab/README.md"),
        ("docs/look.md", f"[a](../../outside{MD}) [b](gone{MD})", "a b"),
        ("docs/look.md", "[a](https://example.org/b.md) [c](#d)", "[a](https://example.org/b.md) [c](#d)"),
    ],
)
def test_links_are_those_of_the_site(tool, source, text, expected):
    assert tool.linked(text, source, ROOT) == expected


def test_every_page_is_in_the_navigation_once(tool):
    listed = re.findall(r"[\w/]+\.md", tool.navigation(ROOT))
    assert sorted(listed) == sorted(tool.pages(ROOT))


def test_the_site_is_whole_and_stands_alone(tool, tmp_path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("material")
    tool.build(tmp_path / "site")
    for place in tool.pages(ROOT):
        assert (tmp_path / "site" / place.replace("README", "index")).with_suffix(".html").is_file()
    page = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert "I have a video" in page
    assert "I reproduce RT-GS" in page
    loaded = re.findall(r"<(?:script|img|link)\b[^>]*(?:src|href)=\"?(https?://[^\" >]+)", page)
    assert [address for address in loaded if "canonical" not in address] == []
    assert (tmp_path / "site" / "images" / "demo.jpg").is_file()
