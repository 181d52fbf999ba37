"""Exposure and tint of each training photo: found again where they are known, unseen by test views."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from photo_cases import grey_photos, photographed, plain, steady, trained
from safetensors.torch import load_file
from training_cases import small_scene, small_trainer

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.evaluate.metrics import cc_psnr
from rtgs.gaussians.ply import write_ply
from rtgs.methods import Mode, create_method
from rtgs.methods.parts.exposure import Exposure, as_photographed, exposed, nearest_photos, rows_by_name
from rtgs.methods.photo_settings import AppearanceSettings
from rtgs.scenes.scene import Scene, View
from rtgs.train.checkpoint import checkpoint_path
from rtgs.train.guard import TrainingDiverged
from rtgs.train.seeds import generator_for
from rtgs.train.trainer import Trainer

FAST = AppearanceSettings(enabled=True, rate=0.05, rate_end=5e-4)
TOTAL = 300


def exposed_scene(scene: Scene) -> tuple[Scene, torch.Tensor]:
    """The training photos at other exposures, and the stops."""
    stops = torch.linspace(-0.4, 0.4, len(scene.train))
    stops = stops[torch.randperm(len(stops), generator=torch.Generator().manual_seed(0))]
    views = (replace(view, image=view.image * 2**each) for view, each in zip(scene.train, stops, strict=True))
    return replace(scene, train=tuple(views)), stops


def test_known_exposures_are_found_again_and_the_test_view_gains():
    scene, stops = exposed_scene(photographed("3dgs"))
    _, without = trained(scene, plain("3dgs"), TOTAL)
    trainer, summary = trained(scene, replace(plain("3dgs"), appearance=FAST), TOTAL)
    (group,) = trainer.method.groups
    assert float((group["stops"].detach() - stops).abs().max()) < 0.05  # type: ignore[index]
    assert summary.psnr_test is not None
    assert without.psnr_test is not None
    assert summary.psnr_test > without.psnr_test + 0.8
    assert any("stops" in decision.why for decision in summary.decisions)


def test_brightness_is_that_of_the_stops_alone():
    grey, generator = torch.full((3, 4, 5), 0.4), torch.Generator().manual_seed(2)
    colors = 0.2 * torch.randn(3, 3, generator=generator)
    assert torch.equal(exposed(grey, torch.zeros(()), torch.zeros(3, 3)), grey)
    brighter = exposed(grey, torch.tensor(0.5), colors)
    assert float(brighter.mean()) == pytest.approx(0.4 * 2**0.5, rel=1e-6)
    assert float(brighter.std(0).mean()) > 0.01


def test_cameras_that_are_no_view_of_the_scene_are_shown_without():
    scene, _ = exposed_scene(photographed("2dgs", views=5))
    trainer, _ = trained(scene, replace(plain("2dgs"), appearance=FAST), 60)
    first = scene.train[0].camera
    stranger = replace(first, name="nobody")
    shown, bare = (trainer.method.render(camera, 60, Mode.EVALUATE).image for camera in (first, stranger))
    group = trainer.method.groups[0]
    torch.testing.assert_close(shown, exposed(bare, group["stops"][0], group["colors"][0]))  # type: ignore[index]
    assert not torch.allclose(shown, bare, atol=1e-3)


def smooth(scene: Scene) -> Scene:
    """All photos, the test view's too, exposed by where they were taken from: up to half a stop apart."""

    def at(view: View) -> View:
        angle = math.atan2(float(view.camera.center[0]), float(view.camera.center[2]))
        return replace(view, image=view.image * 2 ** (0.25 * math.sin(angle)))

    train, test = (tuple(map(at, each)) for each in (scene.train, scene.test))
    return replace(scene, train=train, test=test)


def exposure_of(trainer: Trainer) -> Exposure:
    part = trainer.method.parts["exposure"]  # type: ignore[attr-defined]
    assert isinstance(part, Exposure)
    return part


def test_a_test_view_takes_the_exposure_of_the_photos_nearest_to_it():
    scene = smooth(photographed("2dgs"))
    trainer, summary = trained(scene, replace(plain("2dgs"), appearance=FAST), TOTAL)
    (test,) = scene.test
    part = exposure_of(trainer)
    rows, weights = nearest_photos(test.camera, scene)
    assert sorted(rows.tolist()) == [0, len(scene.train) - 1]  # on the ring, before and after it
    trust = part.trust()
    assert trust["stops"] > 0.8
    with torch.no_grad():
        shown = trainer.method.render(test.camera, TOTAL, Mode.EVALUATE).image
        bare = trainer.method.render(replace(test.camera, name="nobody"), TOTAL, Mode.EVALUATE).image
        stops, colors = part.group["stops"][rows], part.group["colors"][rows]
        mean = (weights * stops).sum(), (weights[:, None, None] * colors).sum(0)
        expected = exposed(bare, trust["stops"] * mean[0], trust["colors"] * mean[1])
    torch.testing.assert_close(shown, expected)
    error, without = (float((image.clamp(0, 1) - test.image).square().mean()) for image in (shown, bare))
    assert error < without
    assert summary.psnr_test == pytest.approx(-10 * math.log10(error), abs=0.01)


def test_neighbours_are_believed_as_far_as_training_photos_agree_with_theirs():
    scene = photographed("2dgs", views=17)
    trainer = small_trainer(scene, replace(plain("2dgs"), appearance=FAST), steady(20))
    part, camera = exposure_of(trainer), scene.test[0].camera
    count = len(scene.train)

    def shown(of: Camera, stops: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            part.group["stops"].copy_(stops)
            return trainer.method.render(of, 20, Mode.EVALUATE).image

    ring = torch.sin(torch.arange(count) * 2 * math.pi / (count + 1) + 0.5)
    in_turns = 0.3 * (-1.0) ** torch.arange(count)
    bare = shown(replace(camera, name="nobody"), ring)
    assert not torch.equal(shown(camera, ring), bare)
    assert part.trust()["stops"] > 0.9
    assert torch.equal(shown(camera, in_turns), bare)  # each is as far off as can be from those beside it
    assert part.trust() == {"stops": 0.0, "colors": 0.0}
    shown(camera, 0.5 * ring + 0.5 * in_turns)
    assert 0.1 < part.trust()["stops"] < 0.9


def test_nearest_photos_are_weighted_by_distance_and_turn():
    """Of places on a line and turns to the right the nearest two, by hand."""
    scene = photographed("2dgs", views=5)
    first = scene.train[0].camera
    numbers = [(0.0, 0.0), (0.3, 0.1), (0.1, 0.4), (0.9, 0.0)]  # shares of the extent, radians

    def put(far: float, turn: float) -> Camera:
        cosine, sine = math.cos(turn), math.sin(turn)
        turned = torch.tensor([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]]).double() @ first.rotation
        center = first.center + far * scene.extent * torch.tensor([0.0, 1.0, 0.0]).double()
        return replace(first, rotation=turned, translation=-turned @ center)

    views = (replace(view, camera=put(*each)) for view, each in zip(scene.train, numbers, strict=True))
    rows, weights = nearest_photos(put(0.1, 0.1), replace(scene, train=tuple(views)))
    assert rows.tolist() == [0, 1]
    squares = torch.tensor([0.1**2 + 0.1**2, 0.2**2])
    expected = 1 / (squares + 1e-4)
    torch.testing.assert_close(weights, expected / expected.sum(), atol=1e-4, rtol=0)


def test_the_photo_itself_does_not_tell_a_training_view():
    scene = photographed("2dgs", views=5)
    rows, weights = nearest_photos(scene.train[0].camera, scene)
    assert 0 not in rows.tolist()
    assert float(weights.sum()) == pytest.approx(1)


def test_a_view_held_out_for_a_judge_is_told_as_a_test_view_is():
    scene = photographed("2dgs", views=7)
    *kept, last = scene.train
    scene = replace(scene, train=tuple(kept), held=(last,))
    method = create_method(replace(plain("2dgs"), appearance=FAST), scene, steady(20), generator_for(0, "initialise"))
    part = method.parts["exposure"]
    assert isinstance(part, Exposure)
    with torch.no_grad():
        part.group["stops"].fill_(0.25)  # as brightly as its neighbours
        shown, bare = (
            method.render(camera, 20, Mode.EVALUATE).image
            for camera in (last.camera, replace(last.camera, name="nobody"))
        )
    torch.testing.assert_close(shown, 2**0.25 * bare)


def test_a_border_below_zero_is_refused():
    with pytest.raises(RtgsError, match=r"method\.appearance\.learn_above"):
        AppearanceSettings(learn_above=-0.1)


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_exposures_are_learned_where_photos_differ(spread: float):
    scene = grey_photos([0.0, spread, -spread, spread, 0.0, -spread])
    asked = replace(plain("3dgs"), appearance=AppearanceSettings(learn_above=0.15))
    method = create_method(asked, scene, steady(20), generator_for(0, "initialise"))
    assert ("exposure" in method.parts) == (spread > 0)
    what = "exposures of photos differ" if spread > 0 else "no exposures learned"
    (told,) = (each for each in method.decisions if each.what == what)
    assert "method.appearance.learn_above is 0.15" in told.why


def test_nothing_is_compared_where_it_is_not_asked_for():
    scene, _ = exposed_scene(photographed("3dgs", views=7))
    assert as_photographed(plain("3dgs"), scene) == (plain("3dgs"), ())
    asked = replace(plain("3dgs"), appearance=replace(FAST, learn_above=0.01))
    assert as_photographed(asked, scene) == (asked, ())  # learned anyway


@pytest.mark.parametrize("why", ["names do not tell", "too few points"])
def test_why_exposures_that_differ_are_not_learned(why: str):
    scene = grey_photos([-0.3, 0.0, 0.3, 0.3, -0.3, 0.0])
    if why == "too few points":
        scene = replace(scene, random_points=True)
    else:
        first, second, *others = scene.train
        twin = replace(second, camera=replace(second.camera, name=first.camera.name))
        scene = replace(scene, train=(first, twin, *others))
    asked = replace(plain("3dgs"), appearance=AppearanceSettings(learn_above=0.01))
    settings, (told,) = as_photographed(asked, scene)
    assert settings == asked
    assert told.what == "no exposures learned"
    assert why in told.why


def test_the_means_over_the_photos_are_held():
    """Photos that are all brighter are a brighter scene, and no exposures."""
    scene = photographed("3dgs", views=6)
    brighter = replace(scene, train=tuple(replace(view, image=view.image * 1.3) for view in scene.train))
    means = {}
    for weight in (0.0, 1.0):
        settings = replace(FAST, mean_exposure=weight, mean_color=weight)
        trainer, _ = trained(brighter, replace(plain("3dgs"), appearance=settings), 150)
        means[weight] = abs(float(trainer.method.groups[0]["stops"].detach().mean()))  # type: ignore[index]
    assert means[1.0] < 0.02
    assert means[0.0] > 3 * means[1.0]


def test_the_penalties_are_sums_over_all_numbers():
    scene = photographed("3dgs", views=3)
    method = create_method(replace(plain("3dgs"), appearance=FAST), scene, steady(20), generator_for(0, "initialise"))
    group = next(group for group in method.groups if group.name == "exposure")
    with torch.no_grad():
        group["stops"].fill_(0.5)
        group["colors"].fill_(0.2)
    view = scene.train[0]
    terms = method.losses(method.render(view.camera, 0, Mode.TRAIN), view, 0).terms
    found = {term.name: float(term.value) for term in terms}
    assert found["exposure"] == pytest.approx(0.5 - 0.05)  # beyond beta = .1: |x| - beta / 2
    assert found["tint"] == pytest.approx(9 * (0.2 - 0.05))


@pytest.mark.parametrize("what", ["appearance", "poses"])
def test_a_run_that_stops_goes_on_bit_for_bit(tmp_path: Path, what: str):
    from rtgs.methods.photo_settings import PoseSettings

    scene, _ = exposed_scene(photographed("2dgs", views=5))
    learned = FAST if what == "appearance" else PoseSettings(enabled=True, rate=1e-3, rate_end=1e-5)
    settings = replace(plain("2dgs"), **{what: learned})
    straight, halted = tmp_path / "straight", tmp_path / "halted"
    small_trainer(scene, settings, steady(40), checkpoint_dir=straight).run()
    trainer = small_trainer(scene, settings, steady(40), checkpoint_dir=halted)
    after_step = trainer.method.after_step

    def interrupted(step: int, observations):
        if step == 36:
            raise KeyboardInterrupt
        return after_step(step, observations)

    trainer.method.after_step = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert small_trainer(scene, settings, steady(40), checkpoint_dir=halted).run().resumed_from == 30
    one, other = (load_file(checkpoint_path(folder, 40) / "state.safetensors") for folder in (straight, halted))
    key = "method.exposure.values.stops" if what == "appearance" else "method.poses.values.deltas"
    assert bool(one[key].any())
    assert one.keys() == other.keys()
    assert [name for name in one if not torch.equal(one[name], other[name])] == []


def test_the_published_model_holds_the_gaussians_alone(tmp_path: Path):
    scene, _ = exposed_scene(photographed("2dgs", views=5))
    trainer, _ = trained(scene, replace(plain("2dgs"), appearance=FAST), 30)
    bare, _ = trained(scene, plain("2dgs"), 30)
    headers = []
    for number, each in enumerate((trainer, bare)):
        (part,) = each.method.sets
        path = tmp_path / f"{number}.ply"
        write_ply(path, part.gaussians)  # type: ignore[attr-defined]
        headers.append(path.read_bytes().split(b"end_header")[0])
    assert headers[0] == headers[1]


def test_a_number_that_is_not_one_stops_the_training_and_is_named():
    scene = photographed("2dgs", views=5)
    trainer = small_trainer(scene, replace(plain("2dgs"), appearance=FAST), steady(20))
    with torch.no_grad():
        trainer.method.groups[0]["stops"][2] = torch.nan  # type: ignore[index]
    with pytest.raises(TrainingDiverged, match=r"set exposure, stops: 1 rows not finite \(row 2"):
        trainer.run()


def test_photos_that_cannot_be_told_apart_are_refused():
    with pytest.raises(RtgsError, match=r"method\.appearance\.enabled learns something of each photo"):
        small_trainer(small_scene(), replace(plain("2dgs"), appearance=FAST))  # cameras without names
    scene = photographed("2dgs", views=4)
    clash = replace(scene, test=(replace(scene.test[0], camera=scene.train[0].camera),))
    with pytest.raises(RtgsError, match="not all their own"):
        rows_by_name(clash, "key")


def test_switched_off_nothing_is_there():
    trainer = small_trainer(small_scene(), plain("2dgs"))
    assert trainer.method.groups == ()
    assert set(trainer.method.parts) == {"base"}


def test_a_colour_fit_undoes_gain_and_offset_of_each_channel():
    generator = torch.Generator().manual_seed(3)
    photo = 0.2 + 0.5 * torch.rand(3, 12, 16, generator=generator)
    gain, offset = torch.tensor([0.8, 1.1, 1.2]), torch.tensor([0.1, -0.05, 0.02])
    render = gain[:, None, None] * photo + offset[:, None, None]
    assert cc_psnr(render, photo) > 90
    assert cc_psnr(photo, photo) == pytest.approx(100)
    flat = torch.full_like(photo, 0.5)
    assert cc_psnr(flat, photo) == pytest.approx(
        -10 * float(torch.log10((photo.mean((1, 2), keepdim=True) - photo).square().mean())), abs=1.0
    )  # nothing to fit: the render stays, up to its mean
