from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from rtgs.core.build import build
from rtgs.core.recipe import NOT_IN_RECIPE, UNLESS_DEFAULT, canonical_json, flatten
from rtgs.optics.settings import OpticsSettings
from rtgs.workflow.fingerprint import fingerprint, recipe_params


@dataclass(frozen=True)
class Inner:
    rate: float = 1e-3
    steps: tuple[int, ...] = (1, 2)


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    name: str = "a"
    source: str = field(default="here", metadata=NOT_IN_RECIPE)


def test_dataclass_json_is_sorted_and_without_blanks():
    assert canonical_json(Outer()) == '{"inner":{"rate":0.001,"steps":[1,2]},"name":"a"}'


def test_where_a_capture_lies_does_not_enter():
    assert fingerprint(Outer(source="/elsewhere")) == fingerprint(Outer())
    assert fingerprint(Outer(name="b")) != fingerprint(Outer())


def test_a_choice_that_came_later_enters_where_it_is_made():
    """What was made before it came keeps its key."""

    @dataclass(frozen=True)
    class Later:
        steps: int = 3
        light: str = field(default="srgb", metadata=UNLESS_DEFAULT)

    assert canonical_json(Later()) == '{"steps":3}'
    assert canonical_json(Later(light="linear")) == '{"light":"linear","steps":3}'
    assert "blend" not in canonical_json(OpticsSettings())
    assert '"blend":"linear"' in canonical_json(OpticsSettings(blend="linear"))


def test_a_default_may_change_without_a_recipe_of_old():
    """A recipe without the key means what was done before there was one, when it is read as well."""

    @dataclass(frozen=True)
    class Later:
        steps: int = 3
        hold: float = field(default=20.0, metadata={"recipe": "unless", "value": 0.0})

    assert canonical_json(Later()) == '{"hold":20.0,"steps":3}'
    assert canonical_json(Later(hold=0.0)) == '{"steps":3}'
    for made in (Later(), Later(hold=0.0), Later(steps=4, hold=5.0)):
        assert build(Later, recipe_params(made)) == made


@pytest.mark.parametrize("spelling", ["0.001", "1.0e-3", "1.e-03", "0.00100"])
def test_yaml_spelling_of_a_float_does_not_matter(spelling):
    assert fingerprint(yaml.safe_load(f"rate: {spelling}")) == fingerprint({"rate": 1e-3})


@settings(max_examples=30, deadline=None)
@given(st.dictionaries(st.text(max_size=5), st.floats(allow_nan=False, allow_infinity=False) | st.text(), max_size=6))
def test_key_order_does_not_matter(values):
    assert fingerprint(dict(reversed(values.items()))) == fingerprint(values)


@settings(max_examples=50, deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False), st.floats(allow_nan=False, allow_infinity=False))
def test_floats_are_told_apart_to_the_last_bit(a, b):
    assert (fingerprint(a) == fingerprint(b)) == (repr(a) == repr(b))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (float("nan"), "nan"),
        (float("inf"), "inf"),
        (Path("/data"), "PosixPath"),
        ({1, 2}, "set"),
        (np.float32(1.0), "float32"),
        (OmegaConf.create({"a": 1}), "DictConfig"),
        (OmegaConf.create([1]), "ListConfig"),
        ({1: "a"}, "keys must be strings"),
        (Outer, "type"),
    ],
)
def test_what_has_no_canonical_spelling_is_refused(value, message):
    with pytest.raises((TypeError, ValueError), match=r"value\.params\.x") as raised:
        canonical_json({"params": {"x": value}})
    assert message in str(raised.value)


def test_flatten_joins_keys_with_dots():
    assert flatten({"a": {"b": 1, "c": [1, 2]}, "d": None}) == {"a.b": 1, "a.c": [1, 2], "d": None}
