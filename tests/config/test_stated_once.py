"""A value is stated once: files of conf/ hold only what differs from the dataclasses and the files below them.

A dataclass's default is what a method gets whose YAML is silent. What one method alone reads (``transmittance``) has
that method's value as its default. Weights of losses are the exception: 0, and a method that has the loss gives it one.
Files of published methods are another: they hold all published numbers, each block with its source, whatever the
schema says.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from typing import Any

import pytest
import yaml
from recipes import PUBLISHED_ELSEWHERE, TRAINED, fitting

from rtgs.config import compose
from rtgs.config.locate import choices_of, conf_dir
from rtgs.config.schema import RunConfig
from rtgs.core.recipe import flatten
from rtgs.methods.settings import TransmittanceSettings
from rtgs.optics.settings import WallSettings

GROUPS = ("scene", "sfm", "masks", "normals", "method", "judge", "tracking")  # below: the schema
SCHEMA = flatten(asdict(RunConfig()))


def stated(name: str, prefix: str = "") -> dict[str, object]:
    """What a file of conf/ says, by the dotted key in the whole config. Interpolations are no values."""
    content = yaml.safe_load((conf_dir() / f"{name}.yaml").read_text()) or {}
    content.pop("defaults", None)
    values = flatten(content, prefix)
    return {key: plain(value) for key, value in values.items() if not str(value).startswith("${")}


def plain(value: Any) -> object:
    """Lists as tuples, as the schema has them."""
    return tuple(value) if isinstance(value, list) else value


def idle(own: Mapping[str, object], below: list[Mapping[str, object]]) -> list[str]:
    """Keys whose value is what each of the layers below says already."""
    return [key for key, value in own.items() if all(layer.get(key) == value for layer in below)]


def presets() -> Iterator[tuple[str, list[str]]]:
    """Each file of presets with those below it, farthest first."""
    yield "short_presets", []
    yield "quick_recipe", ["short_presets"]
    yield "preset/quick", ["short_presets", "quick_recipe"]
    yield "preset/smoke", ["short_presets", "quick_recipe", "preset/quick"]
    yield "preset/standard", ["short_presets"]


def layers(method: str, files: list[str]) -> dict[str, object]:
    """Schema, method and files, each over those before it."""
    values = SCHEMA | stated(f"method/{method}", "method")
    for name in files:
        values |= stated(name)
    return values


@pytest.mark.parametrize("group", GROUPS)
def test_no_choice_restates_the_schema(group):
    """Besides the word that is the file's name: ``tracking=mlflow`` says ``kind: mlflow``."""
    for name in set(choices_of(group)) - (PUBLISHED_ELSEWHERE if group == "method" else set()):
        own = {key: value for key, value in stated(f"{group}/{name}", group).items() if value != name}
        assert idle(own, [SCHEMA]) == [], f"conf/{group}/{name}.yaml"


@pytest.mark.parametrize(("name", "below"), list(presets()))
def test_no_preset_restates_what_every_method_has(name, below):
    assert idle(stated(name), [layers(method, below) for method in TRAINED]) == []


def test_the_presets_below_a_preset_are_those_it_lists():
    for name, below in presets():
        content = yaml.safe_load((conf_dir() / f"{name}.yaml").read_text())
        listed = [f"preset/{file}".replace("preset//", "") for file in content.get("defaults", ["_self_"])[:-1]]
        assert ("/" in name) == bool(listed), name
        assert below[len(below) - len(listed) :] == listed, name
    published = {"paper", "paper_synthetic"}
    assert {name.split("/")[1] for name, _ in presets() if "/" in name} == set(choices_of("preset")) - published


TWICE_QUICK = ("2dgs", "3dgs", "rtgs")  # in standard


def test_twice_quick_restates_nothing_of_what_it_takes():
    below = [layers(method, ["short_presets", "preset/standard", "quick_recipe"]) for method in TWICE_QUICK]
    assert idle(stated("twice_quick"), below) == []


@pytest.mark.parametrize("method", TWICE_QUICK)
def test_standard_of_a_method_restates_nothing_of_what_it_takes(method):
    below = layers(method, ["short_presets", "preset/standard", "quick_recipe", "twice_quick"])
    assert idle(stated(f"method_in_preset/standard_{method}"), [below]) == []


@pytest.mark.parametrize("ablation", [name for name in choices_of("ablation") if name != "none"])
def test_no_ablation_restates_what_its_methods_have(ablation):
    own = {key: value for key, value in stated(f"ablation/{ablation}").items() if not key.startswith("ablation.")}
    stacks = [[], *([*below, name] for name, below in presets() if "/" in name)]
    below = [layers(method, files) for method in TRAINED if ablation in fitting(method) for files in stacks]
    assert below
    assert idle(own, below) == []


def test_glass_has_the_numbers_of_the_schema():
    """rtgs alone reads them: with its published preset they are the dataclass's own, but for the light of its walls."""
    config, _ = compose(["scene=demo", "method=rtgs", "preset=paper"])
    walls = WallSettings(light="fresnel", openings=0.25, clipped_light=1.5)
    beyond = TransmittanceSettings(normal="mesh", start_opacity=0.1, contents="rasterized", rim_samples=16, wall=walls)
    beyond = replace(beyond, density=replace(beyond.density, gradient_threshold=2e-4))
    assert config.method.transmittance == beyond
