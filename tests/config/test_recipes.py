"""What makes a recipe does not change unnoticed: a store filled by an older version is read by this one."""

from __future__ import annotations

import json

import pytest
from recipes import GOLDEN, TRAINED, digest, recipes


@pytest.mark.parametrize("method", TRAINED)
def test_recipes_are_what_they_were(method):
    """Steps, their fingerprints and their order, for every preset, ablation and a set of overrides of the method."""
    golden = json.loads(GOLDEN.read_text())
    found = dict(recipes(method))
    for words, steps in golden["in full"].items():
        if words in found:
            assert found[words] == steps
    expected = {words: key for words, key in golden["digests"].items() if words.split()[1] == method}
    plain = found[f"ball_statue {method} smoke none"]
    if method == "rtgs":  # which reads them all
        assert all(steps != plain for words, steps in found.items() if "=" in words), "words that restate the default"
    told = "recipes changed; where they are meant to: .venv/bin/python tests/config/recipes.py"
    assert {words: digest(steps) for words, steps in found.items()} == expected, told
