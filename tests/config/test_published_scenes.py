"""``preset=paper`` has, for each scene, what the method's own repository sets for it (conf/method_on_scene), in steps
as published; other presets and other scenes have nothing of it.

Read in zju3dv/EnvGS 4dce5a4 (configs/exps/envgs/ref_real and configs/datasets/ref_real), and in train.sh of
gapszju/3DGS-DR e285f6b, YoujiaZhang/Ref-GS bf843b7 and fudan-zvg/ref-gaussian af7691a.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import cache

import pytest
import yaml
from recipes import STAND_INS, TRAINED, flat_leaves, presets_of, scenes_of

from pipelines.publishing.against_paper import keys_of
from rtgs.config import RunConfig, compose
from rtgs.config.locate import choices_of, conf_dir
from rtgs.config.provenance import settings_of
from rtgs.core.errors import RtgsError
from rtgs.core.recipe import flatten
from rtgs.methods import find_method
from rtgs.methods.plans import reflection_plan
from rtgs.train.schedule import loss_start

ENVGS = {  # steps, and what is not one
    "sedan": {"total": 60_000, "sh_from": 0, "window": 30_000, "propagation": 24_000, "k_s": 1e-3, "perceptual": 0.01},
    "spheres": {"total": 40_000, "sh_from": 10_000, "window": 21_000, "propagation": 18_000, "k_s": 0.1}
    | {"perceptual": 0.1},
    "toycar": {"total": 30_000, "sh_from": 10_000, "window": 21_000, "propagation": 18_000, "k_s": 1e-3}
    | {"perceptual": 0.01},
    "fox": {"total": 40_000, "sh_from": 0, "window": 21_000, "propagation": 18_000, "k_s": 1e-3, "perceptual": 0.01},
}
BOXES = {"ref_real/sedan": (0.0, 0.0), "ref_real/gardenspheres": (20.0, 2.0), "ref_real/toycar": (20.0, 2.0)}
SPHERES = {  # radius and centre in the world of Ref-NeRF's captures
    ("3dgs_dr", "ref_real/gardenspheres"): (0.974, (-0.227, 1.970, 1.774)),
    ("3dgs_dr", "ref_real/sedan"): (2.138, (-0.032, 0.808, 0.751)),
    ("3dgs_dr", "ref_real/toycar"): (2.707, (0.681, 0.808, 4.455)),
    ("ref_gs", "ref_real/gardenspheres"): (0.974, (-0.227, 1.970, 1.774)),
    ("ref_gs", "ref_real/sedan"): (2.138, (-0.032, 0.808, 0.751)),
    ("ref_gs", "ref_real/toycar"): (2.507, (0.486, 1.108, 3.72)),
}
WORLDLY = {"method.reflection.box_reach", "method.reflection.box_half"}  # these, and spheres, do not go to stand-ins
FILES = [(method, scene) for method in TRAINED for scene in scenes_of(method)]
ALL = [*STAND_INS, *STAND_INS.values()]


@cache
def composed(method: str, scene: str, preset: str = "paper", *words: str) -> RunConfig:
    return compose([f"scene={scene}", f"method={method}", f"preset={preset}", *words])[0]


@pytest.mark.parametrize("scene", [*ALL, "fox"])
def test_envgs_has_its_own_schedule_on_each_scene(scene: str):
    config = composed("envgs", scene)
    method, schedule = config.method, config.schedule
    plan = reflection_plan(method.reflection, schedule)
    assert plan.reflection.densify_until == schedule.densify_until  # one window for both sets
    found = {"total": schedule.total, "sh_from": schedule.sh_from, "window": schedule.densify_until}
    found |= {"propagation": plan.propagation_until, "k_s": method.materials.specular}
    assert found | {"perceptual": method.loss.perceptual} == ENVGS[STAND_INS.get(scene, scene)]
    assert plan.start == 3_000  # on every scene; so the next
    assert loss_start(method.loss.perceptual_start, schedule.total) == 21_000
    assert schedule.means_lr_steps == 30_000
    box = (method.reflection.box_half, method.reflection.box_reach)
    assert box == BOXES.get(scene, (0.0, 2.0))


@pytest.mark.parametrize("scene", [*ALL, "fox"])
@pytest.mark.parametrize("method", ["3dgs_dr", "ref_gs"])
def test_spheres_are_those_of_the_captures_world(method: str, scene: str):
    config = composed(method, scene)
    own = find_method(method).own_settings(config.method)
    expected = SPHERES.get((method, scene), (0.0, (0.0, 0.0, 0.0)))
    assert (own.scope, own.scope_radius, own.scope_center) == ("sphere", *expected)
    assert config.schedule.total == {"3dgs_dr": 97_000, "ref_gs": 31_000}[method]  # on every scene


@pytest.mark.parametrize("scene", [*ALL, "fox"])
def test_ref_gs_is_1500_steps_alone_on_toycar_and_700_elsewhere(scene: str):
    config = composed("ref_gs", scene)
    start = 1_500 if scene.endswith("toycar") else 700
    assert reflection_plan(config.method.reflection, config.schedule).start == start
    assert loss_start(config.method.loss.normal_start, config.schedule.total) == start


@pytest.mark.parametrize("scene", [*ALL, "fox"])
def test_ref_gaussian_smooths_normals_on_gardenspheres(scene: str):
    config = composed("ref_gaussian", scene)
    own = find_method("ref_gaussian").own_settings(config.method)
    assert own.smooth == (0.45 if STAND_INS.get(scene, scene) == "spheres" else 0)
    assert loss_start(own.smooth_until, config.schedule.total) == 18_000
    assert config.schedule.total == 20_000


def test_there_is_a_file_for_what_is_tested_here_and_for_nothing_else():
    assert {scene for _, scene in FILES} <= set(ALL)
    assert {method for method, _ in FILES} == {"3dgs_dr", "ref_gaussian", "ref_gs", "envgs"}
    presets = {name.split("/")[0] for name in choices_of("method_on_scene")}
    assert presets == {"paper"}, "short presets have one recipe for all scenes"


@pytest.mark.parametrize("method", sorted({method for method, _ in FILES}))
def test_short_presets_and_other_scenes_have_one_recipe(method: str):
    for preset in presets_of(method):
        plain = composed(method, "matte_room", preset)
        for scene in ("fox", "nu_nerf/ballstatue") if preset == "paper" else scenes_of(method):
            config = composed(method, scene, preset)
            assert (config.method, config.schedule) == (plain.method, plain.schedule), scene


@pytest.mark.parametrize(("method", "scene"), FILES)
def test_a_file_sets_numbers_of_its_method_that_are_not_there_without_it(method: str, scene: str):
    content = yaml.safe_load((conf_dir() / "method_on_scene" / "paper" / method / f"{scene}.yaml").read_text())
    below = content.pop("defaults", [])
    assert set(content) <= {"method"}
    plain = composed(method, "matte_room")
    values = flatten(asdict(plain)) | {f"method.own.{key}": value for key, value in own_of(plain).items()}
    for key, value in flat_leaves(content):
        assert values[key] != (tuple(value) if isinstance(value, list) else value), key
    if "/" not in scene:
        assert not below
        assert not set(dict(flat_leaves(content))) & (WORLDLY | {"method.own.scope_radius", "method.own.scope_center"})
    elif (stand_in := STAND_INS[scene]) in scenes_of(method):
        assert below[0] == f"/method_on_scene/paper/{method}/{stand_in}"


def own_of(config: RunConfig) -> dict[str, object]:
    """All settings that the method alone has, by name."""
    own = find_method(config.method.name).own_settings(config.method)
    return {} if own is None else asdict(own)


def test_a_word_wins_and_where_a_value_comes_from_is_told():
    words = ["method.paper_schedule.total=50000", "method.materials.specular=0.2", "method.reflection.start=0.25"]
    config = composed("envgs", "ref_real/gardenspheres", "paper", *words)
    assert (config.schedule.total, config.method.materials.specular) == (50_000, 0.2)
    assert config.method.reflection.start == 0.25
    assert composed("envgs", "sedan", "paper", "schedule.total=77").schedule.total == 77
    chosen = ["scene=ref_real/gardenspheres", "method=envgs", "preset=paper"]
    files = ["conf/method/envgs.yaml", "conf/method_on_scene/paper/envgs/spheres.yaml"]
    assert [each.place for each in settings_of("method.materials.specular", chosen)] == files
    after = settings_of("method.reflection.start", ["scene=toycar", "method=ref_gs", "preset=paper"])
    assert [each.place.rpartition("conf/")[2] for each in after[-2:]] == [
        "after_preset/ref_gs.yaml",
        "method_on_scene/paper/ref_gs/toycar.yaml",
    ]
    assert settings_of("method.materials.specular", [*chosen, "method.materials.specular=0.3"])[-1].text == "0.3"


def test_runs_on_the_papers_captures_are_compared_with_the_numbers_of_the_capture():
    assert keys_of(composed("envgs", "ref_real/sedan"), "envgs") == ()
    assert keys_of(composed("3dgs_dr", "ref_real/toycar"), "3dgs_dr") == ()
    short = keys_of(composed("3dgs_dr", "ref_real/sedan", "quick"), "3dgs_dr")
    assert "method.own.scope_radius is 0 instead of 2.138" in short
    assert "schedule.total is 2000 instead of 97000" in short
    row = "3dgs_dr, no_normal_guide"  # which is off in the published recipe
    assert "schedule.total is 2000 instead of 97000" in keys_of(composed("3dgs_dr", "ref_real/sedan", "quick"), row)


def test_a_scope_that_is_found_takes_the_place_of_a_published_sphere_once_that_is_taken_away():
    chosen = ("3dgs_dr", "ref_real/sedan", "paper", "method.own.scope=masks")
    assert composed(*chosen[:3]).method.own["scope_radius"] > 0
    remedy = r"method\.own\.scope_radius=0 'method\.own\.scope_center=\[0,0,0\]'"
    with pytest.raises(RtgsError, match=f"scope_radius.*{remedy}"):
        composed(*chosen)
    found = composed(*chosen, "method.own.scope_radius=0", "method.own.scope_center=[0,0,0]")
    assert found.method.own["scope"] == "masks"
