"""Words to choose from are part of a setting's type: wherever one is read, another word is refused by its key."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from typing import Any, Literal, cast, get_args

import pytest
from omegaconf import OmegaConf

from rtgs.config.schema import RunConfig, open_schema
from rtgs.config.synthesize import SynthesizeConfig
from rtgs.core.build import build
from rtgs.core.errors import RtgsError
from rtgs.core.refuse import hints_of, refuse_unknown, words_of
from rtgs.prepare.normals.adapters import ADAPTERS, NormalNetwork
from rtgs.workflow.engine import EngineSettings


def fields_of_words(cls: type, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], type]]:
    """The dotted place of every field with words, and the class that has it."""
    for name, hint in hints_of(cls).items():
        if dataclasses.is_dataclass(hint):
            yield from fields_of_words(cast(type, hint), (*path, name))
        elif words_of(hint):
            yield (*path, name), cls


FIELDS = list(fields_of_words(RunConfig))
ALL_FIELDS = [*FIELDS, *fields_of_words(SynthesizeConfig), *fields_of_words(EngineSettings)]


def nested(path: tuple[str, ...], value: object) -> dict[str, Any]:
    """``{"a": {"b": value}}`` of ``("a", "b")``."""
    inner: object = value
    for name in reversed(path):
        inner = {name: inner}
    return cast(dict[str, Any], inner)


@pytest.mark.parametrize(("path", "cls"), FIELDS, ids=lambda item: ".".join(item) if type(item) is tuple else "")
def test_a_config_with_another_word_is_refused_by_its_whole_key(path, cls):
    known = words_of(hints_of(cls)[path[-1]])
    wrong = f"{known[0]}x" if type(known[0]) is str else 77
    message = f"{'.'.join(path)}={wrong!r} is unknown: choose one of {', '.join(map(str, known))}"
    with pytest.raises(RtgsError, match=re.escape(message)) as raised:
        build(RunConfig, nested(path, wrong))
    if type(wrong) is str:
        assert str(raised.value).endswith(f"; did you mean {known[0]!r}?")


@pytest.mark.parametrize(("path", "cls"), ALL_FIELDS, ids=lambda item: ".".join(item) if type(item) is tuple else "")
def test_settings_made_in_python_refuse_it_as_well(path, cls):
    with pytest.raises(RtgsError, match=rf"\b{path[-1]}='no such word' is unknown: choose one of "):
        cls(**{path[-1]: "no such word"})


def test_the_schema_takes_every_word():
    schema = OmegaConf.structured(open_schema(RunConfig))
    for path, cls in FIELDS:
        for word in words_of(hints_of(cls)[path[-1]]):
            merged = OmegaConf.merge(schema, nested(path, word))
            assert OmegaConf.select(merged, ".".join(path)) == word


def test_none_is_a_word_only_where_the_annotation_says_so():
    refuse_unknown("key", None, Literal["a", "b"] | None)
    refuse_unknown("key", "a", Literal["a", "b"] | None)
    refuse_unknown("key", "anything", str)
    with pytest.raises(RtgsError, match="key=None is unknown: choose one of a, b"):
        refuse_unknown("key", None, Literal["a", "b"])


def test_every_network_for_normals_has_an_adapter():
    assert set(get_args(NormalNetwork)) == set(ADAPTERS)
