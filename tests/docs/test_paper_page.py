"""docs/paper.md tells the truth: each value is what the method composes to, and no key that differs is left out."""

from __future__ import annotations

from dataclasses import asdict

from pipelines.publishing.against_paper import keys_of
from rtgs.config import compose
from rtgs.core.recipe import flatten
from tests.docs.register import ROOT, value_of

PAGE = ROOT / "docs/paper.md"


def rows() -> dict[str, tuple[object, object]]:
    """Value of rtgs_printed and of rtgs by key."""
    cells = (line.strip("|").split("|") for line in PAGE.read_text(encoding="utf-8").splitlines() if "`" in line)
    five = ([cell.strip() for cell in row] for row in cells if len(row) == 5)
    return {
        key.strip("`"): (value_of(printed.strip("`")), value_of(ours.strip("`")))
        for _, key, printed, ours, _ in five
        if "." in key
    }


def test_each_value_is_what_the_method_composes_to():
    found = rows()
    assert len(found) > 25
    for index, method in enumerate(("rtgs_printed", "rtgs")):
        values = flatten(asdict(compose(["scene=demo", f"method={method}", "preset=paper"])[0]))
        assert {key: pair[index] for key, pair in found.items()} == {key: values[key] for key in found}


def test_every_key_that_differs_has_its_row():
    config, _ = compose(["scene=demo", "method=rtgs", "preset=paper"])
    differing = {way.split(" is ")[0] for way in keys_of(config, "rtgs")}
    assert differing == set(rows())
