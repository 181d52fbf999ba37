"""Pseudo views in a training: visited like photos, told apart from them, and paid for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from training_cases import look_at_origin, named, pattern, small_method, small_scene, small_schedule

from rtgs.methods import create_method
from rtgs.methods.parts.exposure import Exposure
from rtgs.methods.photo_settings import AppearanceSettings
from rtgs.scenes.scene import Scene, View
from rtgs.train.checkpoint import CheckpointError, scene_digest
from rtgs.train.clock import ElapsedTime
from rtgs.train.method import Mode
from rtgs.train.resolution import GrowingViews
from rtgs.train.seeds import generator_for
from rtgs.train.trainer import Trainer

TOTAL = 40


def taught(visits: int = 3) -> Scene:
    """Five photos and pseudo views from around them."""
    cameras = [replace(look_at_origin(0.4 + 0.7 * index), name=f"pseudo view {index}") for index in range(visits)]
    views = tuple(View(camera, pattern(camera), None, None, camera.name) for camera in cameras)
    return replace(named(small_scene()), pseudo=views)


def trainer(
    scene: Scene, folder: Path | None = None, spent: ElapsedTime | None = None, total: int = TOTAL, **method
) -> Trainer:
    schedule = small_schedule(total)
    made = create_method(replace(small_method(), **method), scene, schedule, generator_for(0, "initialise"))
    return Trainer(made, scene, seed=0, checkpoint_dir=folder, spent=spent)


def visits_of(each: Trainer) -> list[str]:
    """The names of the views that its steps are trained on, in order."""
    visited, losses = [], each.method.losses

    def observed(rendered, view, step):
        visited.append(view.name)
        return losses(rendered, view, step)

    each.method.losses = observed  # type: ignore[method-assign]
    each.run()
    return visited


def test_every_epoch_visits_photos_and_pseudo_views_once_each():
    scene = taught()
    visited = visits_of(trainer(scene))
    every = sorted(view.name for view in (*scene.train, *scene.pseudo))
    assert len(every) == 8
    assert [sorted(visited[start : start + 8]) for start in range(0, TOTAL, 8)] == [every] * (TOTAL // 8)


def test_a_picture_that_is_listed_twice_is_visited_twice():
    scene = taught(1)
    visited = visits_of(trainer(replace(scene, pseudo=scene.pseudo * 3)))
    assert visited[:8].count("pseudo view 0") == 3


def test_a_picture_that_is_listed_twice_is_shrunk_once():
    view = replace(taught(1).pseudo[0], image=torch.rand(3, 128, 160))
    view = replace(view, camera=view.camera.resized(160, 128))
    coarse = small_schedule(TOTAL, coarse=2, coarse_until=1)
    growing = GrowingViews((view, view, replace(view, name="another")), coarse)
    assert growing.factor(0) == 2
    first, again, other = (growing.at(index, 0) for index in range(3))
    assert first is again
    assert other.name == "another"
    assert first.image.shape == other.image.shape == (3, 64, 80)


def test_what_the_models_cost_counts_once_also_after_a_kill(tmp_path: Path):
    spent = ElapsedTime(1000.0, 3000.0)
    first = trainer(taught(), tmp_path, spent).run()
    assert 1000 < first.seconds < 1500
    assert 3000 < first.cpu_seconds < 3500
    again = trainer(taught(), tmp_path, spent).run()
    assert again.resumed_from == TOTAL
    assert 1000 < again.seconds < 1500
    assert trainer(taught()).run().seconds < 500


def test_a_checkpoint_of_other_pseudo_views_is_refused(tmp_path: Path):
    scene = taught()
    trainer(scene, tmp_path).run()
    other = replace(scene.pseudo[0], image=1 - scene.pseudo[0].image)
    for changed in (replace(scene, pseudo=()), replace(scene, pseudo=(other, *scene.pseudo[1:]))):
        with pytest.raises(CheckpointError, match="scene"):
            trainer(changed, tmp_path).run()


def test_a_scene_without_has_the_digest_that_it_had():
    scene = small_scene()
    assert (
        scene_digest(replace(scene, pseudo=()))
        == scene_digest(scene)
        != scene_digest(replace(scene, pseudo=scene.test))
    )


def test_no_exposure_is_learned_of_a_pseudo_view():
    each = trainer(taught(), appearance=AppearanceSettings(enabled=True))
    exposure = each.method.parts["exposure"]
    assert isinstance(exposure, Exposure)
    assert len(exposure.group["stops"]) == 5
    with torch.no_grad():
        exposure.group["stops"].fill_(1.0)
    scene, step = each.scene, 10
    photo, pseudo = scene.train[0], scene.pseudo[0]
    same_place = replace(pseudo.camera, rotation=photo.camera.rotation, translation=photo.camera.translation)
    shown = [each.method.render(camera, step, Mode.EVALUATE).image for camera in (photo.camera, same_place)]
    assert torch.allclose(shown[0], 2 * shown[1], atol=1e-5)


def test_training_on_pictures_of_the_scene_helps_where_no_photo_is():
    """Two photos and the truth from six other places, against the photos alone."""
    scene = taught(6)
    few = replace(scene, train=scene.train[:2])
    quality = []
    for each in (few, replace(few, pseudo=())):
        summary = trainer(each, total=300).run()
        assert summary.psnr_test is not None
        quality.append(summary.psnr_test)
    assert quality[0] > quality[1] + 0.5


def test_state_is_that_of_a_photo_training(tmp_path: Path):
    """Nothing of pseudo views is stored in a checkpoint beside the order of the views."""
    states = [trainer(scene).checkpoint().tensors for scene in (taught(), replace(taught(), pseudo=()))]
    assert states[0].keys() == states[1].keys()
    assert (len(states[0]["views.permutation"]), len(states[1]["views.permutation"])) == (8, 5)
