"""docs/decisions.md tells the truth: every decision is a config key, has the value it states, and can be changed."""

from __future__ import annotations

from dataclasses import asdict
from functools import cache
from itertools import zip_longest

import pytest

from rtgs.config import compose
from rtgs.config.schema import RunConfig
from rtgs.core.recipe import flatten
from tests.docs.register import DEFAULT, LABELS, REGISTER, entries, overrides_of, setting_of, value_of

OPEN_QUESTIONS = 28  # of the paper; what follows them are rtgs's own differences
DECISIONS = entries(REGISTER.read_text(encoding="utf-8"))
SETTINGS = [setting for decision in DECISIONS for setting in decision.settings]


@cache
def composed(overrides: tuple[str, ...]) -> dict[str, object]:
    """The flat config of a run with these overrides."""
    scene = () if any(item.startswith("scene=") for item in overrides) else ("scene=demo",)
    config, _ = compose([*scene, *overrides])
    return flatten(asdict(config))


def test_the_register_is_complete():
    numbers = [decision.number for decision in DECISIONS]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) > OPEN_QUESTIONS
    for decision in DECISIONS:
        assert decision.labels == LABELS, decision.number
        assert decision.settings, decision.number
        for setting in decision.settings:
            assert DEFAULT in setting.here, setting.key
            assert setting.also, setting.key
            assert setting.here[DEFAULT] not in setting.also, setting.key


def test_every_key_stands_once_and_is_one_of_the_schema():
    keys = [setting.key for setting in SETTINGS]
    assert len(keys) == len(set(keys))
    assert set(keys) <= set(flatten(asdict(RunConfig())))


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.key)
def test_a_decision_is_what_the_config_composes_to(setting):
    for overrides, value in setting.here.items():
        assert composed(overrides)[setting.key] == value, overrides


ALONE = "method.transmittance.vertices.rate"  # refused beside other alternatives, which have nothing to move
STILL = "method.transmittance.rim_samples"  # refused beside it: samples of a mesh that stays


def test_every_alternative_is_accepted():
    columns = zip_longest(*([(setting.key, value) for value in setting.also] for setting in SETTINGS))
    together = [dict(pair for pair in column if pair is not None) for column in columns]
    alone = [{ALONE: column.pop(ALONE), STILL: 0} for column in together if ALONE in column]
    assert alone
    for wanted in (*together, *alone):  # the first alternative of every key together, then the second ones, ...
        words = [f"{key}={'null' if value is None else value}" for key, value in wanted.items()]
        config, _ = compose(["scene=demo", *DEFAULT, *words])
        found = flatten(asdict(config))
        assert {key: found[key] for key in wanted} == wanted


def test_how_the_register_is_read():
    assert [value_of(text) for text in ("1/3", "null", "true", "0.05", "mesh")] == [1 / 3, None, True, 0.05, "mesh"]
    read = setting_of("a.b", "`1/60`; `preset=quick`: `0.1`", "`0.0`, `1.0`")
    assert read.here == {DEFAULT: 1 / 60, ("method=rtgs", "preset=quick"): 0.1}
    assert read.also == (0.0, 1.0)
    assert overrides_of("ablation=mcmc") == (*DEFAULT, "ablation=mcmc")
    assert overrides_of("method=envgs scene=sedan") == ("preset=paper", "method=envgs", "scene=sedan")
    with pytest.raises(ValueError, match="here"):
        setting_of("a.b", "`1.0`, but not always", "`0.0`")
    with pytest.raises(ValueError, match="decision 7"):
        entries("## 7. A title\n\n| key | here | also |\n|---|---|---|\n| `a.b` | `1.0` |\n")
