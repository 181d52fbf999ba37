"""Recipes of many runs, and the digests that golden_recipes.json holds of them: old stores must still be read.

``python tests/config/recipes.py`` writes the file anew. Do so only when a recipe is meant to change.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from unittest.mock import patch

import yaml

from pipelines.planning.graph import build_graph
from pipelines.planning.inspection import Inspections
from rtgs.config.locate import choices_of, conf_dir
from rtgs.config.sweep import ComposedJob, compose_jobs
from rtgs.methods import find_method
from rtgs.workflow.plan import topological

GOLDEN = Path(__file__).with_name("golden_recipes.json")
TRAINED = tuple(name for name in choices_of("method") if not find_method(name).elsewhere)
PUBLISHED_ELSEWHERE = {"3dgs_dr", "gaussian_shader", "ref_gaussian", "ref_gs", "envgs"}  # with code of their authors
SCENES = ("ball_statue", "toycar", "matte_room")
STAND_INS = {"ref_real/sedan": "sedan", "ref_real/gardenspheres": "spheres", "ref_real/toycar": "toycar"}
SHIPPED = [f"scene.{key}" for key in ("format=auto", "images_dir=null", "model_dir=null", "resize_ratio=null")]
TOLD_IN_FULL = ("ball_statue rtgs smoke none", "toycar envgs paper none")

# Words beside scene, method and preset. They set keys in every room, defaults and values of YAML files among them.
OVERRIDES = (
    ("rtgs", "seed=3"),
    ("rtgs", "seed=3 schedule.total=333 scene.long_side=120"),
    ("rtgs", "method.optics.blend=srgb method.transmittance.wall.light=learned method.loss.clipped=false"),
    ("rtgs", "method.transmittance.wall.bounces=2 method.transmittance.wall.index_rate=0.01"),
    ("rtgs", "method.transmittance.wall.tint_rate=0.001 method.transmittance.wall.tint=[0.9,0.9,1.0]"),
    ("rtgs", "method.transmittance.wall.roughness=0.03 method.transmittance.rim_samples=16"),
    ("rtgs", "method.optics.fresnel=conductor method.optics.edge_tint=0.8"),
    ("rtgs", "mesh.object.surface.fit=carved method.transmittance.normal=base"),
    ("rtgs", "method.optimizer.decay_from=1.0 method.init.orientation=published"),
    ("rtgs", "method.optics.weight=literal method.optics.remap=none method.optics.masking=separable"),
    ("rtgs", "method.transmittance.interface.normal_hold=0.0"),
    ("rtgs", "method.transmittance.interface.normal_hold=5.0 method.transmittance.interface.normal_loss=0.2"),
    ("rtgs", "method.transmittance.max_gain=null method.transmittance.interface.count=0"),
    ("rtgs", "method.transmittance.enabled=false method.loss.specular=0.1"),
    ("rtgs", "method.loss.specular_start=0.35 method.loss.perceptual=0.02 method.loss.perceptual_form=vgg16_l1"),
    ("rtgs", "method.loss.transmission_depth_form=mean method.transmittance.compositing=sum"),
    ("rtgs", "method.reflection.direction_gradient=last_sh method.reflection.sh_direction=raw"),
    ("rtgs", "method.reflection.init_color=bright method.reflection.background=mean"),
    ("rtgs", "method.materials.specular=0.1 method.materials.roughness_curve=linear method.materials.f0_channels=3"),
    ("rtgs", "method.optimizer.specular_logits=0.01 method.optimizer.sh_dc=0.003"),
    ("rtgs", "masks=none normals=none"),
    ("rtgs", "mesh.source=tsdf mesh.of=scene mesh.object.flat=yes mesh.tsdf.max_blocks=5000"),
    ("rtgs", "mesh.source=hull mesh.object.hull.voxels=64 mesh.object.pane.agree=0.5"),
    ("rtgs", "judge=photos"),
    ("rtgs", "judge.plain=2dgs judge.every=6 schedule.total=333 method.density.max_surfels=500"),
    ("rtgs", "scene.hold_out=5"),
    ("rtgs", "method.appearance.enabled=true"),
    ("envgs", "method.optics.blend=linear method.optics.weight=split_sum"),
    ("envgs", "method.transmittance.interface.normal_hold=5.0 method.transmittance.first_surface=base"),
    ("envgs", "method.reflection.density.strategy=mcmc method.density.strategy=mcmc"),
    ("envgs", "method.loss.specular=0.2 method.loss.perceptual_start=0.4 method.loss.perceptual_crop=48"),
    ("2dgs", "mesh.extract=true mesh.only_masked=true mesh.depth_ratio=1.0"),
    ("2dgs", "method.loss.mono_normal=0.01 method.loss.mono_normal_form=envgs evaluation.lpips=false"),
    ("2dgs", "method.materials.specular=0.2 method.optics.blend=linear method.loss.specular=0.2"),
    ("2dgs", "method.density.max_per_pixel=0.3 method.init.random_points=500 method.render.depth_ratio=1.0"),
    ("2dgs", "method.appearance.enabled=true method.poses.enabled=true"),
    ("2dgs", "evaluation.refined_poses=always evaluation.refine_steps=20"),
    ("3dgs", "method.render.antialiased=true method.render.dilation=0.1 scene.split_every=5"),
    ("3dgs", "method.render.smoothing=0.2 evaluation.supersample=2"),
    ("2dgs", "method.render.surfel_filter=convolved method.render.low_pass=0.1"),
    ("3dgs", "judge=photos"),
    ("3dgs", "method.density.strategy=mcmc method.density.mcmc.growth=0.1"),
)


def about_ablation(name: str) -> dict:
    """What the file of an ablation says of itself: ``why``, ``needs``, ``idle_with``."""
    return yaml.safe_load((conf_dir() / "ablation" / f"{name}.yaml").read_text())["ablation"]


def fitting(method: str, preset: str = "") -> list[str]:
    """The ablations that are for the method, and with a preset for this one, ``none`` first."""
    found = ["none"]
    for name in choices_of("ablation"):
        about = about_ablation(name)
        if name != "none" and set(about.get("needs", ())) <= find_method(method).has:
            found += [name] if preset not in about.get("idle_with", ()) else []
    return found


def presets_of(method: str) -> list[str]:
    """Every preset but those of scenes of a kind for which the method has no schedule."""
    own = choices_of("method_in_preset")
    return [name for name in choices_of("preset") if not name.startswith("paper_") or f"{name}_{method}" in own]


def flat_leaves(values: dict, *before: str) -> Iterator[tuple[str, object]]:
    """Dotted keys and values of a file of ``conf/``, without what it says about itself."""
    for key, value in values.items():
        if isinstance(value, dict) and key != "ablation":
            yield from flat_leaves(value, *before, key)
        elif key != "ablation":
            yield ".".join((*before, key)), value


def recipes(method: str) -> Iterator[tuple[str, list[str]]]:
    """Runs of a method: each in words, and ``step fingerprint`` of all its steps but the report, upstream first.

    Ablations go with the published preset, or with quick where that has nothing to take away, every preset with none,
    and where a scene has published numbers of its own, it with them (``scene=sedan envgs ...``). A report states every
    value with its default: it is made in seconds, and its recipe may change.
    """
    paths = ",".join(f"embedded:{scene}" for scene in SCENES)  # as a value, for files are composed once for all three
    inspections = Inspections()
    with patch("rtgs.pretrained.weights.weight_folders", tuple):  # a machine without networks
        idle = [name for name in fitting(method) if name not in fitting(method, "paper")]
        chosen = [("paper", fitting(method, "paper")), ("smoke,quick,standard", ["none"])]
        chosen += [(preset, ["none"]) for preset in presets_of(method) if preset.startswith("paper_")]
        for presets, ablations in [*chosen, ("quick", idle)] if idle else chosen:
            files = [f"method={method}", f"preset={presets}", f"ablation={','.join(ablations)}"]
            for job in _jobs(["scene=ball_statue", *files, f"scene.path={paths}"]):
                assert job.config is not None
                assert job.choices is not None
                scene = job.config.scene.path.split(":")[1]
                yield f"{scene} {method} {job.choices.preset} {job.choices.ablation}", steps_of(job, inspections)
        for scene in scenes_of(method):
            path = f"scene.path=embedded:{STAND_INS.get(scene, scene)}"  # the papers' captures are not shipped
            (job,) = _jobs([f"scene={scene}", f"method={method}", "preset=paper", path, *SHIPPED])
            yield f"scene={scene} {method} paper none", steps_of(job, inspections)
        for words in (words for of, words in OVERRIDES if of == method):
            (job,) = _jobs(["scene=ball_statue", f"method={method}", "preset=smoke", *words.split()])
            yield f"ball_statue {method} smoke {words}", steps_of(job, inspections)


def scenes_of(method: str) -> list[str]:
    """The scenes for which the method has published numbers of their own."""
    folder = conf_dir() / "method_on_scene" / "paper" / method
    return sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))


def _jobs(words: Sequence[str]) -> tuple[ComposedJob, ...]:
    return compose_jobs(words, multirun=True)[0]


def steps_of(job: ComposedJob, inspections: Inspections) -> list[str]:
    """``step fingerprint`` of the steps of a run, upstream first."""
    assert job.config is not None, job.problem
    assert job.choices is not None
    steps = topological(build_graph(job.config, job.choices, inspections).targets)
    return [f"{step.name} {step.fingerprint}" for step in steps if step.name != "report"]


def digest(steps: Sequence[str]) -> str:
    """16 digits for all the steps of a run."""
    return hashlib.sha256("\n".join(steps).encode()).hexdigest()[:16]


def main() -> None:
    """Write golden_recipes.json."""
    found = {words: steps for method in TRAINED for words, steps in recipes(method)}
    told = {words: found[words] for words in TOLD_IN_FULL}
    content = {"in full": told, "digests": {words: digest(steps) for words, steps in found.items()}}
    GOLDEN.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
