"""Ablations: each takes something away from every method and preset it is for, and is refused by the others."""

from __future__ import annotations

import pytest
import yaml
from recipes import TRAINED, about_ablation, fitting, flat_leaves, presets_of

from pipelines.planning.graph import build_graph
from pipelines.planning.inspection import Inspections
from rtgs.config import compose
from rtgs.config.locate import choices_of, conf_dir
from rtgs.config.sweep import compose_jobs
from rtgs.core.errors import RtgsError

ABLATIONS = [name for name in choices_of("ablation") if name != "none"]
WHOLE_MODELS = {"no_mesh_guide", "learned_glass", "paper_glass"}
PUBLISHED = {  # parts that the abstracts of the papers name as theirs; which rows their tables have was not read
    "3dgs_dr": {"no_propagation"},
    "gaussian_shader": {"no_predicted_normal"},
    "ref_gaussian": {"no_inter_reflection", "no_propagation"},
    "ref_gs": {"no_roughness_levels"},
}
OURS = {
    "3dgs_dr": {"no_sabotage", "no_normal_guide"},
    "gaussian_shader": {"shortest_axis", "residual_color", "shared_rate", "no_normal_guide"},
    "ref_gaussian": {"rough_grow", "forward_only", "one_light_level", "unit_normal", "no_normal_guide"},
    "ref_gs": {"zero_features", "no_opacity_entropy", "no_normal_guide"},
}


def ablation_file(name: str) -> dict:
    """What the file of an ablation sets."""
    content = yaml.safe_load((conf_dir() / "ablation" / f"{name}.yaml").read_text())
    del content["ablation"]
    return content


def keys_in(group: str, name: str) -> set[str]:
    """What a file of ``conf/`` and those that it inherits from set."""
    values = yaml.safe_load((conf_dir() / group / f"{name}.yaml").read_text())
    others = [other for other in values.pop("defaults", ()) if other != "_self_"]
    inherited = (keys_in(".", other[1:]) if other.startswith("/") else keys_in(group, other) for other in others)
    return {key for key, _ in flat_leaves(values)}.union(*inherited)


def test_method_preset_and_ablation_compose_and_no_ablation_is_idle():
    """Method x ablation on one scene, composed by Hydra; what an ablation is not for is refused.

    What an ablation takes away is read by training: the key of its last step is another one, for every method it is
    for, with the published preset, and with every preset that sets a key of the ablation. That scenes add nothing to
    this is a test of test_config.py; `-m slow` walks the product itself.
    """
    presets = {name: keys_in("preset", name) for name in choices_of("preset")}
    keys: dict[tuple[str, str, str], str] = {}
    inspections = Inspections()
    for method, preset in ((name, each) for name in TRAINED for each in presets_of(name)):
        met = [name for name in ABLATIONS if preset.startswith("paper") or keys_in("ablation", name) & presets[preset]]
        mine = ["none", *(name for name in fitting(method, preset) if name in met)]
        words = [f"method={method}", f"preset={preset}", f"ablation={','.join(mine)}"]
        for job in compose_jobs(["scene=ball_statue", *words], multirun=True)[0]:
            chosen = dict(word.split("=") for word in job.words)
            assert job.config is not None, job.problem
            assert job.choices is not None
            assert job.config.ablation.why
            graph = build_graph(job.config, job.choices, inspections)
            assert not graph.unread, "no file gives a weight to a loss that the method lacks"
            keys[method, preset, chosen["ablation"]] = graph.training[-1].fingerprint
    assert len(keys) > sum(len(fitting(method, "paper")) for method in TRAINED)
    for (method, preset, ablation), key in keys.items():
        if ablation != "none":
            assert key != keys[method, preset, "none"], f"ablation {ablation} changes nothing in {method} {preset}"
    assert len(set(keys.values())) == len(keys), "two ablations of a method are the same"


@pytest.mark.parametrize("method", choices_of("method"))
def test_a_method_refuses_what_takes_nothing_from_it(method: str):
    """With smoke one of each sort; `-m slow` takes all."""
    fit = fitting(method) if method in TRAINED else []
    sorts = {str(about_ablation(name).get("needs", ())): name for name in ABLATIONS if name not in fit}
    others = sorted(sorts.values())
    words = ["scene=ball_statue", f"method={method}", "preset=smoke", f"ablation={','.join(others)}"]
    for name, job in zip(others, compose_jobs(words, multirun=True)[0] if others else (), strict=True):
        assert f"ablation={name} takes nothing away from method {method}" in job.problem


IDLE = [
    (name, preset) for name in ABLATIONS for preset in about_ablation(name).get("idle_with", ()) if "=" not in preset
]


@pytest.mark.parametrize(("ablation", "preset"), IDLE)
def test_with_a_preset_that_has_it_off_an_ablation_is_refused(ablation: str, preset: str):
    """And it is off there: in all its methods no normals are propagated, or the values are the ablation's already."""
    assert preset in choices_of("preset")
    for method in (name for name in TRAINED if ablation in fitting(name) and preset in presets_of(name)):
        words = ["scene=toycar", f"method={method}", f"preset={preset}"]
        with pytest.raises(RtgsError) as raised:
            compose([*words, f"ablation={ablation}"])
        told = f"ablation={ablation} takes nothing away from method {method} with preset={preset}, where it is off"
        assert told in str(raised.value)
        settings = compose(words)[0].method
        if settings.reflection.propagation.every == 0 and "propagation" in str(ablation_file(ablation)):
            continue
        if ablation == "rough_grow":
            assert settings.reflection.propagation.every == 0
        else:
            value = {"no_normal_guide": settings.environment.mono_normal}[ablation]
            assert [value] == [value for _, value in flat_leaves(ablation_file(ablation))]


PAPER = ["scene=toycar", "preset=paper"]
OFF = "method.reflection.propagation.every=0"


@pytest.mark.parametrize(("ablation", "method"), [("no_sabotage", "3dgs_dr"), ("rough_grow", "ref_gaussian")])
def test_with_a_value_that_has_it_off_an_ablation_is_refused(ablation: str, method: str):
    words = [*PAPER, f"method={method}", f"ablation={ablation}"]
    compose(words)
    with pytest.raises(RtgsError) as raised:
        compose([*words, OFF])
    said = f"ablation={ablation} takes nothing away from method {method} with {OFF}, where it is off already: leave"
    assert said in str(raised.value)


@pytest.mark.parametrize(
    ("ablation", "words"),
    [
        ("no_propagation", [OFF]),
        ("no_propagation", ["method.reflection.propagation.every=500"]),
        ("no_dssim", ["method.loss.l1=0.7", "method.loss.dssim=0.3"]),
        ("mcmc", ["method.density={strategy:adaptive}", "method.paper_schedule.densify_until=100"]),
    ],
)
def test_an_ablation_all_of_which_is_set_by_words_is_refused(ablation: str, words: list[str]):
    """Whatever the values are, the run is the one without it; where words leave one of its keys, it is not."""
    method = [*PAPER, "method=3dgs_dr"]
    jobs = compose_jobs([*method, *words, "seed=3", f"ablation=none,{ablation}"], multirun=True)[0]
    assert (jobs[0].problem, jobs[1].config) == ("", None)
    assert f"config: ablation={ablation} changes nothing: all that it sets (method." in jobs[1].problem
    assert f"is set on the command line ({' '.join(words)}), which goes over it" in jobs[1].problem
    if len(words) > 1:
        compose([*method, words[0], f"ablation={ablation}"])


def test_a_condition_that_names_no_key_is_refused():
    words = ["scene=toycar", "method=2dgs", "ablation=no_dssim", "ablation.idle_with=['method.los.l1=0']"]
    with pytest.raises(RtgsError, match=r"ablation=no_dssim names method\.los\.l1, which is no key of method 2dgs"):
        compose(words)


def test_what_is_propagated_is_so_with_the_published_schedule():
    for method in ("3dgs_dr", "ref_gaussian", "envgs", "rtgs"):
        settings = compose(["scene=toycar", f"method={method}", "preset=paper"])[0].method
        without = compose(["scene=toycar", f"method={method}", "preset=paper", "ablation=no_propagation"])[0].method
        assert (settings.reflection.propagation.every, without.reflection.propagation.every) == (1000, 0)


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_an_ablation_flips_one_to_three_keys_and_says_why(ablation: str):
    """Or puts a published model as a whole in the place of ours, or takes away whatever reads the mesh."""
    why = about_ablation(ablation)["why"]
    assert why.strip()
    assert "\n" not in why.strip()
    keys = dict(flat_leaves(ablation_file(ablation)))
    assert keys
    if ablation not in WHOLE_MODELS:
        assert len(keys) <= 3


@pytest.mark.parametrize("method", OURS)
def test_each_method_has_its_own_ablations_and_says_whose_they_are(method: str):
    for name in PUBLISHED.get(method, set()) | OURS[method]:
        assert name in fitting(method), name
    for name in PUBLISHED.get(method, ()):
        assert about_ablation(name)["why"].startswith("named in the paper"), name
    for name in OURS[method] - {"residual_color"}:  # the paper's model, which the published run leaves out
        assert about_ablation(name)["why"].startswith("ours;"), name


def test_the_papers_glass_is_the_learned_one_and_more():
    learned, paper = (dict(flat_leaves(ablation_file(name))) for name in ("learned_glass", "paper_glass"))
    assert learned.items() <= paper.items()


def test_a_group_word_sets_the_keys_in_it_and_no_others(tmp_path):
    words = ["scene=demo", "method=2dgs", "preset=quick", "ablation=no_densify", "schedule={total: 1500}"]
    config, _ = compose([*words, f"paths.root={tmp_path}"])
    assert config.schedule.total == 1500
