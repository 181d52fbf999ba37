"""Cells of tables."""

from __future__ import annotations

import pytest

from rtgs.core.listing import spreadsheet_cell


@pytest.mark.parametrize("text", ["=1+1", "+a1", "-a1", "@sum(a)", "\t=1", "\r=1", "-1-1"])
def test_text_that_begins_like_a_formula_gets_an_apostrophe(text):
    assert spreadsheet_cell(text) == f"'{text}"


@pytest.mark.parametrize("value", ["a.jpg", "", "a=1", "-1", "+0.25", "-1e-05", -1.5, 2, None])
def test_other_cells_stay(value):
    assert spreadsheet_cell(value) is value
