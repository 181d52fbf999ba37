"""Every way in which a run is not what the paper describes: its config against that of the paper as printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from pipelines.publishing.results import final_training
from pipelines.steps.training import read_summary
from rtgs.config.compose import compose
from rtgs.config.convert import pictures_only
from rtgs.config.locate import choices_of, conf_dir
from rtgs.config.schema import OF_THE_MACHINE, RunConfig
from rtgs.core.documents import load_yaml
from rtgs.core.recipe import flatten
from rtgs.methods import find_method
from rtgs.train.settings import ScheduleSettings

if TYPE_CHECKING:
    from rtgs.methods.settings import MethodSettings
    from rtgs.workflow import StepResult

PRINTED = {"rtgs": "rtgs_printed"}  # the method that is another one's paper; the others are their own with preset=paper
# Where results go, what is measured, and where this machine has its files: no part of a method.
_OUTSIDE = (
    *("paths.", "tracking.", "table.", "evaluation.", "ablation.", "method.name", *OF_THE_MACHINE),
    *(
        "schedule.checkpoint_every",
        "schedule.evaluate_every",
        "method.paper_schedule.",
        "scene.name",
        "scene.path",
        "scene.format",
        "external.",
        "watch.",
        "normals.file",
    ),
)
_ELSEWHERE = "its pictures are another program's: how that was trained is not known here"
_WEIGHT = "its weight is 0"  # how rtgs.train.terms explains a loss that a method does not have


def ways_of(config: RunConfig, row: str, results: Sequence[StepResult]) -> tuple[str, ...]:
    """In words: each key of the config whose value is not the paper's, then what the training had to leave out.

    ``row`` of a table: ``method`` or ``method, ablation``; an ablation of the paper is compared with the paper's.
    """
    if pictures_only(config):
        return (_ELSEWHERE,)
    decisions = read_summary(final_training(results)).decisions
    told = (str(each) for each in decisions if not each.why.startswith(_WEIGHT))  # a weight is a key of the config
    return (*keys_of(config, row), *told)


def keys_of(config: RunConfig, row: str) -> tuple[str, ...]:
    """In words, each key of the config whose value is not the paper's."""
    ours, theirs = _values(config), _values(_printed(config, row))
    return tuple(
        f"{key} is {_shown(value)} instead of {_shown(theirs.get(key))}"
        for key, value in ours.items()
        if value != theirs.get(key)
    )


def _printed(config: RunConfig, row: str) -> RunConfig:
    """The run that the paper describes on the same scene."""
    method, _, ablation = row.partition(", ")
    words = [f"method={PRINTED.get(method, method)}", "preset=paper", f"scene={_scene_file(config.scene.name)}"]
    if ablation:
        about = load_yaml(conf_dir() / "ablation" / f"{ablation}.yaml")["ablation"]
        has = set(about.get("needs", ())) <= find_method(PRINTED.get(method, method)).has
        words += [f"ablation={ablation}"] if has and "paper" not in about.get("idle_with", ()) else []
    return compose([*words, f"seed={config.seed}"])[0]


def _scene_file(name: str) -> str:
    """The file of the papers' scene of this name; another scene: the demo, whose settings are the defaults."""
    for choice in choices_of("scene"):
        if "/" in choice and load_yaml(conf_dir() / "scene" / f"{choice}.yaml")["name"] == name:
            return choice
    return "demo"


def _values(config: RunConfig) -> dict[str, object]:
    """What the method reads of the config, by dotted key; of its own settings also those that are defaults."""
    read = _read(config.method)
    own = find_method(read.name).own_settings(read)
    values = flatten(asdict(replace(config, method=read)))
    if own is not None:
        values |= {f"method.own.{key}": value for key, value in flatten(asdict(own)).items()}
    adaptive = config.method.density.strategy == "adaptive"
    outside = (*_OUTSIDE, "method.density.mcmc.") if adaptive else _OUTSIDE
    return {key: value for key, value in values.items() if not key.startswith(outside)}


def _read(settings: MethodSettings) -> MethodSettings:
    """Fixed values where the last stage that is on reads nothing."""
    spec = find_method(settings.name)
    last = [stage for stage in spec.stages if stage.on(settings)][-1]
    return replace(last.reads(settings), paper_schedule=ScheduleSettings())


def _shown(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
