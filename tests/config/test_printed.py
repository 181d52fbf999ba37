"""rtgs_printed is the paper: its numbers, with every preset; the ablations that are the paper's are the paper's."""

from __future__ import annotations

from dataclasses import asdict
from functools import cache

import pytest
import torch
import yaml
from recipes import presets_of

from rtgs.config import compose
from rtgs.config.locate import conf_dir
from rtgs.config.schema import RunConfig
from rtgs.core.recipe import flatten
from rtgs.methods import find_method
from rtgs.methods.spec import BEYOND_PAPER, PROPAGATION, SABOTAGE
from rtgs.optics.microfacet import specular_weights

NUMBERS = {  # printed in the paper, with preset=paper
    "schedule.total": 60_000,
    "method.reflection.start": 3_000 / 60_000,
    "method.transmittance.start": 20_000 / 60_000,
    "method.loss.transmission_depth_start": 40_000 / 60_000,
    "method.loss.specular": 0.2,
    "method.loss.specular_target": 0.9,
    "method.loss.transmission_depth": 0.2,
    "method.loss.normal": 0.04,
    "method.loss.mono_normal": 0.01,
    "method.loss.perceptual": 0.01,
}
EQUATIONS = {  # whatever the preset
    "method.optics.weight": "microfacet",  # eq. 6 to 8 and 11
    "method.optics.max_gain": 0.0,
    "method.optics.remap": "pbrt",  # eq. 10
    "method.optics.blend": "srgb",  # eq. 4
    "method.materials.normalized": False,  # eq. 3
    "method.loss.clipped": False,
    "method.loss.normal_inverse_depth": False,  # eq. 14
    "method.loss.mono_normal_form": "cosine",  # eq. 16
    "method.loss.mono_normal_gain": 1.0,
    "method.loss.perceptual_form": "vgg16_l1",  # eq. 17
    "method.reflection.box_reach": 0.0,
    "method.reflection.propagation.every": 0,
    "method.reflection.matte.probation": 0.0,
    "method.transmittance.max_gain": None,
    "method.transmittance.opaque_share": 1.0,
    "method.transmittance.split": False,
    "method.transmittance.box": "scene",
    "method.transmittance.first_surface": "base",
    "method.transmittance.normal": "base",
    "method.transmittance.first_bounce": "transmittance",
    "method.transmittance.second_bounce": "mesh",
    "method.transmittance.second_offset": 0.0,
    "method.transmittance.start_opacity": 1.0,
    "method.transmittance.contents": "traced",
    "method.transmittance.test_masks": "as_trained",
    "method.transmittance.interface.count": 0,
    "method.transmittance.wall.light": "learned",
    "mesh.source": "tsdf",
}


@cache
def composed(*words: str) -> tuple[RunConfig, dict[str, object]]:
    config, _ = compose(["scene=ball_statue", *words])
    return config, flatten(asdict(config))


@pytest.mark.parametrize("preset", presets_of("rtgs_printed"))
def test_no_preset_changes_what_is_printed(preset: str):
    _, found = composed("method=rtgs_printed", f"preset={preset}")
    assert {key: found[key] for key in EQUATIONS} == EQUATIONS
    if preset == "paper":
        assert {key: found[key] for key in NUMBERS} == pytest.approx(NUMBERS)


def test_the_weight_of_a_reflection_has_no_bound_and_starts_as_a_dielectrics():
    config, _ = composed("method=rtgs_printed", "preset=paper")
    one, smooth = torch.ones(1), torch.full((1,), 1e-3)
    assert float(specular_weights(one, smooth, one, config.method.optics).reflection) == pytest.approx(35.6, abs=0.05)
    materials = config.method.materials
    f0, roughness = (torch.tensor([value]) for value in (materials.f0, materials.roughness))
    first = specular_weights(one, roughness, f0, config.method.optics)
    assert 0.2 < float(first.reflection) < 0.4
    assert float(first.transmission) == pytest.approx(0.96)


def test_it_has_what_rtgs_has_but_what_rtgs_adds():
    ours, printed = find_method("rtgs"), find_method("rtgs_printed")
    assert ours.has - printed.has == {BEYOND_PAPER, PROPAGATION, SABOTAGE}
    assert (printed.stages, printed.build) == (ours.stages, ours.build)


def test_the_papers_glass_has_the_weights_the_mesh_and_the_box_of_the_paper():
    config, found = composed("method=rtgs", "preset=quick", "ablation=paper_glass")
    _, printed = composed("method=rtgs_printed", "preset=quick")
    # Of schedule and rounding; of walls by physics alone.
    left = {"freeze_base", "half_size_until", "offset", "rim_samples", "wall.clipped_light", "wall.openings"}
    keys = [key for key in found if key.startswith(("method.transmittance.", "mesh.source", "method.optics.max_gain"))]
    differing = {key for key in keys if found[key] != printed[key]}
    assert {key.removeprefix("method.transmittance.") for key in differing} == left
    materials = config.method.materials
    f0, roughness = (torch.tensor([value]) for value in (materials.f0, materials.roughness))
    first = specular_weights(torch.ones(1), roughness, f0, config.method.optics)
    assert float(first.transmission) > 0.9  # it was 0.1
    assert float(first.reflection) < 1  # it was 7 to 12


def test_without_the_guide_nothing_is_set_that_knows_the_mesh():
    _, found = composed("method=rtgs", "preset=quick", "ablation=no_mesh_guide")
    expected = {
        "method.loss.transmission_depth": 0.0,
        "method.transmittance.second_bounce": "first_bounce",
        "method.transmittance.second_offset": 0.0,
        "method.transmittance.first_surface": "base",
        "method.transmittance.normal": "base",
        "method.transmittance.split": False,
        "method.transmittance.box": "scene",
        "method.transmittance.opaque_share": 1.0,
        "method.transmittance.test_masks": "as_trained",
        "method.transmittance.interface.count": 0,
        "method.transmittance.wall.light": "learned",
    }
    assert {key: found[key] for key in expected} == expected


@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_without_the_specular_loss_nothing_stands_in_for_it(preset: str):
    config, _ = composed("method=rtgs", f"preset={preset}", "ablation=no_specular_loss")
    interface = config.method.transmittance.interface
    assert config.method.loss.specular == 0
    assert interface.specular == config.method.materials.specular
    assert interface.floor < 0.05


@pytest.mark.parametrize("method", ["envgs", "rtgs", "rtgs_printed"])
def test_the_papers_preset_judges_no_scene_matte(method: str):
    config, _ = composed(f"method={method}", "preset=paper")
    assert config.method.reflection.matte.probation == 0


def sweep(experiment: str) -> dict[str, list[str]]:
    content = yaml.safe_load((conf_dir() / "experiment" / f"{experiment}.yaml").read_text())
    return {key: str(value).split(",") for key, value in content["hydra"]["sweeper"]["params"].items()}


def test_the_split_sum_figure_has_the_weight_unbounded_and_with_both_bounds():
    gains = [
        composed("method=rtgs", "preset=quick", f"ablation={name}")[0].method.optics
        for name in sweep("fig_split_sum")["ablation"]
    ]
    assert {optics.max_gain for optics in gains if optics.weight == "microfacet"} == {0.0, 1.0, 16.0}
    assert [optics.weight for optics in gains].count("split_sum") == 1


def test_tables_show_the_paper_beside_ours():
    assert {"rtgs_printed", "rtgs"} <= set(sweep("table2")["method"])
    third = sweep("table3")
    assert third["method"] == ["rtgs_printed", "rtgs"]
    assert third["ablation"][0] == "none"
    assert len(third["ablation"]) == 5
    config, _ = compose(["experiment=table3"])
    assert list(config.table.blocks) == third["method"]
